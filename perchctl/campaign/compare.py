"""Fly the same seeds with several profiles, and find out which differences are significant.

The two flights with the same seed form a pair. The difference in a figure is the mean over all
pairs, with Student's interval. Success is compared by the pairs in which only one of the two
flights succeeded (McNemar's exact test). The 5 % significance level applies to all questions
together and is divided among them (Bonferroni).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import binomtest, ttest_1samp

from perchctl.campaign.flights import fly_all, fly_seed
from perchctl.campaign.results import (
    LEVEL,
    FlightResult,
    align_columns,
    miss_percentiles,
    rate_record,
    rate_text,
)
from perchctl.errors import InvalidValue
from perchctl.plain_yaml import clip_text, split_values
from perchctl.profile import Profile, apply_settings, profile_value, yaml_scalar


def fly_variants(
    profiles: Sequence[Profile],
    seeds: Iterable[int],
    executor: Executor | None = None,
    on_result: Callable[[FlightResult], None] = lambda result: None,
) -> list[FlightResult]:
    """Fly each seed with all profiles before going on to the next seed; for the other parameters,
    see `fly_all`."""
    variants = itertools.product(seeds, range(len(profiles)))
    return fly_all(partial(_fly, tuple(profiles)), variants, executor, on_result)


def _fly(profiles: tuple[Profile, ...], variant: tuple[int, int]) -> FlightResult:
    seed, number = variant
    return replace(fly_seed(profiles[number], seed), variant=number)


def results_by_seed(
    results: Iterable[FlightResult], profile_count: int
) -> list[tuple[FlightResult, ...]]:
    """Return the results of all seeds that were flown with every profile, in order of seed; for
    each seed, one result per profile."""
    by_seed: dict[int, dict[int, FlightResult]] = {}
    for each in results:
        by_seed.setdefault(each.seed, {})[each.variant] = each
    return [
        tuple(flown[number] for number in range(profile_count))
        for _, flown in sorted(by_seed.items())
        if len(flown) == profile_count
    ]


# --- What is compared ---


Pair = tuple[FlightResult, FlightResult]
Comparison = dict[str, Any]
"""The comparison of profiles A and B, which both flew each seed, as values for JSON in SI units.
`better` is "A", "B", or None if the difference is not significant:

- `flights`: the number of seeds;
- `success` (perched, neither locked nor fallen): the rates of `A` and `B`; `only_a` and `only_b`,
  the numbers of seeds for which only A or only B succeeded; `p`, the probability of so uneven a
  split by chance, times the number of questions asked; and `better`;
- for each figure: the number of `pairs` in which both flights have it, the means `a` and `b`, their
  `difference` (B minus A) with its `interval` (None for fewer than `FEWEST_PAIRS`), and `better`.
