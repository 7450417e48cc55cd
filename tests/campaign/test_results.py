"""Figures of a campaign and their intervals."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.campaign import (
    FlightResult,
    all_refused_error,
    campaign_summary,
    campaign_table,
    fly_all,
    fly_in_folder,
    rate_record,
    rate_text,
)
from perchctl.campaign.results import ENDS, worst_first
from perchctl.errors import Interrupted, LogIncomplete, SafetyAbort

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.commands.simulate import run_campaign
from tests.helpers.commands import elsewhere, run  # noqa: F401
from tests.helpers.flights import SHORT, short_profile
from tests.helpers.results import aborted, landed, perched

PERCHED, LANDED, ABORTED = perched(1, miss_m=0.004), landed(2), aborted(3)
REFUSED = FlightResult(4, "refused", "the battery is flat", None, 0.0, 0, False, False)
RESULTS = st.lists(
    st.builds(
        FlightResult,
        seed=st.integers(0, 10_000),
        outcome=st.sampled_from(ENDS),
        reason=st.just("why"),
        miss_m=st.none() | st.floats(0.0, 0.1),
        time_s=st.floats(0.0, 120.0),
        attempts=st.integers(0, 5),
        locked=st.booleans(),
        fell=st.booleans(),
    ),
    max_size=30,
)


def test_a_campaign_of_three() -> None:
    assert campaign_summary([PERCHED, LANDED, ABORTED]) == {
        "flights": 3,
        "perched": 1,
        "landed": 1,
        "aborted": 1,
        "refused": 0,
        "rates": {
            **{end: {"rate": 0.333333, "interval": [0.008404, 0.905701]} for end in ENDS},
            "refused": {"rate": 0.0, "interval": [0.0, 0.707598]},
        },
        "locked": 1,
        "fell": 1,
        "miss_m": {"median": 0.004, "p95": 0.004, "max": 0.004},
        "worst_seeds": [3, 2],
    }


@settings(max_examples=20)  # each a whole campaign
@given(RESULTS)
def test_figures_of_any_campaign(results: list[FlightResult]) -> None:
    figures = campaign_summary(results)
    assert sum(figures[end] for end in ENDS) == figures["flights"] == len(results)
    misses = [r.miss_m for r in results if r.outcome == "perched" and r.miss_m is not None]
    miss = figures["miss_m"]
    if misses:
        assert miss["max"] == pytest.approx(max(misses), abs=1e-6)
        assert miss["median"] <= miss["p95"] + 1e-6 <= miss["max"] + 2e-6
    else:
        assert miss["max"] is None
    assert json.loads(json.dumps(figures)) == figures
    order = worst_first(results)
    ends = [("perched", "refused", "landed", "aborted").index(r.outcome) for r in order]
    assert ends == sorted(ends, reverse=True)
    assert len(order) == sum(r.outcome != "perched" or r.locked or r.fell for r in results)
    assert figures["worst_seeds"] == [r.seed for r in order[:5]]
    text = campaign_table(results)
    assert all(len(line) == len(line.rstrip()) for line in text.splitlines())


def test_the_table_names_the_worst_flights() -> None:
    lines = campaign_table([PERCHED, LANDED, ABORTED, REFUSED]).splitlines()
    shown = {line.split("  ")[0]: line for line in lines if line}
    assert shown["perched"].endswith("1 of 4 (0.6 to 80.6 %)")
    assert shown["flight time [s]"].endswith("median 20.0, max 30.0")  # of those that flew
    assert [line.split()[0] for line in lines[-3:]] == ["3", "2", "4"]
    assert "aborted, locked, fell" in shown["3"]
    assert "worst" not in campaign_table([PERCHED])


# --- refused before take-off: a result of the campaign, not its end -----------------------------


def test_a_flat_battery_is_a_result_and_leaves_no_log(tmp_path: Path) -> None:
    flat = short_profile({"simulation.battery_rest_v": [3.2, 3.3]})
    results = fly_all(partial(fly_in_folder, flat, tmp_path, False), [5, 6])
    assert [r.outcome for r in results] == ["refused", "refused"]
    assert "charge it" in results[0].reason
    assert all(r.log is None and r.scenario is not None for r in results)
    assert list(tmp_path.iterdir()) == []


def test_with_nothing_flown_there_is_nothing_to_report() -> None:
    with pytest.raises(Interrupted, match="0 of 2 flights were flown"):
        run_campaign(lambda *_: None, pytest.fail, 2, nullcontext(None))  # type: ignore[arg-type]


@pytest.mark.parametrize("faults", [(), ("--faults", "disk-full")])
@pytest.mark.parametrize("lost", [0, 1])
def test_logs_that_lack_something_are_an_error(
    lost: int, faults: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A campaign for its logs has not done what was asked."""
    flown: list[Any] = [PERCHED, replace(PERCHED, seed=9, log_problem="no space left")]

    def fly_all(
        _fly: object, seeds: object, _executor: object, note: Callable[[Any], None]
    ) -> None:
        for result in flown[: 1 + lost]:
            note(result)

    monkeypatch.setattr("perchctl.campaign.fly_all", fly_all)
    for name in ("fault_summary", "fault_table"):
        monkeypatch.setattr(f"perchctl.faults.{name}", lambda results: {})
    said = run("simulate", "-n", str(1 + lost), "--log-dir", str(tmp_path), "--json", *faults)
    assert said.code == (LogIncomplete.exit_code if lost else 0)
    sentence = "1 of 2 logs are incomplete: no space left"
    assert (sentence in said.stderr) == bool(lost)
    assert json.loads(said.stdout).get("error") == (sentence if lost else None)


def test_where_none_took_off_it_is_not_the_seeds() -> None:
    assert all_refused_error([]) is None
    assert all_refused_error([REFUSED, LANDED]) is None
    assert isinstance(all_refused_error([REFUSED, REFUSED]), SafetyAbort)


@pytest.mark.long
def test_the_command_says_so_after_its_table(tmp_path: Path) -> None:
    flat = tmp_path / "flat.yaml"
    flat.write_text(f"extends: {SHORT}\nsimulation:\n  battery_rest_v: [3.2, 3.3]\n")
    said = run("simulate", "-p", str(flat), "-n", "2", "--jobs", "1", "--json")
    assert said.code == SafetyAbort.exit_code
    assert json.loads(said.stdout)["refused"] == 2
    assert said.complaint.startswith(
        "every flight was refused before take-off: the resting battery"
    )


def test_a_rate_in_words_and_as_a_record() -> None:
    assert rate_text(100, 100) == "100 of 100 (>= 96.4 %)"
    assert rate_text(0, 100) == "0 of 100 (<= 3.6 %)"
    assert rate_text(97, 100) == "97 of 100 (91.5 to 99.4 %)"
    assert rate_text(0, 0) == "0 of 0"
    assert rate_record(0, 0) == {}
    assert rate_record(100, 100) == {"rate": 1.0, "interval": [0.963783, 1.0]}
