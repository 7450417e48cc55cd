"""Two profiles over the same seeds: what is there is found, and what is not is not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign import FlightResult
from perchctl.campaign.compare import (
    FEWEST_PAIRS,
    Comparison,
    compare_pairs,
    comparison_text,
    mean_interval,
)
from tests.helpers.results import LANDED, PERCHED, landed, perched

NAMES = ("one.yaml", "other.yaml")
Pairs = Sequence[tuple[FlightResult, FlightResult]]


def spread(seeds: int, by_m: float = 0.0, noise_m: float = 0.001, start: int = 0) -> Pairs:
    """Misses that differ from seed to seed by more than from one profile to the other."""
    rng = np.random.default_rng([seeds, start])
    common = rng.uniform(0.001, 0.006, seeds)
    own = np.abs(common + by_m + rng.normal(0.0, noise_m, seeds))
    return [
        (perched(k, float(a)), perched(k, float(b)))
        for k, (a, b) in enumerate(zip(common, own, strict=True))
    ]


def better(found: Comparison) -> set[str]:
    """Those that are proven to be better in something."""
    answers = (found[key]["better"] for key in ("success", "miss_m", "time_s", "attempts"))
    return {which for which in answers if which is not None}


def text(found: Comparison) -> str:
    return comparison_text(NAMES, found)


def test_a_difference_below_the_spread_of_the_seeds_is_found_by_pairs() -> None:
    found = compare_pairs(spread(60, by_m=0.001))
    miss = found["miss_m"]
    assert miss["difference"] == pytest.approx(0.001, abs=0.0004)
    assert 0 < miss["interval"][0] < 0.001 < miss["interval"][1]
    assert (miss["better"], better(found)) == ("A", {"A"})
    assert "A is better by 1." in text(found)
    turned = compare_pairs([(b, a) for a, b in spread(60, by_m=0.001)])
    assert turned["miss_m"]["better"] == "B"


def test_a_profile_and_its_copy_are_identical() -> None:
    found = compare_pairs([(a, replace(a, realtime_factor=3.0)) for a, _ in spread(60)])
    assert better(found) == set()
    assert text(found).endswith("\nidentical in all 60 flights")
    assert text(found).count("no difference proven") == 4


def test_chance_alone_is_seldom_a_difference() -> None:
    """All questions together, in one comparison of twenty."""
    alarms = sum(bool(better(compare_pairs(spread(30, start=k)))) for k in range(40))
    assert alarms <= 5


def test_success_is_told_by_the_pairs_that_differ() -> None:
    """Of 60 flights each 6 of one alone are just proven, of one question: not of four."""
    pairs = [(perched(k), landed(k) if k < 6 else perched(k)) for k in range(60)]
    alone = compare_pairs(pairs, figures=())["success"]
    assert (alone["A"]["good"], alone["B"]["good"]) == (60, 54)
    assert (alone["only_a"], alone["only_b"], alone["better"]) == (6, 0, "A")
    assert alone["p"] == pytest.approx(2 * 0.5**6)
    together = compare_pairs(pairs)["success"]
    assert together["p"] == pytest.approx(8 * 0.5**6)
    assert together["better"] is None
    more = compare_pairs([(landed(k) if k < 12 else perched(k), perched(k)) for k in range(60)])
    assert more["success"]["better"] == "B"
    assert "B is better by 20.0 %" in text(more)


def test_misses_are_compared_where_both_perched() -> None:
    pairs = [(perched(k, 0.002), perched(k, 0.003)) for k in range(20)]
    pairs += [(landed(20), perched(20, 0.5)), (perched(21, 0.5), landed(21))]
    found = compare_pairs(pairs)
    miss = found["miss_m"]
    assert (miss["pairs"], found["time_s"]["pairs"]) == (20, 22)
    assert (miss["a"], miss["b"]) == pytest.approx((0.002, 0.003))
    assert miss["interval"] == pytest.approx([0.001, 0.001])
    assert miss["better"] == "A"


def test_what_fell_or_is_locked_is_no_success() -> None:
    pairs = [(PERCHED, replace(PERCHED, locked=True)), (replace(PERCHED, fell=True), PERCHED)]
    success = compare_pairs(pairs)["success"]
    assert (success["A"]["good"], success["B"]["good"]) == (1, 1)


def test_few_flights_prove_nothing() -> None:
    few = compare_pairs(spread(FEWEST_PAIRS - 1, by_m=0.5))
    assert few["miss_m"]["interval"] is None
    assert better(few) == set()
    assert f"{FEWEST_PAIRS - 1} pairs, {FEWEST_PAIRS} are needed" in text(few)
    none = compare_pairs([(LANDED, LANDED)])
    assert none["miss_m"]["difference"] is None
    assert "-" in text(none)


@pytest.mark.parametrize("others", [[1.0], [1.0, -1.0], [1e9], [1e-12]])
def test_values_that_are_nearly_all_the_same_have_an_interval(others: list[float]) -> None:
    values = np.array([0.0] * FEWEST_PAIRS + others)
    low, high = mean_interval(values)
    assert low <= values.mean() <= high


def test_the_interval_holds_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(4)
    held = 0
    for _ in range(60):
        low, high = mean_interval(rng.normal(1.0, 2.0, 40))
        held += low <= 1.0 <= high
    assert 52 <= held < 60


ends = st.sampled_from([PERCHED, LANDED, replace(PERCHED, fell=True), replace(PERCHED, attempts=3)])


@settings(max_examples=8)
@given(st.lists(st.tuples(ends, ends), min_size=1, max_size=12))
def test_turning_both_round_turns_what_is_said(pairs: Pairs) -> None:
    one, other = compare_pairs(pairs), compare_pairs([(b, a) for a, b in pairs])
    assert json.loads(json.dumps(one)) == one
    assert one["success"]["p"] == other["success"]["p"]
    assert one["success"]["only_a"] == other["success"]["only_b"]
    assert one["identical"] == other["identical"]
    for key in ("miss_m", "time_s", "attempts"):
        assert one[key]["a"] == other[key]["b"]
        assert {one[key]["better"], other[key]["better"]} in ({None}, {"A", "B"})
