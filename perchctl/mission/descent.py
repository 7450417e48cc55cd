"""The one descent for all cases: the planner's LANDING, a blocked loop (watchdog), and the rescue.

Pure: `step_landing(state, observation, profile) -> (state, command)`.

A descent, a release or a motor stop that has begun is completed even if the evidence changes. A
vehicle that is still descending follows one of four policies. `descend` chooses the policy
according to which data is known and fresh, and whether the magnet may hold the vehicle (see the
table in docs/mission.md):

- by position setpoints, straight down;
- level, without a position: raw thrust with feedback from the vertical speed;
- by the firmware's own landing, near the ground or if height, telemetry or loop is unreliable;
- peeled off the magnet by a setpoint below the vehicle; if the magnet does not let go, the weight
  is transferred to it.

A climb is commanded only to catch a fall. The firmware's own landing follows a trajectory on its
own clock and then stops the motors, wherever the vehicle is by then. That landing is therefore
commanded only if a position shows the vehicle away from the ceiling.
"""

from __future__ import annotations

import math

from perchctl.mission.belief import hover
from perchctl.mission.belief.contact import (
    HANGING,
    HANGING_CONFIRMATION_DWELL_S,
    MOTORS_OFF_DESPITE_THRUST_COMMAND,
    MOTORS_OFF_DWELL_S,
    ON_FLOOR,
    has_slipped_off_contact,
    is_pressing_against_surface,
)
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.belief.reckoning import MAGNET_REACH_BELOW_TARGET_M
from perchctl.mission.belief.thrust import MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE
from perchctl.mission.belief.update import (
    COMMANDED_KEEPALIVE_RAW_THRUST,
    reset_phase_dependent_conditions,
    start_dead_reckoning,
    update_thrust_check_after_command,
)
from perchctl.mission.context import Context
from perchctl.mission.level_descent import (
    MIN_COMMANDED_TO_HOVER_THRUST_RATIO,
    MIN_DISTANCE_BELOW_CONTACT_TO_COUNT_AS_DETACHED_M,
    descend_level_by_raw_thrust,
    should_begin_descent_with_setpoints,
)
from perchctl.mission.observation import Observation
from perchctl.mission.observe import update_state_with_observation
from perchctl.mission.phase import Phase, Severity, VehicleDiagnosis
from perchctl.mission.release import (
    catch_falling_vehicle,
    choose_fall_catch_setpoint_above_vehicle_m,
    end_press,
    forget_contact_when_below,
    stop_motors,
    transfer_weight_by_raw_thrust,
)
from perchctl.mission.setpoints import (
    Action,
    limit_setpoint_to_fence_and_height_range,
    make_setpoint_at_vehicle,
    move_setpoint_to_vehicle,
    step_setpoint_towards,
)
from perchctl.mission.state import PlannerState
from perchctl.profile import PlannerConfig, Profile
from perchctl.values import replace
from perchctl.vehicle import FLYING, HL_ACTIVE, Command, Idle, Land, RawThrust

DESCENT_MANEUVER = Maneuver(descends_to_floor=True)
"""Maneuver of a descent, for all of its policies."""

# --- by setpoints, and off the magnet ---
MAX_SETPOINT_DISTANCE_BELOW_VEHICLE_M = 0.35
"""Largest distance of a setpoint below the vehicle during a descent by setpoints, m. Larger: a
vehicle that comes off the magnet falls."""
PEEL_OFF_MAGNET_TIMEOUT_S = 4.0
"""Time after which a vehicle that has not come off the magnet stops pulling and transfers its
weight to the magnet, s. Larger: the vehicle pulls for longer, and falls if the magnet lets go
late."""
MAX_CLIMB_RATE_TO_COUNT_AS_FALLING_OFF_MAGNET_MPS = -0.35
"""Climb rate below which a vehicle that is peeling off the magnet is falling, m/s."""
MAX_HEIGHT_TO_COUNT_AS_LANDED_M = 0.05
"""Height below which a motionless vehicle in a descent by raw thrust counts as being on the floor,
m."""
MAX_VERTICAL_SPEED_TO_COUNT_AS_MOTIONLESS_MPS = 0.1
"""Largest vertical speed of a motionless vehicle, m/s. Larger: the motors stop while the vehicle is
still climbing or sinking."""
MOTIONLESS_DWELL_BEFORE_MOTOR_STOP_S = 0.5
"""Time for which a vehicle must be motionless before its motors are stopped, s."""