"""
FEWEST_PAIRS = 20
"""Number of pairs below which no interval is given, since only the mean of many pairs is nearly
normally distributed."""
_ROUNDING_RATIO = 1e-9
"""Relative difference below which two values differ only by rounding."""
NOT_PROVEN = "no significant difference"
FIGURES = {
    "miss_m": ("miss [mm]", "mm", 1e3),
    "time_s": ("flight time [s]", "s", 1.0),
    "attempts": ("attempts", "", 1.0),
}
"""The figures of a flight, all better when smaller: fields of `FlightResult`, each with its name,
its display unit, and how many of these units make one SI unit."""
MISS = ("miss_m",)


def compare_variants(results: Iterable[FlightResult]) -> Comparison:
    """The comparison of two profiles over the seeds that were flown with both."""
    return compare_pairs([(a, b) for a, b in results_by_seed(results, 2)])


def compare_pairs(
    pairs: Sequence[Pair], figures: Sequence[str] = tuple(FIGURES), comparisons: int = 1
) -> Comparison:
    """Compare the two flights of each seed by success and by `figures` (keys of `FIGURES`).

    `comparisons`: number of comparisons that share the 5 % significance level.
    """
    questions = comparisons * (1 + len(figures))
    level = 1.0 - (1.0 - LEVEL) / questions
    return {
        "flights": len(pairs),
        "success": _success(pairs, questions),
        **{key: _difference(key, pairs, level) for key in figures},
    }


def _success(pairs: Sequence[Pair], questions: int) -> dict[str, Any]:
    only_a = sum(b.is_bad and not a.is_bad for a, b in pairs)
    only_b = sum(a.is_bad and not b.is_bad for a, b in pairs)
    p = float(binomtest(only_a, only_a + only_b).pvalue) if only_a + only_b else 1.0
    p = min(1.0, questions * p)
    better = None
    if p <= 1.0 - LEVEL and only_a != only_b:
        better = "B" if only_b > only_a else "A"
    rates = {}
    for which, name in enumerate("AB"):
        good = sum(not pair[which].is_bad for pair in pairs)
        rates[name] = {"good": good, **rate_record(good, len(pairs))}
    return {**rates, "only_a": only_a, "only_b": only_b, "p": round(p, 9), "better": better}


def _difference(key: str, pairs: Sequence[Pair], level: float) -> dict[str, Any]:
    flown = [(a, b) for a, b in pairs if "refused" not in (a.outcome, b.outcome)]
    both = [(getattr(a, key), getattr(b, key)) for a, b in flown]
    values = np.array([pair for pair in both if None not in pair], float)
    found = dict.fromkeys(("a", "b", "difference", "interval", "better"))
    if len(values):
        a, b = map(float, values.mean(axis=0))
        found |= {"a": round(a, 9), "b": round(b, 9), "difference": round(b - a, 9)}
    if len(values) >= FEWEST_PAIRS:
        low, high = mean_interval(values[:, 1] - values[:, 0], level)
        better = None if low <= 0.0 <= high else "B" if high < 0.0 else "A"
        found |= {"interval": [round(low, 9), round(high, 9)], "better": better}
    return {"pairs": len(values), **found}


def mean_interval(values: np.ndarray, level: float = LEVEL) -> tuple[float, float]:
    """Return Student's confidence interval (low, high) of the mean at `level`."""
    if np.ptp(values) <= _ROUNDING_RATIO * np.max(np.abs(values)):
        return float(values[0]), float(values[0])
    found = ttest_1samp(values, 0.0).confidence_interval(level)
    return float(found.low), float(found.high)


def comparison_text(names: tuple[str, str], found: Comparison) -> str:
    """Format a comparison as a table with verdicts; `names`: the names of A and B."""
    flights, success = found["flights"], found["success"]
    rows: list[tuple[str, ...]] = [("", f"A: {names[0]}", f"B: {names[1]}", "B - A", "")]
    rates = (rate_text(success[which]["good"], flights) for which in "AB")
    only = f"only A {success['only_a']}, only B {success['only_b']}"
    verdict = _verdict(success["better"])
    rows.append(("success", *rates, only, f"{verdict} (p = {success['p']:.2g})"))
    rows += [_figure_row(key, found[key]) for key in FIGURES if key in found]
    lines = [*align_columns(rows), ""]
    together = (
        f"all {len(rows) - 1} comparisons hold jointly at {100 * LEVEL:.0f} %: the "
        "intervals of the differences and the p-values are corrected for this"
    )
    return "\n".join([*lines, together])


def _figure_row(key: str, found: Mapping[str, Any]) -> tuple[str, ...]:
    name, unit, scale = FIGURES[key]
    if not found["pairs"]:
        return name, "-", "-", "-", NOT_PROVEN
    a, b, difference = (scale * found[each] for each in ("a", "b", "difference"))
    shown = (name, f"{a:.2f}", f"{b:.2f}")
    if found["interval"] is None:
        few = f"{NOT_PROVEN}: {found['pairs']} pairs, but {FEWEST_PAIRS} are needed"
        return *shown, f"{difference:+.2f}", few
    low, high = (scale * bound for bound in found["interval"])
    verdict = _verdict(found["better"], f" by {abs(difference):.2f} {unit}")
    return *shown, f"{difference:+.2f} ({low:+.2f} to {high:+.2f})", verdict.rstrip()


