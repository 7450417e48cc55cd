"""The permission to climb: without it, the vehicle waits below its target, for a bounded time."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import Observation, Outcome, Phase, PlannerState, planner
from perchctl.mission.phase import PRE_LANDING_PHASES
from perchctl.mission.phases.align import MAX_WAIT_FOR_CLIMB_PERMISSION_S
from perchctl.vehicle import Command, PositionSetpoint
from tests.helpers.mission import PROFILE, remembering, state_in
from tests.mission.rig import BEGIN_S, TICK_S, at, fly, times

HEIGHT_M = 1.0
WHY = "east is too near its climb"
spells = st.lists(st.tuples(st.booleans(), st.integers(1, 60)), min_size=1, max_size=8)
"""Times, in ticks, with and without permission, in turns."""


def step(state: PlannerState, obs: Observation, may: bool) -> tuple[PlannerState, Command]:
    obs = replace(obs, climb_withheld_reason=None if may else WHY)
    return planner.step_mission(state, obs, PROFILE)


@given(spells)
def test_a_climb_begins_only_in_a_tick_with_permission(spells: list[tuple[bool, int]]) -> None:
    state, look, t_s = state_in(Phase.ALIGN, BEGIN_S, HEIGHT_M), at(HEIGHT_M), BEGIN_S
    for may, ticks in spells:
        for _ in range(ticks):
            t_s += TICK_S
            state, command = step(state, look(t_s), may)
            if state.phase is not Phase.ALIGN:
                assert state.phase is Phase.ASCEND
                assert may
                return
            assert isinstance(command, PositionSetpoint)
            assert command.z_m == pytest.approx(HEIGHT_M), "nothing climbs meanwhile"


@pytest.mark.parametrize("x_m", [0.0, 0.2], ids=["aligned", "beside"])
def test_without_permission_it_lands_in_the_end(x_m: float) -> None:
    """The wait is no alignment that took too long, but has a row and a limit of its own."""
    look = at(position_m=(x_m, 0.0, HEIGHT_M), obs={"climb_withheld_reason": WHY})
    flown = fly(
        state_in(Phase.ALIGN, BEGIN_S), look, MAX_WAIT_FOR_CLIMB_PERMISSION_S + 1.0, one_phase=True
    )
    if x_m:
        assert flown.state.transition_name == "align-timeout"
        return
    assert flown.state.transition_name == "climb-not-permitted"
    assert (flown.state.phase, flown.state.outcome) == (Phase.LANDING, Outcome.SAFETY)
    assert flown.state.transition_reason == f"no permission to climb for 45 s: {WHY}"
    assert flown.ticks[-1].t_s == pytest.approx(BEGIN_S + MAX_WAIT_FOR_CLIMB_PERMISSION_S, abs=0.1)
    waiting = flown.ticks[-2].state
    assert waiting.pause_reason == f"waiting for permission to climb: {WHY}"
    assert waiting.hold_reason == ""


def test_it_climbs_as_soon_as_it_may() -> None:
    state, look = state_in(Phase.ALIGN, BEGIN_S), at(HEIGHT_M)
    for t_s in times(MAX_WAIT_FOR_CLIMB_PERMISSION_S - 1.0):
        state, _ = step(state, look(t_s), may=False)
    state, _ = step(state, look(t_s + TICK_S), may=True)
    assert state.phase is Phase.ASCEND


@pytest.mark.parametrize(
    "phase", sorted(PRE_LANDING_PHASES - {Phase.ALIGN}, key=lambda phase: phase.value)
)
def test_no_other_phase_asks(phase: Phase) -> None:
    """Above all, a climb that has begun is not recalled."""
    free = withheld = remembering(state_in(phase, BEGIN_S))
    for t_s in times(1.0):
        obs = at(HEIGHT_M)(t_s)
        free, command = step(free, obs, may=True)
        withheld, other = step(withheld, obs, may=False)
        if Phase.ALIGN in (free.phase, withheld.phase):
            assert free.phase is withheld.phase
            return
        assert (withheld.phase, other) == (free.phase, command)
