"""Define a phase by its maneuver, entry, action, exits and conditions."""

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


def keep_state_on_entry(state: PlannerState, previous_context: Context) -> PlannerState:
    """Return the state unchanged: the `enter` function of a phase that needs no preparation.
    `previous_context` is not used."""
    del previous_context
    return state


@dataclass(frozen=True, eq=False, kw_only=True)
class PhaseDefinition:
    """A phase of the mission.

    Attributes:
        maneuver: maneuver flown in this phase, which determines how the belief interprets evidence.
        enter: function that prepares the phase. It takes the state that has just entered the phase
            and the context before the transition, in the same tick, and returns the new state.
            `state.entry.diagnosis` holds what the transition asserts about the vehicle
            (`VehicleDiagnosis`).
        act: function that returns the new state and the command of each tick.
        exits: the transitions (rows of the table) out of this phase alone, in the order in which
            they are tried; rows that apply in many phases come before them.
        timed_conditions: conditions that the planner evaluates in every tick, so that the exits of
            the phase can ask for how long each has been true (`Context.true_for_s`).
    """

    phase: Phase
    maneuver: Maneuver
    act: Callable[[Context], Action]
    enter: Callable[[PlannerState, Context], PlannerState] = keep_state_on_entry
    exits: tuple[Transition, ...] = ()
    timed_conditions: tuple[Condition[Context], ...] = ()
