"""Compute position setpoints: step towards a goal, apply learned corrections, and enforce all
limits.

The firmware flies to a setpoint p with a cascade of PID controllers. On top of that cascade,
perchctl computes p from the reference r, the vehicle's position x (height z), its velocity v, and
the acceleration a due to its tilt:

    lateral:   p = r + integral
                   + limit(gain * (LATERAL_ERROR_TO_SETPOINT_CORRECTION_GAIN (r - x)
                                   - LATERAL_VELOCITY_TO_SETPOINT_DAMPING_GAIN_S v
                                   - TILT_ACCELERATION_TO_SETPOINT_DAMPING_GAIN_S2 a))
    vertical:  p = r + limit(HEIGHT_ERROR_TO_SETPOINT_CORRECTION_GAIN (r - z)
                             - CLIMB_RATE_TO_SETPOINT_DAMPING_GAIN_S v_z)

The integral removes the offset that a steady wind leaves. The lateral correction is state feedback
on the whole chain from setpoint to position: a setpoint acts through the attitude, so the present
tilt becomes velocity a tenth of a second later. Feedback of the tilt permits higher gains without
oscillation, but only while the telemetry is prompt. Therefore, `gain` is the smaller of two
factors: one grows from 0 to 1 as the target comes closer, and one falls from 1 to 0 as the
telemetry ages. With a `gain` of 0, the vehicle is left to its onboard controllers, which act
without the delay of the telemetry.
"""

from __future__ import annotations

import math

from perchctl.geometry import rot_z, wrap_rad
from perchctl.mission.context import Context
from perchctl.mission.phase import Phase
from perchctl.mission.state import PlannerState
from perchctl.values import replace
from perchctl.vehicle import Command, PositionSetpoint

Action = tuple[PlannerState, Command]

HEIGHT_ERROR_TO_SETPOINT_CORRECTION_GAIN = 1.5
"""Gain on the height error, to counter the overshoot of the onboard integrator. Larger: the vehicle
oscillates."""
CLIMB_RATE_TO_SETPOINT_DAMPING_GAIN_S = 0.25
"""Damping of the height correction by the vertical speed, s. Smaller: the vehicle overshoots."""
MAX_SETPOINT_HEIGHT_CORRECTION_M = 0.15
"""Largest correction of a setpoint's height, m."""
LATERAL_ERROR_TO_SETPOINT_CORRECTION_GAIN = 3.0
"""Gain on the lateral error near the target. Larger: late pictures make the vehicle oscillate.
Smaller: fluctuations of the thrust move the vehicle further."""
LATERAL_VELOCITY_TO_SETPOINT_DAMPING_GAIN_S = 1.1
"""Damping of the lateral correction by the lateral velocity, s. Larger: the noise of the estimated
velocity moves the vehicle. Smaller: the vehicle oscillates."""
TILT_ACCELERATION_TO_SETPOINT_DAMPING_GAIN_S2 = 0.13
"""Damping of the lateral correction by the acceleration due to the vehicle's tilt, s^2. Larger: the
vehicle responds late to an error. Smaller: the vehicle oscillates with these gains."""
MAX_TELEMETRY_AGE_FOR_FULL_LATERAL_FEEDBACK_S = 0.06
"""Age of the telemetry up to which the lateral feedback has its full gain, s. Larger: late
telemetry makes the vehicle oscillate. Smaller: telemetry at 25 Hz weakens the feedback."""
MAX_TELEMETRY_AGE_FOR_LATERAL_FEEDBACK_S = 0.16
"""Age of the telemetry at which the gain of the lateral feedback has fallen to zero, s."""
LATERAL_FEEDBACK_START_DISTANCE_BELOW_TARGET_M = 0.8
"""Distance of the gear below the target at which the lateral feedback starts, m."""
LATERAL_FEEDBACK_FADE_IN_DISTANCE_M = 0.4
"""Distance over which the lateral feedback grows to its full gain, m."""
MAX_LATERAL_SETPOINT_CORRECTION_M = 0.1
"""Largest correction of a setpoint by the lateral feedback, m."""
MIN_SETPOINT_HEIGHT_ABOVE_GROUND_M = 0.05
"""Lowest height of a setpoint above the ground, m, except in a take-off."""
MAX_LATERAL_ERROR_TO_INTEGRATE_IN_MOTION_M = 0.06
"""Largest lateral position error that the integral still accumulates while the vehicle moves, m."""
MAX_INTEGRAL_SETPOINT_SHIFT_M = 0.4
"""Largest integral, m; it balances a wind of 5 m/s. Larger: the setpoint of a vehicle that is held
winds up further. Smaller: a wind keeps the vehicle off its target permanently."""
MAX_SPEED_TO_COUNT_AS_HOVERING_MPS = 0.1
"""Speed below which the vehicle hovers in place, m/s. Larger: the integral winds up on the way to
the goal. Smaller: a gusty wind is never balanced."""
MAX_LATERAL_SPEED_WITH_UNCONFIRMED_CAMERA_MOUNTING_MPS = 0.25
"""Largest lateral speed of the setpoint while the camera's mounting is unconfirmed, m/s. Larger: a
rotated camera leads the vehicle further off course."""
HELD_SETPOINT_SINK_RATE_WITHOUT_SIGHTING_MPS = 0.2
"""Sink rate commanded during a hold while the camera does not see the target, m/s."""
MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M = 0.3
"""Height above the ground at which a held setpoint stops sinking, m."""


