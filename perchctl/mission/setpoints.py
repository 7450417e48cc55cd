"""Position setpoints: towards a goal, corrected by what was learned, and inside all limits.

The firmware flies to a setpoint p by a cascade of PID controllers. On top of it, from the reference
r, with the vehicle at x and its velocity v:

    p = r + integral + near * limit(POSITION_GAIN (r - x) - VELOCITY_GAIN_S v)     sideways
    p = r + limit(HEIGHT_GAIN (r - z) - HEIGHT_RATE_S v_z)                          in height

The integral removes the offset that a steady wind leaves; `near` grows from 0 to 1 as the target
comes closer.
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

HEIGHT_GAIN = 1.5
"""Multiple of the error in height, against the onboard integrator's overshoot. Larger: it
swings."""
HEIGHT_RATE_S = 0.25
"""Part of the vertical speed that is taken off that, s. Smaller: it overshoots."""
HEIGHT_LIMIT_M = 0.15
"""The most that the height of a setpoint is corrected by."""
POSITION_GAIN = 1.0
"""Feedback on the error sideways near the target. Larger: late pictures make it swing."""
VELOCITY_GAIN_S = 0.3
"""Part of the sideways velocity that is taken off that, s."""
STIFF_BELOW_M = 0.8
"""Gear's distance below the target at which this feedback begins."""
STIFF_RANGE_M = 0.4
"""Way over which it grows to its whole."""
STIFF_LIMIT_M = 0.1
"""The most that it moves a setpoint."""
GROUND_CLEARANCE_M = 0.05
"""No setpoint is lower above the ground, but in a take-off."""
SMALL_ERROR_M = 0.06
"""An error of the position that the integral counts in motion, too."""
MOST_TRIM_M = 0.4
"""Against a wind of 5 m/s. Larger: a vehicle that something holds winds its setpoint up further.
Smaller: a wind holds it aside of its target for good."""
STANDS_MPS = 0.1
"""Slower, a vehicle stands still in the air. Larger: an integral winds up on the way to its goal.
Smaller: a wind that shakes the vehicle is never balanced."""
WARY_MPS = 0.25
"""Speed sideways while nothing confirms the camera's mounting. Larger: a turned camera leads it
farther astray."""
OUT_OF_VIEW_SINK_MPS = 0.2
"""Speed at which a held vehicle sinks whose target is out of view."""
LOWEST_M = 0.3
"""Height above the ground to which it sinks."""


def hold_here(c: Context) -> PositionSetpoint:
    """The setpoint at the vehicle's estimated position and heading."""
    x, y, z = c.telemetry.position_m
    return PositionSetpoint(x, y, z, c.telemetry.yaw_rad)


def body_xy_under_target(c: Context, yaw_rad: float) -> tuple[float, float]:
    """The body's world x and y (m) at which the gear is under the target at heading `yaw_rad`."""
    target = c.belief.target.world_m
    assert target is not None
    gear = rot_z(yaw_rad) @ c.profile.vehicle.gear_body_m
    return float(target[0] - gear[0]), float(target[1] - gear[1])


def setpoint_under_target(c: Context, z_m: float) -> PositionSetpoint:
    """The setpoint with the gear under the target and turned like it, the body at height `z_m`."""
    yaw = c.belief.target.world_yaw_rad
    assert yaw is not None
    x, y = body_xy_under_target(c, yaw)
    return PositionSetpoint(x, y, z_m, yaw)


def step_towards(
    c: Context,
    old: PositionSetpoint,
    goal: PositionSetpoint,
    *,
    up_mps: float = 0.0,
    down_mps: float = 0.4,
    wary: bool = False,
    turns: bool = True,
) -> PositionSetpoint:
    """The setpoint one tick after `old`: towards `goal`, climbing at most at `up_mps`, sinking at
    most at `down_mps`. `wary`: slower sideways while nothing confirms the camera's mounting;
    without `turns` the heading stays."""
    dt_s, align = c.t_s - c.state.t_s, c.planner.align
    xy_mps, yaw_radps = align.speed_mps, math.radians(align.yaw_rate_dps)
    if not turns:
        yaw_radps = 0.0
    if wary and c.belief.mounting.is_unconfirmed:
        xy_mps = min(xy_mps, WARY_MPS) if c.belief.target.is_fresh else 0.0
    dx, dy = goal.x_m - old.x_m, goal.y_m - old.y_m
    distance = math.hypot(dx, dy)
    part = 1.0 if distance <= xy_mps * dt_s else xy_mps * dt_s / distance
    dz = max(-down_mps * dt_s, min(up_mps * dt_s, goal.z_m - old.z_m))
    dyaw = wrap_rad(goal.yaw_rad - old.yaw_rad)
    dyaw = max(-yaw_radps * dt_s, min(yaw_radps * dt_s, dyaw))
    return PositionSetpoint(
        old.x_m + part * dx, old.y_m + part * dy, old.z_m + dz, wrap_rad(old.yaw_rad + dyaw)
    )


def fly_to(c: Context, reference: PositionSetpoint, *, lift: bool = True) -> Action:
    """Remember the reference, and send it corrected; without `lift` at its own height."""
    return replace(c.state, setpoint=reference), limit_setpoint(
        c, correct_setpoint(c, reference, lift=lift)
    )


def fly_under_target(c: Context, z_m: float, *, up_mps: float = 0.0) -> Action:
    """Move under the target at height `z_m`, and learn the trim that keeps the gear there."""
    goal = setpoint_under_target(c, z_m)
    trim = update_integral(c, (goal.x_m, goal.y_m), c.t_s - c.state.t_s)
    c = Context(replace(c.state, integral_m=trim))
    old = c.state.setpoint or hold_here(c)
    return fly_to(c, step_towards(c, old, goal, up_mps=up_mps, wary=True))


