"""Setpoints: where the body has to go, and how fast the setpoint may walk there."""

from __future__ import annotations

import math

from perchctl.geometry import rot_z, wrap_rad
from perchctl.mission.context import Context
from perchctl.mission.state import Phase, PlannerState
from perchctl.values import replace
from perchctl.vehicle import FULL_THRUST, PositionSetpoint

HEIGHT_GAIN = 1.5
HEIGHT_RATE_S = 0.25
HEIGHT_LIMIT_M = 0.15
POSITION_GAIN = 1.0
VELOCITY_GAIN_S = 0.3
STIFF_BELOW_M = 0.8
STIFF_RANGE_M = 0.4
STIFF_LIMIT_M = 0.1
FLOOR_M = 0.05
"""Above the ground, no lower; what is left is the vehicle's own landing."""
PRESSING_PART, PRESSING_RATIO = 0.95, 1.05
UNPRESSED_MPS, UNPRESSED_M, FALLING_MPS = 0.05, 0.08, -0.3
UNWIND_M, UNWIND_AWAY_M, UNPRESS_LIMIT_S = 1.0, 0.25, 4.0
LIFTED_M = 0.1
"""Below it a vehicle may still stand, and its height is not to be corrected."""
FREE_SPEED_MPS = 10.0  # a speed limit that limits nothing


def hold_here(c: Context) -> PositionSetpoint:
    """The present position and heading of the estimate."""
    x, y, z = c.obs.telemetry.position_m
    return PositionSetpoint(x, y, z, c.obs.telemetry.yaw_rad)


def under_target_xy(c: Context, yaw_rad: float) -> tuple[float, float]:
    """Where the body has to be so that the gear is under the target at that heading."""
    target = c.target_m
    assert target is not None
    gear = rot_z(yaw_rad) @ c.profile.vehicle.gear_body_m
    return float(target[0] - gear[0]), float(target[1] - gear[1])


def walk(
    old: PositionSetpoint,
    goal: PositionSetpoint,
    dt_s: float,
    *,
    xy_mps: float,
    up_mps: float,
    down_mps: float,
    yaw_rate_radps: float,
) -> PositionSetpoint:
    """The setpoint one tick later: towards the goal, at limited speeds."""
    dx, dy = goal.x_m - old.x_m, goal.y_m - old.y_m
    distance = math.hypot(dx, dy)
    part = 1.0 if distance <= xy_mps * dt_s else xy_mps * dt_s / distance
    dz = max(-down_mps * dt_s, min(up_mps * dt_s, goal.z_m - old.z_m))
    dyaw = wrap_rad(goal.yaw_rad - old.yaw_rad)
    dyaw = max(-yaw_rate_radps * dt_s, min(yaw_rate_radps * dt_s, dyaw))
    return PositionSetpoint(
        old.x_m + part * dx, old.y_m + part * dy, old.z_m + dz, wrap_rad(old.yaw_rad + dyaw)
    )


def integrated(c: Context, goal_xy: tuple[float, float], dt_s: float) -> tuple[float, float]:
    """Integral of the gear's position error, world axes, limited.

    The onboard position loop answers a steady draught with a steady offset; this
    slow integral takes it away. It rests while the error is large, so that a
    journey does not wind it up.
    """
    planner = c.profile.planner
    ex = goal_xy[0] - c.obs.telemetry.position_m[0]
    ey = goal_xy[1] - c.obs.telemetry.position_m[1]
    tx, ty = c.state.integral_m
    if math.hypot(ex, ey) < 0.06:
        tx += planner.integral_per_s * ex * dt_s
        ty += planner.integral_per_s * ey * dt_s
    size = math.hypot(tx, ty)
    if size > planner.integral_limit_m:
        tx, ty = tx * planner.integral_limit_m / size, ty * planner.integral_limit_m / size
    return tx, ty