def make_setpoint_at_vehicle(c: Context) -> PositionSetpoint:
    """Return the setpoint at the vehicle's estimated position and heading."""
    x, y, z = c.telemetry.position_m
    return PositionSetpoint(x, y, z, c.telemetry.yaw_rad)


def vehicle_world_xy_with_gear_under_target_m(c: Context, yaw_rad: float) -> tuple[float, float]:
    """Return the world x and y, m, that the body's origin must have for the gear to be below the
    target, if the vehicle's heading is `yaw_rad`. The target's position must be known."""
    target = c.belief.target.world_position_m
    assert target is not None
    gear = rot_z(yaw_rad) @ c.profile.vehicle.gear_body_m
    return float(target[0] - gear[0]), float(target[1] - gear[1])


def make_setpoint_under_target(c: Context, vehicle_world_z_m: float) -> PositionSetpoint:
    """Return the setpoint that brings the gear below the target: the body's origin at world z
    `vehicle_world_z_m`, with the target's heading. The target's position must be known."""
    yaw = c.belief.target.world_yaw_rad
    assert yaw is not None
    x, y = vehicle_world_xy_with_gear_under_target_m(c, yaw)
    return PositionSetpoint(x, y, vehicle_world_z_m, yaw)


def step_setpoint_towards(
    c: Context,
    old: PositionSetpoint,
    goal: PositionSetpoint,
    *,
    max_up_mps: float = 0.0,
    max_down_mps: float = 0.4,
    limits_speed_until_camera_mounting_confirmed: bool = False,
    changes_heading: bool = True,
) -> PositionSetpoint:
    """Return the setpoint of the next tick: `old`, moved towards `goal` with a speed of at most
    `max_up_mps` upwards, `max_down_mps` downwards and `align.speed_mps` laterally, and turned at no
    more than `align.yaw_rate_dps`. If `limits_speed_until_camera_mounting_confirmed` is True and
    the camera's mounting is still unconfirmed, the lateral speed is at most
    `MAX_LATERAL_SPEED_WITH_UNCONFIRMED_CAMERA_MOUNTING_MPS`, and zero if the camera has not seen
    the target recently. If `changes_heading` is False, the heading stays."""
    dt_s, align = c.t_s - c.state.t_s, c.planner.align
    xy_mps, yaw_radps = align.speed_mps, math.radians(align.yaw_rate_dps)
    if not changes_heading:
        yaw_radps = 0.0
    if (
        limits_speed_until_camera_mounting_confirmed
        and c.belief.camera_mounting_monitor.is_target_motion_undetermined
    ):
        xy_mps = (
            min(xy_mps, MAX_LATERAL_SPEED_WITH_UNCONFIRMED_CAMERA_MOUNTING_MPS)
            if c.belief.target.is_fresh
            else 0.0
        )
    dx, dy = goal.x_m - old.x_m, goal.y_m - old.y_m
    distance = math.hypot(dx, dy)
    part = 1.0 if distance <= xy_mps * dt_s else xy_mps * dt_s / distance
    dz = max(-max_down_mps * dt_s, min(max_up_mps * dt_s, goal.z_m - old.z_m))
    dyaw = wrap_rad(goal.yaw_rad - old.yaw_rad)
    dyaw = max(-yaw_radps * dt_s, min(yaw_radps * dt_s, dyaw))
    return PositionSetpoint(
        old.x_m + part * dx, old.y_m + part * dy, old.z_m + dz, wrap_rad(old.yaw_rad + dyaw)
    )


