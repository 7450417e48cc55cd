"""Actions at the ceiling: end of a press, release onto the magnet, motor stop, and catch.

In position mode, the onboard controller never commands less than
`MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE`. Raw thrust can be reduced until the motors stop turning
(docs/firmware.md, "Release in raw mode"): the whole weight is transferred to the magnet and
monitored before the motors are stopped.
"""

from __future__ import annotations

from perchctl.mission.belief.contact import HANGING_WITH_MOTORS_STOPPED, is_thrust_above_hover
from perchctl.mission.belief.thrust import MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE
from perchctl.mission.belief.update import COMMANDED_KEEPALIVE_RAW_THRUST
from perchctl.mission.context import Context
from perchctl.mission.setpoints import (
    Action,
    correct_setpoint,
    limit_setpoint_to_fence_and_height_range,
    make_setpoint_at_vehicle,
)
from perchctl.mission.state import PlannerState
from perchctl.values import replace
from perchctl.vehicle import Idle, PositionSetpoint, RawThrust, StopMotors

# --- end of a press ---
MIN_DISTANCE_BELOW_CONTACT_TO_END_PRESS_M = 0.08
"""Distance below the contact beyond which the vehicle has left it, m."""
MAX_CLIMB_RATE_TO_COUNT_AS_FALLING_AFTER_PRESS_MPS = -0.3
"""Climb rate below which a vehicle that ends its press is falling, m/s; the setpoint then stays at
the vehicle."""
INTEGRATOR_UNWIND_SETPOINT_BELOW_VEHICLE_IN_PRESS_M = 1.0
"""Distance of the setpoint below a vehicle that is still pressing, m, to unwind the onboard
integrators. Smaller: unwinding takes seconds."""
INTEGRATOR_UNWIND_SETPOINT_BELOW_VEHICLE_IN_AIR_M = 0.25
"""Distance of the setpoint below a vehicle that has left the contact, m, to unwind the onboard
integrators. Larger: the vehicle falls."""
PRESS_END_TIMEOUT_S = 4.0
"""Time after which `end_press` gives up, even if the vehicle has not come off, s."""

# --- release ---
MAX_PRESS_DURATION_FOR_GRADUAL_RELEASE_S = 1.5
"""Time since the vertical speed became constant, s, after which the setpoint of a press is lowered
at once instead of in steps: by then, the onboard integrator has wound up, and it unwinds slowly by
itself. Larger: a press whose contact is proven late, because the thrust was not reported, lasts
longer than 4 s."""
COMMANDED_FRACTION_OF_MAX_THRUST_THAT_PROVES_HANGING = 0.9
"""The raw thrust of a press is lowered to this fraction of `complete.hold_ratio` times hover
thrust, the largest thrust that proves that the magnet holds the vehicle (too little to fly)."""
EXTRA_HANGING_DWELL_IF_THRUST_UNCONFIRMED_S = 1.5
"""Additional hang time if the reported thrust does not follow the commanded one, s."""

# --- stop ---
MOTOR_STOP_COMMAND_COUNT = 5
"""Number of stop commands: a single lost notify message would lock a hanging vehicle."""
MOTOR_STOP_COMMAND_PERIOD_S = 0.1
"""Time between stop commands, s."""
MOTOR_STOP_COMMAND_PERIOD_WHILE_THRUST_REPORTED_S = 0.5
"""Time after which one more stop command is sent while the telemetry shows thrust, s."""

# --- catch ---
FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_OFF_M = 1.0
"""Height of the setpoint above a falling vehicle whose motors have stopped, m."""
FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_ON_M = 0.2
"""Height of the setpoint above a falling vehicle whose motors are running, m: full thrust would
carry it to the ceiling."""
MIN_THRUST_TO_HOVER_RATIO_TO_COUNT_MOTORS_AS_ON = 0.5
"""Fraction of hover thrust above which the motors count as running."""
MIN_FALL_CATCH_DURATION_S = 0.1
"""Shortest duration of a catch, s."""
MAX_FALL_CATCH_DURATION_S = 2.0
"""Longest duration of a catch, s."""
MIN_CLIMB_RATE_TO_END_FALL_CATCH_MPS = -0.1
"""Vertical speed above which the catch ends, m/s: the thrust then exceeds the weight."""
MAX_LATERAL_SPEED_BRAKED_IN_FALL_CATCH_MPS = 1.0
"""Largest lateral speed that is braked, m/s; no impact that the vehicle survives leaves a
higher one."""
ONBOARD_POSITION_TO_VELOCITY_GAIN_PER_S = 2.0
"""Gains `posCtlPid.xKp` and `yKp` of the firmware, 1/s."""


