"""Two flights on one time: each phase begins at the same moment in both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.log.read import FlightLog, PhaseSpan


@dataclass(frozen=True)
class Stretch:
    """One phase on the common time, as long as the longer of the two stays in it.

    `stays`: the two flights' own, in the order of the flights; None where it was not flown.
    """

    phase: str
    start_s: float
    end_s: float
    stays: tuple[PhaseSpan | None, PhaseSpan | None]


def stretches(one: Sequence[PhaseSpan], other: Sequence[PhaseSpan]) -> tuple[Stretch, ...]:
    """The phases of both in an order that is each flight's own.

    What only one of them flew, as a second attempt, stands alone.
    """
    found: list[Stretch] = []

    def add(a: PhaseSpan | None, b: PhaseSpan | None) -> None:
        stays = [stay for stay in (a, b) if stay is not None]
        start_s = found[-1].end_s if found else 0.0
        end_s = start_s + max(stay.duration_s for stay in stays)
        found.append(Stretch(stays[0].phase, start_s, end_s, (a, b)))

    names = ([stay.phase for stay in one], [stay.phase for stay in other])
    for tag, i0, i1, j0, j1 in SequenceMatcher(None, *names, autojunk=False).get_opcodes():
        if tag == "equal":
            for a, b in zip(one[i0:i1], other[j0:j1], strict=True):
                add(a, b)
            continue
        for a in one[i0:i1]:
            add(a, None)
        for b in other[j0:j1]:
            add(None, b)
    return tuple(found)


def ticks_of(log: FlightLog, stretch: Stretch, which: int) -> tuple[Any, Array]:
    """Which of the flight's ticks (0: the first flight's) lie in the stretch, (n,) bool, and when
    on the common time these are, (k,)."""
    stay = stretch.stays[which]
    t_s = log.column("t_s")
    if stay is None:
        return np.zeros(len(t_s), dtype=bool), np.empty(0)
    inside = (t_s >= stay.start_s) & (t_s <= stay.end_s)
    return inside, t_s[inside] - stay.start_s + stretch.start_s
