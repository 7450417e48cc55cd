"""Conditions that count once they have held for a while, and what that rests on.

A condition is true or false in one tick. It is evidence only after it has been true without a
break, so that one wrong sample proves nothing; `since` holds from when on each has been true.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

Seen = TypeVar("Seen", contravariant=True)


class Rests(Enum):
    """What a condition rests on. It does not count while that is old or unknown."""

    NOTHING = "nothing that could be old"
    TELEMETRY = "fresh telemetry"
    POSITION = "fresh telemetry and a valid position"


@dataclass(frozen=True, eq=False)
class Condition(Generic[Seen]):
    """Something that is true or false in one tick: `holds`, a function of what is known then.

    Attributes:
        name: in words, for whoever reads a memory.
        lasts: it is the vehicle's own, whatever the maneuver: a change of phase or a hold does not
            begin it anew.
        rests_on: what has to be fresh for it to count; what may stop the motors or end a flight
            rests on telemetry at least.
    """

    name: str
    holds: Callable[[Seen], bool]
    lasts: bool = False
    rests_on: Rests = Rests.NOTHING

    def __repr__(self) -> str:
        return f"<condition: {self.name}>"


Since = Mapping[Condition, float]  # type: ignore[type-arg]  # of several kinds


def update_since(
    old: Since, conditions: Iterable[Condition[Seen]], seen: Seen, now_s: float
) -> dict[Condition[Seen], float]:
    """When each of the conditions that hold now began to hold."""
    return {each: old.get(each, now_s) for each in conditions if each.holds(seen)}


def lasting(since: Since) -> dict[Condition, float]:  # type: ignore[type-arg]
    """The entries that outlast a change of phase, or a hold."""
    return {each: began_s for each, began_s in since.items() if each.lasts}
