"""What each phase sends: one small function a phase, (view) -> (state, command).

Before each command ask: what if it is the last packet? A position setpoint left
alone levels out after 0.5 s and is cut after 2 s (docs/firmware.md,
"Silence"), so anything
that ends a flight is handed to the vehicle's own high-level commander, which
needs no further packet.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from perchctl.mission.context import HANGING_S, Context
from perchctl.mission.guidance import (
    FREE_SPEED_MPS,
    corrected,
    hold_here,
    integrated,
    limited,
    under_target_xy,
    walk,
)
from perchctl.mission.state import Condition, MotorStop, Phase, PlannerState
from perchctl.vehicle import (
    Command,
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    TakeOff,
)

Acted = tuple[PlannerState, Command]

REPEAT_ORDER_S = 0.5
"""An order that shows no effect in the telemetry is given again after this time."""
MAX_ORDERS = 4
STOPS, STOP_PERIOD_S = 5, 0.1


def act(c: Context) -> Acted:
    """The phase's command for this tick."""
    if c.state.hold and c.state.setpoint is not None:
        return _fly_to(c, c.state.setpoint)
    return ACTIONS[c.state.phase](c)


def _fly_to(c: Context, reference: PositionSetpoint, *, lift: bool = True) -> Acted:
    """Remember the reference, send it corrected. `lift` False sends its height as it is."""
    return replace(c.state, setpoint=reference), limited(c, corrected(c, reference, lift=lift))


def _walk_to(
    c: Context, goal: PositionSetpoint, *, up_mps: float = 0.0, down_mps: float = 0.4
) -> Acted:
    """Only SEARCH and ASCEND pass an `up_mps`, and PERCH presses: nothing else climbs."""
    return _fly_to(c, _walked(c, goal, up_mps, down_mps))


