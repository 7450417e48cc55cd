"""The perching planner: `step(state, observation, profile) -> (state, command)`.

Pure: no clock, no input but its arguments, so a log replays to the same commands
(`perchctl.replay.decide`, and `tests/replay/test_corpus.py` demands it).
One tick: remember what was observed, look up the table, act for the phase.
"""

from __future__ import annotations

import math

import numpy as np

from perchctl.mission import budget
from perchctl.mission.actions import act
from perchctl.mission.conditions import KEPT_OVER_A_CHANGE, conditions_since, hovers
from perchctl.mission.context import PUT_RIGHT_S, Context
from perchctl.mission.guidance import presses
from perchctl.mission.hold import hold_reason, is_lost
from perchctl.mission.level import felt_climb_mps, is_felt_alone
from perchctl.mission.mounting import MountWatch, sight_of, watched
from perchctl.mission.release import CATCH_STILL_ABOVE_M, catch_above_m, is_carried
from perchctl.mission.row import Row, risen
from perchctl.mission.safety import IN_THE_OPEN
from perchctl.mission.state import (
    TERMINALS,
    Condition,
    Observation,
    Phase,
    PlannerState,
)
from perchctl.mission.table import TABLE, first_match
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import Command, PositionSetpoint, Telemetry

HOVER_WITHIN = 0.2
UNSEEN_S = 0.15
_LEARNING = (Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND)
Place = tuple[float, float, float]


def start(obs: Observation) -> PlannerState:
    """A planner on the ground, before take-off."""
    tel = obs.telemetry
    return PlannerState(
        entered_s=obs.t_s,
        started_s=obs.t_s,
        t_s=obs.t_s,
        search_step_s=obs.t_s,
        ground_m=tel.position_m,
        entry_m=tel.position_m,
        entry_yaw_rad=tel.yaw_rad,
    )


def step(
    state: PlannerState, obs: Observation, profile: Profile, table: tuple[Row, ...] = TABLE
) -> tuple[PlannerState, Command]:
    """One tick of the mission."""
    state = _remember(state, obs, profile)
    row = first_match(Context(state, obs, profile), table)
    if row is not None:
        state = _enter(state, row, Context(state, obs, profile))
        state = replace(state, hold=hold_reason(Context(state, obs, profile)))
    new, command = act(Context(state, obs, profile))
    return replace(new, t_s=obs.t_s), command


def is_over(state: PlannerState) -> bool:
    return state.phase in TERMINALS


def _remember(state: PlannerState, obs: Observation, profile: Profile) -> PlannerState:
    state = _with_target(state, obs)
    if obs.position_age_s > profile.positioning.hold_s:
        state = replace(state, stale_s=obs.t_s)
    if obs.jumped:
        state = _jumped(state, obs)
    if obs.turned_rad > math.radians(profile.safety.heading_lost_deg):
        # Where no hover thrust was learned yet, the present one has to do.
        hover = state.hover_thrust or obs.telemetry.thrust
        state = replace(state, heading_lost=True, hover_thrust=hover)
    context = Context(state, obs, profile)
    # A landing of the vehicle's own is near its end, and goes on by the height, which is good yet.
    sets_down = state.phase is Phase.LANDING and state.blind_s is None and not state.orders
    if sets_down and context.by_sight and is_lost(context):
        state = _blinded(state, obs, in_reach=state.contact_z_m is not None)
        context = Context(state, obs, profile)
    state = replace(state, hold=hold_reason(context))
    since = conditions_since(context)
    if state.hold:
        since = _kept(since)  # a held vehicle proves nothing: the dwell times begin anew
    # Near the target an ascent may press against a ceiling that is lower than thought.
    away = state.phase is not Phase.ASCEND or context.error_z_m > profile.planner.ascend.near_m
    if away and state.phase in _LEARNING and hovers(context):
        state = replace(state, hover_thrust=_learned_hover_thrust(state, obs))
    felt_mps = felt_climb_mps(Context(state, obs, profile))
    state = replace(state, last=obs.telemetry, felt_mps=felt_mps, energy=budget.watched(context))
    state = replace(state, battery=budget.outlook(Context(state, obs, profile)))
    return replace(state, since=since, mount=_mount_watched(Context(state, obs, profile)))