def _verdict(better: str | None, by: str = "") -> str:
    return NOT_PROVEN if better is None else f"{better} is better{by}"


# --- Sweep: several values of one profile key ---


@dataclass(frozen=True)
class Sweep:
    """The profiles of a sweep, one for each value of a key; the last has the original value."""

    key: str
    profiles: tuple[Profile, ...]

    def record(self, results: Sequence[FlightResult]) -> dict[str, Any]:
        """The sweep's results for JSON, over the seeds flown with all values.

        `cells`: each value's figures; `best`: the value with the most successes, then the smallest
        median miss; `best_against_own`: `Comparison` of the original value (A) with `best` (B),
        None if these are the same.
        """
        seeds = results_by_seed(results, len(self.profiles))
        own = len(self.profiles) - 1
        cells = [
            {"value": profile_value(profile, self.key), "own": number == own}
            | _figures([flown[number] for flown in seeds])
            for number, profile in enumerate(self.profiles)
        ]
        best = min(range(len(cells)), key=lambda number: _rank(cells[number]))
        against = None
        if best != own:
            pairs = [(flown[own], flown[best]) for flown in seeds]
            against = compare_pairs(pairs, MISS, comparisons=own)
        return {"cells": cells, "best": cells[best]["value"], "best_against_own": against}

    def text(self, record: dict[str, Any]) -> str:
        """The `record` of a sweep as a table, and the comparison of the best value with the
        original."""
        rows: list[tuple[str, ...]] = [(self.key, "success", "miss [mm]: median", "p95", "")]
        for cell in record["cells"]:
            misses = ("-" if m is None else f"{1e3 * m:.1f}" for m in cell["miss_m"].values())
            rate = rate_text(cell["good"], cell["flights"])
            note = "own" if cell["own"] else ""
            rows.append((yaml_scalar(cell["value"]), rate, *misses, note))
        lines = [*align_columns(rows), "", f"best: {yaml_scalar(record['best'])}"]
        if record["best_against_own"] is not None:
            lines += [f"selected from {len(rows) - 1} values; the statistics account for this:"]
            lines += [comparison_text(("own", "best"), record["best_against_own"])]
        return "\n".join(lines)


def make_sweep(profile: Profile, sweep: str) -> Sweep:
    """The sweep of `profile` given by the text ``key=value,value``, with values as in a profile's
    file. Errors: InvalidValue."""
    key, equals, text = (part.strip() for part in sweep.partition("="))
    try:
        texts = list(split_values(text))
    except ValueError as error:
        raise InvalidValue(f"sweep {clip_text(sweep)}: {error}") from None
    if not equals or not key or not texts:
        raise InvalidValue(
            f"{clip_text(sweep)} must be KEY=VALUE,VALUE with a key of the profile, as in "
            f"planner.align.xy_m=0.02,0.04"
        )
    profiles = [apply_settings(profile, [f"{key}={text}"], "sweep") for text in texts]
    others = [p for k, p in enumerate(profiles) if p not in (profile, *profiles[:k])]
    return Sweep(key, (*others, profile))


def _figures(results: Sequence[FlightResult]) -> dict[str, Any]:
    good = sum(not r.is_bad for r in results)
    misses = [r.miss_m for r in results if r.outcome == "perched" and r.miss_m is not None]
    rate = rate_record(good, len(results))
    return {"flights": len(results), "good": good, **rate, "miss_m": miss_percentiles(misses)}


def _rank(cell: dict[str, Any]) -> tuple[float, ...]:
    median_m = cell["miss_m"]["median"]
    return -cell["good"], math.inf if median_m is None else median_m, not cell["own"]
