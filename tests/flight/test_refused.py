"""A flight of a campaign that is refused before take-off: one of its results, not its end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import SafetyAbort
from perchctl.flight import (
    FlightResult,
    campaign_summary,
    campaign_table,
    none_took_off,
    run_campaign,
    seed_log_path,
)
from perchctl.flight.compared import FIGURES
from perchctl.flight.record import flown_record, result_from, result_record
from perchctl.flight.results import worst_first
from tests.helpers.commands import elsewhere, run  # noqa: F401
from tests.helpers.flights import SHORT, short_profile
from tests.helpers.results import aborted, landed, perched

PERCHED, ABORTED = perched(1, miss_m=0.004), aborted(3)
LANDED = replace(landed(2), attempts=0, reason="target not found")
REFUSED = FlightResult(4, "refused", "the battery is flat", None, 0.0, 0, False, False, 0.0)


def test_a_flat_battery_is_a_result_and_leaves_no_log(tmp_path: Path) -> None:
    flat = short_profile({"simulation.battery_rest_v": [3.2, 3.3]})
    results = run_campaign(flat, [5, 6], log_dir=tmp_path)
    assert [r.outcome for r in results] == ["refused", "refused"]
    assert "charge it" in results[0].reason
    for result in results:
        assert result.scenario is not None
        assert 3.2 <= result.scenario.battery_rest_v <= 3.3
        assert result.log is None
        assert not seed_log_path(result.seed, tmp_path).exists()
        assert flown_record(result_from(result_record(result))) == flown_record(result)


def test_it_counts_as_bad_but_did_no_harm() -> None:
    results = [REFUSED, PERCHED, ABORTED, LANDED]
    assert [r.seed for r in worst_first(results)] == [3, 2, 4]
    assert PERCHED.badness < REFUSED.badness < LANDED.badness < ABORTED.badness
    figures = campaign_summary(results)
    assert (figures["flights"], figures["perched"], figures["refused"]) == (4, 1, 1)
    assert figures["realtime_factor"] == pytest.approx(60.0 / (4.0 + 6.0 + 4.0))


def test_the_table_has_a_line_for_them_where_there_are_any() -> None:
    assert "refused" in campaign_table([PERCHED, REFUSED])
    assert "refused" not in campaign_table([PERCHED, LANDED])
    assert "flight time [s]   median 20.0, max 20.0" in campaign_table([PERCHED, REFUSED])


def test_it_has_no_time_and_no_attempts_to_compare() -> None:
    assert [figure.of(REFUSED) for figure in FIGURES] == [None, None, None]
    assert [figure.of(LANDED) for figure in FIGURES] == [None, 30.0, 0.0]


def test_where_none_took_off_it_is_not_the_seeds() -> None:
    assert none_took_off([]) is None
    assert none_took_off([REFUSED, LANDED]) is None
    problem = none_took_off([REFUSED, REFUSED])
    assert isinstance(problem, SafetyAbort)
    assert "every flight was refused before take-off: the battery is flat" in str(problem)


@pytest.mark.long
def test_the_command_says_so_after_its_table(tmp_path: Path) -> None:
    flat = tmp_path / "flat.yaml"
    flat.write_text(f"extends: {SHORT}\nsimulation:\n  battery_rest_v: [3.2, 3.3]\n")
    said = run("simulate", "-p", str(flat), "-n", "2", "--jobs", "1", "--json")
    assert said.code == SafetyAbort.exit_code
    assert json.loads(said.stdout)["refused"] == 2
    assert said.complaint.startswith("every flight was refused before take-off: the battery rests")
