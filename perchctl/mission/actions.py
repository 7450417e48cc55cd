"""What each phase sends: one small function a phase, (context) -> (state, command).

Before each command ask: what if it is the last packet? A position setpoint left
alone levels out after 0.5 s and is cut after 2 s (docs/firmware.md, "When setpoints
stop"). `perchctl.mission.release` holds what stops the motors, `landing` the way down.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from perchctl.mission import lander
from perchctl.mission.context import Context
from perchctl.mission.guards import sinking
from perchctl.mission.guidance import (
    FREE_SPEED_MPS,
    LIFTED_M,
    corrected,
    hold_here,
    integrated,
    limited,
    under_target_xy,
    unpressed,
    walk,
)
from perchctl.mission.release import (
    Acted,
    catch,
    is_still,
    left_contact,
    let_go,
    lower,
    stop_motors,
)
from perchctl.mission.state import Condition, MotorStop, Phase
from perchctl.values import replace
from perchctl.vehicle import (
    EmergencyStop,
    Idle,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)

AWAY_M = 0.05
"""Below the contact by so much, or by half of the descent, a vehicle has left the ceiling."""
BLOCKED_ROOM_M = 0.1
"""How far a search keeps from what it once was pressed against."""
WARY_MPS, WARY_M = 0.25, 0.2
"""Sideways, as long as nothing tells whether the camera's mounting is right."""


def act(c: Context) -> Acted:
    """The phase's command for this tick."""
    # A fall is caught, and a press ended, whatever else is to be held: its setpoint is above.
    leaves = c.state.phase is Phase.RECOVER and (c.state.pressed or not c.state.caught)
    if c.state.hold and c.state.setpoint is not None and not leaves:
        lift = c.state.phase is not Phase.APPROACH or c.height_m > LIFTED_M
        return _fly_to(c, sinking(c, c.state.setpoint), lift=lift)
    return ACTIONS[c.state.phase](c)


def _fly_to(c: Context, reference: PositionSetpoint, *, lift: bool = True) -> Acted:
    """Remember the reference, send it corrected. `lift` False sends its height as it is."""
    return replace(c.state, setpoint=reference), limited(c, corrected(c, reference, lift=lift))


def _walk_to(
    c: Context, goal: PositionSetpoint, *, up_mps: float = 0.0, down_mps: float = 0.4
) -> Acted:
    """Only SEARCH and ASCEND pass an `up_mps`. What else climbs: APPROACH, the press of PERCH,
    and the catch of a slip."""
    return _fly_to(c, _walked(c, goal, up_mps, down_mps))


def _walked(c: Context, goal: PositionSetpoint, up_mps: float, down_mps: float) -> PositionSetpoint:
    align = c.profile.planner.align
    xy_mps = align.speed_mps
    if c.state.phase in (Phase.ALIGN, Phase.ASCEND) and c.state.mount.open:
        xy_mps = min(xy_mps, WARY_MPS) if c.fresh else 0.0
    return walk(
        c.state.setpoint or hold_here(c),
        goal,
        c.obs.t_s - c.state.t_s,
        xy_mps=xy_mps,
        up_mps=up_mps,
        down_mps=down_mps,
        yaw_rate_radps=math.radians(align.yaw_rate_dps),
    )


def _under_target(c: Context, z_m: float, *, up_mps: float = 0.0, down_mps: float = 0.4) -> Acted:
    """Walk under the target at height `z_m`, and learn the trim that keeps the gear there."""
    goal = _target_goal(c, z_m)
    trim = integrated(c, (goal.x_m, goal.y_m), c.obs.t_s - c.state.t_s)
    c = Context(replace(c.state, integral_m=trim), c.obs, c.profile)
    return _walk_to(c, goal, up_mps=up_mps, down_mps=down_mps)


def _target_goal(c: Context, z_m: float) -> PositionSetpoint:
    yaw = c.target_yaw_rad
    assert yaw is not None
    x, y = under_target_xy(c, yaw)
    return PositionSetpoint(x, y, z_m, yaw)


def _approach(c: Context) -> Acted:
    """Rise from the ground on position setpoints. A stream that falls silent, at whatever
    moment, ends in level-out and cut, never in a hover of the vehicle's own."""
    planner, state = c.profile.planner, c.state
    assert state.ground_m is not None
    x, y, z = state.ground_m
    start = state.setpoint or PositionSetpoint(x, y, z, state.entry_yaw_rad)
    if planner.approach_xy_m is not None and c.height_m > 0.7 * planner.takeoff_height_m:
        x, y = planner.approach_xy_m
    goal = PositionSetpoint(x, y, z + planner.takeoff_height_m, state.entry_yaw_rad)
    c = Context(replace(state, setpoint=start), c.obs, c.profile)
    setpoint = _walked(c, goal, planner.takeoff_speed_mps, 0.4)
    return _fly_to(c, setpoint, lift=c.height_m > LIFTED_M)


def _search(c: Context) -> Acted:
    """Wait, climb a step, turn a step, wait again; never above the limit. A target that
    was seen before is looked for from under it, not climbed to; as long as nothing speaks
    for the camera's mounting, only a little nearer than where it was seen last."""
    search, state, ground_m = c.profile.planner.search, c.state, c.state.ground_m
    assert ground_m is not None
    if c.obs.t_s - state.search_step_s > search.wait_s:
        state = replace(state, searches=state.searches + 1, search_step_s=c.obs.t_s)
        c = Context(state, c.obs, c.profile)
    x, y, z = state.entry_m
    if c.target_m is not None:
        there = under_target_xy(c, state.entry_yaw_rad)
        x, y = _not_far(state.mount.last_from or (x, y), there) if state.mount.open else there
        height = min(z, c.contact_goal_z_m - c.profile.planner.ascend.near_m)
    else:
        top = max(z, ground_m[2] + search.max_height_m)
        if state.blocked_z_m is not None:
            top = min(top, state.blocked_z_m - BLOCKED_ROOM_M)
        height = min(z + search.step_m * state.searches, top)
    yaw = state.entry_yaw_rad + math.radians(search.yaw_step_deg) * state.searches
    up_mps = c.profile.planner.ascend.speed_mps
    return _walk_to(c, PositionSetpoint(x, y, height, yaw), up_mps=up_mps)


