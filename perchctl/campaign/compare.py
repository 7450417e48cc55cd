"""The same seeds flown by several profiles: what differs between two, and whether it is proven.

Each seed is its own pair, so what differs from seed to seed takes no part. A figure's difference
is the mean over the pairs, with a bootstrap's interval (BCa, Efron 1987); success is compared by
the pairs in which only one of both succeeded (McNemar's test, the exact one). All questions that
are asked together err together in one comparison of twenty at most: each gets its part of the 5 %.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest, bootstrap

from perchctl.campaign.flights import fly_all, fly_seed
from perchctl.campaign.results import LEVEL, FlightResult, align_columns, rate_record, rate_text
from perchctl.profile import Profile


@dataclass(frozen=True)
class VariantResult:
    """The flight of a seed by the profile of that `number`."""

    number: int
    result: FlightResult

    @property
    def seed(self) -> int:
        return self.result.seed

    @property
    def outcome(self) -> str:
        return self.result.outcome

    @property
    def badness(self) -> tuple[Any, ...]:
        return self.result.badness

    @property
    def log(self) -> Path | None:
        return self.result.log

    @property
    def log_problem(self) -> str | None:
        return self.result.log_problem


@dataclass(frozen=True)
class _Variant:
    """One flight that is to be flown: of a seed, by the profile of that number."""

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
    """Fly each seed by all profiles before the next seed, as `fly_all` does."""
    variants = [_Variant(seed, number) for seed in seeds for number in range(len(profiles))]
    return fly_all(partial(_fly, tuple(profiles)), variants, executor, on_result)


def _fly(profiles: tuple[Profile, ...], variant: _Variant) -> VariantResult:
    return VariantResult(variant.number, fly_seed(profiles[variant.number], variant.seed))


def whole_seeds(results: Iterable[VariantResult], profiles: int) -> list[tuple[FlightResult, ...]]:
    """The seeds that were flown by all profiles, in order: of each seed one result a profile."""
    by_seed: dict[int, dict[int, FlightResult]] = {}
    for each in results:
        by_seed.setdefault(each.seed, {})[each.number] = each.result
    return [
        tuple(flown[number] for number in range(profiles))
        for _, flown in sorted(by_seed.items())
        if len(flown) == profiles
    ]


# --- What is compared --------------------------------------------------------------------------


FEWEST_PAIRS = 20
"""An interval of fewer would promise too much: of 8 pairs a bootstrap's is wrong five times as
often as it says."""
RESAMPLES, TAIL_RESAMPLES = 9999, 20
"""At least, and so many beyond each end of an interval, of which the level may be high."""
_MOST_AT_ONCE = 500
_SEED = 0
_SAME = 1e-9
"""Values that differ by less of themselves do so by rounding."""
NOT_PROVEN = "no difference proven"


@dataclass(frozen=True)
class Figure:
    """A figure of a flight of which less is better. `of` gives it in SI, None where a flight has
    none; `scale` makes it `unit`."""

    name: str
    key: str
    unit: str
    scale: float
    of: Callable[[FlightResult], float | None]


def _perched_miss_m(result: FlightResult) -> float | None:
    return result.miss_m if result.outcome == "perched" else None


def _flown_s(result: FlightResult) -> float | None:
    return result.time_s if result.outcome != "refused" else None


def _attempts(result: FlightResult) -> float | None:
    return float(result.attempts) if result.outcome != "refused" else None


MISS = Figure("miss", "miss_m", "mm", 1e3, _perched_miss_m)
FIGURES = (
    MISS,
    Figure("flight time", "time_s", "s", 1.0, _flown_s),
    Figure("attempts", "attempts", "", 1.0, _attempts),
)


@dataclass(frozen=True)
class Difference:
    """The difference of a figure, B's less A's, in SI.

    Attributes:
        pairs: the seeds of which both have the figure.
        means: A's and B's over these; None without any.
        interval: of the difference of the means; None for fewer than `FEWEST_PAIRS`.
    """

    figure: Figure
    pairs: int
    means: tuple[float, float] | None = None
    interval: tuple[float, float] | None = None

    @property
    def mean(self) -> float | None:
        return None if self.means is None else self.means[1] - self.means[0]

    @property
    def better(self) -> int | None:
        """Which of both is proven to be better, 0 or 1; None where neither is."""
        if self.interval is None or self.interval[0] <= 0.0 <= self.interval[1]:
            return None
        return int(self.interval[1] < 0.0)


@dataclass(frozen=True)
class Success:
    """Flights that perched, and were neither locked nor fell.

    Attributes:
        flights: of each of both.
        good: how many of A's and of B's did.
        alone: seeds of which only A's did, and only B's.
        p: that chance alone splits these so unevenly, times the questions that were asked.
    """

    flights: int
    good: tuple[int, int]
    alone: tuple[int, int]
    p: float

    @property
    def better(self) -> int | None:
        if self.p > 1.0 - LEVEL or self.alone[0] == self.alone[1]:
            return None
        return int(self.alone[1] > self.alone[0])


@dataclass(frozen=True)
class Comparison:
    """`identical`: the seeds whose two flights ended the same in all that a result tells."""

    names: tuple[str, str]
    success: Success
    differences: tuple[Difference, ...]
    identical: int

    @property
    def flights(self) -> int:
        return self.success.flights

    @property
    def all_identical(self) -> bool:
        return 0 < self.identical == self.flights

    @property
    def better(self) -> set[int]:
        """Those of both that are proven to be better in something."""
        found = {self.success.better, *(each.better for each in self.differences)}
        return {which for which in found if which is not None}

    def text(self) -> str:
        """The comparison as a table, for people."""
        return "\n".join(_lines(self))

    def record(self) -> dict[str, Any]:
        """For programs: SI; a difference is B's less A's, `better` "A", "B" or None."""
        success = self.success
        return {
            "flights": self.flights,
            "identical": self.identical,
            "success": {
                **{
                    name: {"good": k, **rate_record(k, success.flights)}
                    for name, k in zip("AB", success.good, strict=True)
                },
                "only_a": success.alone[0],
                "only_b": success.alone[1],
                "p": round(success.p, 9),
                "better": _letter(success.better),
            },
            **{each.figure.key: _difference_record(each) for each in self.differences},
        }


def compare_profiles(names: tuple[str, str], results: Iterable[VariantResult]) -> Comparison:
    """The comparison of two profiles, by the seeds that both have flown."""
    return compare_pairs(names, [(a, b) for a, b in whole_seeds(results, len(names))])


def compare_pairs(
    names: tuple[str, str],
    pairs: Sequence[tuple[FlightResult, FlightResult]],
    figures: Sequence[Figure] = FIGURES,
    times_asked: int = 1,
) -> Comparison:
    """The comparison of two flights a seed. `times_asked`: comparisons that are made together."""
    questions = times_asked * (1 + len(figures))
    level = 1.0 - (1.0 - LEVEL) / questions
    return Comparison(
        names,
        _success(pairs, questions),
        tuple(_difference(figure, pairs, level) for figure in figures),
        sum(_ending(a) == _ending(b) for a, b in pairs),
    )


def _success(pairs: Sequence[tuple[FlightResult, FlightResult]], questions: int) -> Success:
    alone = (
        sum(b.is_bad and not a.is_bad for a, b in pairs),
        sum(a.is_bad and not b.is_bad for a, b in pairs),
    )
    good = (sum(not a.is_bad for a, _ in pairs), sum(not b.is_bad for _, b in pairs))
    p = float(binomtest(alone[0], sum(alone)).pvalue) if any(alone) else 1.0
    return Success(len(pairs), good, alone, min(1.0, questions * p))


def _difference(
    figure: Figure, pairs: Sequence[tuple[FlightResult, FlightResult]], level: float
) -> Difference:
    both = [(figure.of(a), figure.of(b)) for a, b in pairs]
    values = np.array([(a, b) for a, b in both if a is not None and b is not None])
    if not len(values):
        return Difference(figure, 0)
    means = (float(values[:, 0].mean()), float(values[:, 1].mean()))
    interval = None
    if len(values) >= FEWEST_PAIRS:
        interval = mean_interval(values[:, 1] - values[:, 0], level)
    return Difference(figure, len(values), means, interval)


def mean_interval(values: np.ndarray, level: float = LEVEL) -> tuple[float, float]:
    """The bootstrap's interval of the mean; the same for the same values."""
    if np.ptp(values) <= _SAME * np.max(np.abs(values)):
        return float(values[0]), float(values[0])
    resamples = max(RESAMPLES, math.ceil(2 * TAIL_RESAMPLES / (1.0 - level)))
    for method in ("BCa", "percentile"):
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # of values for which BCa has no answer
            found = bootstrap(
                (values,), np.mean, n_resamples=resamples, batch=_MOST_AT_ONCE, method=method,
                confidence_level=level, rng=np.random.default_rng(_SEED),
            ).confidence_interval  # fmt: skip
        low, high = float(found.low), float(found.high)
        if math.isfinite(low) and math.isfinite(high):
            break
    return low, high