def fly_to(c: Context, reference: PositionSetpoint, *, corrects_height: bool = True) -> Action:
    """Return the state and the command that bring the vehicle to `reference`. The state stores
    `reference` as its setpoint. The command is that setpoint, corrected for wind and onboard
    control errors (`correct_setpoint`) and kept inside the fence and the height limits. If
    `corrects_height` is False, the height is not corrected."""
    return replace(c.state, setpoint=reference), limit_setpoint_to_fence_and_height_range(
        c, correct_setpoint(c, reference, corrects_height=corrects_height)
    )


def fly_under_target(c: Context, vehicle_world_z_m: float, *, max_up_mps: float = 0.0) -> Action:
    """Return the state and the command that move the gear under the target, with the body's origin
    at world z `vehicle_world_z_m`. The setpoint climbs at no more than `max_up_mps`; by default, it
    does not climb. The state's lateral integral, which shifts the setpoint against a steady wind,
    is updated (`update_lateral_integral`)."""
    goal = make_setpoint_under_target(c, vehicle_world_z_m)
    integral_setpoint_shift_world_xy_m = update_lateral_integral(
        c, (goal.x_m, goal.y_m), c.t_s - c.state.t_s
    )
    c = Context(
        replace(c.state, integral_setpoint_shift_world_xy_m=integral_setpoint_shift_world_xy_m)
    )
    old = c.state.setpoint or make_setpoint_at_vehicle(c)
    return fly_to(
        c,
        step_setpoint_towards(
            c, old, goal, max_up_mps=max_up_mps, limits_speed_until_camera_mounting_confirmed=True
        ),
    )


def update_lateral_integral(
    c: Context, goal_world_xy_m: tuple[float, float], dt_s: float
) -> tuple[float, float]:
    """Return the integral (x, y) over time of the lateral position error to `goal_world_xy_m`,
    times the gain `integral_per_s`: a shift of the setpoint, m, world axes, that removes the offset
    which a steady wind leaves. `dt_s` is the time since the last update.

    While the vehicle hovers in place (slower than `MAX_SPEED_TO_COUNT_AS_HOVERING_MPS`), any error
    is integrated, up to a shift of `MAX_INTEGRAL_SETPOINT_SHIFT_M`. While it moves, only errors
    below `MAX_LATERAL_ERROR_TO_INTEGRATE_IN_MOTION_M` are, and the shift does not grow beyond
    `integral_limit_m`.
    """
    planner = c.planner
    ex = goal_world_xy_m[0] - c.telemetry.position_m[0]
    ey = goal_world_xy_m[1] - c.telemetry.position_m[1]
    tx, ty = c.state.integral_setpoint_shift_world_xy_m
    stands = c.belief.speed_mps < MAX_SPEED_TO_COUNT_AS_HOVERING_MPS
    most_m = (
        MAX_INTEGRAL_SETPOINT_SHIFT_M
        if stands
        else max(planner.integral_limit_m, math.hypot(tx, ty))
    )
    if stands or math.hypot(ex, ey) < MAX_LATERAL_ERROR_TO_INTEGRATE_IN_MOTION_M:
        tx += planner.integral_per_s * ex * dt_s
        ty += planner.integral_per_s * ey * dt_s
    return limit_vector_length(tx, ty, most_m)