# --- level, by raw thrust ---
MIN_TIME_BETWEEN_HEADING_SETPOINTS_S = 0.5
"""Shortest time between two setpoints that give the firmware a new heading during a descent by raw
thrust, s. Larger: after a second jump, the vehicle turns for longer. Smaller: with a heading that
jumps again and again, position control moves the vehicle in a wrong direction."""

# --- by the firmware's own landing ---
LANDING_COMMAND_PERIOD_S = 0.3
"""Time between landing commands, s. Without its notify message, the firmware does not execute a
command (docs/firmware.md, "Order without notify")."""
MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY = 3
"""Number of landing commands before the telemetry can confirm that the vehicle is landing."""
MAX_LANDING_COMMAND_COUNT = 6
"""Largest number of landing commands."""
ONBOARD_LANDING_PEAK_SPEED_MPS = 0.35
"""Peak speed of the quintic landing trajectory, m/s."""
ONBOARD_LANDING_DURATION_MARGIN_S = 1.8
"""Time added to the duration of the quintic landing trajectory, s."""
QUINTIC_PEAK_TO_MEAN_SPEED_RATIO = 1.875
"""Ratio of a quintic's peak speed to its mean speed."""
TIME_BEFORE_END_TO_EXTEND_ONBOARD_LANDING_S = 1.0
"""Time before the end of its trajectory at which the firmware's landing is extended, s; the vehicle
has sunk by 95 % of the trajectory by then. Larger: the vehicle sinks more slowly, because each
trajectory starts from rest. Smaller: if commands are lost, the trajectory ends first."""
MAX_ONBOARD_LANDING_EXTENSIONS = 4
"""Number of extensions, each of which lowers the vehicle by 0.3 to 0.5 m. Larger: if the estimate
sinks faster than the vehicle can, the vehicle climbs for longer. Smaller: after a longer drift, the
last trajectory ends in the air."""
MIN_ESTIMATED_DEPTH_BELOW_GROUND_TO_EXTEND_LANDING_M = 0.1
"""Estimated depth below the ground beyond which a vehicle that is still flying shows that the
ground is lower, m. Larger: a trajectory ends before it is extended. Smaller: the error of a height
without drift extends the landing."""
MIN_HEIGHT_ABOVE_GROUND_TO_EXTEND_LANDING_M = 0.06
"""Estimated height above the ground from which a landing is extended if the vehicle is still flying
just before its end, m: with too little thrust, it may float in its own ground effect, and stopped
motors would let it drop. Larger: the vehicle drops from there. Smaller: a vehicle that touches down
at the last moment waits for another trajectory."""
TIME_BEFORE_END_TO_EXTEND_LANDING_ABOVE_GROUND_S = 0.25
"""Time before the end of its trajectory at which the firmware's landing is extended if the vehicle
is still flying above the estimated ground, s. Larger: a landing that is about to touch down is
extended. Smaller: if a command is lost, the trajectory ends first."""
MIN_THRUST_TO_HOVER_RATIO_TO_COUNT_AS_FLYING = 0.85
"""Thrust, as a fraction of the hover thrust, from which a vehicle that the firmware is landing
counts as still flying. Once the vehicle is on the floor, and therefore above the end of its
trajectory, the firmware commands its smallest thrust. Larger: a vehicle that sinks faster and
faster counts as landed. Smaller: a vehicle that has just touched down counts as flying."""
MAX_ASSUMED_HEIGHT_DRIFT_FOR_LANDING_GOAL_M = 1.0
"""Largest assumed drift of the height, m."""
MAX_SPECIFIC_FORCE_TO_COUNT_AS_FALLING_G = 0.5
"""Specific force below which the vehicle is falling, g: no floor is supporting it."""
MAX_SINK_RATE_TO_COUNT_AS_LANDED_MPS = 1.0
"""Largest speed of a drop from 5 cm above the floor, m/s."""
MIN_HEIGHT_TO_COUNT_MOTOR_STOP_AS_IN_FLIGHT_M = 0.4
"""Height above which stopped motors mean that they were cut in flight and not that the vehicle has
landed, m."""


