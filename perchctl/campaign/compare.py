"""The same seeds flown by several profiles: what differs between two, and whether it is proven.

Each seed is its own pair, so what differs from seed to seed takes no part. A figure's difference
is the mean over the pairs, with Student's interval; success is compared by the pairs in which only
one of both succeeded (McNemar's test, the exact one). All questions that
are asked together err together in one comparison of twenty at most: each gets its part of the 5 %.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.stats import binomtest, ttest_1samp

from perchctl.campaign.flights import fly_all, fly_seed
from perchctl.campaign.results import LEVEL, FlightResult, align_columns, rate_record, rate_text
from perchctl.profile import Profile


@dataclass(frozen=True)
class VariantResult:
    """The result of one seed, flown by the profile of that `number`."""

    number: int
    result: FlightResult

    @property
    def seed(self) -> int:
        return self.result.seed

    @property
    def outcome(self) -> str:
        return self.result.outcome


@dataclass(frozen=True)
class _Variant:
    """One flight to be flown: a seed and the number of its profile."""

    seed: int
    number: int

    def __str__(self) -> str:
        return f"{self.seed} (profile {self.number + 1})"


def fly_variants(
    profiles: Sequence[Profile],
    seeds: Iterable[int],
    executor: Executor | None = None,
    on_result: Callable[[VariantResult], None] = lambda result: None,
) -> list[VariantResult]:
    """Fly each seed by all profiles before the next seed; arguments and errors as of `fly_all`."""
    variants = [_Variant(seed, number) for seed in seeds for number in range(len(profiles))]
    return fly_all(partial(_fly, tuple(profiles)), variants, executor, on_result)


def _fly(profiles: tuple[Profile, ...], variant: _Variant) -> VariantResult:
    return VariantResult(variant.number, fly_seed(profiles[variant.number], variant.seed))


def whole_seeds(results: Iterable[VariantResult], profiles: int) -> list[tuple[FlightResult, ...]]:
    """Return, in the order of the seeds, the results of each seed that all profiles have flown."""
    by_seed: dict[int, dict[int, FlightResult]] = {}
    for each in results:
        by_seed.setdefault(each.seed, {})[each.number] = each.result
    return [
        tuple(flown[number] for number in range(profiles))
        for _, flown in sorted(by_seed.items())
        if len(flown) == profiles
    ]


def compare_variants(results: Iterable[VariantResult]) -> Comparison:
    """Return the comparison of two profiles by the seeds that both have flown."""
    return compare_pairs([(a, b) for a, b in whole_seeds(results, 2)])


# --- What is compared --------------------------------------------------------------------------


Pair = tuple[FlightResult, FlightResult]
Comparison = dict[str, Any]
"""What is known of two flights a seed, A's and B's, ready for JSON, in SI; `better` is "A", "B", or
None where nothing is proven:

- `flights`, and how many of them ended the same in all that a result tells, `identical`;
- `success` (perched, neither locked nor fallen): the rates of `A` and `B`; the seeds of which only
  one succeeded, `only_a` and `only_b`; the chance `p` that they split so unevenly, times the
  questions that were asked; `better`;
