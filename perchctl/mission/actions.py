"""What each phase sends: one small function a phase, (view) -> (state, command).

Before each command ask: what if it is the last packet? A position setpoint left
alone levels out after 0.5 s and is cut after 2 s (firmware facts), so anything
that ends a flight is handed to the vehicle's own high-level commander, which
needs no further packet.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from perchctl.mission.guidance import (
    FREE_SPEED_MPS,
    corrected,
    hold_here,
    limited,
    trimmed,
    under_target_xy,
    walk,
)
from perchctl.mission.state import Operator, Outcome, Phase, PlannerState
from perchctl.mission.types import (
    Command,
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    TakeOff,
)
from perchctl.mission.view import HANGING_S, View

Acted = tuple[PlannerState, Command]

REPEAT_ORDER_S = 0.5
"""An order that shows no effect in the telemetry is given again after this time."""
MAX_ORDERS = 4


def act(v: View) -> Acted:
    """The phase's command for this tick."""
    if v.state.hold and v.state.setpoint is not None:
        return _fly_to(v, v.state.setpoint)
    return ACTIONS[v.state.phase](v)


def _fly_to(v: View, reference: PositionSetpoint, *, lift: bool = True) -> Acted:
    """Remember the reference, send it corrected. `lift` False sends its height as it is."""
    return replace(v.state, setpoint=reference), limited(v, corrected(v, reference, lift=lift))


def _walk_to(
    v: View, goal: PositionSetpoint, *, up_mps: float = 0.0, down_mps: float = 0.4
) -> Acted:
    """Only SEARCH and ASCEND pass an `up_mps`, and PERCH presses: nothing else climbs."""
    return _fly_to(v, _walked(v, goal, up_mps, down_mps))


def _walked(v: View, goal: PositionSetpoint, up_mps: float, down_mps: float) -> PositionSetpoint:
    align = v.profile.planner.align
    return walk(
        v.state.setpoint or hold_here(v),
        goal,
        v.obs.t_s - v.state.t_s,
        xy_mps=align.speed_mps,
        up_mps=up_mps,
        down_mps=down_mps,
        yaw_rate_radps=math.radians(align.yaw_rate_dps),
    )


def _under_target(v: View, z_m: float, *, up_mps: float = 0.0, down_mps: float = 0.4) -> Acted:
    """Walk under the target at height `z_m`, and learn the trim that keeps the gear there."""
    goal = _target_goal(v, z_m)
    trim = trimmed(v, (goal.x_m, goal.y_m), v.obs.t_s - v.state.t_s)
    v = View(replace(v.state, trim_m=trim), v.obs, v.profile)
    return _walk_to(v, goal, up_mps=up_mps, down_mps=down_mps)


def _target_goal(v: View, z_m: float) -> PositionSetpoint:
    assert v.state.anchor is not None
    yaw = v.state.anchor.yaw_rad
    x, y = under_target_xy(v, yaw)
    return PositionSetpoint(x, y, z_m, yaw)


def _approach(v: View) -> Acted:
    planner, state = v.profile.planner, v.state
    assert state.ground_m is not None
    height = state.ground_m[2] + planner.takeoff_height_m
    if state.setpoint is not None:
        x, y = planner.approach_xy_m or (state.ground_m[0], state.ground_m[1])
        goal = PositionSetpoint(x, y, height, state.entry_yaw_rad)
        return _walk_to(v, goal)
    waited = math.inf if state.ordered_s is None else v.obs.t_s - state.ordered_s
    unseen = not v.high_level_active and not v.flying
    if waited > 2 * REPEAT_ORDER_S and unseen and state.orders < MAX_ORDERS:
        order = TakeOff(height, planner.takeoff_duration_s)
        return replace(state, ordered_s=v.obs.t_s, orders=state.orders + 1), order
    if waited >= planner.takeoff_duration_s and v.flying:
        # "Finished" is by the clock: the position setpoint takes over at the same height.
        start = PositionSetpoint(state.ground_m[0], state.ground_m[1], height, state.entry_yaw_rad)
        return _fly_to(v, start)
    return state, Idle()


def _search(v: View) -> Acted:
    """Wait, climb a step, turn a step, wait again; never above the limit. A target that
    was seen before is looked for from under it, not climbed to."""
    search, state, ground_m = v.profile.planner.search, v.state, v.state.ground_m
    assert ground_m is not None
    if v.obs.t_s - state.search_step_s > search.wait_s:
        state = replace(state, searches=state.searches + 1, search_step_s=v.obs.t_s)
        v = View(state, v.obs, v.profile)
    x, y, z = state.entry_m
    if state.anchor is not None:
        x, y = under_target_xy(v, state.entry_yaw_rad)
        height = min(z, v.contact_goal_z_m - v.profile.planner.ascend.near_m)
    else:
        top = max(z, ground_m[2] + search.max_height_m)
        height = min(z + search.step_m * state.searches, top)
    yaw = state.entry_yaw_rad + math.radians(search.yaw_step_deg) * state.searches
    up_mps = v.profile.planner.ascend.speed_mps
    return _walk_to(v, PositionSetpoint(x, y, height, yaw), up_mps=up_mps)


def _estimate(v: View) -> Acted:
    return _fly_to(v, v.state.setpoint or hold_here(v))


def _align(v: View) -> Acted:
    setpoint = v.state.setpoint or hold_here(v)
    return _under_target(v, setpoint.z_m)