def end_press(c: Context) -> tuple[PlannerState, PositionSetpoint | None]:
    """Return the state, and a setpoint below the vehicle until it has left the contact and the
    onboard integrators have unwound. The setpoint is None after that, after `PRESS_END_TIMEOUT_S`
    in the phase, or if the phase did not begin with a press (`must_end_press` is False)."""
    state, tel = c.state, c.telemetry
    x, y, z = state.entry.vehicle_world_position_m
    if not state.must_end_press:
        return state, None
    away_m = z - tel.position_m[2]
    calm = (
        away_m > MIN_DISTANCE_BELOW_CONTACT_TO_END_PRESS_M
        and not is_thrust_above_hover(c.belief)
        and tel.velocity_mps[2] > MAX_CLIMB_RATE_TO_COUNT_AS_FALLING_AFTER_PRESS_MPS
    )
    if calm or c.time_in_phase_s > PRESS_END_TIMEOUT_S:
        return replace(state, must_end_press=False), None
    setpoint_below_vehicle_m = (
        INTEGRATOR_UNWIND_SETPOINT_BELOW_VEHICLE_IN_PRESS_M
        if away_m < MIN_DISTANCE_BELOW_CONTACT_TO_END_PRESS_M
        else INTEGRATOR_UNWIND_SETPOINT_BELOW_VEHICLE_IN_AIR_M
    )
    if tel.velocity_mps[2] < MAX_CLIMB_RATE_TO_COUNT_AS_FALLING_AFTER_PRESS_MPS:
        setpoint_below_vehicle_m = 0.0
    dx, dy = state.integral_setpoint_shift_world_xy_m
    setpoint = PositionSetpoint(
        x + dx,
        y + dy,
        tel.position_m[2] - setpoint_below_vehicle_m,
        state.entry.vehicle_world_yaw_rad,
    )
    return state, limit_setpoint_to_fence_and_height_range(c, setpoint)


def reduce_press_before_weight_transfer(c: Context) -> Action:
    """Return the state and the command of the first stage of the release: the press against the
    target is reduced so that the magnet takes over the vehicle. The caller starts the second stage
    (`transfer_weight_by_raw_thrust`) once measurements show that the magnet holds.

    In a press by position setpoint, the setpoint is lowered in `complete.steps` steps to
    `complete.release_drop_m` below the contact, or at once if the press has lasted longer than
    `MAX_PRESS_DURATION_FOR_GRADUAL_RELEASE_S`. In a press by raw thrust, which winds up no
    integrator, the thrust is lowered in the same steps to just below the largest thrust that proves
    that the magnet holds the vehicle; with old telemetry, the vehicle is held by position control
    instead (`hold_contact_by_position`).
    """
    complete, perch, state, b = c.planner.complete, c.planner.perch, c.state, c.belief
    step = min(complete.steps, 1 + int(c.time_in_phase_s / complete.release_s * complete.steps))
    pressed_s = c.t_s - b.imu.climb_rate_became_steady_at_s
    if perch.mode != "raw" and pressed_s > MAX_PRESS_DURATION_FOR_GRADUAL_RELEASE_S:
        step = complete.steps
    part = step / complete.steps
    if perch.mode == "raw":
        if not b.is_imu_fresh:
            return hold_contact_by_position(c)
        lowest = (
            COMMANDED_FRACTION_OF_MAX_THRUST_THAT_PROVES_HANGING
            * complete.hold_ratio
            * b.hover_thrust
        )
        return state, RawThrust(int(perch.thrust + part * (lowest - perch.thrust)))
    setpoint = state.setpoint or make_setpoint_at_vehicle(c)
    assert b.vehicle_world_z_at_last_contact_m is not None
    slid_m = (
        0.0
        if b.is_position_valid
        else c.telemetry.position_m[2] - b.vehicle_world_z_at_last_contact_m
    )
    top = state.entry.vehicle_world_position_m[2] + perch.press_m + slid_m
    low = b.vehicle_world_z_at_last_contact_m - complete.release_drop_m + slid_m
    setpoint = replace(setpoint, z_m=top + part * (low - top))
    sent = limit_setpoint_to_fence_and_height_range(
        c, correct_setpoint(c, setpoint, corrects_height=False)
    )
    return replace(state, setpoint=setpoint), sent