- for each figure the `pairs` that have it, its means `a` and `b`, their `difference` (B's less
  A's) with its `interval` (None for fewer than `FEWEST_PAIRS`), and `better`.
"""
FEWEST_PAIRS = 20
"""Fewer pairs get no interval: differences are not normally distributed, and only the mean of
many nearly is."""
_SAME = 1e-9
"""Values whose relative difference is below this differ by rounding only."""
NOT_PROVEN = "no difference proven"


@dataclass(frozen=True)
class Figure:
    """A figure of a flight that is better when smaller. `of` returns it in SI units, None if the
    flight has none; `scale` converts it to `unit`."""

    name: str
    key: str
    unit: str
    scale: float
    of: Callable[[FlightResult], float | None]


MISS = Figure("miss", "miss_m", "mm", 1e3, lambda r: r.miss_m if r.outcome == "perched" else None)
FIGURES = (
    MISS,
    Figure("flight time", "time_s", "s", 1.0, lambda r: _flown(r, r.time_s)),
    Figure("attempts", "attempts", "", 1.0, lambda r: _flown(r, r.attempts)),
)


def _flown(result: FlightResult, value: float) -> float | None:
    return None if result.outcome == "refused" else float(value)


def compare_pairs(
    pairs: Sequence[Pair], figures: Sequence[Figure] = FIGURES, times_asked: int = 1
) -> Comparison:
    """Return the comparison of two flights per seed. `times_asked`: the number of comparisons
    that share the 5 %."""
    questions = times_asked * (1 + len(figures))
    level = 1.0 - (1.0 - LEVEL) / questions
    return {
        "flights": len(pairs),
        "identical": sum(_ending(a) == _ending(b) for a, b in pairs),
        "success": _success(pairs, questions),
        **{figure.key: _difference(figure, pairs, level) for figure in figures},
    }


def _ending(r: FlightResult) -> tuple[Any, ...]:
    return r.outcome, r.reason, r.miss_m, r.time_s, r.attempts, r.locked, r.fell


def _success(pairs: Sequence[Pair], questions: int) -> dict[str, Any]:
    only_a = sum(b.is_bad and not a.is_bad for a, b in pairs)
    only_b = sum(a.is_bad and not b.is_bad for a, b in pairs)
    p = float(binomtest(only_a, only_a + only_b).pvalue) if only_a + only_b else 1.0
    p = min(1.0, questions * p)
    better = None
    if p <= 1.0 - LEVEL and only_a != only_b:
        better = "B" if only_b > only_a else "A"
    good_a, good_b = (sum(not pair[which].is_bad for pair in pairs) for which in (0, 1))
    return {
        "A": {"good": good_a, **rate_record(good_a, len(pairs))},
        "B": {"good": good_b, **rate_record(good_b, len(pairs))},
        "only_a": only_a,
        "only_b": only_b,
        "p": round(p, 9),
        "better": better,
    }


def _difference(figure: Figure, pairs: Sequence[Pair], level: float) -> dict[str, Any]:
    both = [(figure.of(a), figure.of(b)) for a, b in pairs]
    values = np.array([(a, b) for a, b in both if a is not None and b is not None])
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
    """Return Student's confidence interval of the mean."""
    if np.ptp(values) <= _SAME * np.max(np.abs(values)):
        return float(values[0]), float(values[0])
    found = ttest_1samp(values, 0.0).confidence_interval(level)
    return float(found.low), float(found.high)


# --- For people --------------------------------------------------------------------------------


def comparison_text(names: tuple[str, str], found: Comparison) -> str:
    """Return the comparison as a table, followed by what is proven."""
    flights, identical = found["flights"], found["identical"]
    figures = [figure for figure in FIGURES if figure.key in found]
    head = ("", f"A: {names[0]}", f"B: {names[1]}", "B less A", "")
    rows = [head, _success_row(found["success"], flights)]
    lines = align_columns(rows + [_figure_row(each, found[each.key]) for each in figures])
    if 0 < identical == flights:
        return "\n".join([*lines, "", f"identical in all {flights} flights"])
    if identical:
        lines += ["", f"identical in {identical} of {flights} flights"]
    together = (
        f"the {1 + len(figures)} answers hold together at {100 * LEVEL:.0f} %: intervals of "
        f"differences and p are widened for it"
    )
    return "\n".join([*lines, "", together])


def _success_row(success: Mapping[str, Any], flights: int) -> tuple[str, ...]:
    good_a, good_b = success["A"]["good"], success["B"]["good"]
    verdict = NOT_PROVEN
    if success["better"] is not None:
        share = 100.0 * abs(good_b - good_a) / flights
        verdict = f"{success['better']} is better by {share:.1f} %"
    return (
        "success",
        rate_text(good_a, flights),
        rate_text(good_b, flights),
        f"only A {success['only_a']}, only B {success['only_b']}",
        f"{verdict} (p = {success['p']:.2g})",
    )


def _figure_row(figure: Figure, found: Mapping[str, Any]) -> tuple[str, ...]:
    name = f"{figure.name} [{figure.unit}]" if figure.unit else figure.name
    if not found["pairs"]:
        return name, "-", "-", "-", NOT_PROVEN
    a, b, difference = (figure.scale * found[key] for key in ("a", "b", "difference"))
    text, verdict = f"{difference:+.2f}", NOT_PROVEN
    if found["interval"] is None:
        verdict += f": {found['pairs']} pairs, {FEWEST_PAIRS} are needed"
    else:
        low, high = (figure.scale * bound for bound in found["interval"])
        text += f" ({low:+.2f} to {high:+.2f})"
    if found["better"] is not None:
        verdict = f"{found['better']} is better by {abs(difference):.2f} {figure.unit}".rstrip()
    return name, f"{a:.2f}", f"{b:.2f}", text, verdict