def step_landing(
    state: PlannerState | None, obs: Observation, profile: Profile
) -> tuple[PlannerState, Command]:
    """Return the planner's new state and the command for one tick of the landing, without the
    mission's transition table. The watchdog calls this function when the loop has stopped
    responding, and the rescue calls it after an exception. If `state` is not in the phase LANDING
    yet, the landing begins. `state` is None if the planner has not run yet."""
    state = state or PlannerState.initial_on_ground(obs, profile)
    state = replace(state, belief=state.belief.with_observation(obs, profile))
    state = update_state_with_observation(begin_landing(state), obs, profile, DESCENT_MANEUVER)
    return record_command(*act_in_landing(Context(state)))


def record_command(state: PlannerState, command: Command) -> tuple[PlannerState, Command]:
    """Return the result of a tick: the state, with the time of the tick and the commanded raw
    thrust stored for later ticks, and `command` itself. `Idle` leaves the stored raw thrust
    unchanged; any other command that is not a raw thrust sets it to None."""
    order = state.commanded_raw_thrust
    if not isinstance(command, Idle):
        order = command.thrust if isinstance(command, RawThrust) else None
    belief = update_thrust_check_after_command(state.belief, command)
    return replace(state, belief=belief, commanded_raw_thrust=order, t_s=belief.obs.t_s), command


def begin_landing(state: PlannerState) -> PlannerState:
    """Return the state at the start of the phase LANDING, with the present time, position and
    heading as those of the phase's start, and a severity of at least `LAND`. The start times of
    conditions are forgotten, except for conditions that persist across phases, and the descent is
    prepared (`enter_descent`). If the landing has begun already, the state is returned
    unchanged."""
    if state.phase is Phase.LANDING:
        return state
    b, tel = state.belief, state.belief.telemetry
    new = replace(
        state,
        phase=Phase.LANDING,
        entry=replace(
            state.entry,
            t_s=b.obs.t_s,
            vehicle_world_position_m=tel.position_m,
            vehicle_world_yaw_rad=tel.yaw_rad,
        ),
        severity=max(state.severity, Severity.LAND),
        condition_start_times_s={},
        belief=reset_phase_dependent_conditions(b),
        must_end_press=state.fall_catch_setpoint_above_vehicle_m is None
        and is_pressing_against_surface(b),
        last_stop_or_land_command_at_s=None,
        stop_or_land_command_count=0,
    )
    return enter_descent(new, state)


def enter_descent(state: PlannerState, previous_state: PlannerState) -> PlannerState:
    """Return the state at the start of a descent. `state` is the state after the transition to the
    new phase, and `previous_state` the state before it.

    If the vehicle is hovering in place, the setpoint moves to its position. The hover thrust is
    estimated for the descent. A landing that the firmware is already executing counts as commanded,
    and motors that are already off count as stopped, so that no command starts them again. After a
    press, the vehicle counts as within the magnet's reach. If only accelerometer and attitude are
    left, the belief switches to dead reckoning.
    """
    b, tel, old = state.belief, state.belief.telemetry, previous_state.belief
    heard = b.attitude_age_s <= b.profile.safety.proof_age_s
    if (
        heard
        and tel.has_bit(HL_ACTIVE)
        and not b.is_target_position_source
        and not b.is_position_diverged
    ):
        state = replace(
            state,
            stop_or_land_command_count=MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY,
            last_stop_or_land_command_at_s=b.obs.t_s,
        )
    elif heard and tel.thrust < 1 and previous_state.motor_stop_commanded_at_s is None:
        # The motors were stopped or never ran; no command may start them again.
        state = replace(state, motor_stop_commanded_at_s=b.obs.t_s)
    vehicle_world_z_at_last_contact_m = old.vehicle_world_z_at_last_contact_m
    pressed_unseen = state.must_end_press and b.is_target_position_source
    if vehicle_world_z_at_last_contact_m is None and (
        previous_state.phase is Phase.PERCH or pressed_unseen
    ):
        # The vehicle may be within the magnet's reach, even below a sheet that hangs from an unseen
        # ceiling. The vehicle counts as free only after a sighting from below.
        vehicle_world_z_at_last_contact_m = tel.position_m[2]
    # If the vehicle is hovering in place, the offset that holds it against the wind is kept.
    state = move_setpoint_to_vehicle(Context(state))
    within = (
        vehicle_world_z_at_last_contact_m is not None
        or b.dead_reckoning.gear_below_target_m < MAGNET_REACH_BELOW_TARGET_M
    )
    lost = b.has_only_imu_for_descent
    b = replace(
        b,
        magnet_reach_entered_at_s=previous_state.t_s
        if within and old.magnet_reach_entered_at_s is None
        else old.magnet_reach_entered_at_s,
        vehicle_world_z_at_last_contact_m=vehicle_world_z_at_last_contact_m,
        hover_thrust_estimate=hover.estimate_hover_thrust(old),
    )
    return replace(state, belief=start_dead_reckoning(b) if lost else b)


