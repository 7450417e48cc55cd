"""Values of a key over the same seeds: which is the best, and what of it is proven."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign import VariantResult, make_sweep
from perchctl.campaign.compare import whole_seeds
from perchctl.campaign.sweep import Sweep
from perchctl.errors import InvalidValue, UsageError
from perchctl.profile import load_profile
from tests.helpers.results import landed, perched

SIM = load_profile("sim")
KEY = "planner.align.xy_m"


def sweep(values: str) -> Sweep:
    return make_sweep(SIM, f"{KEY}={values}")


def test_each_value_is_a_cell_and_the_profiles_own_is_one_of_them() -> None:
    asked = sweep("0.02,0.04,0.08")
    assert asked.texts == ("0.02", "0.04", "0.08")
    assert [profile.planner.align.xy_m for profile in asked.profiles] == [0.02, 0.04, 0.08]
    assert asked.own == 1
    without = sweep("0.02,0.08")
    assert (without.texts[-1], without.own) == ("0.04", 2)
    assert without.profiles[-1] == SIM


def test_values_may_be_lists() -> None:
    lists = make_sweep(SIM, "simulation.mass_kg=[0.04, 0.04],[0.05,0.05]")
    assert lists.texts[:2] == ("[0.04, 0.04]", "[0.05,0.05]")
    assert lists.profiles[1].simulation.mass_kg == (0.05, 0.05)


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        (KEY, UsageError, "must be KEY=VALUE,VALUE"),
        ("=1,2", UsageError, "must be KEY=VALUE,VALUE"),
        (f"{KEY}=", UsageError, "must be KEY=VALUE,VALUE"),
        (f"{KEY}=0.1,[", InvalidValue, "not YAML"),
        (f"{KEY}=0.1,9", InvalidValue, "found 9"),
        ("planner.align.xx=1", InvalidValue, "allowed here are xy_m"),
        (f"{KEY}=0.1,0.10", UsageError, "0.1 and 0.10 are the same"),
    ],
)
def test_what_cannot_be_swept_is_refused(text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=re.escape(words)):
        make_sweep(SIM, text)


def flown(seeds: int, *misses_m: float | None) -> list[VariantResult]:
    """One a cell; None does not perch. Seeds differ."""
    return [
        VariantResult(cell, landed(k) if m is None else perched(k, m + 1e-4 * (k % 7)))
        for k in range(seeds)
        for cell, m in enumerate(misses_m)
    ]


def test_the_best_is_proven_or_not() -> None:
    asked = sweep("0.02,0.04,0.08")
    record = asked.record(flown(40, 0.001, 0.003, None))
    assert json.loads(json.dumps(record)) == record
    assert record["best"] == {KEY: 0.02}
    assert [cell["own"] for cell in record["cells"]] == [False, True, False]
    assert (record["cells"][0]["flights"], record["cells"][2]["good"]) == (40, 0)
    assert record["cells"][0]["miss_m"]["median"] == pytest.approx(0.0013)
    text = asked.text(record)
    assert "picked out of 3, which is counted" in text
    assert "B is better by 2.00 mm" in text
    few = sweep("0.02,0.04")
    assert "no difference proven" in few.text(few.record(flown(4, 0.001, 0.003)))
    assert "nothing can be said" in few.text(few.record([]))


def test_of_equal_cells_the_profiles_own_is_the_best() -> None:
    asked = sweep("0.02,0.04")
    record = asked.record(flown(20, 0.002, 0.002))
    assert (record["best"], record["best_against_own"]) == ({KEY: 0.04}, None)
    assert asked.text(record).endswith("the profile's own value is the best")


def test_chance_among_many_cells_is_no_proof() -> None:
    """Eight of ten seeds fail with the own value; the best of 12 others has none that does. Of one
    other that would be proven."""
    asked = sweep(",".join(f"{0.01 * k:.2f}" for k in range(5, 17)))
    results = [
        VariantResult(cell, landed(k) if cell == asked.own and k < 8 else perched(k))
        for k in range(10)
        for cell in range(len(asked.profiles))
    ]
    record = asked.record(results)
    assert record["cells"][asked.own]["good"] == 2
    assert record["best"] != {KEY: 0.04}
    assert "no difference proven" in asked.text(record)


def test_seeds_count_that_every_cell_has_flown() -> None:
    results = [
        VariantResult(number, replace(perched(seed), attempts=number))
        for seed in (4, 3)
        for number in (1, 0)
    ]
    seeds = whole_seeds([*results, VariantResult(0, perched(5))], 2)
    assert [(row[0].seed, row[0].attempts, row[1].attempts) for row in seeds] == [
        (3, 0, 1), (4, 0, 1),
    ]  # fmt: skip
