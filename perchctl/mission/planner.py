"""The perching planner: `step_mission(state, observation, profile) -> (state, command)`.

Pure: no clock, no input but its arguments, so a log replays to the same commands. One tick:
remember what was observed, look up the table, act for the phase.

Before each command ask: what if it is the last packet? A position setpoint left alone levels out
after 0.5 s and is cut after 2 s (docs/firmware.md, "When setpoints stop").
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from perchctl.mission import battery, lander
from perchctl.mission.conditions import (
    contact_error,
    contact_tolerance_m,
    is_hover_thrust,
    last_touch_error,
    lasting_conditions,
    update_conditions,
)
from perchctl.mission.context import Context
from perchctl.mission.guidance import (
    FREE_SPEED_MPS,
    LIFTED_M,
    Action,
    body_xy_under_target,
    catch_goal_above_m,
    catch_slip,
    clear_contact_below,
    correct_setpoint,
    hold_here,
    is_pressing,
    leave_press,
    limit_setpoint,
    lower_thrust,
    motors_are_still,
    release_by_thrust,
    sink_setpoint,
    step_towards,
    stop_motors,
    update_integral,
)
from perchctl.mission.imu import discount_wrong_positions
from perchctl.mission.mounting import MountingMonitor, mount_sample, update_monitor
from perchctl.mission.state import (
    IN_THE_OPEN,
    Condition,
    ContactError,
    Observation,
    Outcome,
    Phase,
    PlannerState,
    Severity,
)
from perchctl.mission.table import (
    TABLE,
    Transition,
    first_transition,
    hold_reason,
)
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import Command, Idle, PositionSetpoint, RawThrust, StopMotors

HOVER_WITHIN = 0.2
CARRIED_RATIO = 0.85  # of the hover thrust: with so much it sinks slowly
AWAY_M = 0.05  # below the contact, or half of the descent: it has left
BLOCKED_ROOM_M = 0.1  # a search keeps away from what blocked it
WARY_M = 0.2  # sideways, while nothing confirms the camera's mounting
_LEARNING = (Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND)


def step_mission(
    state: PlannerState | None,
    obs: Observation,
    profile: Profile,
    table: tuple[Transition, ...] = TABLE,
) -> tuple[PlannerState, Command]:
    """Fly one tick of the mission; `state` is None in the first tick, on the ground."""
    c = _remember(Context(state or PlannerState.on_ground(obs), obs, profile))
    row = first_transition(c, table)
    if row is None:
        c = c.evolve(waits="") if c.state.waits else c
    elif row.waits_in(c.state.phase):
        waited_s = c.state.waited_s + c.t_s - c.state.t_s
        c = c.evolve(waits=row.reason_text(c), waited_s=waited_s)
    else:
        c = _enter(c, row)
        c = c.evolve(hold=hold_reason(c))
    new, command = act(c)
    return replace(lander.record_thrust_order(new, command), t_s=obs.t_s), command


def _remember(c: Context) -> Context:
    c = lander.remember_observation(c.with_state(_with_target(c.state, c.obs)))
    hold, since, hover = hold_reason(c), update_conditions(c), c.state.hover_thrust
    if hold:
        since = lasting_conditions(since)  # a held vehicle proves nothing
    away = c.state.phase is not Phase.ASCEND or c.error_z_m > c.planner.ascend.near_m
    if away and c.state.phase in _LEARNING and is_hover_thrust(c):
        hover = _learned_hover_thrust(c.state, c.obs)
    energy = battery.read_battery(c)
    c = c.evolve(hold=hold, hover_thrust=hover, last=c.telemetry, energy=energy)
    return c.evolve(battery=battery.battery_outlook(c), since=since, mount=_mount_watched(c))


def _with_target(state: PlannerState, obs: Observation) -> PlannerState:
    """The state with how many frames in a row measured the target, and their spread."""
    target = obs.target
    if not obs.new_frame:
        return state
    if target is None or not target.measured or target.world_m is None:
        return replace(state, confirmed=0)
    spread_m = 0.0
    if state.target_m is not None:
        moved_m = float(np.linalg.norm(target.world_m - state.target_m))
        spread_m = max(moved_m, 0.9 * state.target_spread_m)
    return replace(
        state,
        target_m=target.world_m,
        target_spread_m=spread_m,
        confirmed=state.confirmed + 1,
    )


def _mount_watched(c: Context) -> MountingMonitor:
    state = c.state
    measured = c.obs.new_frame and state.confirmed > 0 and c.proves and not state.hold
    if state.target_m is None or not measured or state.phase not in IN_THE_OPEN:
        return state.mount
    return update_monitor(state.mount, mount_sample(c.t_s, c.telemetry, state.target_m))


def _learned_hover_thrust(state: PlannerState, obs: Observation) -> float:
    """Slow mean of the thrust in quiet flight: the reference of the contact proof."""
    thrust = obs.telemetry.thrust
    if state.hover_thrust == 0.0:
        return obs.imu.hover_thrust or thrust
    if abs(thrust / state.hover_thrust - 1.0) > HOVER_WITHIN:
        return state.hover_thrust  # held by the ceiling, or by a hand
    part = min(1.0, (obs.t_s - state.t_s) / 1.5)
    return state.hover_thrust + part * (thrust - state.hover_thrust)


def _enter(c: Context, row: Transition) -> Context:
    state = c.state
    # An ordered press has wound the integrators up, whatever thrust is read; a fall that is just
    # being caught turns at full thrust in the air.
    ends = row.to in (Phase.RECOVER, Phase.LANDING)
    pressed = ends and state.caught and (state.phase is Phase.PERCH or is_pressing(c))
    new = c.evolve(
        phase=row.to,
        entered_s=c.t_s,
        reason=row.reason_text(c),
        row=row.name,
        severity=state.severity.escalate(row.severity),
        stop=row.stop,
        outcome=_outcome(state, row),
        since=lasting_conditions(state.since),
        attempts=state.attempts + int(row.severity is Severity.BACK_OFF),
        entry_m=c.telemetry.position_m,
        entry_yaw_rad=c.telemetry.yaw_rad,
        waits="",
        waited_s=0.0,
        search_step_s=c.t_s,
        confirmed=0,
        pressed=pressed,
        ordered_s=None,
        orders=0,
    )
    return _started_phase(new, c)


def _outcome(state: PlannerState, row: Transition) -> Outcome | None:
    """The outcome; what hangs on its way down keeps the landing's."""
    if state.phase is Phase.LANDING and row.outcome is Outcome.PERCHED and state.outcome:
        return state.outcome
    if row.name == "hung" and state.outcome is Outcome.TARGET_NOT_FOUND:
        return Outcome.ATTEMPTS_USED_UP
    return row.outcome or state.outcome