def corrected(c: Context, reference: PositionSetpoint, *, lift: bool = True) -> PositionSetpoint:
    """The setpoint that brings the vehicle to the reference.

    Horizontally the learned trim is added and, near the target, the position loop is
    stiffened (`_stiffened`). In height the onboard integrator has wound up in a climb
    and carries the vehicle several centimetres past a setpoint that stops (`zKi` over
    `zKp` of the firmware: a time constant of 4 s); adding a multiple of the height
    error takes that down to the multiple's part.
    """
    tel = c.obs.telemetry
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
    """Position and velocity feedback on top of the onboard loop, near the target only.

    Far away an attitude that is some milliseconds beside its frame moves the seen
    target by centimetres, and a stiff loop would chase that into an oscillation.
    """
    near = (STIFF_BELOW_M - c.error_z_m) / STIFF_RANGE_M
    gain = max(0.0, min(1.0, near))
    if gain == 0.0:
        return 0.0, 0.0
    (x, y, _), (vx, vy, _) = c.obs.telemetry.position_m, c.obs.telemetry.velocity_mps
    dx = gain * (POSITION_GAIN * (reference.x_m - x) - VELOCITY_GAIN_S * vx)
    dy = gain * (POSITION_GAIN * (reference.y_m - y) - VELOCITY_GAIN_S * vy)
    size = math.hypot(dx, dy)
    part = 1.0 if size <= STIFF_LIMIT_M else STIFF_LIMIT_M / size
    return part * dx, part * dy


def limited(c: Context, setpoint: PositionSetpoint) -> PositionSetpoint:
    """The setpoint inside the fence, under the height limit and above the ground (fault 36):
    wherever a wrong target or a step of the estimate would lead, nothing dives into the floor.
    Only a take-off begins lower."""
    ground, safety = c.state.ground_m, c.profile.safety
    if ground is None:
        return setpoint
    dx, dy = setpoint.x_m - ground[0], setpoint.y_m - ground[1]
    distance = math.hypot(dx, dy)
    floor_m = ground[2] + (0.0 if c.state.phase is Phase.APPROACH else FLOOR_M)
    if distance > safety.fence_radius_m:
        dx, dy = dx * safety.fence_radius_m / distance, dy * safety.fence_radius_m / distance
    return replace(
        setpoint,
        x_m=ground[0] + dx,
        y_m=ground[1] + dy,
        z_m=min(max(setpoint.z_m, floor_m), ground[2] + safety.max_height_m),
    )


def presses(c: Context) -> bool:
    """The vehicle is at its thrust's limit, or above what hovering takes, and does not move."""
    return (
        _is_strong(c)
        and abs(c.obs.telemetry.velocity_mps[2]) <= UNPRESSED_MPS
        and c.height_m >= LIFTED_M
    )


def _is_strong(c: Context) -> bool:
    thrust, hover = c.obs.telemetry.thrust, c.state.hover_thrust
    return thrust >= PRESSING_PART * FULL_THRUST or (hover > 0 and thrust >= PRESSING_RATIO * hover)


def unpressed(c: Context) -> tuple[PlannerState, PositionSetpoint | None]:
    """Below where the vehicle is, until it is away from what it pressed against and the
    integrators have come down; None once they have, or where nothing was pressed.

    Pressed for a second at full thrust they take many seconds to come down by a setpoint
    that is a little below, and the change to the vehicle's own landing does not reset them.
    """
    state, tel = c.state, c.obs.telemetry
    x, y, z = state.entry_m
    if not state.pressed:
        return state, None
    away_m = z - tel.position_m[2]
    calm = away_m > UNPRESSED_M and not _is_strong(c) and tel.velocity_mps[2] > FALLING_MPS
    if calm or c.in_phase_s > UNPRESS_LIMIT_S:
        return replace(state, pressed=False), None
    below_m = UNWIND_M if away_m < UNPRESSED_M else UNWIND_AWAY_M
    if tel.velocity_mps[2] < FALLING_MPS:
        below_m = 0.0
    setpoint = PositionSetpoint(x, y, tel.position_m[2] - below_m, state.entry_yaw_rad)
    return state, limited(c, setpoint)
