"""Summarize how a flight ended: its contact offset, its touchdown speed, and the errors of latency
and mounting that it has shown. No simulator is required."""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.mission.belief.belief import GearToTargetDistance
from perchctl.mission.belief.contact import MOTORS_OFF_AS_COMMANDED, current_gear_to_target
from perchctl.mission.context import Context
from perchctl.mission.observation import Observation
from perchctl.mission.phase import Outcome, Phase, VehicleDiagnosis
from perchctl.mission.records import Event
from perchctl.mission.rest import RestState, find_rest_state
from perchctl.mission.state import PlannerState
from perchctl.mission.table import TABLE
from perchctl.profile import CameraConfig, Profile
from perchctl.values import replace
from perchctl.vehicle import LOCKED
from perchctl.vision import CameraCalibrationErrors

MIN_HARD_TOUCHDOWN_SPEED_MPS = 0.6
"""Touchdown speed above which a landing is hard, m/s; no normal descent is faster."""
MAX_TIME_BEFORE_MOTOR_STOP_TO_COUNT_AS_TOUCHDOWN_S = 5.0
"""Longest time from a touchdown to the stop of the motors, s; an earlier impact was not the
floor."""
MAX_HEIGHT_ABOVE_FINAL_POSITION_TO_COUNT_AS_TOUCHDOWN_M = 0.3
"""Largest height of an impact above the final position for it to be a touchdown, m."""
SIGMAS_FOR_95_PERCENT_INTERVAL = 1.96
"""Half width of a 95 % interval, in standard deviations."""
MIN_LATENCY_ERROR_TO_GIVE_ADVICE_S = 0.02
"""Latency error above which the report gives advice, s: an error of 30 ms makes the alignment
oscillate by centimetres."""
MIN_ROTATION_ERROR_TO_GIVE_ADVICE_DEG = 2.0
"""Rotation error above which the report gives advice, deg: 2 deg are 35 mm at 1 m, more than the
cone of an ascent allows."""


def find_transition_diagnosis(transition_name: str) -> VehicleDiagnosis:
    """Return the diagnosis of the built-in transition called `transition_name`; logs store that
    name. Return `NONE` for any other name, such as that of a transition of your own."""
    return next(
        (row.diagnosis for row in TABLE if row.name == transition_name), VehicleDiagnosis.NONE
    )


@dataclass(frozen=True)
class Touchdown:
    """Downward speed just before the touchdown, m/s, at least 0, and the largest specific force
    along the body's z axis during it, g. Samples come every 10 ms, so the true peak may be
    higher."""

    speed_mps: float
    peak_g: float

    @property
    def is_hard(self) -> bool:
        """True if the vehicle touched down faster than `MIN_HARD_TOUCHDOWN_SPEED_MPS`."""
        return self.speed_mps > MIN_HARD_TOUCHDOWN_SPEED_MPS

    @property
    def text(self) -> str:
        """The touchdown in words, for example ``touched down hard: 1.4 m/s, 3.2 g``."""
        how = "touched down hard" if self.is_hard else "touched down"
        return f"{how}: {self.speed_mps:.1f} m/s, {self.peak_g:.1f} g"