def act_in_landing(c: Context) -> Action:
    """Return the landing's new state and command. The first action that applies is taken: catch a
    fall, stop the motors, transfer the weight to the magnet, continue the firmware's own landing,
    or descend."""
    state = c.state
    if _has_fallen_off_magnet(c):
        return _restart_landing_by_catching_fall(c)
    if (
        state.motor_stop_commanded_at_s is None
        and state.fall_catch_setpoint_above_vehicle_m is not None
    ):
        if (caught := _catch_fall(c)) is not None:
            return caught
        c = Context(replace(state, fall_catch_setpoint_above_vehicle_m=None))
    is_off = c.true_for_s(MOTORS_OFF_DESPITE_THRUST_COMMAND) >= MOTORS_OFF_DWELL_S
    if c.state.motor_stop_commanded_at_s is not None or is_off or _is_standing_on_floor(c):
        return stop_motors(c)
    if c.state.weight_transfer_began_at_s is not None:
        return _complete_weight_transfer_to_magnet(c)
    # changing to another policy during the firmware's own landing would cost height
    if c.state.stop_or_land_command_count:
        return _command_onboard_landing(c)
    return (
        _transfer_weight_to_magnet(c)
        if c.true_for_s(HANGING) >= HANGING_CONFIRMATION_DWELL_S
        else descend(c)
    )


def descend(c: Context) -> Action:
    """Return the new state and command of the first of these policies that applies:

    - By raw thrust, held level, without a usable position.
    - Peel off the magnet, if the vehicle may be within its reach: lower the setpoint until the
      vehicle comes off, or transfer its weight to the magnet after `PEEL_OFF_MAGNET_TIMEOUT_S`.
    - With the target as the position source, by setpoints down to `landing.handover_m`, and by raw
      thrust below it: the firmware's own landing would follow the camera's estimate to a floor of
      unknown height.
    - The firmware's own landing, below `landing.handover_m`, after `landing.setpoint_time_s` in the
      phase, or if height, telemetry or loop is unreliable.
    - By setpoints, otherwise.

    A press that has not ended is ended first if the target is the position source, or if the
    vehicle is out of the magnet's reach and its flight data are reliable.
    """
    b = c.belief
    if not b.can_descend_under_position_control:
        return _descend_by_raw_thrust(c)
    landing, in_reach, doubtful = (
        c.planner.landing,
        b.is_possibly_in_magnet_reach,
        b.is_flight_data_unreliable,
    )
    if b.is_target_position_source or not (in_reach or doubtful):
        state, away = end_press(c)
        if away is not None:
            return state, away
        c = Context(state)
    low = b.height_m <= landing.handover_m
    if in_reach:
        gives_up = c.time_in_phase_s > PEEL_OFF_MAGNET_TIMEOUT_S and (
            b.is_imu_fresh or not doubtful
        )
        return _transfer_weight_to_magnet(c) if gives_up else _descend_by_setpoints(c)
    if b.is_target_position_source:
        return (
            _descend_by_raw_thrust(c)
            if c.state.descent.last_commanded_raw_thrust or low
            else _descend_by_setpoints(c)
        )
    overdue = c.time_in_phase_s > landing.setpoint_time_s
    return _command_onboard_landing(c) if doubtful or overdue or low else _descend_by_setpoints(c)


