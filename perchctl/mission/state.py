"""The planner's memory between ticks: its belief, and its decisions so far."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import CommandHistory, Maneuver
from perchctl.mission.observation import Observation
from perchctl.mission.phase import Outcome, Phase, Severity, VehicleDiagnosis
from perchctl.profile import Profile
from perchctl.vehicle import EmergencyStop, PositionSetpoint, StopMotors


@dataclass(frozen=True)
class BatteryOutlook:
    """How long the battery lasts: predicted hover time, s, until row `battery-low` of the
    transition table would land the vehicle; number of attempts that the battery allows, with a
    landing after the last one; charge consumed so far, mAh; and resting voltage (without load), V.
    None means unknown."""

    hover_time_left_s: float | None = None  # hover time until `battery-low` would land the vehicle
    # attempts that the battery allows, with the landing after the last one; None before the first
    # sighting
    affordable_attempts: int | None = None
    consumed_charge_mah: float = 0.0  # charge consumed by the assumed current
    rest_v: float | None = None  # estimated resting voltage


@dataclass(frozen=True)
class DescentState:
    """The planner's memory of a descent; times are on the loop's clock.

    For a descent by raw thrust: the last commanded thrust, 0..65535 (0 before the descent); the
    time since which all commanded thrusts have been too small to fly (inf if the last one was not);
    the time of the newest measured climb rate, and the change of the climb rate, m/s, positive up,
    that commands have caused since; the time at which the floor was detected (None before); and the
    time at which a setpoint last gave the firmware a new heading. For the firmware's own landing:
    the time at which its trajectory ends, and how often it was extended.
    """

    last_commanded_raw_thrust: float = 0.0
    thrust_too_low_to_fly_since_s: float = math.inf
    climb_rate_measured_at_s: float = -math.inf  # time of the newest sample at the last tick
    # climb rate that recent commands cause and no sample shows yet
    climb_rate_change_not_yet_measured_mps: float = 0.0
    floor_detected_at_s: float | None = None  # time at which the floor was detected
    heading_setpoint_sent_at_s: float = -math.inf
    onboard_landing_ends_at_s: float = math.inf
    onboard_landing_extension_count: int = 0


@dataclass(frozen=True)
class HoverErrorAccumulator:
    """Position errors of the gear during a hover, from all frames that measured the target.

    An error is the hover position relative to the gear along x (forward), y (left) and z (up), m,
    in the level frame, and the heading error, rad, both from the filtered pose. The camera measures
    these errors. An error of the camera's calibration or mounting shifts the vehicle and the
    measurement alike, and is therefore not included.
    """

    hover_began_at_s: float = 0.0  # start of the hover
    newest_frame_at_s: float = 0.0  # time of the newest of these frames
    frame_count: int = 0
    squared_error_sums_level_xyz_m2_yaw_rad2: tuple[float, float, float, float] = (
        0.0,
        0.0,
        0.0,
        0.0,
    )
    """Sums of the squared errors in x, y, z, m^2, and yaw, rad^2."""

    def with_error(
        self,
        t_s: float,
        gear_to_hover_position_level_m: tuple[float, float, float],
        vehicle_to_target_yaw_rad: float,
    ) -> HoverErrorAccumulator:
        """Return the errors with those of one more frame at `t_s`: the vector from the gear to the
        hover position (forward, left, up) in the level frame, m, and the target's heading relative
        to the vehicle's, rad."""
        errors = (*gear_to_hover_position_level_m, vehicle_to_target_yaw_rad)
        x2, y2, z2, yaw2 = (
            s + e * e
            for s, e in zip(self.squared_error_sums_level_xyz_m2_yaw_rad2, errors, strict=True)
        )
        return HoverErrorAccumulator(
            self.hover_began_at_s, t_s, self.frame_count + 1, (x2, y2, z2, yaw2)
        )

    @property
    def duration_s(self) -> float:
        """Time from the start of the hover to the newest frame, s."""
        return self.newest_frame_at_s - self.hover_began_at_s

    @property
    def rms_level_xyz_m_yaw_rad(self) -> tuple[float, float, float, float]:
        """Root mean squares of the errors in x, y, z, m, and heading, rad; NaN without a frame."""
        if not self.frame_count:
            return math.nan, math.nan, math.nan, math.nan
        x, y, z, yaw = (
            math.sqrt(each / self.frame_count)
            for each in self.squared_error_sums_level_xyz_m2_yaw_rad2
        )
        return x, y, z, yaw


@dataclass(frozen=True, kw_only=True)
class PhaseEntry:
    """How the present phase was entered: the time on the loop's clock, s; the vehicle's estimated
    position, m, and heading, rad, in the world at that time; and the transition's name, its reason
    in words, its diagnosis, and the stop command that it sends at once, if any.

    The position is the reference for the phase's motion, so it moves with a jump of the estimate's
    world frame. A search replaces position and heading by those of the last setpoint, and a phase
    that catches a fall replaces the position.
    """

    t_s: float = 0.0
    # estimated position and heading of the vehicle
    vehicle_world_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    vehicle_world_yaw_rad: float = 0.0
    transition_name: str = ""  # name of the transition, for logs and displays
    reason: str = "start"
    diagnosis: VehicleDiagnosis = VehicleDiagnosis.NONE  # diagnosis of the transition
    stop_command: EmergencyStop | StopMotors | None = None  # sent at once by the transition