def _started_phase(new: Context, c: Context) -> Context:
    """The tick with what its phase starts with; `c` is the tick before the transition."""
    old, row, z_m = c.state, new.state.row, c.telemetry.position_m[2]
    match new.state.phase:
        case Phase.COMPLETE:
            contact = last_touch_error(c) or contact_error(c)
            return new.evolve(contact_z_m=z_m, contact=contact, released_s=None)
        case Phase.RECOVER:
            touched = old.phase is Phase.PERCH or row == "blocked"
            return new.evolve(
                stopped_s=None,
                contact=_touched(old, row, c),
                # In the magnet's reach until it is seen below.
                contact_z_m=z_m if touched else old.contact_z_m,
                released_s=None,
                # What the motors carry most of hardly falls.
                caught=row != "slipped" or c.telemetry.thrust >= CARRIED_RATIO * old.hover_thrust,
                catch_goal_above_m=catch_goal_above_m(old.hover_thrust, c.telemetry.thrust),
                blocked_z_m=z_m if row == "blocked" else old.blocked_z_m,
            )
        case Phase.LANDING:
            # The mounting may be right and the motion capture's axes wrong, by which the landing
            # would speed up until it tilts over.
            capture = c.profile.positioning.by == "mocap" and old.mount.is_wrong
            if row == "position-astray" or (row == "mounting" and capture):
                reckoning = old.reckoning if old.astray else discount_wrong_positions(old.reckoning)
                new = new.evolve(astray=True, reckoning=reckoning)
            if row == "mounting":
                new = new.evolve(setpoint=None)  # it is ahead, in a wrong direction
            if old.phase is Phase.RECOVER and row != "hangs-at-contact":
                new = new.evolve(contact=None)  # nothing was felt to hold it there
            return lander.enter_landing(new, old)
        case Phase.ASCEND:
            return new.evolve(searches=0)
        case Phase.SEARCH if old.setpoint is not None:
            sp = old.setpoint
            return new.evolve(entry_m=(sp.x_m, sp.y_m, sp.z_m), entry_yaw_rad=sp.yaw_rad)
        case _:
            return new