def _walked(c: Context, goal: PositionSetpoint, up_mps: float, down_mps: float) -> PositionSetpoint:
    align = c.profile.planner.align
    return walk(
        c.state.setpoint or hold_here(c),
        goal,
        c.obs.t_s - c.state.t_s,
        xy_mps=align.speed_mps,
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
    planner, state = c.profile.planner, c.state
    assert state.ground_m is not None
    height = state.ground_m[2] + planner.takeoff_height_m
    if state.setpoint is not None:
        x, y = planner.approach_xy_m or (state.ground_m[0], state.ground_m[1])
        goal = PositionSetpoint(x, y, height, state.entry_yaw_rad)
        return _walk_to(c, goal)
    waited = math.inf if state.ordered_s is None else c.obs.t_s - state.ordered_s
    unseen = not c.high_level_active and not c.flying
    if waited > 2 * REPEAT_ORDER_S and unseen and state.orders < MAX_ORDERS:
        order = TakeOff(height, planner.takeoff_duration_s)
        return replace(state, ordered_s=c.obs.t_s, orders=state.orders + 1), order
    if waited >= planner.takeoff_duration_s and c.flying:
        # "Finished" is by the clock: the position setpoint takes over at the same height.
        start = PositionSetpoint(state.ground_m[0], state.ground_m[1], height, state.entry_yaw_rad)
        return _fly_to(c, start)
    return state, Idle()


def _search(c: Context) -> Acted:
    """Wait, climb a step, turn a step, wait again; never above the limit. A target that
    was seen before is looked for from under it, not climbed to."""
    search, state, ground_m = c.profile.planner.search, c.state, c.state.ground_m
    assert ground_m is not None
    if c.obs.t_s - state.search_step_s > search.wait_s:
        state = replace(state, searches=state.searches + 1, search_step_s=c.obs.t_s)
        c = Context(state, c.obs, c.profile)
    x, y, z = state.entry_m
    if c.target_m is not None:
        x, y = under_target_xy(c, state.entry_yaw_rad)
        height = min(z, c.contact_goal_z_m - c.profile.planner.ascend.near_m)
    else:
        top = max(z, ground_m[2] + search.max_height_m)
        height = min(z + search.step_m * state.searches, top)
    yaw = state.entry_yaw_rad + math.radians(search.yaw_step_deg) * state.searches
    up_mps = c.profile.planner.ascend.speed_mps
    return _walk_to(c, PositionSetpoint(x, y, height, yaw), up_mps=up_mps)


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
    goal = _target_goal(c, c.contact_goal_z_m + perch.press_m)
    return _fly_to(c, _walked(c, goal, perch.climb_mps, 0.0), lift=False)


def _complete(c: Context) -> Acted:
    """Release in steps; stop the motors once the magnet is proven to hold; watch."""
    complete, state = c.profile.planner.complete, c.state
    if state.motors_stopped:
        return _stop_motors(c)
    if c.held(Condition.MAGNET_HOLDS) >= complete.hold_dwell_s:
        return _stop_motors(c)
    step = min(complete.steps, 1 + int(c.in_phase_s / complete.release_s * complete.steps))
    part = step / complete.steps
    if c.profile.planner.perch.mode == "raw":
        # The lowest step stays below what could carry the vehicle, above the idle cut.
        lowest = 0.9 * complete.hold_ratio * state.hover_thrust
        thrust = c.profile.planner.perch.thrust
        return state, RawThrust(int(thrust + part * (lowest - thrust)))
    setpoint = state.setpoint or hold_here(c)
    assert state.contact_z_m is not None
    top = state.entry_m[2] + c.profile.planner.perch.press_m
    low = state.contact_z_m - complete.release_drop_m
    return _fly_to(c, replace(setpoint, z_m=top + part * (low - top)), lift=False)


def _stop_motors(c: Context) -> Acted:
    """Stop and notify, several times whatever the telemetry shows, and again while it shows
    thrust: one lost notify locks a vehicle that hangs well, one lost stop leaves the motors
    running, and the pair is harmless twice (docs/firmware.md, "Repeated stop")."""
    state, now_s = c.state, c.obs.t_s
    if not state.motors_stopped or state.ordered_s is None:
        return replace(state, motors_stopped=True, ordered_s=now_s, orders=1), StopMotors()
    waited_s = now_s - state.ordered_s
    repeated = state.orders >= STOPS
    if waited_s < (REPEAT_ORDER_S if repeated else STOP_PERIOD_S):
        return state, Idle()
    if repeated and c.obs.telemetry.thrust < 1:
        return state, Idle()
    return replace(state, ordered_s=now_s, orders=state.orders + 1), StopMotors()


def _recover(c: Context) -> Acted:
    """Hold in the air `descend_m` below where the attempt ended. Position mode all
    along, so no controller is reset; the setpoint is below at once."""
    recover, state = c.profile.planner.recover, c.state
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


def _landing(c: Context) -> Acted:
    """One high-level landing; given again only while it shows no effect. When the motors
    are off already (on the ground, or hanging), nothing is started again."""
    landing, state = c.profile.planner.landing, c.state
    if state.motors_stopped or c.held(Condition.HANGING) >= HANGING_S:
        return _stop_motors(c)
    if c.obs.telemetry.thrust < 1 and (state.orders or not c.flying):
        return state, Idle()  # on the floor: another order would spin the motors up again
    ground_z = state.ground_m[2] if state.ground_m else 0.0
    floor = ground_z - landing.undershoot_m
    waited = math.inf if state.ordered_s is None else c.obs.t_s - state.ordered_s
    near_floor = c.obs.telemetry.position_m[2] < ground_z + 0.15
    if state.orders and near_floor and c.held(Condition.RESTING) > 1.0 and waited > 2.0:
        return _stop_motors(c)
    ignored = not c.high_level_active and waited > REPEAT_ORDER_S
    if state.orders == 0 or (ignored and state.orders < MAX_ORDERS):
        height = max(0.0, c.obs.telemetry.position_m[2] - floor)
        order = Land(floor, max(1.0, height / landing.speed_mps))
        return replace(state, ordered_s=c.obs.t_s, orders=state.orders + 1, setpoint=None), order
    return state, Idle()


def _terminal(c: Context) -> Acted:
    return c.state, Idle()


def _aborted(c: Context) -> Acted:
    """The motors, once, as the row that aborted wants it."""
    if c.state.orders:
        return c.state, Idle()
    state = replace(c.state, orders=1, ordered_s=c.obs.t_s)
    match state.motor_stop:
        case MotorStop.EMERGENCY:
            return state, EmergencyStop()
        case MotorStop.PLAIN:
            return state, StopMotors()
        case MotorStop.NONE:
            return state, Idle()


ACTIONS: dict[Phase, Callable[[Context], Acted]] = {
    Phase.APPROACH: _approach,
    Phase.SEARCH: _search,
    Phase.ESTIMATE: _estimate,
    Phase.ALIGN: _align,
    Phase.ASCEND: _ascend,
    Phase.PERCH: _perch,
    Phase.COMPLETE: _complete,
    Phase.RECOVER: _recover,
    Phase.LANDING: _landing,
    Phase.PERCHED: _terminal,
    Phase.LANDED: _terminal,
    Phase.ABORTED: _aborted,
}
