"""How a flight failed: the kind of it, by which two failures are the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2

from perchctl.errors import PerchError
from perchctl.flight.campaign import OUTCOMES, fly_all
from perchctl.flight.conditions import ScenarioConditions
from perchctl.flight.lockstep import LockstepFlight, fly_lockstep
from perchctl.flight.memory import give_back_memory
from perchctl.flight.minimise import Levels, minimised
from perchctl.flight.results import FlightEnd
from perchctl.mission import Phase
from perchctl.profile import Profile


class Kind(NamedTuple):
    """`row`: of the mission's table, that gave the flight up; empty where none did."""

    outcome: FlightEnd
    row: str
    locked: bool
    fell: bool


@dataclass(frozen=True)
class EndedFlight:
    """One flight's end, and why."""

    seed: int
    kind: Kind
    reason: str

    @property
    def outcome(self) -> str:
        return self.kind.outcome

    @property
    def failed(self) -> bool:
        return self.kind.outcome != "perched" or self.kind.locked or self.kind.fell

    @property
    def told(self) -> str:
        """In words: how it ended, and why."""
        flags = [word for word in ("locked", "fell") if getattr(self.kind, word)]
        return f"{', '.join([self.outcome, *flags])}: {self.reason}"


def fly_to_its_end(profile: Profile, seed: int) -> EndedFlight:
    """One flight; what the program refuses to fly has ended, too."""
    cv2.setNumThreads(1)
    try:
        flight = fly_lockstep(profile, seed)
    except PerchError as error:
        return EndedFlight(seed, Kind("refused", "", False, False), str(error))
    ended = EndedFlight(seed, kind_of(flight), flight.report.reason)
    del flight
    give_back_memory()
    return ended


def kind_of(flight: LockstepFlight) -> Kind:
    ends = (Phase.LANDING, Phase.LANDED, Phase.ABORTED)
    rows = [event.row for event in flight.report.history if event.phase in ends and event.row]
    outcome = "aborted" if flight.fell else OUTCOMES[flight.report.phase]
    return Kind(outcome, rows[0] if rows else "", flight.locked, flight.fell)


def minimised_failure(
    conditions: ScenarioConditions,
    failure: EndedFlight,
    executor: Executor | None = None,
    jobs: int = 1,
    on_result: Callable[[EndedFlight], None] = lambda ended: None,
    on_less: Callable[[Levels, EndedFlight], None] = lambda levels, ended: None,
    fly: Callable[[Profile, int], EndedFlight] = fly_to_its_end,
) -> dict[str, float]:
    """The levels of `perchctl.flight.minimise`, of a seed that ended in `failure`, by flights; the
    same failure is one of the same kind.

    `jobs` fly at a time. What is found is the same however many do. `on_less`: each smaller
    failure as it is found.
    """
    ends: list[EndedFlight] = []

    def first_failing(several: Sequence[Levels]) -> int | None:
        for start in range(0, len(several), jobs):
            profiles = tuple(conditions.toned(levels) for levels in several[start : start + jobs])
            one = partial(_fly_toned, fly, profiles, conditions.seed)
            flown = fly_all(one, range(len(profiles)), executor, on_result)
            for number, ended in enumerate(flown, start):
                if ended.kind == failure.kind:
                    ends.append(ended)
                    return number
        return None

    return minimised(
        conditions.names,
        conditions.gradual,
        first_failing,
        lambda levels: on_less(dict(levels), ends[-1]),
    )


def _fly_toned(
    fly: Callable[[Profile, int], EndedFlight], profiles: Sequence[Profile], seed: int, number: int
) -> EndedFlight:
    return fly(profiles[number], seed)