def move_setpoint_to_vehicle(c: Context) -> PlannerState:
    """Return the state for a landing that keeps the learned wind correction. If the vehicle is
    hovering in place, x and y of the setpoint become those of the vehicle, and the lateral integral
    absorbs the difference, so that the command that is sent does not jump.

    If there is no setpoint or positions have diverged, only the integral changes: it becomes zero.
    Otherwise, a vehicle that is moving or has no valid position keeps its setpoint and integral.
    """
    reference, (x_m, y_m, _) = c.state.setpoint, c.telemetry.position_m
    if reference is None or c.belief.is_position_diverged:
        return replace(c.state, integral_setpoint_shift_world_xy_m=(0.0, 0.0))
    if not c.belief.is_position_valid or c.belief.speed_mps > MAX_SPEED_TO_COUNT_AS_HOVERING_MPS:
        return c.state
    sent = correct_setpoint(c, reference)
    return replace(
        c.state,
        setpoint=replace(reference, x_m=x_m, y_m=y_m),
        integral_setpoint_shift_world_xy_m=limit_vector_length(
            sent.x_m - x_m, sent.y_m - y_m, MAX_INTEGRAL_SETPOINT_SHIFT_M
        ),
    )


def limit_vector_length(x: float, y: float, max_length: float) -> tuple[float, float]:
    """Return the vector (x, y), shortened to at most `max_length`."""
    size = math.hypot(x, y)
    return (x, y) if size <= max_length else (x * max_length / size, y * max_length / size)


def correct_setpoint(
    c: Context, reference: PositionSetpoint, *, corrects_height: bool = True
) -> PositionSetpoint:
    """Return the setpoint to send so that the vehicle reaches `reference` in spite of wind and
    onboard control errors: the reference plus the lateral integral, the lateral feedback
    (`_lateral_feedback_shift_world_xy_m`), and a height correction of at most
    `MAX_SETPOINT_HEIGHT_CORRECTION_M` from the height error and the vertical speed (world axes, m;
    the module docstring has the equations). If `corrects_height` is False, the height is that of
    the reference."""
    tel = c.telemetry
    rise = (
        HEIGHT_ERROR_TO_SETPOINT_CORRECTION_GAIN * (reference.z_m - tel.position_m[2])
        - CLIMB_RATE_TO_SETPOINT_DAMPING_GAIN_S * tel.velocity_mps[2]
    )
    lifted = (
        max(-MAX_SETPOINT_HEIGHT_CORRECTION_M, min(MAX_SETPOINT_HEIGHT_CORRECTION_M, rise))
        if corrects_height
        else 0.0
    )
    dx, dy = _lateral_feedback_shift_world_xy_m(c, reference)
    return replace(
        reference,
        x_m=reference.x_m + c.state.integral_setpoint_shift_world_xy_m[0] + dx,
        y_m=reference.y_m + c.state.integral_setpoint_shift_world_xy_m[1] + dy,
        z_m=reference.z_m + lifted,
    )


def _lateral_feedback_shift_world_xy_m(
    c: Context, reference: PositionSetpoint
) -> tuple[float, float]:
    """Return the shift (x, y) of the setpoint, m, world axes, that adds feedback of lateral
    position, velocity and tilt to the feedback of the onboard controllers; zero far from the target
    or with old telemetry."""
    near = (
        LATERAL_FEEDBACK_START_DISTANCE_BELOW_TARGET_M - c.belief.target.gear_to_target_z_m
    ) / LATERAL_FEEDBACK_FADE_IN_DISTANCE_M
    prompt = (MAX_TELEMETRY_AGE_FOR_LATERAL_FEEDBACK_S - c.belief.attitude_age_s) / (
        MAX_TELEMETRY_AGE_FOR_LATERAL_FEEDBACK_S - MAX_TELEMETRY_AGE_FOR_FULL_LATERAL_FEEDBACK_S
    )
    gain = max(0.0, min(1.0, near, prompt))
    if gain == 0.0:
        return 0.0, 0.0
    (error_x_m, error_y_m), (vx_mps, vy_mps) = _lateral_error_and_velocity_world_xy(c, reference)
    ax_mps2, ay_mps2 = c.belief.acceleration_from_tilt_world_xy_mps2
    dx = (
        LATERAL_ERROR_TO_SETPOINT_CORRECTION_GAIN * error_x_m
        - LATERAL_VELOCITY_TO_SETPOINT_DAMPING_GAIN_S * vx_mps
        - TILT_ACCELERATION_TO_SETPOINT_DAMPING_GAIN_S2 * ax_mps2
    )
    dy = (
        LATERAL_ERROR_TO_SETPOINT_CORRECTION_GAIN * error_y_m
        - LATERAL_VELOCITY_TO_SETPOINT_DAMPING_GAIN_S * vy_mps
        - TILT_ACCELERATION_TO_SETPOINT_DAMPING_GAIN_S2 * ay_mps2
    )
    dx, dy = gain * dx, gain * dy
    size = math.hypot(dx, dy)
    part = (
        1.0
        if size <= MAX_LATERAL_SETPOINT_CORRECTION_M
        else MAX_LATERAL_SETPOINT_CORRECTION_M / size
    )
    return part * dx, part * dy