def update_integral(c: Context, goal_xy: tuple[float, float], dt_s: float) -> tuple[float, float]:
    """The integral (x, y) of the position's error to `goal_xy`, m, world axes, which removes the
    offset that a steady wind leaves.

    It is limited, and frozen while the vehicle is still on its way: a large error counts, and a
    large integral is learned, only once the vehicle stands still in the air."""
    planner = c.planner
    ex = goal_xy[0] - c.telemetry.position_m[0]
    ey = goal_xy[1] - c.telemetry.position_m[1]
    tx, ty = c.state.integral_m
    stands = c.belief.speed_mps < STANDS_MPS
    most_m = MOST_TRIM_M if stands else max(planner.integral_limit_m, math.hypot(tx, ty))
    if stands or math.hypot(ex, ey) < SMALL_ERROR_M:
        tx += planner.integral_per_s * ex * dt_s
        ty += planner.integral_per_s * ey * dt_s
    return limited(tx, ty, most_m)


def anchor_in_wind(c: Context) -> PlannerState:
    """The state with a setpoint where the vehicle is, and with the integral that holds it there, if
    it stands still in the air: the same command as before. A vehicle on its way keeps its setpoint
    and integral. One without a setpoint, or whose positions have diverged, has no integral."""
    reference, (x_m, y_m, _) = c.state.setpoint, c.telemetry.position_m
    if reference is None or c.belief.diverged:
        return replace(c.state, integral_m=(0.0, 0.0))
    if not c.belief.position_valid or c.belief.speed_mps > STANDS_MPS:
        return c.state
    sent = correct_setpoint(c, reference)
    return replace(
        c.state,
        setpoint=replace(reference, x_m=x_m, y_m=y_m),
        integral_m=limited(sent.x_m - x_m, sent.y_m - y_m, MOST_TRIM_M),
    )


def limited(x: float, y: float, most: float) -> tuple[float, float]:
    """The vector (x, y), shortened to a length of `most`."""
    size = math.hypot(x, y)
    return (x, y) if size <= most else (x * most / size, y * most / size)


def correct_setpoint(
    c: Context, reference: PositionSetpoint, *, lift: bool = True
) -> PositionSetpoint:
    """The setpoint that brings the vehicle to `reference`, by the equations above; without `lift`
    at the reference's own height."""
    tel = c.telemetry
    rise = HEIGHT_GAIN * (reference.z_m - tel.position_m[2]) - HEIGHT_RATE_S * tel.velocity_mps[2]
    lifted = max(-HEIGHT_LIMIT_M, min(HEIGHT_LIMIT_M, rise)) if lift else 0.0
    dx, dy = _stiffened(c, reference)
    return replace(
        reference,
        x_m=reference.x_m + c.state.integral_m[0] + dx,
        y_m=reference.y_m + c.state.integral_m[1] + dy,
        z_m=reference.z_m + lifted,
    )


def _stiffened(c: Context, reference: PositionSetpoint) -> tuple[float, float]:
    """Feedback on top of the onboard loop, near the target only."""
    near = (STIFF_BELOW_M - c.belief.target.error_z_m) / STIFF_RANGE_M
    gain = max(0.0, min(1.0, near))
    if gain == 0.0:
        return 0.0, 0.0
    (x, y, _), (vx, vy, _) = c.telemetry.position_m, c.belief.velocity_mps
    dx = gain * (POSITION_GAIN * (reference.x_m - x) - VELOCITY_GAIN_S * vx)
    dy = gain * (POSITION_GAIN * (reference.y_m - y) - VELOCITY_GAIN_S * vy)
    size = math.hypot(dx, dy)
    part = 1.0 if size <= STIFF_LIMIT_M else STIFF_LIMIT_M / size
    return part * dx, part * dy


def sink_setpoint(c: Context, setpoint: PositionSetpoint) -> PositionSetpoint:
    """The held `setpoint` a tick later; lower if the position source is a target out of view."""
    b = c.belief
    if not (b.by_target and b.position_is_stale) or b.ground_m is None:
        return setpoint
    lowest_m = min(setpoint.z_m, b.ground_m[2] + LOWEST_M)
    z_m = setpoint.z_m - OUT_OF_VIEW_SINK_MPS * max(0.0, c.t_s - c.state.t_s)
    return replace(setpoint, z_m=max(lowest_m, z_m))


def limit_setpoint(c: Context, setpoint: PositionSetpoint) -> PositionSetpoint:
    """The setpoint moved inside the fence, under the height limit and (fault 36)
    `GROUND_CLEARANCE_M` above the ground; in a take-off, down to the ground."""
    ground, safety = c.belief.ground_m, c.safety
    if ground is None:
        return setpoint
    dx, dy = setpoint.x_m - ground[0], setpoint.y_m - ground[1]
    distance = math.hypot(dx, dy)
    floor_m = ground[2] + (0.0 if c.state.phase is Phase.APPROACH else GROUND_CLEARANCE_M)
    if distance > safety.fence_radius_m:
        dx, dy = dx * safety.fence_radius_m / distance, dy * safety.fence_radius_m / distance
    return replace(
        setpoint,
        x_m=ground[0] + dx,
        y_m=ground[1] + dy,
        z_m=min(max(setpoint.z_m, floor_m), ground[2] + safety.max_height_m),
    )