@dataclass(frozen=True)
class CameraFindings:
    """Estimates of a flight's camera: its total latency, s, and the rotation of its mounting
    relative to the profile about body x, y and z, degrees, positive by the right-hand rule, each
    with one standard deviation. `advice` has one sentence for each value in the profile that should
    be corrected. It is empty if the profile fits, and for a simulated vehicle."""

    measured_latency_s: float
    latency_sigma_s: float
    mount_rotation_relative_to_profile_xyz_deg: tuple[float, float, float]
    mount_rotation_sigma_xyz_deg: tuple[float, float, float]
    advice: tuple[str, ...] = ()

    @classmethod
    def from_camera_errors(
        cls,
        camera_errors: CameraCalibrationErrors,
        camera: CameraConfig,
        *,
        simulated: bool = False,
    ) -> CameraFindings:
        """Return the findings from a flight's estimates `camera_errors`, with `camera` as in the
        profile. There is advice on each error above its limit
        (`MIN_LATENCY_ERROR_TO_GIVE_ADVICE_S`, `MIN_ROTATION_ERROR_TO_GIVE_ADVICE_DEG`) that is also
        larger than the full width of its 95 % interval, but none on a latency that the profile
        leaves to be measured, and none at all if the flight was `simulated`."""
        latency_s = camera.start_latency_s + camera_errors.latency_above_profile_s
        x, y, z = (math.degrees(turn) for turn in camera_errors.mount_rotation_from_profile_xyz_rad)
        sx, sy, sz = (math.degrees(sigma) for sigma in camera_errors.mount_rotation_sigma_xyz_rad)
        found, advice = cls(latency_s, camera_errors.latency_sigma_s, (x, y, z), (sx, sy, sz)), []
        if simulated:
            return found
        set_here = not isinstance(camera.latency_s, str)  # otherwise the measured latency is used
        if set_here and _is_significant(
            camera_errors.latency_above_profile_s,
            MIN_LATENCY_ERROR_TO_GIVE_ADVICE_S,
            camera_errors.latency_sigma_s,
        ):
            advice.append(
                f"the latency is {found.latency_text}, not {camera.start_latency_s * 1e3:.0f} ms "
                f"as in the profile: set camera.latency_s to {max(0.0, latency_s):.3f}"
            )
        turns = zip(
            found.mount_rotation_relative_to_profile_xyz_deg,
            found.mount_rotation_sigma_xyz_deg,
            strict=True,
        )
        if any(
            _is_significant(turn, MIN_ROTATION_ERROR_TO_GIVE_ADVICE_DEG, sigma)
            for turn, sigma in turns
        ):
            advice.append(
                f"the camera is rotated by {found.rotation_text} relative to the profile: measure "
                f"the mounting with `perchctl calibrate mount`"
            )
        return replace(found, advice=tuple(advice))

    @property
    def latency_text(self) -> str:
        """The latency with its 95 % interval, for example ``92 +- 6 ms``."""
        margin_s = SIGMAS_FOR_95_PERCENT_INTERVAL * self.latency_sigma_s
        return f"{self.measured_latency_s * 1e3:.0f} +- {margin_s * 1e3:.0f} ms"

    @property
    def rotation_text(self) -> str:
        """The rotation about x, y and z with 95 % intervals, for example ``0.2 +- 0.6, -0.1 +- 0.6,
        0.4 +- 1.8 deg``."""
        each = zip(
            self.mount_rotation_relative_to_profile_xyz_deg,
            self.mount_rotation_sigma_xyz_deg,
            strict=True,
        )
        return (
            ", ".join(
                f"{turn:.1f} +- {SIGMAS_FOR_95_PERCENT_INTERVAL * sigma:.1f}"
                for turn, sigma in each
            )
            + " deg"
        )


def _is_significant(difference: float, threshold: float, sigma: float) -> bool:
    """True if the magnitude of the difference exceeds both the threshold and 3.92 `sigma`, the full
    width of its 95 % interval. All three have the same unit."""
    return abs(difference) > max(threshold, 2.0 * SIGMAS_FOR_95_PERCENT_INTERVAL * sigma)