def _not_far(start: tuple[float, float], goal: tuple[float, float]) -> tuple[float, float]:
    """The goal, or as far towards it as a wrong mounting may lead."""
    dx, dy = goal[0] - start[0], goal[1] - start[1]
    part = min(1.0, WARY_M / max(math.hypot(dx, dy), 1e-6))
    return start[0] + part * dx, start[1] + part * dy


def _estimate(c: Context) -> Acted:
    return _fly_to(c, c.state.setpoint or hold_here(c))


def _align(c: Context) -> Acted:
    setpoint = c.state.setpoint or hold_here(c)
    return _under_target(c, setpoint.z_m)


def _ascend(c: Context) -> Acted:
    """Climb only with a fresh target and well inside the cone; slower near the target."""
    ascend = c.profile.planner.ascend
    setpoint = c.state.setpoint or hold_here(c)
    goal_z = c.contact_goal_z_m - ascend.standoff_m
    may_climb = c.fresh and c.error_xy_m < 0.7 * c.cone_m
    lag = setpoint.z_m - c.obs.telemetry.position_m[2]
    speed = ascend.near_speed_mps if c.error_z_m < ascend.near_m else ascend.speed_mps
    # Slower and slower towards the stand-off, and a vehicle short of thrust is not
    # pulled by a setpoint that runs away from it.
    speed = min(speed, max(0.02, goal_z - setpoint.z_m))
    return _under_target(c, goal_z, up_mps=speed if may_climb and lag < 0.15 else 0.0)


def _perch(c: Context) -> Acted:
    """Press. Position and trim are kept as they are: against the ceiling they would
    only wind up."""
    perch = c.profile.planner.perch
    if perch.mode == "raw":
        return c.state, RawThrust(perch.thrust)
    if c.target_m is None:
        return _fly_to(c, c.state.setpoint or hold_here(c), lift=False)
    goal = _target_goal(c, c.contact_goal_z_m + perch.press_m)
    return _fly_to(c, _walked(c, goal, perch.climb_mps, 0.0), lift=False)


def _complete(c: Context) -> Acted:
    """Release in two stages; stop the motors once the whole weight hangs; watch."""
    if c.state.stopped_s is not None:
        return stop_motors(c)
    holds = c.held(Condition.MAGNET_HOLDS) >= c.profile.planner.complete.hold_dwell_s
    return let_go(c) if holds or c.state.released_s is not None else lower(c)


def _recover(c: Context) -> Acted:
    """Hold in the air `descend_m` below where the attempt ended. Position mode all
    along, so no controller is reset; the setpoint is below at once."""
    if (caught := catch(c)) is not None:
        return caught
    recover = c.profile.planner.recover
    c = left_contact(c, min(AWAY_M, 0.5 * recover.descend_m))
    state, away = unpressed(c)
    if away is not None:
        return state, away
    if not state.caught:
        x, y, z = c.obs.telemetry.position_m  # from where it sinks no more
        state = replace(state, caught=True, setpoint=None, entry_m=(x, y, z + recover.descend_m))
    z = state.entry_m[2] - recover.descend_m
    setpoint = state.setpoint or hold_here(c)
    if setpoint.z_m > z:
        setpoint = replace(setpoint, z_m=z)
    if c.target_m is not None and c.target_age_s < 3.0:
        x, y = under_target_xy(c, setpoint.yaw_rad)
        goal = PositionSetpoint(x, y, z, setpoint.yaw_rad)
    else:
        goal = replace(setpoint, z_m=z)
    c = Context(replace(state, setpoint=setpoint), c.obs, c.profile)
    return _walk_to(c, goal, up_mps=0.0, down_mps=FREE_SPEED_MPS)


def _terminal(c: Context) -> Acted:
    return c.state, Idle()


def _aborted(c: Context) -> Acted:
    """The motors, once, as the row that aborted wants it. What hangs with its motors still
    would be locked 2 s after the stream's end: it gets the pair that prevents that."""
    if c.state.orders:
        return c.state, Idle()
    state = replace(c.state, orders=1, ordered_s=c.obs.t_s)
    match state.motor_stop:
        case MotorStop.EMERGENCY:
            return state, EmergencyStop()
        case MotorStop.PLAIN:
            return state, StopMotors()
        case MotorStop.NONE:
            return state, StopMotors() if is_still(c) or lander.is_spent(c) else Idle()


ACTIONS: dict[Phase, Callable[[Context], Acted]] = {
    Phase.APPROACH: _approach,
    Phase.SEARCH: _search,
    Phase.ESTIMATE: _estimate,
    Phase.ALIGN: _align,
    Phase.ASCEND: _ascend,
    Phase.PERCH: _perch,
    Phase.COMPLETE: _complete,
    Phase.RECOVER: _recover,
    Phase.LANDING: lander.act,
    Phase.PERCHED: _terminal,
    Phase.LANDED: _terminal,
    Phase.ABORTED: _aborted,
}
