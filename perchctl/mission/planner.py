"""The perching planner.

`step_mission(state, observation, profile) -> (state, command)`.

Pure: no clock, no input but its arguments, so a log replays to the same commands
(`perchctl.analysis.decide`, and `tests/replay/test_corpus.py` demands it).
One tick: remember what was observed, look up the table, act for the phase.
"""

from __future__ import annotations

import numpy as np

from perchctl.mission import budget, lander
from perchctl.mission.actions import act
from perchctl.mission.conditions import (
    KEPT_OVER_A_CHANGE,
    conditions_since,
    contact_aside_m,
    contact_within_m,
    hovers,
    touched_aside_m,
)
from perchctl.mission.context import Context
from perchctl.mission.guards import hold_reason
from perchctl.mission.guidance import presses
from perchctl.mission.imu import led_astray
from perchctl.mission.mounting import MountWatch, sight_of, watched
from perchctl.mission.release import catch_above_m, is_carried
from perchctl.mission.state import (
    TERMINALS,
    Condition,
    Observation,
    Outcome,
    Phase,
    PlannerState,
)
from perchctl.mission.table import IN_THE_OPEN, TABLE, Row, first_match, risen
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import Command

HOVER_WITHIN = 0.2
_LEARNING = (Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND)


def start_mission(obs: Observation) -> PlannerState:
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


def step_mission(
    state: PlannerState, obs: Observation, profile: Profile, table: tuple[Row, ...] = TABLE
) -> tuple[PlannerState, Command]:
    """One tick of the mission."""
    state = _remember(state, obs, profile)
    row = first_match(Context(state, obs, profile), table)
    if row is not None:
        state = _enter(state, row, Context(state, obs, profile))
        state = replace(state, hold=hold_reason(Context(state, obs, profile)))
    new, command = act(Context(state, obs, profile))
    return replace(lander.ordered(new, command), t_s=obs.t_s), command


def is_mission_over(state: PlannerState) -> bool:
    """True once the mission is in a phase that it never leaves."""
    return state.phase in TERMINALS


def _remember(state: PlannerState, obs: Observation, profile: Profile) -> PlannerState:
    state = lander.observed(_with_target(state, obs), obs, profile)
    context = Context(state, obs, profile)
    state = replace(state, hold=hold_reason(context))
    since = conditions_since(context)
    if state.hold:
        since = _kept(since)  # a held vehicle proves nothing: the dwell times begin anew
    # Near the target an ascent may press against a ceiling that is lower than thought.
    away = state.phase is not Phase.ASCEND or context.error_z_m > profile.planner.ascend.near_m
    if away and state.phase in _LEARNING and hovers(context):
        state = replace(state, hover_thrust=_learned_hover_thrust(state, obs))
    state = replace(state, last=obs.telemetry, energy=budget.watched(context))
    state = replace(state, battery=budget.outlook(Context(state, obs, profile)))
    return replace(state, since=since, mount=_mount_watched(Context(state, obs, profile)))


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


def _learned_hover_thrust(state: PlannerState, obs: Observation) -> float:
    """Slow mean of the thrust in quiet flight: the reference of the contact proof."""
    thrust = obs.telemetry.thrust
    if state.hover_thrust == 0.0:
        return obs.imu.hover_thrust or thrust
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
        outcome=_outcome(state, row),
        since=_kept(state.since),
        attempts=state.attempts + int(row.counts_attempt),
        entry_m=obs.telemetry.position_m,
        entry_yaw_rad=obs.telemetry.yaw_rad,
        search_step_s=obs.t_s,
        confirmed=0,
        # A fall that is just being caught turns at full thrust, in the air. A press that was
        # ordered has wound the integrators up, whatever thrust is read.
        pressed=row.to in (Phase.RECOVER, Phase.LANDING)
        and state.caught
        and (state.phase is Phase.PERCH or presses(context)),
        ordered_s=None,
        orders=0,
    )
    return _started_phase(new, state, context)