def _ending(r: FlightResult) -> tuple[Any, ...]:
    return r.outcome, r.reason, r.miss_m, r.time_s, r.attempts, r.locked, r.fell


def _lines(found: Comparison) -> Iterator[str]:
    a, b = found.names
    success = found.success
    n = success.flights
    alone = f"only A {success.alone[0]}, only B {success.alone[1]}"
    rate_a, rate_b = (rate_text(k, n) for k in success.good)
    yield from align_columns(
        [
            ("", f"A: {a}", f"B: {b}", "B less A", ""),
            ("success", rate_a, rate_b, alone, success_verdict(success)),
            *(_cells(each) for each in found.differences),
        ]
    )
    yield ""
    if found.all_identical:
        yield f"identical in all {n} flights"
        return
    if found.identical:
        yield f"identical in {found.identical} of {n} flights"
    yield (
        f"the {1 + len(found.differences)} answers hold together at {100 * LEVEL:.0f} %: intervals "
        f"of differences and p are widened for it"
    )


def _cells(each: Difference) -> tuple[str, str, str, str, str]:
    figure = each.figure
    unit = f" [{figure.unit}]" if figure.unit else ""
    name = f"{figure.name}{unit}"
    if each.means is None or each.mean is None:
        return name, "-", "-", "-", NOT_PROVEN
    a, b = (f"{figure.scale * mean:.2f}" for mean in each.means)
    return name, a, b, _signed(each), difference_verdict(each)


