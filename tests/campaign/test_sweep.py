"""Values of one or two keys over the same seeds: which is the best, and what of it is proven."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign import FlightResult, VariantResult, sweep_grid
from perchctl.campaign.compare import whole_seeds
from perchctl.campaign.sweep import sweep_results
from perchctl.errors import InvalidValue, UsageError
from perchctl.profile import load_profile
from tests.helpers.results import landed, perched

SIM = load_profile("sim")
KEY = "planner.align.xy_m"
OTHER = "planner.perch.mode"


def test_each_value_is_a_cell_and_the_profiles_own_is_one_of_them() -> None:
    grid = sweep_grid(SIM, [f"{KEY}=0.02,0.04,0.08"])
    assert [cell.texts for cell in grid.cells] == [("0.02",), ("0.04",), ("0.08",)]
    assert [cell.profile.planner.align.xy_m for cell in grid.cells] == [0.02, 0.04, 0.08]
    assert grid.own == 1
    assert sweep_grid(SIM, [f"{KEY}=0.02,0.08"]).cells[-1].texts == ("0.04",)
    assert sweep_grid(SIM, [f"{KEY}=0.02,0.08"]).own == 2


def test_two_keys_are_each_with_each_and_values_may_be_lists() -> None:
    grid = sweep_grid(
        SIM, [f"{OTHER}=raw, position", "simulation.mass_kg=[0.04, 0.04],[0.05,0.05]"]
    )
    assert [cell.texts for cell in grid.cells[:4]] == [
        ("raw", "[0.04, 0.04]"), ("raw", "[0.05,0.05]"),
        ("position", "[0.04, 0.04]"), ("position", "[0.05,0.05]"),
    ]  # fmt: skip
    assert grid.cells[1].profile.simulation.mass_kg == (0.05, 0.05)
    assert len(grid.cells) == 5
    assert grid.cells[4].profile == SIM


@pytest.mark.parametrize(
    ("sweeps", "error", "words"),
    [
        ([KEY], UsageError, "must be KEY=VALUE,VALUE"),
        (["=1,2"], UsageError, "must be KEY=VALUE,VALUE"),
        ([f"{KEY}="], UsageError, "must be KEY=VALUE,VALUE"),
        ([f"{KEY}=0.1,["], InvalidValue, "not YAML"),
        ([f"{KEY}=0.1,9"], InvalidValue, "found 9"),
        (["planner.align.xx=1"], InvalidValue, "allowed here are xy_m"),
        (["nothing.xx=1"], InvalidValue, "nothing is unknown"),
        ([f"{KEY}=0.1,0.10"], UsageError, "0.1 and 0.10 are the same"),
        ([f"{KEY}=0.1", f"{KEY}=0.2"], UsageError, "given twice"),
        ([f"{KEY}=0.1", f"{OTHER}=raw", "planner.attempts=1"], UsageError, "3 keys"),
    ],
)
def test_what_cannot_be_swept_is_refused(
    sweeps: list[str], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words.replace("[", r"\[")):
        sweep_grid(SIM, sweeps)


def flights(seeds: int, *misses_m: float | None) -> list[tuple[FlightResult, ...]]:
    """One a cell; None does not perch. Seeds differ."""
    return [
        tuple(landed(k) if m is None else perched(k, m + 1e-4 * (k % 7)) for m in misses_m)
        for k in range(seeds)
    ]


def test_the_best_is_proven_or_not() -> None:
    grid = sweep_grid(SIM, [f"{KEY}=0.02,0.04,0.08"])
    found = sweep_results(grid, flights(40, 0.001, 0.003, None))
    assert (found.best, found.figures[0].flights, found.figures[2].good) == (0, 40, 0)
    assert found.figures[0].median_m == pytest.approx(0.0013)
    text = found.text()
    assert f"best:  {KEY}=0.02" in text
    assert f"own:   {KEY}=0.04" in text
    assert "counting that it was picked out of 3: miss, B is better by 2.00 mm" in text
    assert json.loads(json.dumps(found.record()))["best"] == {KEY: 0.02}


def test_a_best_cell_of_few_seeds_is_not_proven() -> None:
    grid = sweep_grid(SIM, [f"{KEY}=0.02,0.04"])
    found = sweep_results(grid, flights(4, 0.001, 0.003))
    assert found.best == 0
    assert "no difference proven" in found.text()


def test_of_equal_cells_the_profiles_own_is_the_best() -> None:
    grid = sweep_grid(SIM, [f"{KEY}=0.02,0.04"])
    found = sweep_results(grid, flights(20, 0.002, 0.002))
    assert found.best == grid.own
    assert found.against_own is None
    assert found.text().endswith("the profile's own values are the best")


def test_chance_among_many_cells_is_no_proof() -> None:
    """Two of ten seeds fail with the own value; the best of 12 others has none that does."""
    values = ",".join(f"{0.01 * k:.2f}" for k in range(5, 17))
    grid = sweep_grid(SIM, [f"{KEY}={values}"])
    rows = [
        tuple(landed(k) if cell.own and k < 6 else perched(k) for cell in grid.cells)
        for k in range(10)
    ]
    found = sweep_results(grid, rows)
    assert found.figures[grid.own].good == 4
    assert found.best != grid.own
    assert "no difference proven" in found.text()


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