def _blinded(state: PlannerState, obs: Observation, *, in_reach: bool) -> PlannerState:
    """Nothing but the gyroscope is left: level, and down by thrust. For good, since each change
    of the mode costs height."""
    hover = state.hover_thrust or _felt_hover_thrust(obs.telemetry)
    return replace(state, blind_s=obs.t_s, blind_in_reach=in_reach, hover_thrust=hover)


def _jumped(state: PlannerState, obs: Observation) -> PlannerState:
    """The estimate's world has moved, the vehicle has not: ground, contact and what else is
    remembered are where the estimate has them now, and it is held where it is. Where samples
    are missing before the step, it may be the vehicle that has moved, even to the floor; where
    positions from outside have come again, the step ends a drift, and what was true before is."""
    tel, last = obs.telemetry, state.last
    if last is None:
        return replace(state, jump_s=obs.t_s if state.jump_s is None else state.jump_s)
    x, y, z = tel.position_m
    vx, vy, vz = tel.velocity_mps
    dt_s = tel.t_s - tel.behind_s - (last.t_s - last.behind_s)
    lx, ly, lz = last.position_m
    step = (x - lx - vx * dt_s, y - ly - vy * dt_s, z - lz - vz * dt_s)
    put_right = state.stale_s is not None and obs.t_s - state.stale_s <= PUT_RIGHT_S
    if dt_s > UNSEEN_S or put_right:
        step = (0.0, 0.0, 0.0)
    setpoint, contact_z_m, blocked_z_m = state.setpoint, state.contact_z_m, state.blocked_z_m
    if state.phase is Phase.LANDING and state.orders and tel.thrust >= 1:
        # Its own landing goes on along a line in the world that was: it dives, or climbs.
        state = replace(
            state,
            entered_s=obs.t_s,
            orders=0,
            ordered_s=None,
            caught=False,
            catch_above_m=CATCH_STILL_ABOVE_M,
        )
    if setpoint is not None:
        z_m = z if contact_z_m is None else setpoint.z_m + step[2]
        setpoint = PositionSetpoint(x, y, z_m, tel.yaw_rad)
    return replace(
        state,
        setpoint=setpoint,
        ground_m=None if state.ground_m is None else _moved(state.ground_m, step),
        entry_m=_moved(state.entry_m, step),
        contact_z_m=None if contact_z_m is None else contact_z_m + step[2],
        blocked_z_m=None if blocked_z_m is None else blocked_z_m + step[2],
        jump_s=obs.t_s if state.jump_s is None else state.jump_s,
    )


def _moved(place: Place, step: Place) -> Place:
    return (place[0] + step[0], place[1] + step[1], place[2] + step[2])


def _with_target(state: PlannerState, obs: Observation) -> PlannerState:
    """Whether frames in a row measure the target, and how far they agree on its place."""
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


def _mount_watched(c: Context) -> MountWatch:
    """With this tick's frame, where it measured the target and the telemetry is fresh."""
    mount, target = c.state.mount, c.obs.target
    if c.state.phase not in IN_THE_OPEN or c.state.hold or not (c.obs.new_frame and c.proves):
        return mount
    if target is None or not target.measured or target.world_m is None:
        return mount
    return watched(mount, sight_of(c.obs.t_s, c.obs.telemetry, target.world_m))


def _felt_hover_thrust(tel: Telemetry) -> float:
    """In a climb, or sinking, the accelerometer tells by how much the thrust is beside the
    weight."""
    return tel.thrust / min(1.5, max(0.75, tel.acc_z_g))


