"""The perching planner: `step(state, observation, profile) -> (state, command)`.

Pure: no clock, no input but its arguments, so a log replays to the same commands.
One tick: remember what was observed, look up the table, act for the phase.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perchctl.mission.actions import act
from perchctl.mission.conditions import conditions_since, hold_reason
from perchctl.mission.context import Context
from perchctl.mission.state import (
    TERMINALS,
    Anchor,
    Observation,
    Phase,
    PlannerState,
    Severity,
)
from perchctl.mission.table import TABLE, Row, first_match
from perchctl.profile import Profile
from perchctl.vehicle import Command
from perchctl.vision.types import Stage

MAX_DRIFT_MPS = 0.05
"""The target stands still: what seems to move faster is the filter's noise."""


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
    state = _with_anchor(state, obs)
    if obs.jumped and state.jump_s is None:
        state = replace(state, jump_s=obs.t_s)
    view = Context(state, obs, profile)
    state = replace(state, hold=hold_reason(view))
    if state.hold:
        # A held vehicle proves nothing: the dwell times begin anew.
        keep = ("tilted", "battery_low", "high_level_idle")
        since = {k: s for k, s in conditions_since(view).items() if k in keep}
    else:
        since = conditions_since(view)
    if state.phase in (Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND) and view.speed_mps < 0.3:
        state = replace(state, hover_thrust=_learned_hover_thrust(state, obs))
    return replace(state, since=since)


def _with_anchor(state: PlannerState, obs: Observation) -> PlannerState:
    target = obs.target
    if not obs.new_frame:
        return state
    if target is None or not target.measured or target.world_m is None:
        return replace(state, confirmed=0)
    velocity = target.world_velocity_mps
    velocity = np.zeros(3) if velocity is None else velocity
    speed = float(np.linalg.norm(velocity))
    if speed > MAX_DRIFT_MPS:
        velocity = velocity * (MAX_DRIFT_MPS / speed)
    yaw = target.world_yaw_rad if target.world_yaw_rad is not None else 0.0
    anchor = Anchor(target.t_s, target.world_m, yaw, velocity)
    spread = 0.0
    if state.anchor is not None:
        moved = float(np.linalg.norm(anchor.world_m - state.anchor.at(target.t_s)))
        spread = max(moved, 0.9 * state.anchor_spread_m)
    small_seen = target.stage in (Stage.BOTH, Stage.SMALL)
    return replace(
        state,
        anchor=anchor,
        anchor_spread_m=spread,
        confirmed=state.confirmed + 1,
        small_seen_s=target.t_s if small_seen else state.small_seen_s,
    )


def _learned_hover_thrust(state: PlannerState, obs: Observation) -> float:
    """Slow mean of the thrust in quiet flight: the yardstick of the contact proof."""
    thrust = obs.telemetry.thrust
    if thrust < 1000:
        return state.hover_thrust
    if state.hover_thrust == 0.0:
        return thrust
    part = min(1.0, (obs.t_s - state.t_s) / 1.5)
    return state.hover_thrust + part * (thrust - state.hover_thrust)


def _enter(state: PlannerState, row: Row, view: Context) -> PlannerState:
    obs = view.obs
    keep = ("battery_low", "tilted")
    new = replace(
        state,
        phase=row.to,
        entered_s=obs.t_s,
        reason=row.explain(view),
        row=row.name,
        severity=Severity(max(row.severity, Severity.CONTINUE)),
        outcome=row.outcome or state.outcome,
        since={k: s for k, s in state.since.items() if k in keep},
        attempts=state.attempts + int(row.counts_attempt),
        entry_m=obs.telemetry.position_m,
        entry_yaw_rad=obs.telemetry.yaw_rad,
        search_step_s=obs.t_s,
        confirmed=0,
        ordered_s=None,
        orders=0,
    )
    return _started_phase(new, state, obs)


def _started_phase(new: PlannerState, old: PlannerState, obs: Observation) -> PlannerState:
    """What a phase starts with, beyond the clock."""
    match new.phase:
        case Phase.COMPLETE:
            return replace(new, contact_z_m=obs.telemetry.position_m[2])
        case Phase.RECOVER:
            return replace(new, motors_stopped=False, contact_z_m=None)
        case Phase.ASCEND:
            return replace(new, searches=0)
        case Phase.SEARCH if old.setpoint is not None:
            sp = old.setpoint
            return replace(new, entry_m=(sp.x_m, sp.y_m, sp.z_m), entry_yaw_rad=sp.yaw_rad)
        case _:
            return new
