"""The planner's belief about the vehicle: one frozen value per tick.

`update_belief` computes it once per tick from the previous belief, the observation, the commands
sent so far, and the profile. The belief makes no decisions and does not depend on the mission
phase. Quantities that follow from its fields are properties, computed on first access. Every
estimate has a variance or an age, which is infinite while the estimate is unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from perchctl.geometry import GRAVITY_MPS2, Array
from perchctl.mission.belief.battery import BatteryFitState
from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.lateral_offset import LateralOffsetAndVelocity, LateralOffsetFilter
from perchctl.mission.belief.maneuver import CommandHistory, Maneuver
from perchctl.mission.belief.motion import ZERO_VECTOR, ImuMotion, Vector
from perchctl.mission.belief.mounting import CameraMountingMonitor
from perchctl.mission.belief.reckoning import DeadReckoningState
from perchctl.mission.belief.target import TargetBelief, VisualVelocityFilter
from perchctl.mission.belief.thrust import HoverThrustEstimate
from perchctl.mission.observation import CameraImuMismatch, Observation
from perchctl.profile import Profile
from perchctl.values import cached_property, replace
from perchctl.vehicle import Telemetry

ESTIMATE_SETTLING_TIME_AFTER_POSITIONS_RETURN_S = 0.5
"""Time that the state estimate needs to converge once positions return after a gap, s. Smaller: the
estimate is trusted before it has converged."""
MAX_POSITION_AGE_BEYOND_LATENCY_TO_CORRECT_VELOCITY_S = 0.13
"""Largest age of the newest external position, in addition to the camera's latency, at which it
still corrects the estimated velocity, s: four picture intervals at 30 per second, so three lost
pictures make no difference. Larger: `is_estimate_missing_gust` detects an impact later."""
MIN_LATERAL_SPEED_GAIN_TO_DETECT_GUST_MPS = 0.2
"""Lateral speed, gained without a sighting, above which the cause must be an impact or gust, m/s;
flights without a fault show 0.06 m/s. Larger: an impact goes unnoticed. Smaller: an attitude error
counts as an impact."""
GUST_DETECTION_THRESHOLD_INCREASE_PER_LATENCY_SIGMA_MPS2 = 2.0
"""Increase of `MIN_LATERAL_SPEED_GAIN_TO_DETECT_GUST_MPS`, in m/s per second of the latency's
standard deviation; the increase is necessary because the vehicle oscillates if pictures are 0.1 s
later than assumed. Larger: with an uncertain latency, impacts go unnoticed."""
MAX_COMMAND_TO_REPORTED_THRUST_DELAY_S = 0.2
"""Time within which the telemetry reports a commanded raw thrust, s. Smaller: with late telemetry,
the vehicle seems to ignore the commanded thrust."""


@dataclass(frozen=True)
class GearToTargetDistance:
    """Horizontal distance between the gear and the target's axis, m, and its standard deviation, m,
    which is infinite if the distance is unknown."""

    distance_xy_m: float
    sigma_m: float

    def is_certainly_within(self, radius_m: float) -> bool:
        """True if the distance plus one standard deviation is at most `radius_m`; False while the
        distance is unknown."""
        return self.distance_xy_m + self.sigma_m <= radius_m

    @property
    def text(self) -> str:
        """The distance in words, for example ``1.8 +- 0.6 mm off centre``."""
        if not math.isfinite(self.sigma_m):
            return "at an unknown distance from the centre"
        return f"{1e3 * self.distance_xy_m:.1f} +- {1e3 * self.sigma_m:.1f} mm off centre"


@dataclass(frozen=True, eq=False, kw_only=True)
class Belief:
    """The belief about vehicle and target, together with the evidence for it: reliability of the
    state estimate, dead reckoning, target, contact, hover thrust and battery.

    Times are on the loop's clock. A time is None, or -inf, until the event has happened. Positions
    and velocities are in the world frame of the state estimate.
    """

    obs: Observation  #: newest observation, on which all properties depend
    profile: Profile
    command_history: CommandHistory = field(
        default_factory=lambda: CommandHistory(maneuver=Maneuver())
    )
    t_s: float = 0.0  #: time of the last update
    last_telemetry: Telemetry | None = None  #: newest sample that an update has used

    # --- world frame of the state estimate, and how far to trust it ---
    takeoff_position_m: Vector | None = None  #: position where the flight started
    first_estimate_jump_at_s: float | None = None  #: first jump of the state estimate
    #: shift of the estimate's world frame in this tick
    world_frame_shift_in_tick_m: Vector = ZERO_VECTOR
    position_last_stale_at_s: float | None = None  #: last time at which the position was stale
    #: external positions have led the vehicle away from its setpoint and are no longer evidence
    is_position_diverged: bool = False
    #: heading is so wrong that position control would move the vehicle away from its setpoint
    is_heading_lost: bool = False
    #: time at which the belief switched to accelerometer and attitude alone
    dead_reckoning_began_at_s: float | None = None
    #: height above the ground, integrated since `dead_reckoning_began_at_s`
    dead_reckoned_height_m: float = 0.0

    # --- motion, target and contact ---
    dead_reckoning: DeadReckoningState = field(default_factory=DeadReckoningState)
    #: target's position in world axes, m, in the last frame that measured it
    last_target_position_world_m: Array | None = None
    #: decaying maximum of the target's movement in the world between successive measured frames
    recent_max_target_world_shift_between_pictures_m: float = 0.0
    #: vehicle's velocity from pictures alone
    visual_velocity_filter: VisualVelocityFilter = field(default_factory=VisualVelocityFilter)
    #: Kalman filter of the lateral offset from the target
    lateral_offset_filter: LateralOffsetFilter = field(default_factory=LateralOffsetFilter)
    camera_mounting_monitor: CameraMountingMonitor = field(default_factory=CameraMountingMonitor)
    #: low-passed `thrust_direction_world_xy` (time constant
    #: `MEAN_THRUST_DIRECTION_TIME_CONSTANT_S`)
    mean_thrust_direction_world_xy: tuple[float, float] = (0.0, 0.0)
    #: height of the vehicle at which the magnet may hold it
    vehicle_world_z_at_last_contact_m: float | None = None
    gear_to_target_at_last_contact: GearToTargetDistance | None = None
    #: time at which the gear came within the magnet's reach
    magnet_reach_entered_at_s: float | None = None
    #: start time of each true condition
    condition_start_times_s: dict[Condition[Any], float] = field(default_factory=dict)

    # --- thrust and battery ---
    hover_thrust_estimate: HoverThrustEstimate = field(default_factory=HoverThrustEstimate)
    #: thrust that the rotors produce, 0..65535; None before the first sample
    lagged_rotor_raw_thrust: float | None = None
    #: time at which the reported thrust began to differ from the commanded one
    thrust_began_to_differ_from_command_at_s: float | None = None
    #: last tick in which the two had differed for longer than
    #: `MAX_COMMAND_TO_REPORTED_THRUST_DELAY_S`
    thrust_last_differed_from_command_at_s: float = -math.inf
    battery_fit: BatteryFitState = field(
        default_factory=BatteryFitState
    )  #: state of the battery fit

    @classmethod
    def initial_on_ground(cls, obs: Observation, profile: Profile) -> Belief:
        """Return the belief about a vehicle that is on the ground at its take-off position."""
        return cls(
            obs=obs, profile=profile, t_s=obs.t_s, takeoff_position_m=obs.telemetry.position_m
        )

    def with_observation(self, obs: Observation, profile: Profile) -> Belief:
        """Return a copy with a newer observation. Properties that read the observation, such as
        telemetry and ages, change immediately; the filtered fields keep their values until
        `update_belief`."""
        return replace(self, obs=obs, profile=profile)

    def true_for_s(self, condition: Condition[Belief]) -> float:
        """Seconds for which the condition has been true; -1 while it is false."""
        began_s = self.condition_start_times_s.get(condition)
        return -1.0 if began_s is None else self.obs.t_s - began_s

    # --- Age of the telemetry ---

    @property
    def telemetry(self) -> Telemetry:
        """The newest telemetry sample."""
        return self.obs.telemetry

    @property
    def imu(self) -> ImuMotion:
        """The motion derived from accelerometer and attitude alone."""
        return self.obs.imu

    @cached_property
    def attitude_age_s(self) -> float:
        """Age, s, of attitude, acceleration, thrust and supervisor bits, which arrive together."""
        return self.obs.t_s - self.obs.telemetry.t_s

    @cached_property
    def is_imu_fresh(self) -> bool:
        """True if attitude, acceleration and thrust are recent enough to count as evidence: at most
        `safety.proof_age_s` old."""
        return self.attitude_age_s <= self.profile.safety.proof_age_s

    @cached_property
    def telemetry_age_s(self) -> float:
        """Age of the oldest part of the telemetry, s. Real readings never repeat exactly, so the
        age of a repeated reading is measured from its first sample."""
        tel, imu = self.obs.telemetry, self.obs.imu
        oldest_s = max(tel.behind_s, imu.only_attitude_frozen_for_s, imu.only_position_frozen_for_s)
        return self.obs.t_s - tel.t_s + oldest_s

    @cached_property
    def is_telemetry_fresh(self) -> bool:
        """True if all parts of the telemetry are recent enough to count as evidence: the oldest
        part is at most `safety.proof_age_s` old."""
        return self.telemetry_age_s <= self.profile.safety.proof_age_s

    # --- Reliability of the position ---

    @cached_property
    def is_target_position_source(self) -> bool:
        """True if the positions come from the target itself, without a deck or motion capture."""
        return self.profile.positioning.source.is_target

    @cached_property
    def max_axis_velocity_variance_m2ps2(self) -> float:
        """Variance of the estimated velocity along its most uncertain axis, (m/s)^2. Infinite if it
        is missing; 0 if `link.unreported` says that the vehicle never reports it, so that no
        variance limit applies."""
        return self._replace_missing_variance(self.obs.telemetry.velocity_variance_m2ps2)

    @cached_property
    def max_axis_position_variance_m2(self) -> float:
        """Variance of the estimated position along its most uncertain axis, m^2; with decks, the
        variance of the height alone, because a Flow deck measures no other position. Infinite if
        unknown, 0 if `link.unreported` says that the vehicle does not report it."""
        tel = self.obs.telemetry
        by_deck = self.profile.positioning.source.is_deck
        return self._replace_missing_variance(
            tel.height_variance_m2 if by_deck else tel.position_variance_m2
        )

    def _replace_missing_variance(self, variance: float | None) -> float:
        if variance is None:
            return 0.0 if "variance" in self.profile.link.unreported else math.inf
        return variance if variance >= 0.0 else math.inf

    @cached_property
    def is_estimate_variance_too_large(self) -> bool:
        """True if the largest variance of velocity or position exceeds the limit for position
        control, `safety.flight_velocity_variance_m2ps2` or `safety.flight_variance_m2`. Also true
        if a variance is missing although the vehicle should report it."""
        safety = self.profile.safety
        return (
            self.max_axis_velocity_variance_m2ps2 > safety.flight_velocity_variance_m2ps2
            or self.max_axis_position_variance_m2 > safety.flight_variance_m2
        )

    @cached_property
    def position_correction_age_s(self) -> float:
        """Age, s, of the newest external position sent to the vehicle; with decks, age of the
        newest correction of the state estimate."""
        if self.profile.positioning.source.is_deck:
            return max(
                self.obs.external_position_age_s,
                self.obs.imu.estimate_fusion_monitor.age_s(self.obs.t_s),
            )
        return self.obs.external_position_age_s

    @cached_property
    def is_position_stale(self) -> bool:
        """True if `position_correction_age_s`, the age of the newest external position or, with
        decks, of the newest correction, exceeds `positioning.hold_s`: the estimated position is
        then too old for position control."""
        return self.position_correction_age_s > self.profile.positioning.hold_s

    @cached_property
    def is_position_trusted(self) -> bool:
        """True if the estimated position and velocity can be trusted: external positions (or, with
        decks, corrections) have arrived without a gap for longer than
        `ESTIMATE_SETTLING_TIME_AFTER_POSITIONS_RETURN_S`, have not led the vehicle away from its
        setpoint and, if they come from pictures, agree with the accelerometer."""
        doubted = self.is_position_diverged or (
            self.is_target_position_source and self.obs.camera_imu_mismatch is not None
        )
        returns = (
            self.position_last_stale_at_s is not None
            and self.obs.t_s - self.position_last_stale_at_s
            <= ESTIMATE_SETTLING_TIME_AFTER_POSITIONS_RETURN_S
        )
        return not (doubted or self.is_position_stale or returns)

    @cached_property
    def is_position_valid(self) -> bool:
        """True if the position is trusted and the telemetry is recent enough to count as
        evidence."""
        return self.is_position_trusted and self.is_telemetry_fresh

    @cached_property
    def camera_latency_s(self) -> float:
        """Assumed age of a camera frame when it arrives, s, counted from its exposure: the
        profile's `camera.start_latency_s` plus the correction measured in this flight."""
        return self.profile.camera.start_latency_s + self.obs.camera_latency_above_profile_s

    @cached_property
    def is_estimated_velocity_being_corrected(self) -> bool:
        """True while the newest external position still corrects the estimated velocity: it is
        older than the camera's latency by at most
        `MAX_POSITION_AGE_BEYOND_LATENCY_TO_CORRECT_VELOCITY_S`."""
        return (
            self.position_correction_age_s
            <= self.camera_latency_s + MAX_POSITION_AGE_BEYOND_LATENCY_TO_CORRECT_VELOCITY_S
        )

    @cached_property
    def is_estimate_missing_gust(self) -> bool:
        """True after an impact or gust that only the accelerometer has measured, until a sighting
        corrects the estimate. The firmware's estimator ignores lateral forces. Always False if the
        positions come from a deck or motion capture."""
        is_reckoned = self.dead_reckoning.imu_at_last_update is not None
        if not (
            self.is_target_position_source
            and is_reckoned
            and not self.is_estimated_velocity_being_corrected
        ):
            return False
        least_mps = (
            MIN_LATERAL_SPEED_GAIN_TO_DETECT_GUST_MPS
            + GUST_DETECTION_THRESHOLD_INCREASE_PER_LATENCY_SIGMA_MPS2
            * self.obs.camera_latency_sigma_s
        )
        return (
            math.hypot(*self.dead_reckoning.recent_imu_minus_estimate_velocity_world_xy_mps)
            > least_mps
        )

    @cached_property
    def is_flight_data_unreliable(self) -> bool:
        """True if the state estimate has jumped, the telemetry is older than
        `safety.telemetry_hold_s`, the link reports a problem, or the loop is running late. A
        descent is then left to the firmware's own landing where that is possible."""
        safety = self.profile.safety
        return (
            self.obs.link_problem is not None
            or self.telemetry_age_s > safety.telemetry_hold_s
            or self.first_estimate_jump_at_s is not None
            or self.obs.tick_start_delay_s > safety.loop_late_hold_s
        )

    @cached_property
    def can_descend_with_target_as_position_source(self) -> bool:
        """True if the estimate is good enough for a descent with the target as the only position
        source: the positions are trusted (recent, not diverged), no gust is uncorrected, and the
        flight data is reliable."""
        return (
            self.is_position_trusted
            and not self.is_estimate_missing_gust
            and not self.is_flight_data_unreliable
        )

    @cached_property
    def has_only_imu_for_descent(self) -> bool:
        """True if a descent can use only accelerometer and attitude.

        With the target as the position source, this is the case once
        `can_descend_with_target_as_position_source` is false. With a deck or motion capture, it is
        the case while positions are missing or have returned too recently to be trusted, but not
        once they have diverged.
        """
        if self.is_target_position_source:
            return not self.can_descend_with_target_as_position_source
        return not (self.is_position_trusted or self.is_position_diverged)

    @cached_property
    def can_descend_under_position_control(self) -> bool:
        """True if the vehicle can descend under position control, using a position from any source
        (deck, motion capture or target): positions have not diverged, dead reckoning has not
        replaced them, and the heading is not lost. With a deck or motion capture, a lost heading is
        accepted if the telemetry is too old for the alternative, a descent by raw thrust. With the
        target as the source, `can_descend_with_target_as_position_source` must be true as well."""
        lost = self.is_position_diverged or self.dead_reckoning_began_at_s is not None
        if lost or (
            self.is_target_position_source and not self.can_descend_with_target_as_position_source
        ):
            return False
        # A descent by raw thrust needs a fresh vertical speed. Without one, only the firmware's own
        # landing remains.
        heard = self.attitude_age_s <= self.profile.safety.telemetry_hold_s
        return not (self.is_heading_lost and (self.is_target_position_source or heard))

    # --- Motion ---

    @property
    def ground_z_m(self) -> float:
        """World z, m, in the frame of the state estimate, of the position where the flight started;
        0 if unknown. Its error is the drift of the estimated height since then."""
        return self.takeoff_position_m[2] if self.takeoff_position_m else 0.0

    @cached_property
    def height_m(self) -> float:
        """Estimated height above the position where the flight started, m: world z of the vehicle's
        origin minus `ground_z_m`. Its error is the drift of the state estimate."""
        return self.obs.telemetry.position_m[2] - self.ground_z_m

    @cached_property
    def tilt_rad(self) -> float:
        """Angle, rad, 0..pi, between the vehicle's upward axis and the world's, from the roll and
        pitch of the newest telemetry."""
        tel = self.obs.telemetry
        up = math.cos(tel.roll_rad) * math.cos(tel.pitch_rad)
        return math.acos(max(-1.0, min(1.0, up)))

    @cached_property
    def is_accelerometer_reading_one_g(self) -> bool:
        """True if the accelerometer reads 1 g within `perch.contact_acc_g`, as it does in hover and
        while the vehicle rests on the floor, at the ceiling or on the magnet."""
        return abs(self.obs.telemetry.acc_z_g - 1.0) <= self.profile.planner.perch.contact_acc_g

    @cached_property
    def velocity_world_mps(self) -> Vector:
        """Estimated velocity in world axes, m/s. While the position is valid, the bias that wind
        adds to the estimate is subtracted."""
        vx_mps, vy_mps, vz_mps = self.obs.telemetry.velocity_mps
        if self.is_position_valid:
            bias_x_mps, bias_y_mps = self.dead_reckoning.estimated_velocity_bias_world_xy_mps
            vx_mps, vy_mps = vx_mps - bias_x_mps, vy_mps - bias_y_mps
        return vx_mps, vy_mps, vz_mps

    @cached_property
    def thrust_direction_world_xy(self) -> tuple[float, float]:
        """Horizontal part (x, y) of the unit vector along the thrust, world axes. Its length is the
        sine of the tilt, and it points in the direction in which the vehicle leans."""
        tel = self.obs.telemetry
        level_x = math.sin(tel.pitch_rad) * math.cos(tel.roll_rad)
        level_y = -math.sin(tel.roll_rad)
        cos_yaw, sin_yaw = math.cos(tel.yaw_rad), math.sin(tel.yaw_rad)
        return cos_yaw * level_x - sin_yaw * level_y, sin_yaw * level_x + cos_yaw * level_y

    @cached_property
    def acceleration_from_tilt_world_xy_mps2(self) -> tuple[float, float]:
        """Lateral acceleration (x, y) in world axes, m/s^2, from the tilt minus its mean (a
        low-pass filter with the time constant `MEAN_THRUST_DIRECTION_TIME_CONSTANT_S`). The mean
        tilt is assumed not to accelerate the vehicle: it balances the wind, an uneven mass
        distribution, or an error of the estimated attitude. The result is wrong after a change in
        the wind, until the mean has settled."""
        (x, y), (mean_x, mean_y) = (
            self.thrust_direction_world_xy,
            self.mean_thrust_direction_world_xy,
        )
        return GRAVITY_MPS2 * (x - mean_x), GRAVITY_MPS2 * (y - mean_y)

    @cached_property
    def speed_mps(self) -> float:
        """Magnitude of `velocity_world_mps`, all three axes, m/s."""
        return math.sqrt(sum(v * v for v in self.velocity_world_mps))

    @cached_property
    def climb_mps(self) -> float:
        """Vertical speed, m/s, positive upwards. It comes from the state estimate while the
        position is valid. Otherwise, or once dead reckoning has replaced the estimate, it comes
        from the accelerometer and drifts."""
        is_reckoned = self.dead_reckoning.imu_at_last_update is not None
        if is_reckoned and (
            self.dead_reckoning_began_at_s is not None or not self.is_position_valid
        ):
            return self.dead_reckoning.velocity_world_mps[2]
        return self.obs.telemetry.velocity_mps[2]

    def is_sinking(self, min_sink_mps: float) -> bool:
        """True if the vehicle is sinking faster than `min_sink_mps` (positive), according to
        `climb_mps`.

        Without a valid position, the accelerometer must also read less than 1 g by more than
        `perch.contact_acc_g`, because the dead-reckoned speed drifts.
        """
        if self.climb_mps >= -min_sink_mps:
            return False
        light_g = 1.0 - self.profile.planner.perch.contact_acc_g
        return self.is_position_valid or self.obs.telemetry.acc_z_g < light_g

    @property
    def hover_thrust(self) -> float:
        """The estimated hover thrust, 0..65535; 0 while unknown."""
        return self.hover_thrust_estimate.raw_thrust

    @cached_property
    def is_reported_thrust_reliable(self) -> bool:
        """True if the reported thrust can be used: no raw thrust is commanded, or the reported
        thrust agrees with it or has differed from it for at most
        `MAX_COMMAND_TO_REPORTED_THRUST_DELAY_S`."""
        return (
            self.thrust_began_to_differ_from_command_at_s is None
            or self.obs.t_s - self.thrust_began_to_differ_from_command_at_s
            <= MAX_COMMAND_TO_REPORTED_THRUST_DELAY_S
        )

    # --- The target ---

    @cached_property
    def target(self) -> TargetBelief:
        """The belief about the target, from the pipeline's newest estimate."""
        return TargetBelief.from_estimate(
            self.obs.target, self.obs.t_s, self.camera_latency_s, self.profile
        )

    @cached_property
    def lateral_offset_and_velocity(self) -> LateralOffsetAndVelocity | None:
        """Horizontal vector from the gear to the target and horizontal velocity of the vehicle, in
        world axes, estimated from pictures and tilt. None if the last pictures are too old or too
        few. Also None if the pictures contradict the vehicle's motion: the camera may then be
        rotated relative to the profile, and feedback of this velocity would not damp the motion."""
        if (
            self.camera_mounting_monitor.is_camera_mounting_wrong
            or self.obs.camera_imu_mismatch is not None
        ):
            return None
        return self.lateral_offset_filter.predict(self.obs.t_s)

    @cached_property
    def camera_imu_mismatch(self) -> CameraImuMismatch:
        """Error of the camera's latency, s, or of its yaw in the mounting, rad, that explains why
        pictures and accelerometer disagree; both values are 0 while they do not disagree."""
        return self.obs.camera_imu_mismatch or CameraImuMismatch()

    @cached_property
    def sighting_age_s(self) -> float:
        """Seconds since the exposure of the last picture that shows the target; infinite before the
        first one."""
        return max(0.0, self.obs.t_s - self.dead_reckoning.last_sighting_at_s)

    @cached_property
    def does_camera_motion_match_vehicle(self) -> bool:
        """True if the motion in the pictures agrees with the vehicle's own motion: with its
        accelerometer if the target is the position source, otherwise with its state estimate. False
        if they disagree, and until there has been enough motion to compare them."""
        if self.is_target_position_source:
            return (
                self.obs.visual_inertial_motion is not None and self.obs.camera_imu_mismatch is None
            )
        return not (
            self.camera_mounting_monitor.is_target_motion_undetermined
            or self.camera_mounting_monitor.is_camera_mounting_wrong
        )

    @property
    def is_possibly_in_magnet_reach(self) -> bool:
        """True if the magnet may be holding the vehicle: a contact is recorded
        (`vehicle_world_z_at_last_contact_m`), or dead reckoning has placed the gear within the
        magnet's reach (`magnet_reach_entered_at_s`)."""
        return (
            self.vehicle_world_z_at_last_contact_m is not None
            or self.magnet_reach_entered_at_s is not None
        )
