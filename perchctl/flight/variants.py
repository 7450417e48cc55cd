"""The same seeds flown by several profiles, so that each seed is a pair, or a row, of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from perchctl.flight.campaign import fly_all, fly_seed
from perchctl.flight.results import FlightResult
from perchctl.profile import Profile


@dataclass(frozen=True)
class Variant:
    """One flight that is to be flown: of a seed, by the profile of that number."""

    seed: int
    number: int

    def __str__(self) -> str:
        return f"{self.seed} (profile {self.number + 1})"


@dataclass(frozen=True)
class VariantResult:
    variant: Variant
    result: FlightResult

    @property
    def seed(self) -> int:
        return self.variant.seed

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


def fly_variants(
    profiles: Sequence[Profile],
    seeds: Iterable[int],
    executor: Executor | None = None,
    on_result: Callable[[VariantResult], None] = lambda result: None,
) -> list[VariantResult]:
    """Each seed by all profiles before the next seed."""
    variants = [Variant(seed, number) for seed in seeds for number in range(len(profiles))]
    return fly_all(partial(_fly, tuple(profiles)), variants, executor, on_result)


def _fly(profiles: tuple[Profile, ...], variant: Variant) -> VariantResult:
    return VariantResult(variant, fly_seed(profiles[variant.number], variant.seed))


def whole_seeds(results: Iterable[VariantResult], profiles: int) -> list[tuple[FlightResult, ...]]:
    """The seeds that were flown by all profiles, in order: of each seed one result a profile."""
    by_seed: dict[int, dict[int, FlightResult]] = {}
    for each in results:
        by_seed.setdefault(each.seed, {})[each.variant.number] = each.result
    return [
        tuple(flown[number] for number in range(profiles))
        for _, flown in sorted(by_seed.items())
        if len(flown) == profiles
    ]