@dataclass(frozen=True)
class HoverReport:
    """Duration of a hover below the target, s, the intended distance of the gear below the target,
    m, and the RMS errors as the camera measured them (`HoverErrorAccumulator`): x forward, y left
    and z up in the level frame, m, and heading, rad."""

    duration_s: float
    hover_distance_below_target_m: float
    gear_to_hover_position_rms_xyz_m: tuple[float, float, float]
    yaw_error_rms_rad: float

    @classmethod
    def from_state(cls, state: PlannerState, profile: Profile) -> HoverReport | None:
        """Return the report of the newest hover; None if the mission has no hover, or if no frame
        of the hover measured the target."""
        hover, errors = profile.planner.hover, state.hover_errors
        if hover is None or not errors.frame_count:
            return None
        x_m, y_m, z_m, yaw_rad = errors.rms_level_xyz_m_yaw_rad
        return cls(errors.duration_s, hover.below_m, (x_m, y_m, z_m), yaw_rad)

    @property
    def text(self) -> str:
        """The report in words, for example ``20.0 s; RMS error x 4.1, y 3.0, z 6.2 mm, heading 0.8
        deg``."""
        x, y, z = (f"{1e3 * each:.1f}" for each in self.gear_to_hover_position_rms_xyz_m)
        yaw = f"{math.degrees(self.yaw_error_rms_rad):.1f}"
        return f"{self.duration_s:.1f} s; RMS error x {x}, y {y}, z {z} mm, heading {yaw} deg"


@dataclass(frozen=True)
class FlightReport:
    """How a flight ended: its last phase, outcome and reason, the number of attempts that failed or
    succeeded, the duration, s, whether the firmware's supervisor has locked the vehicle, and the
    events of the flight (`history`). Findings about the camera, the horizontal distance between
    gear and target of a hanging vehicle, the touchdown and the newest hover follow, each None if it
    is unknown or does not apply. `detached_watcher_messages` has one sentence for each observer of
    the flight (log, panel or callback) that raised an exception and was not called again."""

    phase: Phase
    outcome: Outcome
    reason: str
    attempts: int
    duration_s: float
    is_locked_by_supervisor: bool
    history: tuple[Event, ...] = ()  # events of the phases, from the start of the flight
    findings: CameraFindings | None = None  # latency and mounting, if the flight was long enough
    gear_to_target_at_last_contact: GearToTargetDistance | None = None  # None unless it is hanging
    touchdown: Touchdown | None = None  # touchdown of a vehicle that reached the floor
    hover: HoverReport | None = None  # the newest hover of a mission that hovers
    # one sentence for each watcher detached after an exception
    detached_watcher_messages: tuple[str, ...] = ()

    @property
    def is_profile_suspect(self) -> bool:
        """True if a row whose diagnosis includes `PROFILE_MAY_BE_WRONG` fired during the flight."""
        return any(
            VehicleDiagnosis.PROFILE_MAY_BE_WRONG in event.diagnosis for event in self.history
        )

    @classmethod
    def from_state(
        cls,
        state: PlannerState,
        obs: Observation,
        profile: Profile,
        history: tuple[Event, ...],
        camera_errors: CameraCalibrationErrors | None,
        *,
        simulated: bool = False,
    ) -> FlightReport:
        """Return the report of a completed mission from its last tick: the final `state` and `obs`,
        the flight's events `history`, and the estimated `camera_errors`, None if the flight was too
        short to estimate them. A `simulated` flight gives no advice about its camera."""
        b = state.belief.with_observation(obs, profile)
        hangs, contact = state.phase is Phase.PERCHED, b.gear_to_target_at_last_contact
        if hangs and contact is None:  # the magnet caught the vehicle during the descent
            contact = current_gear_to_target(b)
        placed = hangs and contact is not None and math.isfinite(contact.sigma_m)
        return cls(
            phase=state.phase,
            outcome=state.outcome or Outcome.SAFETY,
            reason=_flight_end_reason(state, history),
            # If a hanging vehicle is noticed after the last attempt, that attempt was counted as
            # failed.
            attempts=state.failed_attempts
            + int(hangs and state.outcome is not Outcome.ATTEMPTS_USED_UP)
            + int(state.outcome is Outcome.HOVERED),
            duration_s=obs.t_s - state.flight_started_at_s,
            # An emergency stop always locks the vehicle, but the newest telemetry predates it.
            is_locked_by_supervisor=obs.telemetry.has_bit(LOCKED)
            or state.outcome is Outcome.EMERGENCY,
            history=history,
            findings=None
            if camera_errors is None
            else CameraFindings.from_camera_errors(
                camera_errors, profile.camera, simulated=simulated
            ),
            gear_to_target_at_last_contact=contact if placed else None,
            touchdown=find_touchdown(Context(replace(state, belief=b))),
            hover=HoverReport.from_state(state, profile),
        )


