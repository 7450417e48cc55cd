"""Setpoints, the release at the ceiling, and the catch of a slip: for the phases and the lander.

In position mode the onboard controller never goes below `THRUST_MIN`. Raw thrust goes on to where
the motors stand still (docs/firmware.md, "Release in raw mode"): the whole weight is put on the
magnet and monitored, and only then the motors are stopped.
"""

from __future__ import annotations

import math

from perchctl.geometry import rot_z, wrap_rad
from perchctl.mission.context import Context
from perchctl.mission.state import Condition, Phase, PlannerState
from perchctl.values import replace
from perchctl.vehicle import (
    FULL_THRUST,
    Command,
    Idle,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)

Action = tuple[PlannerState, Command]

HEIGHT_GAIN, HEIGHT_RATE_S, HEIGHT_LIMIT_M = 1.5, 0.25, 0.15
POSITION_GAIN, VELOCITY_GAIN_S = 1.0, 0.3
STIFF_BELOW_M, STIFF_RANGE_M, STIFF_LIMIT_M = 0.8, 0.4, 0.1
FLOOR_M = 0.05  # above the ground, no lower
PRESSING_PART, PRESSING_RATIO = 0.95, 1.05
UNPRESSED_MPS, UNPRESSED_M, FALLING_MPS = 0.05, 0.08, -0.3
UNWIND_M, UNWIND_AWAY_M, UNPRESS_LIMIT_S = 1.0, 0.25, 4.0
SMALL_ERROR_M = 0.06  # an error of the position that counts in motion, too
MOST_TRIM_M = 0.4
"""Against a wind of 5 m/s. Larger: a vehicle that something holds winds its setpoint up further.
Smaller: a wind holds it aside of its target for good."""
STANDS_MPS = 0.1
"""Slower, a vehicle stands still in the air. Larger: an integral winds up on the way to its goal.
Smaller: a wind that shakes the vehicle is never balanced."""
LIFTED_M = 0.1  # below it a vehicle may still stand
WARY_MPS = 0.25  # sideways, while nothing confirms the camera's mounting
FREE_SPEED_MPS = 10.0  # a speed limit that limits nothing
SINK_MPS, LOWEST_M = 0.2, 0.3
STILL_THRUST = 1000  # raw: the motors stand still, the stream lives
UNREAD_S = 1.5  # longer hang if thrust is not read
THRUST_MIN = 20000  # the least of position mode
STOPS, STOP_PERIOD_S, STOP_AGAIN_S = 5, 0.1, 0.5
CATCH_STILL_ABOVE_M, CATCH_TURNING_ABOVE_M = 1.0, 0.2
"""By all the thrust there is, motors that turn would carry it back to the ceiling."""
CATCH_LEAST_S, CATCH_LIMIT_S = 0.1, 2.0
MOST_BRAKED_MPS = 1.0  # no blow that the vehicle survives leaves more
POSITION_GAIN_PER_S = 2.0  # the firmware's `posCtlPid.xKp` and `yKp`
CAUGHT_MPS = -0.1  # by then the thrust is above the weight


# --- Setpoints ---


def hold_here(c: Context) -> PositionSetpoint:
    """The setpoint at the vehicle's estimated position and heading."""
    x, y, z = c.telemetry.position_m
    return PositionSetpoint(x, y, z, c.telemetry.yaw_rad)


def body_xy_under_target(c: Context, yaw_rad: float) -> tuple[float, float]:
    """The body's world x and y (m) at which the gear is under the target at heading `yaw_rad`."""
    target = c.target_m
    assert target is not None
    gear = rot_z(yaw_rad) @ c.profile.vehicle.gear_body_m
    return float(target[0] - gear[0]), float(target[1] - gear[1])