@dataclass(frozen=True, eq=False)
class PlannerState:
    """The planner's whole state between two ticks: its belief, the present phase and how it was
    entered, the setpoint and last commands, the number of failed attempts, and the outcome (None
    until one is decided). Times are on the loop's clock; positions are in the world frame of the
    state estimate.

    `severity` is that of the last transition, but never falls once it is `LAND` or higher.
    `must_end_press` is True if the phase began with the vehicle pressed at high thrust and the
    press has not ended yet. `integral_setpoint_shift_world_xy_m` is the lateral integral, in world
    axes, that is added to the setpoint. `fall_catch_setpoint_above_vehicle_m` is None unless a
    fall is being caught. `hold_reason` says why the vehicle holds its position, and
    `wait_in_phase_reason` why a row of the transition table keeps the mission in its phase; both
    are empty otherwise.
    """

    belief: Belief
    phase: Phase = Phase.APPROACH
    entry: PhaseEntry = PhaseEntry()  #: time, position and reason of the start of the phase
    flight_started_at_s: float = 0.0  #: start of the flight
    t_s: float = 0.0  #: time of the last decision
    severity: Severity = Severity.CONTINUE
    outcome: Outcome | None = None
    condition_start_times_s: dict[Condition[Any], float] = field(default_factory=dict)
    """Start time of each true condition of the phases."""
    failed_attempts: int = 0  #: number of failed attempts
    #: number of successive frames in this phase that measured the target
    consecutive_target_frames: int = 0
    searched_position_count: int = 0
    search_step_began_at_s: float = 0.0
    setpoint: PositionSetpoint | None = None
    integral_setpoint_shift_world_xy_m: tuple[float, float] = (0.0, 0.0)
    #: the phase began with the vehicle pressed at high thrust, and the press has not ended yet
    must_end_press: bool = False
    fall_catch_setpoint_above_vehicle_m: float | None = None
    """Height of the setpoint above the vehicle during a catch, m; None outside a catch."""
    #: height at which an obstacle blocked the vehicle
    vehicle_world_z_when_blocked_m: float | None = None
    weight_transfer_began_at_s: float | None = None  #: start of the transfer by raw thrust
    motor_stop_commanded_at_s: float | None = None  #: first command to stop the motors
    last_stop_or_land_command_at_s: float | None = None  #: last command to land or to stop motors
    stop_or_land_command_count: int = 0
    commanded_raw_thrust: int | None = None  #: last commanded raw thrust; None in position mode
    descent: DescentState = DescentState()
    hold_reason: str = ""  #: why the vehicle is holding its position; empty without a hold
    wait_in_phase_reason: str = ""  #: why a row keeps the mission in its phase; empty if none does
    total_wait_in_phase_s: float = 0.0  #: total waiting time in this phase
    battery: BatteryOutlook = BatteryOutlook()
    hover_errors: HoverErrorAccumulator = (
        HoverErrorAccumulator()
    )  #: position errors in the newest hover

    @property
    def transition_name(self) -> str:
        """Name of the transition into the phase, for logs and displays."""
        return self.entry.transition_name

    @property
    def transition_reason(self) -> str:
        """Why the phase was entered, in words."""
        return self.entry.reason

    @property
    def pause_reason(self) -> str:
        """Why the mission is paused: the reason for the hold, or the reason that a row of the
        transition table gives for waiting in the phase. Empty if the mission is not paused."""
        return self.hold_reason or self.wait_in_phase_reason

    @property
    def is_before_weight_transfer_and_motor_stop(self) -> bool:
        """True until the weight transfer by raw thrust begins or the motors are commanded to
        stop."""
        return self.weight_transfer_began_at_s is None and self.motor_stop_commanded_at_s is None

    def command_history(self, maneuver: Maneuver) -> CommandHistory:
        """Return what the belief may know of the planner: the present setpoint and raw thrust, the
        position at which the phase began, and the times at which the weight transfer began, the
        motor stop was commanded and the floor was detected. `maneuver` is the maneuver of the
        present phase."""
        return CommandHistory(
            maneuver=maneuver,
            maneuver_start_position_m=self.entry.vehicle_world_position_m,
            setpoint=self.setpoint,
            commanded_raw_thrust=self.commanded_raw_thrust,
            weight_transfer_began_at_s=self.weight_transfer_began_at_s,
            motor_stop_commanded_at_s=self.motor_stop_commanded_at_s,
            floor_detected_at_s=self.descent.floor_detected_at_s,
        )

    @classmethod
    def initial_on_ground(cls, obs: Observation, profile: Profile) -> PlannerState:
        """Return the planner's state before the first decision, for a vehicle at its take-off
        position."""
        tel, t_s = obs.telemetry, obs.t_s
        return cls(
            belief=Belief.initial_on_ground(obs, profile),
            entry=PhaseEntry(
                t_s=t_s, vehicle_world_position_m=tel.position_m, vehicle_world_yaw_rad=tel.yaw_rad
            ),
            flight_started_at_s=t_s,
            t_s=t_s,
            search_step_began_at_s=t_s,
        )
