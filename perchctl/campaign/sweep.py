"""A key of a profile at several values, over the same seeds."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.campaign.compare import (
    MISS,
    VariantResult,
    compare_pairs,
    comparison_text,
    whole_seeds,
)
from perchctl.campaign.results import FlightResult, align_columns, rate_record, rate_text
from perchctl.errors import InvalidValue, UsageError
from perchctl.plain_yaml import clip_text, split_values
from perchctl.profile import Profile, changed_profile, profile_value, scalar_text


@dataclass(frozen=True)
class Sweep:
    """The profiles of a sweep, one for each value of a key. `texts` are the values; number `own`
    is the profile's own, added at the end if the sweep does not name it."""

    key: str
    texts: tuple[str, ...]
    profiles: tuple[Profile, ...]
    own: int

    def record(self, results: Iterable[VariantResult]) -> dict[str, Any]:
        """The figures of each value (a cell), by the seeds that were flown with every value: for
        programs, in SI. `best`: the value with the most successes, of these the one with the
        smallest median miss; `best_against_own` is the `Comparison` of the own value, A, with it,
        None where they are the same. What is proven there counts that it was picked out of all."""
        seeds = whole_seeds(results, len(self.profiles))
        by_cell = list(zip(*seeds, strict=True)) or [()] * len(self.profiles)
        cells = [
            {"values": {self.key: profile_value(profile, self.key)}, "own": number == self.own}
            | _figures(by_cell[number])
            for number, profile in enumerate(self.profiles)
        ]
        best = min(range(len(cells)), key=lambda n: (*_rank(cells[n]), n != self.own, n))
        against = None
        if best != self.own:
            pairs = list(zip(by_cell[self.own], by_cell[best], strict=True))
            against = compare_pairs(pairs, (MISS,), times_asked=len(cells) - 1)
        return {"cells": cells, "best": cells[best]["values"], "best_against_own": against}

    def text(self, record: dict[str, Any]) -> str:
        """The table of a sweep's `record`, and how the best value compares, for people."""
        rows = [(self.key, "success", "miss [mm]: median", "p95", "")]
        for text, cell in zip(self.texts, record["cells"], strict=True):
            is_best = cell["values"] == record["best"]
            notes = [word for word, on in (("best", is_best), ("own", cell["own"])) if on]
            misses = (_mm(cell["miss_m"]["median"]), _mm(cell["miss_m"]["p95"]))
            rate = rate_text(cell["good"], cell["flights"])
            rows.append((text, rate, *misses, ", ".join(notes)))
        lines = [*align_columns(rows), ""]
        if not record["cells"][0]["flights"]:
            return "\n".join([*lines, "no seed was flown with every value: nothing can be said"])
        if record["best_against_own"] is None:
            return "\n".join([*lines, "the profile's own value is the best"])
        counted = f"the best was picked out of {len(rows) - 1}, which is counted:"
        table = comparison_text(("own", "best"), record["best_against_own"])
        return "\n".join([*lines, counted, table])


def make_sweep(profile: Profile, sweep: str) -> Sweep:
    """The sweep of ``key=value,value``; the values as in a profile's file. Errors: UsageError,
    InvalidValue."""
    key, equals, text = (part.strip() for part in sweep.partition("="))
    try:
        texts = list(split_values(text))
    except ValueError as error:
        raise InvalidValue(f"sweep {clip_text(sweep)}: {error}") from None
    if not equals or not key or not texts:
        raise UsageError(
            f"{clip_text(sweep)} must be KEY=VALUE,VALUE with a key of the profile, as in "
            f"planner.align.xy_m=0.02,0.04"
        )
    profiles = [changed_profile(profile, [f"{key}={text}"], "sweep") for text in texts]
    for (n, one), (m, other) in itertools.combinations(enumerate(profiles), 2):
        if one == other:
            raise UsageError(f"sweep: {texts[n]} and {texts[m]} are the same: keep one")
    own = changed_profile(profile, ())
    number = profiles.index(own) if own in profiles else len(profiles)
    if own not in profiles:
        profiles.append(profile)
        texts.append(scalar_text(profile_value(profile, key)))
    return Sweep(key, tuple(texts), tuple(profiles), number)


def _figures(results: Sequence[FlightResult]) -> dict[str, Any]:
    """Return the figures of one value's flights; `miss` is taken over the perched ones, None
    without any."""
    misses = [miss for r in results if (miss := MISS.of(r)) is not None]
    good = sum(not r.is_bad for r in results)
    median_m, p95_m = np.percentile(misses, (50, 95)).round(6).tolist() if misses else (None, None)
    return {
        "flights": len(results),
        "good": good,
        **rate_record(good, len(results)),
        "miss_m": {"median": median_m, "p95": p95_m},
    }


def _rank(cell: dict[str, Any]) -> tuple[float, float]:
    median_m = cell["miss_m"]["median"]
    return -cell["good"], math.inf if median_m is None else median_m


def _mm(value_m: float | None) -> str:
    return "-" if value_m is None else f"{1e3 * value_m:.1f}"