def step_towards(
    c: Context, goal: PositionSetpoint, *, up_mps: float = 0.0, down_mps: float = 0.4
) -> PositionSetpoint:
    """The setpoint one tick later: towards `goal`, climbing at most at `up_mps`, sinking at most at
    `down_mps`, and slower sideways while nothing confirms the camera's mounting. In a landing the
    heading stays."""
    old, dt_s, align = c.state.setpoint or hold_here(c), c.t_s - c.state.t_s, c.planner.align
    xy_mps, yaw_radps = align.speed_mps, math.radians(align.yaw_rate_dps)
    if c.state.phase is Phase.LANDING:
        yaw_radps = 0.0
    if c.state.phase in (Phase.ALIGN, Phase.ASCEND) and c.state.mount.is_unconfirmed:
        xy_mps = min(xy_mps, WARY_MPS) if c.fresh else 0.0
    dx, dy = goal.x_m - old.x_m, goal.y_m - old.y_m
    distance = math.hypot(dx, dy)
    part = 1.0 if distance <= xy_mps * dt_s else xy_mps * dt_s / distance
    dz = max(-down_mps * dt_s, min(up_mps * dt_s, goal.z_m - old.z_m))
    dyaw = wrap_rad(goal.yaw_rad - old.yaw_rad)
    dyaw = max(-yaw_radps * dt_s, min(yaw_radps * dt_s, dyaw))
    return PositionSetpoint(
        old.x_m + part * dx, old.y_m + part * dy, old.z_m + dz, wrap_rad(old.yaw_rad + dyaw)
    )


def update_integral(c: Context, goal_xy: tuple[float, float], dt_s: float) -> tuple[float, float]:
    """The integral (x, y) of the position's error to `goal_xy`, m, world axes, which removes the
    offset that a steady wind leaves.

    It is limited, and frozen while the vehicle is still on its way: a large error counts, and a
    large integral is learned, only once the vehicle stands still in the air."""
    planner = c.planner
    ex = goal_xy[0] - c.telemetry.position_m[0]
    ey = goal_xy[1] - c.telemetry.position_m[1]
    tx, ty = c.state.integral_m
    stands = c.speed_mps < STANDS_MPS
    most_m = MOST_TRIM_M if stands else max(planner.integral_limit_m, math.hypot(tx, ty))
    if stands or math.hypot(ex, ey) < SMALL_ERROR_M:
        tx += planner.integral_per_s * ex * dt_s
        ty += planner.integral_per_s * ey * dt_s
    return limited(tx, ty, most_m)


