"""Several profiles over the same seeds: what is there is found, and what is not is not."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign import FlightResult, comparison_text, make_sweep
from perchctl.campaign.compare import (
    FEWEST_PAIRS,
    FIGURES,
    Comparison,
    Sweep,
    compare_pairs,
    results_by_seed,
)
from perchctl.errors import InvalidValue
from perchctl.profile import load_profile
from tests.helpers.results import LANDED, PERCHED, landed, perched

SIM = load_profile("sim")
KEY = "planner.align.xy_m"
Pairs = Sequence[tuple[FlightResult, FlightResult]]


def spread(seeds: int, by_m: float = 0.0, start: int = 0) -> Pairs:
    """Misses that differ from seed to seed by more than from one profile to the other."""
    rng = np.random.default_rng([seeds, start])
    common = rng.uniform(0.001, 0.006, seeds)
    own = np.abs(common + by_m + rng.normal(0.0, 0.001, seeds))
    return [
        (perched(k, float(a)), perched(k, float(b)))
        for k, (a, b) in enumerate(zip(common, own, strict=True))
    ]


def better(found: Comparison) -> set[str]:
    """Those that are proven to be better in something."""
    return {found[key]["better"] for key in ("success", *FIGURES)} - {None}


def text(found: Comparison) -> str:
    return comparison_text(("one.yaml", "other.yaml"), found)


def test_a_difference_below_the_spread_of_the_seeds_is_found_by_pairs() -> None:
    found = compare_pairs(spread(60, by_m=0.001))
    miss = found["miss_m"]
    assert miss["difference"] == pytest.approx(0.001, abs=0.0004)
    assert 0 < miss["interval"][0] < 0.001 < miss["interval"][1]
    assert (miss["better"], better(found)) == ("A", {"A"})
    assert "A is better by 1." in text(found)
    alone = compare_pairs(spread(60, by_m=0.001), ("miss_m",))["miss_m"]
    assert np.ptp(alone["interval"]) < np.ptp(miss["interval"]), "of fewer questions"


def test_a_profile_and_its_copy_are_identical() -> None:
    found = compare_pairs([(a, replace(a, cpu_s=3.0)) for a, _ in spread(60)])
    assert better(found) == set()
    assert text(found).count("no significant difference") == 4


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
    harmed = [(PERCHED, replace(PERCHED, locked=True)), (replace(PERCHED, fell=True), PERCHED)]
    assert [compare_pairs(harmed)["success"][which]["good"] for which in "AB"] == [1, 1]


def test_misses_are_compared_where_both_perched_and_times_where_both_flew() -> None:
    refused = FlightResult(0, "refused", "flat", None, 0.0, 0, False, False)
    pairs = [(perched(k, 0.002), perched(k, 0.003)) for k in range(20)]
    pairs += [(landed(20), perched(20, 0.5)), (perched(21, 0.5), landed(21)), (refused, PERCHED)]
    found = compare_pairs(pairs)
    miss = found["miss_m"]
    assert (miss["pairs"], found["time_s"]["pairs"]) == (20, 22)
    assert (miss["a"], miss["b"]) == pytest.approx((0.002, 0.003))
    assert miss["interval"] == pytest.approx([0.001, 0.001])
    assert miss["better"] == "A"


def test_few_flights_prove_nothing() -> None:
    few = compare_pairs(spread(FEWEST_PAIRS - 1, by_m=0.5))
    assert few["miss_m"]["interval"] is None
    assert better(few) == set()
    assert f"{FEWEST_PAIRS - 1} pairs, but {FEWEST_PAIRS} are needed" in text(few)
    none = compare_pairs([(LANDED, LANDED)])
    assert none["miss_m"]["difference"] is None
    assert "-" in text(none)


ends = st.sampled_from([PERCHED, LANDED, replace(PERCHED, fell=True), replace(PERCHED, attempts=3)])


@settings(max_examples=8)
@given(st.lists(st.tuples(ends, ends), min_size=1, max_size=12))
def test_turning_both_round_turns_what_is_said(pairs: Pairs) -> None:
    one, other = compare_pairs(pairs), compare_pairs([(b, a) for a, b in pairs])
    assert json.loads(json.dumps(one)) == one
    assert one["success"]["p"] == other["success"]["p"]
    assert one["success"]["only_a"] == other["success"]["only_b"]
    for key in FIGURES:
        assert one[key]["a"] == other[key]["b"]
        assert {one[key]["better"], other[key]["better"]} in ({None}, {"A", "B"})


def test_seeds_count_that_every_profile_has_flown() -> None:
    results = [
        replace(perched(seed), attempts=number, variant=number)
        for seed in (4, 3)
        for number in (1, 0)
    ]
    seeds = results_by_seed([*results, perched(5)], 2)
    assert [(row[0].seed, row[0].attempts, row[1].attempts) for row in seeds] == [
        (3, 0, 1), (4, 0, 1),
    ]  # fmt: skip


# --- values of a key ----------------------------------------------------------------------------


def sweep(values: str) -> Sweep:
    return make_sweep(SIM, f"{KEY}={values}")


def test_each_value_is_a_cell_and_the_profiles_own_is_the_last() -> None:
    for values in ("0.02,0.04,0.08", "0.02,0.08,0.020"):
        asked = sweep(values)
        assert [profile.planner.align.xy_m for profile in asked.profiles] == [0.02, 0.08, 0.04]
        assert asked.profiles[-1] == SIM
    lists = make_sweep(SIM, "simulation.mass_kg=[0.04, 0.04],[0.05,0.05]")
    assert lists.profiles[1].simulation.mass_kg == (0.05, 0.05)


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        (KEY, InvalidValue, "must be KEY=VALUE,VALUE"),
        ("=1,2", InvalidValue, "must be KEY=VALUE,VALUE"),
        (f"{KEY}=", InvalidValue, "must be KEY=VALUE,VALUE"),
        (f"{KEY}=0.1,[", InvalidValue, "not YAML"),
        (f"{KEY}=0.1,9", InvalidValue, "found 9"),
        ("planner.align.xx=1", InvalidValue, "allowed here are xy_m"),
    ],
)
def test_what_cannot_be_swept_is_refused(text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=re.escape(words)):
        make_sweep(SIM, text)


def flown(seeds: int, *misses_m: float | None) -> list[FlightResult]:
    """One a cell; None does not perch. Seeds differ."""
    return [
        replace(landed(k) if m is None else perched(k, m + 1e-4 * (k % 7)), variant=cell)
        for k in range(seeds)
        for cell, m in enumerate(misses_m)
    ]


def test_the_best_is_proven_or_not() -> None:
    asked = sweep("0.02,0.08")
    record = asked.record(flown(40, 0.001, None, 0.003))
    assert json.loads(json.dumps(record)) == record
    assert record["best"] == 0.02
    assert [cell["own"] for cell in record["cells"]] == [False, False, True]
    assert (record["cells"][0]["flights"], record["cells"][1]["good"]) == (40, 0)
    assert record["cells"][0]["miss_m"]["median"] == pytest.approx(0.0013)
    assert "B is better by 2.00 mm" in asked.text(record)
    few = sweep("0.02")
    assert "no significant difference" in few.text(few.record(flown(4, 0.001, 0.003)))
    assert few.text(few.record([]))
    same = few.record(flown(20, 0.002, 0.002))  # of equal cells the profile's own is the best
    assert (same["best"], same["best_against_own"]) == (0.04, None)


def test_chance_among_many_cells_is_no_proof() -> None:
    """Eight of ten seeds fail with the own value; the best of 12 others has none that does. Of one
    other that would be proven."""
    asked = sweep(",".join(f"{0.01 * k:.2f}" for k in range(5, 17)))
    results = [
        replace(landed(k) if cell == 12 and k < 8 else perched(k), variant=cell)
        for k in range(10)
        for cell in range(13)
    ]
    record = asked.record(results)
    assert record["cells"][12]["good"] == 2
    assert record["best"] != 0.04
    assert "no significant difference" in asked.text(record)