def has_descent_command_reached_minimum(c: Context) -> bool:
    """True if a landing has reached its end: the last commanded raw thrust is at its minimum
    (`MIN_COMMANDED_TO_HOVER_THRUST_RATIO` times hover thrust) or, if the end of the landing could
    not be confirmed in time (`LANDING_UNCONFIRMED`), the setpoint is at most `landing.handover_m`
    above the take-off position. The motors must then be stopped, or the firmware's supervisor locks
    the vehicle when the setpoints end."""
    setpoint, takeoff_position_m = c.state.setpoint, c.belief.takeoff_position_m
    if setpoint is not None and takeoff_position_m is not None:
        low = setpoint.z_m <= takeoff_position_m[2] + c.planner.landing.handover_m
        if low and VehicleDiagnosis.LANDING_UNCONFIRMED in c.state.entry.diagnosis:
            return True
    return (
        0.0
        < c.state.descent.last_commanded_raw_thrust
        <= MIN_COMMANDED_TO_HOVER_THRUST_RATIO * c.belief.hover_thrust + 1.0
    )


# --- Falls, and proof that the vehicle is on the floor ---


def _has_fallen_off_magnet(c: Context) -> bool:
    """True if the vehicle has come off the magnet and is falling. During a weight transfer and
    after the command to stop the motors, it must have slipped off its contact
    (`has_slipped_off_contact`). Before that, a contact must be recorded, no catch may be in
    progress, and the climb rate must be below `MAX_CLIMB_RATE_TO_COUNT_AS_FALLING_OFF_MAGNET_MPS`;
    during the firmware's own landing, no fall is detected. Always False with old IMU data."""
    b, state = c.belief, c.state
    if not b.is_imu_fresh:
        return False
    if not state.is_before_weight_transfer_and_motor_stop:
        return b.is_possibly_in_magnet_reach and has_slipped_off_contact(b)
    if state.stop_or_land_command_count:
        return False
    caught = state.fall_catch_setpoint_above_vehicle_m is None
    return (
        b.vehicle_world_z_at_last_contact_m is not None
        and caught
        and b.is_sinking(-MAX_CLIMB_RATE_TO_COUNT_AS_FALLING_OFF_MAGNET_MPS)
    )


def _is_standing_on_floor(c: Context) -> bool:
    """True if the vehicle is proven to be on the floor, in one of two ways. The condition
    `ON_FLOOR` (motionless, with too little thrust to fly, and low or further down than at the
    start) has been true for `MOTIONLESS_DWELL_BEFORE_MOTOR_STOP_S`, and the telemetry is fresh. Or,
    in a descent by raw thrust with valid positions from the target, the vehicle is lower than
    `MAX_HEIGHT_TO_COUNT_AS_LANDED_M`, its vertical speed is below
    `MAX_VERTICAL_SPEED_TO_COUNT_AS_MOTIONLESS_MPS`, and it cannot be on the magnet."""
    b = c.belief
    if b.is_telemetry_fresh and c.true_for_s(ON_FLOOR) >= MOTIONLESS_DWELL_BEFORE_MOTOR_STOP_S:
        return True
    placed = (
        b.is_target_position_source and b.is_position_valid and b.dead_reckoning_began_at_s is None
    )
    low = b.height_m < MAX_HEIGHT_TO_COUNT_AS_LANDED_M and not b.is_possibly_in_magnet_reach
    return (
        placed
        and c.state.descent.last_commanded_raw_thrust > 0.0
        and low
        and abs(b.climb_mps) < MAX_VERTICAL_SPEED_TO_COUNT_AS_MOTIONLESS_MPS
    )