def _ascend(v: View) -> Acted:
    """Climb only with a fresh target and well inside the cone; slower near the target."""
    ascend = v.profile.planner.ascend
    setpoint = v.state.setpoint or hold_here(v)
    goal_z = v.contact_goal_z_m - ascend.standoff_m
    may_climb = v.fresh and v.error_xy_m < 0.7 * v.cone_m
    lag = setpoint.z_m - v.obs.telemetry.position_m[2]
    speed = ascend.near_speed_mps if v.error_z_m < ascend.near_m else ascend.speed_mps
    # Slower and slower towards the stand-off, and a vehicle short of thrust is not
    # pulled by a setpoint that runs away from it.
    speed = min(speed, max(0.02, goal_z - setpoint.z_m))
    return _under_target(v, goal_z, up_mps=speed if may_climb and lag < 0.15 else 0.0)


def _perch(v: View) -> Acted:
    """Press. Position and trim are kept as they are: against the ceiling they would
    only wind up."""
    perch = v.profile.planner.perch
    if perch.mode == "raw":
        return v.state, RawThrust(perch.thrust)
    goal = _target_goal(v, v.contact_goal_z_m + perch.press_m)
    return _fly_to(v, _walked(v, goal, perch.climb_mps, 0.0), lift=False)


def _complete(v: View) -> Acted:
    """Release in steps; stop the motors once the magnet is proven to hold; watch."""
    complete, state = v.profile.planner.complete, v.state
    if state.motors_stopped:
        return _stop_motors(v)
    if v.held("magnet_holds") >= complete.hold_dwell_s:
        return _stop_motors(v)
    step = min(complete.steps, 1 + int(v.in_phase_s / complete.release_s * complete.steps))
    part = step / complete.steps
    if v.profile.planner.perch.mode == "raw":
        # The lowest step stays below what could carry the vehicle, above the idle cut.
        lowest = 0.9 * complete.hold_ratio * state.hover_thrust
        thrust = v.profile.planner.perch.thrust
        return state, RawThrust(int(thrust + part * (lowest - thrust)))
    setpoint = state.setpoint or hold_here(v)
    assert state.contact_z_m is not None
    top = state.entry_m[2] + v.profile.planner.perch.press_m
    low = state.contact_z_m - complete.release_drop_m
    return _fly_to(v, replace(setpoint, z_m=top + part * (low - top)), lift=False)


def _stop_motors(v: View) -> Acted:
    """Stop and notify, again while the telemetry still shows thrust: a lost packet must
    not leave the motors running, and the pair is harmless twice."""
    state = v.state
    if state.ordered_s is not None and v.obs.t_s - state.ordered_s < REPEAT_ORDER_S:
        return state, Idle()
    if state.ordered_s is not None and v.obs.telemetry.thrust < 1:
        return state, Idle()
    return replace(state, motors_stopped=True, ordered_s=v.obs.t_s), StopMotors()


def _recover(v: View) -> Acted:
    """Hold in the air `descend_m` below where the attempt ended. Position mode all
    along, so no controller is reset; the setpoint is below at once."""
    recover, state = v.profile.planner.recover, v.state
    z = state.entry_m[2] - recover.descend_m
    setpoint = state.setpoint or hold_here(v)
    if setpoint.z_m > z:
        setpoint = replace(setpoint, z_m=z)
    if state.anchor is not None and v.target_age_s < 3.0:
        x, y = under_target_xy(v, setpoint.yaw_rad)
        goal = PositionSetpoint(x, y, z, setpoint.yaw_rad)
    else:
        goal = replace(setpoint, z_m=z)
    v = View(replace(state, setpoint=setpoint), v.obs, v.profile)
    return _walk_to(v, goal, up_mps=0.0, down_mps=FREE_SPEED_MPS)


def _landing(v: View) -> Acted:
    """One high-level landing; given again only while it shows no effect. When the motors
    are off already (on the ground, or hanging), nothing is started again."""
    landing, state = v.profile.planner.landing, v.state
    if state.motors_stopped or v.held("hanging") >= HANGING_S:
        return _stop_motors(v)
    if v.obs.telemetry.thrust < 1 and (state.orders or not v.flying):
        return state, Idle()  # on the floor: another order would spin the motors up again
    ground_z = state.ground_m[2] if state.ground_m else 0.0
    floor = ground_z - landing.undershoot_m
    waited = math.inf if state.ordered_s is None else v.obs.t_s - state.ordered_s
    near_floor = v.obs.telemetry.position_m[2] < ground_z + 0.15
    if state.orders and near_floor and v.held("resting") > 1.0 and waited > 2.0:
        return _stop_motors(v)
    ignored = not v.high_level_active and waited > REPEAT_ORDER_S
    if state.orders == 0 or (ignored and state.orders < MAX_ORDERS):
        height = max(0.0, v.obs.telemetry.position_m[2] - floor)
        order = Land(floor, max(1.0, height / landing.speed_mps))
        return replace(state, ordered_s=v.obs.t_s, orders=state.orders + 1, setpoint=None), order
    return state, Idle()


def _terminal(v: View) -> Acted:
    return v.state, Idle()


def _aborted(v: View) -> Acted:
    """Motors off, once: cut and locked on the user's word or with a useless attitude,
    plainly stopped where the supervisor has ended the flight already."""
    if v.state.orders:
        return v.state, Idle()
    state = replace(v.state, orders=1, ordered_s=v.obs.t_s)
    if v.state.outcome is Outcome.EMERGENCY or v.obs.operator is Operator.STOP:
        return state, EmergencyStop()
    if v.state.row == "tilted":
        return state, EmergencyStop()
    return (state, Idle()) if v.state.row == "landing-timeout" else (state, StopMotors())


ACTIONS: dict[Phase, Callable[[View], Acted]] = {
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
