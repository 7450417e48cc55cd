"""What makes up a phase: its entry, its action, its exits and the conditions that these count."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.context import Context
from perchctl.mission.phase import Phase
from perchctl.mission.setpoints import Action
from perchctl.mission.state import PlannerState
from perchctl.mission.transition import Transition


def enter_as_it_is(state: PlannerState, before: Context) -> PlannerState:
    """The entry of a phase that begins with nothing of its own."""
    del before
    return state


@dataclass(frozen=True, eq=False, kw_only=True)
class PhaseDefinition:
    """A phase in one value.

    Attributes:
        maneuver: what the vehicle is flown to do in it, as far as evidence depends on it.
        enter: the state with what the phase begins with, from the state that has just entered it
            and the tick before the transition. `state.entry.claims` are the transition's.
        act: the phase's new state and command in each tick.
        exits: its own rows, in their order; the rows that hold in many phases stand before them.
        conditions: its own conditions, which its exits count.
    """

    phase: Phase
    maneuver: Maneuver
    act: Callable[[Context], Action]
    enter: Callable[[PlannerState, Context], PlannerState] = enter_as_it_is
    exits: tuple[Transition, ...] = ()
    conditions: tuple[Condition[Context], ...] = ()
