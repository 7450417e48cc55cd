"""Conditions that become evidence after they have been true for some time.

In each tick, a condition is either true or false. It counts as evidence only after it has been true
without interruption for a dwell time, so that a single wrong sample proves nothing.
`ConditionStartTimes` maps each true condition to the time at which it became true.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

ConditionInput = TypeVar("ConditionInput", contravariant=True)


class RequiredData(Enum):
    """Data that a condition requires: nothing, fresh telemetry, or fresh telemetry and a valid
    position. The condition does not count while that data is old or unknown."""

    NOTHING = "no data that could be out of date"
    TELEMETRY = "fresh telemetry"
    POSITION = "fresh telemetry and a valid position"


@dataclass(frozen=True, eq=False)
class Condition(Generic[ConditionInput]):
    """A condition that counts as evidence once it has been true for some time: for example
    `ON_FLOOR`. It is evaluated once per tick, either on the estimated state of vehicle and target
    (`Belief`) or on that together with the planner's own state (`Context`).

    Attributes:
        name: readable name, for `repr`.
        predicate: function that returns True if the condition is true in this tick.
        persists_across_phases: True if the condition describes the vehicle independently of its
            maneuver: its start time is not reset by a change of phase, or by a hold, which pauses
            the mission.
        required_data: data that must be fresh for the condition to count. A condition that may stop
            the motors or end a flight requires at least fresh telemetry.
    """

    name: str
    predicate: Callable[[ConditionInput], bool]
    persists_across_phases: bool = False
    required_data: RequiredData = RequiredData.NOTHING

    def __repr__(self) -> str:
        return f"<condition: {self.name}>"


ConditionStartTimes = Mapping[Condition, float]  # type: ignore[type-arg]  # conditions of several types


def update_condition_start_times(
    old: ConditionStartTimes,
    conditions: Iterable[Condition[ConditionInput]],
    condition_input: ConditionInput,
    now_s: float,
) -> dict[Condition[ConditionInput], float]:
    """Return the start time, s, of each of `conditions` whose predicate is true for
    `condition_input`: the time in `old` if the condition was true before, otherwise `now_s`. All
    other conditions, also those of `old`, are omitted."""
    return {each: old.get(each, now_s) for each in conditions if each.predicate(condition_input)}


def keep_start_times_across_phases(
    condition_start_times_s: ConditionStartTimes,
) -> dict[Condition, float]:  # type: ignore[type-arg]
    """Return the start times of those conditions that do not restart when the phase changes or a
    hold pauses the mission: the ones with `persists_across_phases`."""
    return {
        each: began_s
        for each, began_s in condition_start_times_s.items()
        if each.persists_across_phases
    }