def _learned_hover_thrust(state: PlannerState, obs: Observation) -> float:
    """Slow mean of the thrust in quiet flight: the reference of the contact proof."""
    thrust = obs.telemetry.thrust
    if state.hover_thrust == 0.0:
        return thrust
    if abs(thrust / state.hover_thrust - 1.0) > HOVER_WITHIN:
        return state.hover_thrust  # held by the ceiling, or by a hand: nothing hovers on that
    part = min(1.0, (obs.t_s - state.t_s) / 1.5)
    return state.hover_thrust + part * (thrust - state.hover_thrust)


def _kept(since: dict[Condition, float]) -> dict[Condition, float]:
    return {name: since_s for name, since_s in since.items() if name in KEPT_OVER_A_CHANGE}


def _enter(state: PlannerState, row: Row, context: Context) -> PlannerState:
    obs = context.obs
    new = replace(
        state,
        phase=row.to,
        entered_s=obs.t_s,
        reason=row.explain(context),
        row=row.name,
        severity=risen(state.severity, row.severity),
        motor_stop=row.motor_stop,
        outcome=row.outcome or state.outcome,
        since=_kept(state.since),
        attempts=state.attempts + int(row.counts_attempt),
        entry_m=obs.telemetry.position_m,
        entry_yaw_rad=obs.telemetry.yaw_rad,
        search_step_s=obs.t_s,
        confirmed=0,
        # A fall that is just being caught turns at full thrust, in the air.
        pressed=row.to in (Phase.RECOVER, Phase.LANDING) and state.caught and presses(context),
        ordered_s=None,
        orders=0,
    )
    if row.name == "position-astray":
        new = replace(new, felt_alone=is_felt_alone(context))
    if row.to is Phase.LANDING and context.by_sight and is_lost(context):
        touched = state.contact_z_m is not None or state.phase in (Phase.PERCH, Phase.COMPLETE)
        new = _blinded(new, obs, in_reach=touched)
    return _started_phase(new, state, obs)


def _started_phase(new: PlannerState, old: PlannerState, obs: Observation) -> PlannerState:
    """What a phase starts with, beyond the clock."""
    match new.phase:
        case Phase.COMPLETE:
            return replace(new, contact_z_m=obs.telemetry.position_m[2], released_s=None)
        case Phase.RECOVER:
            z_m = obs.telemetry.position_m[2]
            blocked_z_m = z_m if new.row == "blocked" else old.blocked_z_m
            touched = old.phase is Phase.PERCH or new.row == "blocked"
            return replace(
                new,
                stopped_s=None,
                # In the magnet's reach until it is seen below.
                contact_z_m=z_m if touched else old.contact_z_m,
                released_s=None,
                caught=new.row != "slipped" or is_carried(old.hover_thrust, obs.telemetry.thrust),
                catch_above_m=catch_above_m(old.hover_thrust, obs.telemetry.thrust),
                blocked_z_m=blocked_z_m,
            )
        case Phase.LANDING if old.phase is Phase.PERCH:
            # It may be in the magnet's reach: it has to be seen below before it counts as free.
            return replace(new, contact_z_m=obs.telemetry.position_m[2])
        case Phase.LANDING if new.row == "position-astray":
            hover = old.hover_thrust or _felt_hover_thrust(obs.telemetry)
            return replace(new, heading_lost=True, astray=True, hover_thrust=hover)
        case Phase.LANDING if new.row == "mounting":
            # The setpoint is ahead, and every centimetre there is one in a wrong direction.
            return replace(new, setpoint=None)
        case Phase.ASCEND:
            return replace(new, searches=0)
        case Phase.SEARCH if old.setpoint is not None:
            sp = old.setpoint
            return replace(new, entry_m=(sp.x_m, sp.y_m, sp.z_m), entry_yaw_rad=sp.yaw_rad)
        case _:
            return new