def _signed(each: Difference) -> str:
    assert each.mean is not None
    text = f"{each.figure.scale * each.mean:+.2f}"
    if each.interval is None:
        return text
    low, high = (f"{each.figure.scale * bound:+.2f}" for bound in each.interval)
    return f"{text} ({low} to {high})"


def success_verdict(success: Success) -> str:
    if success.better is None:
        return f"{NOT_PROVEN} (p = {success.p:.2g})"
    share = 100.0 * abs(success.good[1] - success.good[0]) / success.flights
    return f"{'AB'[success.better]} is better by {share:.1f} % (p = {success.p:.2g})"


def difference_verdict(each: Difference) -> str:
    if each.mean is None or each.interval is None:
        return f"{NOT_PROVEN}: {each.pairs} pairs, {FEWEST_PAIRS} are needed"
    if each.better is None:
        return NOT_PROVEN
    unit = f" {each.figure.unit}" if each.figure.unit else ""
    return f"{'AB'[each.better]} is better by {each.figure.scale * abs(each.mean):.2f}{unit}"


def _difference_record(each: Difference) -> dict[str, Any]:
    means = each.means or (None, None)
    return {
        "pairs": each.pairs,
        "a": _rounded(means[0]),
        "b": _rounded(means[1]),
        "difference": _rounded(each.mean),
        "interval": None if each.interval is None else [_rounded(b) for b in each.interval],
        "better": _letter(each.better),
    }


def _letter(which: int | None) -> str | None:
    return None if which is None else "AB"[which]


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 9)