def transfer_weight_by_raw_thrust(c: Context, *, max_stale_telemetry_age_s: float = 0.0) -> Action:
    """Return the state and the command of the second stage of the release: raw thrust is reduced
    until the motors stop turning, and the motor stop is commanded once the vehicle has hung for
    `complete.hang_s` with motors that no longer turn. If the reported thrust does not follow the
    commanded one, it must hang longer, by `EXTRA_HANGING_DWELL_IF_THRUST_UNCONFIRMED_S`.

    While the telemetry is not fresh and older than `max_stale_telemetry_age_s`, hold the vehicle by
    position control instead; the stage then starts over. With 0, any telemetry that is not fresh
    has this effect.
    """
    complete, state, b = c.planner.complete, c.state, c.belief
    if not b.is_imu_fresh and b.attitude_age_s > max_stale_telemetry_age_s:
        return hold_contact_by_position(c)
    weight_transfer_began_at_s = state.weight_transfer_began_at_s
    if weight_transfer_began_at_s is None:
        weight_transfer_began_at_s, z_m = c.t_s, c.telemetry.position_m[2]
        b = replace(
            b,
            vehicle_world_z_at_last_contact_m=z_m
            if b.vehicle_world_z_at_last_contact_m is None
            else b.vehicle_world_z_at_last_contact_m,
        )
        state = replace(state, weight_transfer_began_at_s=weight_transfer_began_at_s, belief=b)
    hung_s = c.true_for_s(HANGING_WITH_MOTORS_STOPPED)
    unconfirmed = b.thrust_last_differed_from_command_at_s >= c.t_s - hung_s
    extra_s = EXTRA_HANGING_DWELL_IF_THRUST_UNCONFIRMED_S if unconfirmed else 0.0
    if hung_s >= complete.hang_s + extra_s:
        return stop_motors(c)
    part = min(1.0, (c.t_s - weight_transfer_began_at_s) / complete.ramp_s)
    start = (
        c.planner.perch.thrust
        if state.setpoint is None
        else MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE
    )
    start = min(start, MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE)
    return state, RawThrust(int(start + part * (COMMANDED_KEEPALIVE_RAW_THRUST - start)))


def hold_contact_by_position(c: Context) -> Action:
    """Command a position setpoint above the vehicle while the telemetry is old, to stay in contact
    or to catch an undetected fall. The setpoint is
    `FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_ON_M` above the recorded contact or, without a
    contact or a valid position, above the vehicle's last reported height. The weight transfer then
    starts over."""
    state, tel, b = c.state, c.telemetry, c.belief
    x, y, z_m = tel.position_m
    if b.vehicle_world_z_at_last_contact_m is not None and b.is_position_valid:
        z_m = b.vehicle_world_z_at_last_contact_m
    setpoint = PositionSetpoint(
        x, y, z_m + FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_ON_M, tel.yaw_rad
    )
    return replace(
        state, setpoint=setpoint, weight_transfer_began_at_s=None
    ), limit_setpoint_to_fence_and_height_range(c, setpoint)


def has_thrust_ramped_down(c: Context) -> bool:
    """True if the downward ramp of raw thrust has lasted its whole duration, `complete.ramp_s`, so
    that the commanded thrust no longer turns the motors. False if no ramp has begun."""
    weight_transfer_began_at_s = c.state.weight_transfer_began_at_s
    return (
        weight_transfer_began_at_s is not None
        and c.t_s - weight_transfer_began_at_s > c.planner.complete.ramp_s
    )


def stop_motors(c: Context) -> Action:
    """Send the stop command, and with it the message that ends high-level setpoints (notify),
    `MOTOR_STOP_COMMAND_COUNT` times: if a single notify were lost, the firmware's supervisor would
    lock the hanging vehicle. Send more stop commands while the telemetry shows thrust."""
    state, now_s = c.state, c.t_s
    if state.motor_stop_commanded_at_s is None:
        return replace(
            state,
            motor_stop_commanded_at_s=now_s,
            last_stop_or_land_command_at_s=now_s,
            stop_or_land_command_count=1,
        ), StopMotors()
    waited_s = now_s - (
        state.last_stop_or_land_command_at_s
        if state.last_stop_or_land_command_at_s is not None
        else state.motor_stop_commanded_at_s
    )
    still_to_send = (
        state.stop_or_land_command_count < MOTOR_STOP_COMMAND_COUNT
        and waited_s >= MOTOR_STOP_COMMAND_PERIOD_S
    )
    if still_to_send or (
        c.telemetry.thrust >= 1 and waited_s >= MOTOR_STOP_COMMAND_PERIOD_WHILE_THRUST_REPORTED_S
    ):
        return replace(
            state,
            last_stop_or_land_command_at_s=now_s,
            stop_or_land_command_count=state.stop_or_land_command_count + 1,
        ), StopMotors()
    return state, Idle()