def _touched(old: PlannerState, row: str, c: Context) -> ContactError | None:
    if row == "not-released":  # the contact was proven, and nothing has come off
        return old.contact
    if old.phase is Phase.RECOVER:  # pressed again before it had left
        return old.contact if old.contact_z_m is not None else None
    proven = c.held_s(Condition.CONTACT) >= c.planner.perch.contact_dwell_s
    carried = proven or c.held_s(Condition.CARRIED) >= 0.0  # which has that dwell in itself
    if old.phase is Phase.PERCH and carried and abs(c.error_z_m) <= contact_tolerance_m(c):
        return contact_error(c)
    return None


# --- What each phase sends ---


def act(c: Context) -> Action:
    """The phase's new state and command for this tick."""
    # A fall is caught and a press ended although the vehicle is held: the setpoint is above.
    leaves = c.state.phase is Phase.RECOVER and (c.state.pressed or not c.state.caught)
    if c.state.hold and c.state.setpoint is not None and not leaves:
        lift = c.state.phase is not Phase.APPROACH or c.height_m > LIFTED_M
        return _fly_to(c, sink_setpoint(c, c.state.setpoint), lift=lift)
    return ACTIONS[c.state.phase](c)


def _fly_to(c: Context, reference: PositionSetpoint, *, lift: bool = True) -> Action:
    """Remember the reference, and send it corrected; without `lift` at its own height."""
    return replace(c.state, setpoint=reference), limit_setpoint(
        c, correct_setpoint(c, reference, lift=lift)
    )


def _under_target(c: Context, z_m: float, *, up_mps: float = 0.0) -> Action:
    """Walk under the target at height `z_m`, and learn the trim that keeps the gear there."""
    goal = _target_goal(c, z_m)
    trim = update_integral(c, (goal.x_m, goal.y_m), c.t_s - c.state.t_s)
    c = c.evolve(integral_m=trim)
    return _fly_to(c, step_towards(c, goal, up_mps=up_mps))


def _target_goal(c: Context, z_m: float) -> PositionSetpoint:
    yaw = c.target_yaw_rad
    assert yaw is not None
    x, y = body_xy_under_target(c, yaw)
    return PositionSetpoint(x, y, z_m, yaw)


def _approach(c: Context) -> Action:
    """Rise from the ground on position setpoints, without which the firmware levels out."""
    planner, state = c.planner, c.state
    assert state.ground_m is not None
    x, y, z = state.ground_m
    start = state.setpoint or PositionSetpoint(x, y, z, state.entry_yaw_rad)
    if planner.approach_xy_m is not None and c.height_m > 0.7 * planner.takeoff_height_m:
        x, y = planner.approach_xy_m
    goal = PositionSetpoint(x, y, z + planner.takeoff_height_m, state.entry_yaw_rad)
    setpoint = step_towards(c.evolve(setpoint=start), goal, up_mps=planner.takeoff_speed_mps)
    return _fly_to(c, setpoint, lift=c.height_m > LIFTED_M)


def _search(c: Context) -> Action:
    """Wait, climb a step, turn a step, wait again; never above the limit. A target that was seen
    before is looked for from under it."""
    search, state, ground_m = c.planner.search, c.state, c.state.ground_m
    assert ground_m is not None
    if c.t_s - state.search_step_s > search.wait_s:
        state = replace(state, searches=state.searches + 1, search_step_s=c.t_s)
        c = c.with_state(state)
    x, y, z = state.entry_m
    if c.target_m is not None:
        there = body_xy_under_target(c, state.entry_yaw_rad)
        x, y = _not_far(state.mount, (x, y), there) if state.mount.is_unconfirmed else there
        height = min(z, c.contact_goal_z_m - c.planner.ascend.near_m)
    else:
        top = max(z, ground_m[2] + search.max_height_m)
        if state.blocked_z_m is not None:
            top = min(top, state.blocked_z_m - BLOCKED_ROOM_M)
        height = min(z + search.step_m * state.searches, top)
    yaw = state.entry_yaw_rad + math.radians(search.yaw_step_deg) * state.searches
    goal = PositionSetpoint(x, y, height, yaw)
    return _fly_to(c, step_towards(c, goal, up_mps=c.planner.ascend.speed_mps))


