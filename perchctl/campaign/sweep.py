"""One or two keys of a profile at several values each, over the same seeds."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.campaign.compare import (
    MISS,
    NOT_PROVEN,
    Comparison,
    VariantResult,
    compare_pairs,
    difference_verdict,
    success_verdict,
    whole_seeds,
)
from perchctl.campaign.results import FlightResult, align_columns, rate_record, rate_text
from perchctl.errors import InvalidValue, UsageError
from perchctl.plain_yaml import clip_text, split_values
from perchctl.profile import Profile, changed_profile, profile_value, scalar_text

MOST_KEYS = 2


@dataclass(frozen=True)
class Cell:
    """`texts`: the value of each key. `own`: these are the profile's own values."""

    texts: tuple[str, ...]
    profile: Profile
    own: bool = False


@dataclass(frozen=True)
class Grid:
    """`cells`: each value of one key with each of the other, and the profile's own values at the
    end where they are none of these."""

    keys: tuple[str, ...]
    cells: tuple[Cell, ...]

    @property
    def own(self) -> int:
        return next(number for number, cell in enumerate(self.cells) if cell.own)

    def name(self, number: int) -> str:
        texts = zip(self.keys, self.cells[number].texts, strict=True)
        return ", ".join(f"{key}={text}" for key, text in texts)

    def compared(self, results: Iterable[VariantResult]) -> Swept:
        """The figures of all cells, by the seeds that were flown in every cell."""
        return sweep_results(self, whole_seeds(results, len(self.cells)))


def sweep_grid(profile: Profile, sweeps: Sequence[str]) -> Grid:
    """The grid of each ``key=value,value``; the values as in a profile's file. Errors: UsageError,
    InvalidValue."""
    if len(sweeps) > MOST_KEYS:
        raise UsageError(
            f"{len(sweeps)} keys are given: a sweep takes one or two, each value with each"
        )
    keys, texts = zip(*map(_split, sweeps), strict=True)
    if len(set(keys)) < len(keys):
        raise UsageError(f"{keys[0]} is given twice: give all its values at once")
    cells = []
    for row in itertools.product(*texts):
        settings = [f"{key}={text}" for key, text in zip(keys, row, strict=True)]
        swept = changed_profile(profile, settings, "sweep")
        cells.append(Cell(row, swept, swept == changed_profile(profile, ())))
    if not any(cell.own for cell in cells):
        own = tuple(scalar_text(profile_value(profile, key)) for key in keys)
        cells.append(Cell(own, profile, True))
    for one, other in itertools.combinations(cells, 2):
        if one.profile == other.profile:
            raise UsageError(f"sweep: {_row(one)} and {_row(other)} are the same: keep one")
    return Grid(keys, tuple(cells))


def _split(sweep: str) -> tuple[str, tuple[str, ...]]:
    key, equals, text = sweep.partition("=")
    try:
        parts = split_values(text)
    except ValueError as error:
        raise InvalidValue(f"sweep {clip_text(sweep)}: {error}") from None
    if not equals or not key.strip() or not parts:
        raise UsageError(
            f"{clip_text(sweep)} must be KEY=VALUE,VALUE with a key of the profile, as in "
            f"planner.align.xy_m=0.02,0.04"
        )
    return key.strip(), tuple(parts)


def _row(cell: Cell) -> str:
    return " with ".join(cell.texts)


@dataclass(frozen=True)
class Figures:
    """Figures of one cell's flights; misses are those of the perched ones, None without any."""

    flights: int
    good: int
    median_m: float | None
    p95_m: float | None


@dataclass(frozen=True)
class Swept:
    """`best`: the cell with the most successes, of these the one with the smallest median miss.
    `against_own`: the profile's own values (A) against these (B); None where they are the same.
    What is proven there counts that the best was picked out of all cells."""

    grid: Grid
    figures: tuple[Figures, ...]
    best: int
    against_own: Comparison | None

    def text(self) -> str:
        """The table of a sweep, and the best of its values, for people."""
        return "\n".join(_lines(self))

    def record(self) -> dict[str, Any]:
        """For programs: SI; `values` as the profile has them."""
        cells = [
            {
                "values": {key: profile_value(cell.profile, key) for key in self.grid.keys},
                "own": cell.own,
                "flights": figures.flights,
                "good": figures.good,
                **rate_record(figures.good, figures.flights),
                "miss_m": {"median": _rounded(figures.median_m), "p95": _rounded(figures.p95_m)},
            }
            for cell, figures in zip(self.grid.cells, self.figures, strict=True)
        ]
        against = None if self.against_own is None else self.against_own.record()
        return {"cells": cells, "best": cells[self.best]["values"], "best_against_own": against}


def sweep_results(grid: Grid, seeds: Sequence[tuple[FlightResult, ...]]) -> Swept:
    """The sweep's figures from each seed's flights, one a cell."""
    by_cell = list(zip(*seeds, strict=True)) or [()] * len(grid.cells)
    figures = tuple(map(_figures, by_cell))
    best = min(range(len(figures)), key=lambda n: (*_rank(figures[n]), n != grid.own, n))
    against = None
    if best != grid.own:
        pairs = list(zip(by_cell[grid.own], by_cell[best], strict=True))
        names = (grid.name(grid.own), grid.name(best))
        against = compare_pairs(names, pairs, (MISS,), times_asked=len(figures) - 1)
    return Swept(grid, figures, best, against)


def _figures(results: Sequence[FlightResult]) -> Figures:
    found = [miss for r in results if (miss := MISS.of(r)) is not None]
    good = sum(not r.is_bad for r in results)
    if not found:
        return Figures(len(results), good, None, None)
    median_m, p95_m = (float(np.percentile(found, percent)) for percent in (50, 95))
    return Figures(len(results), good, median_m, p95_m)


def _rank(figures: Figures) -> tuple[float, float]:
    return -figures.good, math.inf if figures.median_m is None else figures.median_m


def _lines(found: Swept) -> Iterator[str]:
    grid = found.grid
    rows = [(*grid.keys, "success", "miss [mm]: median", "p95", "")]
    for number, (cell, figures) in enumerate(zip(grid.cells, found.figures, strict=True)):
        notes = [word for word, on in (("best", number == found.best), ("own", cell.own)) if on]
        rows.append(
            (
                *cell.texts,
                rate_text(figures.good, figures.flights),
                _mm(figures.median_m),
                _mm(figures.p95_m),
                ", ".join(notes),
            )
        )
    yield from align_columns(rows)
    yield ""
    yield f"best:  {grid.name(found.best)}"
    yield f"own:   {grid.name(grid.own)}"
    yield _verdict(found)


def _verdict(found: Swept) -> str:
    against = found.against_own
    if not found.figures[0].flights:
        return "no seed was flown in every cell: nothing can be said"
    if against is None:
        return "the profile's own values are the best"
    if against.all_identical:
        return f"the flights of both are identical, all {against.flights}"
    miss = against.differences[0]
    said = [
        f"{name}, {verdict}"
        for name, better, verdict in (
            ("success", against.success.better, success_verdict(against.success)),
            ("miss", miss.better, difference_verdict(miss)),
        )
        if better is not None
    ]
    asked = f"counting that it was picked out of {len(found.figures)}"
    if not said:
        return f"of the best against the profile's own values: {NOT_PROVEN}, {asked}"
    return f"proven of the profile's own values (A) against the best (B), {asked}: " + "; ".join(
        said
    )


def _mm(value_m: float | None) -> str:
    return "-" if value_m is None else f"{1e3 * value_m:.1f}"


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 6)