def _lateral_error_and_velocity_world_xy(
    c: Context, reference: PositionSetpoint
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the vector from the vehicle to `reference`, m, and the vehicle's velocity, m/s, both
    (x, y) in world axes. Both come from pictures and tilt while recent pictures show the target,
    otherwise from the state estimate. During take-off and landing, which do not follow the target,
    they always come from the state estimate."""
    lateral, tel, maneuver = (
        c.belief.lateral_offset_and_velocity,
        c.telemetry,
        c.belief.command_history.maneuver,
    )
    follows_target = maneuver.is_camera_guided or maneuver.presses_against_target
    if lateral is None or not follows_target or c.belief.target.world_position_m is None:
        x_m, y_m, _ = tel.position_m
        return (reference.x_m - x_m, reference.y_m - y_m), c.belief.velocity_world_mps[:2]
    # The reference may still be on its way to the target. The offset applies to the gear at the
    # vehicle's present heading, and the reference's heading may differ.
    x_m, y_m = vehicle_world_xy_with_gear_under_target_m(c, tel.yaw_rad)
    return (
        reference.x_m - x_m + lateral.gear_to_target_world_xy_m[0],
        reference.y_m - y_m + lateral.gear_to_target_world_xy_m[1],
    ), lateral.vehicle_velocity_world_xy_mps


def lower_held_setpoint(c: Context, setpoint: PositionSetpoint) -> PositionSetpoint:
    """Return `setpoint`, which the vehicle holds, one tick later. If the target is the position
    source and the position is stale because the target is out of view, the setpoint sinks at
    `HELD_SETPOINT_SINK_RATE_WITHOUT_SIGHTING_MPS`, down to
    `MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M` above the ground, to bring the target back into view.
    Otherwise, it is unchanged."""
    b = c.belief
    if not (b.is_target_position_source and b.is_position_stale) or b.takeoff_position_m is None:
        return setpoint
    lowest_m = min(setpoint.z_m, b.takeoff_position_m[2] + MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M)
    z_m = setpoint.z_m - HELD_SETPOINT_SINK_RATE_WITHOUT_SIGHTING_MPS * max(
        0.0, c.t_s - c.state.t_s
    )
    return replace(setpoint, z_m=max(lowest_m, z_m))


def limit_setpoint_to_fence_and_height_range(
    c: Context, setpoint: PositionSetpoint
) -> PositionSetpoint:
    """Return the setpoint moved inside the fence, below the height limit, and at least
    `MIN_SETPOINT_HEIGHT_ABOVE_GROUND_M` above the ground; in a take-off, at least at the ground.
    The setpoint is unchanged while the take-off position is unknown."""
    ground, safety = c.belief.takeoff_position_m, c.safety
    if ground is None:
        return setpoint
    dx, dy = setpoint.x_m - ground[0], setpoint.y_m - ground[1]
    distance = math.hypot(dx, dy)
    floor_m = ground[2] + (
        0.0 if c.state.phase is Phase.APPROACH else MIN_SETPOINT_HEIGHT_ABOVE_GROUND_M
    )
    if distance > safety.fence_radius_m:
        dx, dy = dx * safety.fence_radius_m / distance, dy * safety.fence_radius_m / distance
    return replace(
        setpoint,
        x_m=ground[0] + dx,
        y_m=ground[1] + dy,
        z_m=min(max(setpoint.z_m, floor_m), ground[2] + safety.max_height_m),
    )