def _restart_landing_by_catching_fall(c: Context) -> Action:
    """Return the new state and command of a landing that restarts at the vehicle's present
    position, after a fall off the magnet. The recorded contact, weight transfer and motor stop are
    forgotten. The command is a setpoint above the vehicle that stops the fall (a catch) or, if no
    catch is possible, the first command of the descent."""
    tel, b = c.telemetry, c.belief
    belief = replace(
        b,
        vehicle_world_z_at_last_contact_m=None,
        magnet_reach_entered_at_s=None,
        dead_reckoning=replace(b.dead_reckoning, gear_below_target_m=math.inf),
    )
    state = replace(
        c.state,
        belief=belief,
        weight_transfer_began_at_s=None,
        motor_stop_commanded_at_s=None,
        must_end_press=False,
        fall_catch_setpoint_above_vehicle_m=choose_fall_catch_setpoint_above_vehicle_m(
            b.hover_thrust, tel.thrust
        ),
        setpoint=None,
        last_stop_or_land_command_at_s=None,
        stop_or_land_command_count=0,
        descent=replace(c.state.descent, last_commanded_raw_thrust=0.0),
        entry=replace(
            c.state.entry,
            t_s=c.t_s,
            vehicle_world_position_m=tel.position_m,
            vehicle_world_yaw_rad=tel.yaw_rad,
        ),
    )
    c = Context(state)
    return _catch_fall(c) or descend(c)


def _catch_fall(c: Context) -> Action | None:
    """Return the new state and the setpoint above the vehicle that stops its fall
    (`catch_falling_vehicle`); None without a heading, with diverged positions, with old telemetry,
    or if no fall has to be caught any more."""
    return (
        None
        if c.belief.is_heading_lost or c.belief.is_position_diverged
        else catch_falling_vehicle(c)
    )


# --- The four policies ---


def _descend_by_setpoints(c: Context) -> Action:
    """Return the new state and the position setpoint of a descent by setpoints. In each tick, the
    setpoint sinks at `landing.speed_mps` towards the ground, vertically below the position at which
    the landing began. With recent telemetry, it stays within
    `MAX_SETPOINT_DISTANCE_BELOW_VEHICLE_M` below the vehicle. The setpoint that is sent also
    contains the lateral integral and is limited to the fence and the height range."""
    landing, state, b = c.planner.landing, c.state, c.belief
    here = make_setpoint_at_vehicle(c)
    start = here
    if state.fall_catch_setpoint_above_vehicle_m is None and state.setpoint is not None:
        start = state.setpoint
    start = replace(start, z_m=min(start.z_m, here.z_m))
    x, y, _ = state.entry.vehicle_world_position_m
    goal = replace(start, x_m=x, y_m=y, z_m=b.ground_z_m + 0.5 * landing.handover_m)
    setpoint = step_setpoint_towards(
        c, start, goal, max_down_mps=landing.speed_mps, changes_heading=False
    )
    if b.telemetry_age_s <= c.safety.telemetry_hold_s:
        setpoint = replace(
            setpoint, z_m=max(setpoint.z_m, here.z_m - MAX_SETPOINT_DISTANCE_BELOW_VEHICLE_M)
        )
    state = forget_contact_when_below(state, MIN_DISTANCE_BELOW_CONTACT_TO_COUNT_AS_DETACHED_M)
    state = replace(state, setpoint=setpoint, fall_catch_setpoint_above_vehicle_m=None)
    dx, dy = state.integral_setpoint_shift_world_xy_m
    sent = replace(setpoint, x_m=setpoint.x_m + dx, y_m=setpoint.y_m + dy)
    return state, limit_setpoint_to_fence_and_height_range(c, sent)