@dataclass(frozen=True)
class RestStateReport:
    """Where a vehicle rests once its motors are off (`RestState`: for example on the floor, or
    hanging on the target), and its touchdown if there was one."""

    state: RestState
    touchdown: Touchdown | None = None

    @property
    def text(self) -> str:
        """The rest state in words without a full stop, with the touchdown if it was hard: for
        example ``the vehicle is on the floor with its motors off; it touched down hard: 1.4 m/s,
        3.2 g``."""
        if self.touchdown is None or not self.touchdown.is_hard:
            return self.state.value
        return f"{self.state.value}; it {self.touchdown.text}"


def report_rest_state(
    state: PlannerState, obs: Observation, profile: Profile, min_motors_off_s: float
) -> RestStateReport | None:
    """Return where the vehicle rests (`RestState`), with its touchdown unless the magnet or another
    object holds it; None until telemetry has shown the motors off for `min_motors_off_s`, in
    seconds. `obs` is the newest observation, with which the belief in `state` is updated first."""
    c = Context(replace(state, belief=state.belief.with_observation(obs, profile)))
    if c.true_for_s(MOTORS_OFF_AS_COMMANDED) < min_motors_off_s:
        return None
    found = find_rest_state(c)
    hangs = found in (RestState.HANGS, RestState.HELD)
    return RestStateReport(found, None if hangs else find_touchdown(c))


def find_touchdown(c: Context) -> Touchdown | None:
    """Return the newest impact from below if it may be the touchdown. Return None if the vehicle is
    perched, if the impact was more than `MAX_TIME_BEFORE_MOTOR_STOP_TO_COUNT_AS_TOUCHDOWN_S` before
    the motors stopped (or before now, if they are still turning), or if a valid position shows that
    it was too far above the final position.

    The downward speed, m/s, comes from dead reckoning if that has replaced the state estimate or if
    positions have diverged; otherwise, it comes from the state estimate.
    """
    b = c.belief
    tel, imu, dead_reckoning = c.telemetry, b.imu, b.dead_reckoning
    impact = imu.newest_impact
    if (
        c.state.phase is Phase.PERCHED
        or min(tel.t_s, imu.motors_stopped_at_s) - impact.t_s
        > MAX_TIME_BEFORE_MOTOR_STOP_TO_COUNT_AS_TOUCHDOWN_S
    ):
        return None
    higher = (
        impact.world_z_m - tel.position_m[2]
        > MAX_HEIGHT_ABOVE_FINAL_POSITION_TO_COUNT_AS_TOUCHDOWN_M
    )
    if b.is_position_valid and b.dead_reckoning_began_at_s is None and higher:
        return None
    reckoned = b.dead_reckoning_began_at_s is not None or b.is_position_diverged
    speed_mps = -(
        dead_reckoning.climb_rate_before_newest_impact_mps
        if reckoned
        else impact.estimated_climb_rate_before_impact_mps
    )
    return Touchdown(max(0.0, speed_mps), impact.peak_specific_force_body_z_g)


def _flight_end_reason(state: PlannerState, history: tuple[Event, ...]) -> str:
    why = next((e.reason for e in reversed(history) if e.phase is Phase.LANDING), "")
    told = why and (
        state.phase is not Phase.ABORTED
        or VehicleDiagnosis.LANDING_UNCONFIRMED in state.entry.diagnosis
    )
    return f"{why}; {state.transition_reason}" if told else state.transition_reason