def choose_fall_catch_setpoint_above_vehicle_m(
    hover_thrust: float, reported_thrust: float
) -> float:
    """Return how far above a falling vehicle, m, a setpoint must be to catch the fall. The height
    is smaller if the motors are turning, that is, if the reported thrust exceeds
    `MIN_THRUST_TO_HOVER_RATIO_TO_COUNT_MOTORS_AS_ON` times hover thrust (both 0..65535)."""
    turning = reported_thrust > MIN_THRUST_TO_HOVER_RATIO_TO_COUNT_MOTORS_AS_ON * hover_thrust
    return (
        FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_ON_M
        if turning
        else FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_OFF_M
    )


def catch_falling_vehicle(c: Context) -> Action | None:
    """Catch a vehicle that is falling off the magnet: return a setpoint above it by the height that
    the state prepared for the catch. None if no catch is prepared, or with old telemetry. Also None
    after `MIN_FALL_CATCH_DURATION_S`, once the climb rate is at least
    `MIN_CLIMB_RATE_TO_END_FALL_CATCH_MPS`, and in any case after `MAX_FALL_CATCH_DURATION_S`."""
    state, tel, b = c.state, c.telemetry, c.belief
    if state.fall_catch_setpoint_above_vehicle_m is None or not b.is_imu_fresh:
        return None
    begun = c.time_in_phase_s < MIN_FALL_CATCH_DURATION_S
    if begun or (
        b.climb_mps < MIN_CLIMB_RATE_TO_END_FALL_CATCH_MPS
        and c.time_in_phase_s < MAX_FALL_CATCH_DURATION_S
    ):
        x, y = (
            _braking_setpoint_world_xy_m(c)
            if b.is_estimate_missing_gust
            else state.entry.vehicle_world_position_m[:2]
        )
        setpoint = PositionSetpoint(
            x,
            y,
            tel.position_m[2] + state.fall_catch_setpoint_above_vehicle_m,
            state.entry.vehicle_world_yaw_rad,
        )
        return replace(state, setpoint=setpoint), limit_setpoint_to_fence_and_height_range(
            c, setpoint
        )
    return None


def _braking_setpoint_world_xy_m(c: Context) -> tuple[float, float]:
    """Return world x and y, m, of a setpoint that brakes the lateral velocity that dead reckoning
    shows and the state estimate does not (the difference between the two). The setpoint is behind
    the vehicle, opposite to this velocity, by the velocity (at most
    `MAX_LATERAL_SPEED_BRAKED_IN_FALL_CATCH_MPS` per axis) divided by
    `ONBOARD_POSITION_TO_VELOCITY_GAIN_PER_S`."""
    tel, reckoned_mps = c.telemetry, c.belief.dead_reckoning.velocity_world_mps
    missing_mps = (reckoned_mps[i] - tel.velocity_mps[i] for i in range(2))
    x_mps, y_mps = (
        max(
            -MAX_LATERAL_SPEED_BRAKED_IN_FALL_CATCH_MPS,
            min(MAX_LATERAL_SPEED_BRAKED_IN_FALL_CATCH_MPS, mps),
        )
        for mps in missing_mps
    )
    x_m, y_m, _ = tel.position_m
    return (
        x_m - x_mps / ONBOARD_POSITION_TO_VELOCITY_GAIN_PER_S,
        y_m - y_mps / ONBOARD_POSITION_TO_VELOCITY_GAIN_PER_S,
    )


def forget_contact_when_below(
    state: PlannerState, min_distance_below_contact_m: float
) -> PlannerState:
    """Return the state without its recorded contact if the vehicle is more than
    `min_distance_below_contact_m` below that contact; otherwise unchanged."""
    b = state.belief
    if (
        b.vehicle_world_z_at_last_contact_m is None
        or b.telemetry.position_m[2]
        >= b.vehicle_world_z_at_last_contact_m - min_distance_below_contact_m
    ):
        return state
    return replace(
        state,
        belief=replace(
            b, vehicle_world_z_at_last_contact_m=None, gear_to_target_at_last_contact=None
        ),
    )