def _outcome(state: PlannerState, row: Row) -> Outcome | None:
    """What hangs after all has found its target, by whatever it was brought there. What was found
    hanging on its way down is told as what led to that: nobody has seen whether it hangs there."""
    if state.phase is Phase.LANDING and row.outcome is Outcome.PERCHED and state.outcome:
        return state.outcome
    if row.name == "hung" and state.outcome is Outcome.TARGET_NOT_FOUND:
        return Outcome.ATTEMPTS_USED_UP
    return row.outcome or state.outcome


def _started_phase(new: PlannerState, old: PlannerState, c: Context) -> PlannerState:
    """What a phase starts with, beyond the clock."""
    obs = c.obs
    match new.phase:
        case Phase.COMPLETE:
            aside_m, sigma_m = touched_aside_m(c) or contact_aside_m(c)
            return replace(
                new,
                contact_z_m=obs.telemetry.position_m[2],
                contact_aside_m=aside_m,
                contact_sigma_m=sigma_m,
                released_s=None,
            )
        case Phase.RECOVER:
            z_m = obs.telemetry.position_m[2]
            blocked_z_m = z_m if new.row == "blocked" else old.blocked_z_m
            touched = old.phase is Phase.PERCH or new.row == "blocked"
            kept_aside_m, kept_sigma_m = _touched_aside(old, new.row, c)
            return replace(
                new,
                stopped_s=None,
                contact_aside_m=kept_aside_m,
                contact_sigma_m=kept_sigma_m,
                # In the magnet's reach until it is seen below.
                contact_z_m=z_m if touched else old.contact_z_m,
                released_s=None,
                caught=new.row != "slipped" or is_carried(old.hover_thrust, obs.telemetry.thrust),
                catch_above_m=catch_above_m(old.hover_thrust, obs.telemetry.thrust),
                blocked_z_m=blocked_z_m,
            )
        case Phase.LANDING:
            # The mounting may be right, and the motion capture's axes wrong: nothing tells which,
            # and by such positions the landing would speed up until it tilts over.
            capture = c.profile.positioning.by == "mocap" and old.mount.wrong
            if new.row == "position-astray" or (new.row == "mounting" and capture):
                reckoning = old.reckoning if old.astray else led_astray(old.reckoning)
                new = replace(new, astray=True, reckoning=reckoning)
            if new.row == "mounting":
                # The setpoint is ahead, and every centimetre there is one in a wrong direction.
                new = replace(new, setpoint=None)
            if old.phase is Phase.RECOVER and new.row != "hangs-at-contact":
                new = replace(new, contact_aside_m=None)  # nothing was felt to hold it there
            return lander.started(new, old, obs, c.profile)
        case Phase.ASCEND:
            return replace(new, searches=0)
        case Phase.SEARCH if old.setpoint is not None:
            sp = old.setpoint
            return replace(new, entry_m=(sp.x_m, sp.y_m, sp.z_m), entry_yaw_rad=sp.yaw_rad)
        case _:
            return new


def _touched_aside(old: PlannerState, row: str, c: Context) -> tuple[float | None, float]:
    """How far aside of the target it touched something at the target's height, with the standard
    deviation, for what backs off from there; None where nothing was felt to be touched."""
    kept = old.contact_aside_m, old.contact_sigma_m
    if row == "not-released":  # the contact was proven, and nothing has come off
        return kept
    if old.phase is Phase.RECOVER:  # pressed again before it had left
        return kept if old.contact_z_m is not None else (None, 0.0)
    proven = c.held(Condition.CONTACT) >= c.profile.planner.perch.contact_dwell_s
    carried = proven or c.held(Condition.CARRIED) >= 0.0  # which has that dwell in itself
    if old.phase is Phase.PERCH and carried and abs(c.error_z_m) <= contact_within_m(c):
        return contact_aside_m(c)
    return None, 0.0