def _not_far(
    mount: MountingMonitor, start: tuple[float, float], goal: tuple[float, float]
) -> tuple[float, float]:
    """The goal, world x and y (m), cut to `WARY_M` from the last sight, else from `start`."""
    if mount.sights:
        start = (mount.sights[-1].vehicle_m.real, mount.sights[-1].vehicle_m.imag)
    dx, dy = goal[0] - start[0], goal[1] - start[1]
    part = min(1.0, WARY_M / max(math.hypot(dx, dy), 1e-6))
    return start[0] + part * dx, start[1] + part * dy


def _ascend(c: Context) -> Action:
    """Climb only with a fresh target and well inside the cone; slower near the target."""
    ascend = c.planner.ascend
    setpoint = c.state.setpoint or hold_here(c)
    goal_z = c.contact_goal_z_m - ascend.standoff_m
    may_climb = c.fresh and c.error_xy_m < 0.7 * c.cone_m
    lag = setpoint.z_m - c.telemetry.position_m[2]
    speed = ascend.near_speed_mps if c.error_z_m < ascend.near_m else ascend.speed_mps
    speed = min(speed, max(0.02, goal_z - setpoint.z_m))
    return _under_target(c, goal_z, up_mps=speed if may_climb and lag < 0.15 else 0.0)


def _perch(c: Context) -> Action:
    """Press. Position and trim stay as they are: against the ceiling they would wind up."""
    perch = c.planner.perch
    if perch.mode == "raw":
        return c.state, RawThrust(perch.thrust)
    if c.target_m is None:
        return _fly_to(c, c.state.setpoint or hold_here(c), lift=False)
    goal = _target_goal(c, c.contact_goal_z_m + perch.press_m)
    return _fly_to(c, step_towards(c, goal, up_mps=perch.climb_mps, down_mps=0.0), lift=False)


def _complete(c: Context) -> Action:
    """Release in two stages; stop the motors once the whole weight hangs; watch."""
    if c.state.stopped_s is not None:
        return stop_motors(c)
    holds = c.held_s(Condition.MAGNET_HOLDS) >= c.planner.complete.hold_dwell_s
    return release_by_thrust(c) if holds or c.state.released_s is not None else lower_thrust(c)


def _recover(c: Context) -> Action:
    """Hold in the air `descend_m` below where the attempt ended, in position mode all along."""
    if (caught := catch_slip(c)) is not None:
        return caught
    recover = c.planner.recover
    c = clear_contact_below(c, min(AWAY_M, 0.5 * recover.descend_m))
    state, away = leave_press(c)
    if away is not None:
        return state, away
    if not state.caught:
        x, y, z = c.telemetry.position_m  # from where it sinks no more
        state = replace(state, caught=True, setpoint=None, entry_m=(x, y, z + recover.descend_m))
    z = state.entry_m[2] - recover.descend_m
    setpoint = state.setpoint or hold_here(c)
    if setpoint.z_m > z:
        setpoint = replace(setpoint, z_m=z)
    if c.target_m is not None and c.target_age_s < 3.0:
        x, y = body_xy_under_target(c, setpoint.yaw_rad)
        goal = PositionSetpoint(x, y, z, setpoint.yaw_rad)
    else:
        goal = replace(setpoint, z_m=z)
    c = c.with_state(replace(state, setpoint=setpoint))
    return _fly_to(c, step_towards(c, goal, down_mps=FREE_SPEED_MPS))


def _aborted(c: Context) -> Action:
    """The motor stop, once; what hangs with its motors still would be locked without one."""
    if c.state.orders:
        return c.state, Idle()
    ends = StopMotors() if motors_are_still(c) or lander.is_landing_over(c) else Idle()
    return replace(c.state, orders=1, ordered_s=c.t_s), c.state.stop or ends


ACTIONS: dict[Phase, Callable[[Context], Action]] = {
    Phase.APPROACH: _approach,
    Phase.SEARCH: _search,
    Phase.ESTIMATE: lambda c: _fly_to(c, c.state.setpoint or hold_here(c)),
    Phase.ALIGN: lambda c: _under_target(c, (c.state.setpoint or hold_here(c)).z_m),
    Phase.ASCEND: _ascend,
    Phase.PERCH: _perch,
    Phase.COMPLETE: _complete,
    Phase.RECOVER: _recover,
    Phase.LANDING: lander.act,
    Phase.PERCHED: lambda c: (c.state, Idle()),
    Phase.LANDED: lambda c: (c.state, Idle()),
    Phase.ABORTED: _aborted,
}