def anchor_in_wind(c: Context) -> Context:
    """The context with a setpoint where the vehicle is, and with the integral that holds it there,
    if it stands still in the air: the same command as before. A vehicle on its way keeps its
    setpoint and integral. One without a setpoint, or whose positions lead astray, has no
    integral."""
    reference, (x_m, y_m, _) = c.state.setpoint, c.telemetry.position_m
    if reference is None or c.state.astray:
        return c.evolve(integral_m=(0.0, 0.0))
    if not c.placed or c.speed_mps > STANDS_MPS:
        return c
    sent = correct_setpoint(c, reference)
    return c.evolve(
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
    """The setpoint that brings the vehicle to `reference`: with the learned integral, a stiffer
    position loop near the target, and, with `lift`, a multiple of the error in height against
    the onboard integrator's overshoot."""
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
    near = (STIFF_BELOW_M - c.error_z_m) / STIFF_RANGE_M
    gain = max(0.0, min(1.0, near))
    if gain == 0.0:
        return 0.0, 0.0
    (x, y, _), (vx, vy, _) = c.telemetry.position_m, c.velocity_mps
    dx = gain * (POSITION_GAIN * (reference.x_m - x) - VELOCITY_GAIN_S * vx)
    dy = gain * (POSITION_GAIN * (reference.y_m - y) - VELOCITY_GAIN_S * vy)
    size = math.hypot(dx, dy)
    part = 1.0 if size <= STIFF_LIMIT_M else STIFF_LIMIT_M / size
    return part * dx, part * dy


def sink_setpoint(c: Context, setpoint: PositionSetpoint) -> PositionSetpoint:
    """The held `setpoint` a tick later; lower if the position source is a target out of view."""
    if not (c.by_sight and c.position_is_stale) or c.state.ground_m is None:
        return setpoint
    lowest_m = min(setpoint.z_m, c.state.ground_m[2] + LOWEST_M)
    z_m = setpoint.z_m - SINK_MPS * max(0.0, c.t_s - c.state.t_s)
    return replace(setpoint, z_m=max(lowest_m, z_m))


def limit_setpoint(c: Context, setpoint: PositionSetpoint) -> PositionSetpoint:
    """The setpoint moved inside the fence, under the height limit and (fault 36) `FLOOR_M` above
    the ground; in a take-off, down to the ground."""
    ground, safety = c.state.ground_m, c.safety
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


# --- The press, its release, and the catch of a slip ---


def is_pressing(c: Context) -> bool:
    """True if the thrust is at its limit, or above hover thrust, and the vehicle does not move."""
    return (
        _is_strong(c)
        and abs(c.telemetry.velocity_mps[2]) <= UNPRESSED_MPS
        and c.height_m >= LIFTED_M
    )


def _is_strong(c: Context) -> bool:
    thrust, hover = c.telemetry.thrust, c.state.hover_thrust
    return thrust >= PRESSING_PART * FULL_THRUST or (hover > 0 and thrust >= PRESSING_RATIO * hover)


def leave_press(c: Context) -> tuple[PlannerState, PositionSetpoint | None]:
    """The state, and a setpoint below the vehicle until it is away from what it pressed against and
    the onboard integrators have come down; None after that, or if nothing was pressed."""
    state, tel = c.state, c.telemetry
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
    dx, dy = state.integral_m
    setpoint = PositionSetpoint(x + dx, y + dy, tel.position_m[2] - below_m, state.entry_yaw_rad)
    return state, limit_setpoint(c, setpoint)


def lower_thrust(c: Context) -> Action:
    """The release's first stage: lower the setpoint, or a press's raw thrust, in steps."""
    complete, perch, state = c.planner.complete, c.planner.perch, c.state
    step = min(complete.steps, 1 + int(c.in_phase_s / complete.release_s * complete.steps))
    part = step / complete.steps
    if perch.mode == "raw":
        if not c.imu_proves:
            return hold_by_position(c)
        lowest = 0.9 * complete.hold_ratio * state.hover_thrust
        return state, RawThrust(int(perch.thrust + part * (lowest - perch.thrust)))
    setpoint = state.setpoint or hold_here(c)
    assert state.contact_z_m is not None
    slid_m = 0.0 if c.placed else c.telemetry.position_m[2] - state.contact_z_m
    top = state.entry_m[2] + perch.press_m + slid_m
    low = state.contact_z_m - complete.release_drop_m + slid_m
    setpoint = replace(setpoint, z_m=top + part * (low - top))
    sent = limit_setpoint(c, correct_setpoint(c, setpoint, lift=False))
    return replace(state, setpoint=setpoint), sent


def release_by_thrust(c: Context) -> Action:
    """The release's second stage: raw thrust down to still motors, and the stop when the whole
    weight has hung long enough. Old telemetry restarts the stage; a landing takes older samples."""
    late_s = c.safety.telemetry_hold_s if c.state.phase is Phase.LANDING else 0.0
    if not c.imu_proves and c.attitude_age_s > late_s:
        return hold_by_position(c)
    complete, state = c.planner.complete, c.state
    if state.released_s is None:
        z_m = c.telemetry.position_m[2]
        state = replace(state, released_s=c.t_s, contact_z_m=state.contact_z_m or z_m)
    assert state.released_s is not None
    hung_s = c.held_s(Condition.WEIGHT_HANGS)
    unread_s = UNREAD_S if state.unread_s >= c.t_s - hung_s else 0.0
    if hung_s >= complete.hang_s + unread_s:
        return stop_motors(c)
    part = min(1.0, (c.t_s - state.released_s) / complete.ramp_s)
    start = c.planner.perch.thrust if state.setpoint is None else THRUST_MIN
    start = min(start, THRUST_MIN)
    return state, RawThrust(int(start + part * (STILL_THRUST - start)))


def hold_by_position(c: Context) -> Action:
    """Hold by position while telemetry is old, to stay in contact or to catch an unseen fall."""
    state, tel = c.state, c.telemetry
    x, y, z_m = tel.position_m
    if state.contact_z_m is not None and c.placed:
        z_m = state.contact_z_m
    setpoint = PositionSetpoint(x, y, z_m + CATCH_TURNING_ABOVE_M, tel.yaw_rad)
    return replace(state, setpoint=setpoint, released_s=None), limit_setpoint(c, setpoint)


def motors_are_still(c: Context) -> bool:
    """True if raw thrust has brought the motors to a stop."""
    released_s = c.state.released_s
    return released_s is not None and c.t_s - released_s > c.planner.complete.ramp_s


def stop_motors(c: Context) -> Action:
    """Send stop and notify `STOPS` times, since a lost notify locks a hanging vehicle; send more
    while telemetry shows thrust."""
    state, now_s = c.state, c.t_s
    if state.stopped_s is None:
        return replace(state, stopped_s=now_s, ordered_s=now_s, orders=1), StopMotors()
    waited_s = now_s - (state.ordered_s if state.ordered_s is not None else state.stopped_s)
    still_to_send = state.orders < STOPS and waited_s >= STOP_PERIOD_S
    if still_to_send or (c.telemetry.thrust >= 1 and waited_s >= STOP_AGAIN_S):
        return replace(state, ordered_s=now_s, orders=state.orders + 1), StopMotors()
    return state, Idle()


def catch_goal_above_m(hover_thrust: float, thrust: float) -> float:
    """Return how far above a falling vehicle its setpoint must be, by its present `thrust`."""
    turning = thrust > 0.5 * hover_thrust
    return CATCH_TURNING_ABOVE_M if turning else CATCH_STILL_ABOVE_M


def catch_slip(c: Context) -> Action | None:
    """The setpoint far above that stops a slip; None after the fall, or with old telemetry."""
    state, tel = c.state, c.telemetry
    if state.caught or not c.imu_proves:
        return None
    begun = c.in_phase_s < CATCH_LEAST_S
    if begun or (c.climb_mps < CAUGHT_MPS and c.in_phase_s < CATCH_LIMIT_S):
        x, y = _braked_place_m(c) if c.is_blown else state.entry_m[:2]
        setpoint = PositionSetpoint(
            x, y, tel.position_m[2] + state.catch_goal_above_m, state.entry_yaw_rad
        )
        return replace(state, setpoint=setpoint), limit_setpoint(c, setpoint)
    return None


def _braked_place_m(c: Context) -> tuple[float, float]:
    """The setpoint that takes out a sideways speed which the estimate misses."""
    tel, reckoned_mps = c.telemetry, c.state.reckoning.velocity_mps
    missed_mps = (reckoned_mps[i] - tel.velocity_mps[i] for i in range(2))
    x_mps, y_mps = (max(-MOST_BRAKED_MPS, min(MOST_BRAKED_MPS, mps)) for mps in missed_mps)
    x_m, y_m, _ = tel.position_m
    return x_m - x_mps / POSITION_GAIN_PER_S, y_m - y_mps / POSITION_GAIN_PER_S


def clear_contact_below(c: Context, below_m: float) -> Context:
    """The context; without its contact if the vehicle is more than `below_m` below the contact."""
    contact_z_m = c.state.contact_z_m
    if contact_z_m is None or c.telemetry.position_m[2] >= contact_z_m - below_m:
        return c
    return c.evolve(contact_z_m=None, contact=None)
