"""A failure brought down to what makes it fail: the fewest conditions, each as weak as may be.

Delta debugging (Zeller and Hildebrandt 2002) over the conditions of a scenario: as many as
possible are toned down to nominal while the flight still fails in the same way, first halves of
them, then fewer and fewer, until none of those left can be taken away. Then each of these is made
weaker by bisection. What flies is a function, so that this file knows neither profile nor flight.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence

Levels = Mapping[str, float]
"""A condition's share of what the seed drew: 1 is that, 0 nominal."""
HALVINGS = 4
"""What a condition can be weakened to is known to a sixteenth."""


def minimised(
    names: Sequence[str],
    gradual: Sequence[str],
    first_failing: Callable[[Sequence[Levels]], int | None],
    on_less: Callable[[Levels], None] = lambda levels: None,
) -> dict[str, float]:
    """The levels that are left, of a scenario that fails with all of `names` at 1.

    Args:
        gradual: those that can be weakened; another one is there or not.
        first_failing: flies each of the given levels, and returns which is the first that
            fails as the whole did; None: none does.
        on_less: told of each smaller failure as it is found.

    Returns:
        The level of each name; taking one of those above 0 away, it no longer fails. All are 0
        where the nominal flight fails in the same way.
    """
    search = _Search(names, first_failing, on_less)
    kept = search.fewest()
    return search.weakest(kept, [name for name in kept if name in gradual])


class _Search:
    def __init__(
        self,
        names: Sequence[str],
        first_failing: Callable[[Sequence[Levels]], int | None],
        on_less: Callable[[Levels], None],
    ) -> None:
        self._names = names
        self._first_failing = first_failing
        self._on_less = on_less
        self._not_failing: set[frozenset[str]] = set()

    def fewest(self) -> list[str]:
        """Of the names, in their order."""
        if self._first(iter([[]])) is not None:
            return []
        kept, parts = list(self._names), 2
        while len(kept) > 1:
            chunks = _split(kept, parts)
            if (chunk := self._first(iter(chunks))) is not None:
                kept, parts = chunk, 2
            elif (rest := self._first(_rests(kept, chunks))) is not None:
                kept, parts = rest, max(parts - 1, 2)
            elif parts < len(kept):
                parts = min(2 * parts, len(kept))
            else:
                break
        return kept

    def weakest(self, kept: Sequence[str], gradual: Sequence[str]) -> dict[str, float]:
        levels = self._levels(kept)
        for name in gradual:
            below, above = 0.0, 1.0
            for _ in range(HALVINGS):
                middle = 0.5 * (below + above)
                if self._first_failing([levels | {name: middle}]) is None:
                    below = middle
                else:
                    above = middle
                    levels[name] = middle
                    self._on_less(levels)
        return levels

    def _first(self, sets: Iterator[list[str]]) -> list[str] | None:
        """The first of the sets that still fails. None is flown twice."""
        untried = [names for names in sets if frozenset(names) not in self._not_failing]
        found = self._first_failing([self._levels(names) for names in untried]) if untried else None
        tried = untried if found is None else untried[:found]
        self._not_failing |= {frozenset(names) for names in tried}
        if found is None:
            return None
        self._on_less(self._levels(untried[found]))
        return untried[found]

    def _levels(self, kept: Sequence[str]) -> dict[str, float]:
        return {name: float(name in kept) for name in self._names}


def _split(names: list[str], parts: int) -> list[list[str]]:
    edges = [round(k * len(names) / parts) for k in range(parts + 1)]
    return [names[a:b] for a, b in itertools.pairwise(edges)]


def _rests(names: list[str], chunks: Sequence[list[str]]) -> Iterator[list[str]]:
    """What is left without each of the chunks."""
    for chunk in chunks:
        gone = set(chunk)
        yield [name for name in names if name not in gone]