def _descend_by_raw_thrust(c: Context) -> Action:
    """Return the new state and command of a level descent by raw thrust. With old telemetry and a
    hover thrust that is not known well enough, the descent begins by setpoints
    (`should_begin_descent_with_setpoints`).

    In a tick in which the estimated heading jumps, one setpoint with the new heading is sent
    instead. Under raw thrust, the firmware keeps the heading setpoint that it received last, so it
    would turn the vehicle by the jump. Such a turn saturates two motors, which reduces the lift. No
    setpoint is sent to a vehicle that is so low that the setpoint would be above it.
    """
    descent, b = c.state.descent, c.belief
    if (
        c.obs.heading_jump_rad > math.radians(c.safety.heading_lost_deg)
        and b.is_telemetry_fresh
        and descent.floor_detected_at_s is None
        and c.t_s - descent.heading_setpoint_sent_at_s >= MIN_TIME_BETWEEN_HEADING_SETPOINTS_S
        and all(map(math.isfinite, (*b.telemetry.position_m, b.telemetry.yaw_rad)))
    ):
        setpoint = limit_setpoint_to_fence_and_height_range(c, make_setpoint_at_vehicle(c))
        if setpoint.z_m <= b.telemetry.position_m[2]:
            descent = replace(descent, heading_setpoint_sent_at_s=c.t_s)
            return replace(c.state, descent=descent, setpoint=setpoint), setpoint
    return (
        _descend_by_setpoints(c)
        if should_begin_descent_with_setpoints(c)
        else descend_level_by_raw_thrust(c)
    )


def make_onboard_landing_command(
    planner: PlannerConfig, ground_z_m: float, time_in_flight_s: float, vehicle_world_z_m: float
) -> Land:
    """Return the command for the firmware's own landing from height `vehicle_world_z_m`, a quintic
    from rest to rest. Both heights are world z, m. The duration keeps the peak speed at or below
    `ONBOARD_LANDING_PEAK_SPEED_MPS`.

    The motors stop at the end of the trajectory. The goal of the trajectory is therefore below the
    ground by more than the estimated height may have drifted during `time_in_flight_s`, and never
    above the vehicle.
    """
    drifted_m = min(
        MAX_ASSUMED_HEIGHT_DRIFT_FOR_LANDING_GOAL_M,
        planner.landing.drift_mps * max(0.0, time_in_flight_s),
    )
    goal_z_m = min(ground_z_m, vehicle_world_z_m) - (planner.landing.undershoot_m + drifted_m)
    return Land(
        goal_z_m,
        ONBOARD_LANDING_DURATION_MARGIN_S
        + QUINTIC_PEAK_TO_MEAN_SPEED_RATIO
        * (vehicle_world_z_m - goal_z_m)
        / ONBOARD_LANDING_PEAK_SPEED_MPS,
    )


def _command_onboard_landing(c: Context) -> Action:
    """Return the new state and command of the firmware's own landing. The landing command is
    repeated every `LANDING_COMMAND_PERIOD_S`, at most `MAX_LANDING_COMMAND_COUNT` times in all,
    until the telemetry shows that the firmware is executing it. The command is `Idle` in all other
    ticks. With reliable flight data, a press that has not ended is ended by setpoints before the
    first landing command.

    The firmware stops the motors at the end of its trajectory. If that would happen in the air, one
    setpoint ends the trajectory, and a new landing is commanded. There are two such cases. A
    vehicle that is still flying below the estimated ground shows that the estimated height has
    drifted or that the ground is lower here. A vehicle that is still above the ground just before
    the end floats in its ground effect, with too little thrust to follow the trajectory.
    """
    tel, b = c.telemetry, c.belief
    state, away = end_press(c)
    if (
        away is not None
        and not b.is_flight_data_unreliable
        and not state.stop_or_land_command_count
    ):
        return state, away
    ends = (
        state.stop_or_land_command_count >= MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY
        and not (
            b.is_position_valid and b.height_m >= MIN_HEIGHT_TO_COUNT_MOTOR_STOP_AS_IN_FLIGHT_M
        )
    )
    carried = tel.acc_z_g > MAX_SPECIFIC_FORCE_TO_COUNT_AS_FALLING_G or (
        ends and tel.velocity_mps[2] > -MAX_SINK_RATE_TO_COUNT_AS_LANDED_MPS
    )
    if (
        b.is_imu_fresh
        and tel.thrust < 1
        and carried
        and (state.stop_or_land_command_count or not tel.has_bit(FLYING))
    ):
        return state, Idle()  # on the floor, another command would start the motors again
    waited = (
        math.inf
        if state.last_stop_or_land_command_at_s is None
        else c.t_s - state.last_stop_or_land_command_at_s
    )
    seen = (
        state.stop_or_land_command_count >= MIN_LANDING_COMMANDS_BEFORE_CONFIRMATION_BY_TELEMETRY
        and b.is_imu_fresh
        and tel.has_bit(HL_ACTIVE)
    )
    still_flies = (
        all(map(math.isfinite, tel.position_m))
        and tel.thrust >= MIN_THRUST_TO_HOVER_RATIO_TO_COUNT_AS_FLYING * b.hover_thrust
    )
    lead_s = -math.inf
    if b.height_m < -MIN_ESTIMATED_DEPTH_BELOW_GROUND_TO_EXTEND_LANDING_M:
        lead_s = TIME_BEFORE_END_TO_EXTEND_ONBOARD_LANDING_S
    elif b.height_m > MIN_HEIGHT_ABOVE_GROUND_TO_EXTEND_LANDING_M:
        lead_s = TIME_BEFORE_END_TO_EXTEND_LANDING_ABOVE_GROUND_S
    extension_count = state.descent.onboard_landing_extension_count
    if (
        seen
        and still_flies
        and c.t_s >= state.descent.onboard_landing_ends_at_s - lead_s
        and extension_count < MAX_ONBOARD_LANDING_EXTENSIONS
    ):
        # While a landing is in progress, the firmware refuses another one; a setpoint ends its
        # trajectory.
        descent = replace(state.descent, onboard_landing_extension_count=extension_count + 1)
        return replace(
            state, descent=descent, stop_or_land_command_count=0
        ), make_setpoint_at_vehicle(c)
    if (
        not seen
        and waited > LANDING_COMMAND_PERIOD_S
        and state.stop_or_land_command_count < MAX_LANDING_COMMAND_COUNT
    ):
        time_in_flight_s = c.t_s - state.flight_started_at_s
        order = make_onboard_landing_command(
            c.planner, b.ground_z_m, time_in_flight_s, tel.position_m[2]
        )
        descent = state.descent
        if not state.stop_or_land_command_count:  # the firmware ignores the commands that follow
            descent = replace(descent, onboard_landing_ends_at_s=c.t_s + order.duration_s)
        return replace(
            state,
            descent=descent,
            last_stop_or_land_command_at_s=c.t_s,
            stop_or_land_command_count=state.stop_or_land_command_count + 1,
            setpoint=None,
        ), order
    return state, Idle()


def _transfer_weight_to_magnet(c: Context) -> Action:
    """Return the new state and command of a weight transfer to the magnet: raw thrust that falls
    until the magnet carries the vehicle, and then the motor stop. Telemetry with an age up to
    `safety.telemetry_hold_s` is accepted; during a perch, only fresh telemetry is."""
    return transfer_weight_by_raw_thrust(c, max_stale_telemetry_age_s=c.safety.telemetry_hold_s)


def _complete_weight_transfer_to_magnet(c: Context) -> Action:
    """Return the new state and command of a weight transfer that has begun: the thrust continues to
    fall until the magnet carries the vehicle (`_transfer_weight_to_magnet`). A fall is caught
    before this function is called.

    If the attitude in the telemetry is older than `safety.telemetry_hold_s`, a fall could not be
    detected, so the transfer starts over, with a thrust of at most
    `MIN_COMMANDED_TO_HOVER_THRUST_RATIO` of the hover thrust: a hanging vehicle stays in place, and
    a fallen one does not climb."""
    if c.belief.attitude_age_s <= c.safety.telemetry_hold_s:
        return _transfer_weight_to_magnet(c)
    part = MIN_COMMANDED_TO_HOVER_THRUST_RATIO * c.belief.hover_thrust
    thrust = int(
        max(COMMANDED_KEEPALIVE_RAW_THRUST, min(MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE, part))
    )
    return replace(c.state, weight_transfer_began_at_s=c.t_s), RawThrust(thrust)
