"""Figures of a campaign and the words after a flight."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.progress import Task, TaskID

from perchctl.commands.progress import TimeLeft, progress_bar
from perchctl.flight import FlightResult, campaign_summary, campaign_table
from perchctl.flight.results import ENDS, worst_first
from perchctl.log import FlightSummary, read_log, summarise_flight, summary_text
from perchctl.log.read import PhaseSpan
from perchctl.log.write import FlightLogWriter
from tests.helpers import log as synthetic
from tests.helpers.results import aborted, landed, perched

PERCHED, ABORTED = perched(1, miss_m=0.004), aborted(3)
LANDED = replace(landed(2), attempts=0, reason="target not found")


results_lists = st.lists(
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
        realtime_factor=st.floats(0.1, 50.0),
    ),
    max_size=30,
)


def test_a_campaign_of_three() -> None:
    figures = campaign_summary([PERCHED, LANDED, ABORTED], wall_s=12.0)
    assert figures == {
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
        "realtime_factor": 5.0,
        "peak_memory_mb": 5e6,
        "worst_seeds": [3, 2],
    }
    without_wall = campaign_summary([PERCHED, LANDED, ABORTED])
    assert without_wall["realtime_factor"] == pytest.approx(60.0 / (4.0 + 6.0 + 4.0))


def test_no_flights() -> None:
    figures = campaign_summary([])
    assert figures["miss_m"] == {"median": None, "p95": None, "max": None}
    assert (figures["flights"], figures["realtime_factor"], figures["worst_seeds"]) == (0, None, [])
    assert "flights" in campaign_table([])


@given(results_lists)
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
    severity = ("perched", "refused", "landed", "aborted")
    ends = [severity.index(r.outcome) for r in order]
    assert ends == sorted(ends, reverse=True)
    assert all(r.outcome != "perched" or r.locked or r.fell for r in order)
    assert len(order) == sum(r.outcome != "perched" or r.locked or r.fell for r in results)
    assert figures["worst_seeds"] == [r.seed for r in order[:5]]
    text = campaign_table(results)
    assert all(len(line) == len(line.rstrip()) for line in text.splitlines())


def test_good_flights_are_no_worst_ones_but_the_largest_miss_has_its_seed() -> None:
    misses = [0.003, 0.009, 0.001, 0.007]
    results = [replace(PERCHED, seed=i, miss_m=m) for i, m in enumerate(misses)]
    assert campaign_summary(results)["worst_seeds"] == []
    text = campaign_table(results)
    assert text.endswith("worst flights: none is bad, all perched, none locked or fell")
    assert "max 9.0 (seed 1)\n" in text


def test_more_bad_flights_than_are_shown_are_counted() -> None:
    lines = campaign_table([replace(LANDED, seed=i) for i in range(7)]).splitlines()
    assert "worst flights, 5 of 7" in lines
    assert [line.split()[0] for line in lines[-5:]] == list("01234")


def test_table_says_what_happened() -> None:
    lines = campaign_table([PERCHED, LANDED, ABORTED], wall_s=12.0).splitlines()
    said = {line.split("  ")[0]: line for line in lines if line}
    assert said["perched"].endswith("1 of 3 (0.8 to 90.6 %)")
    assert said["miss [mm]"].endswith("median 4.0, p95 4.0, max 4.0 (seed 1)")
    assert said["flight time [s]"].endswith("median 20.0, max 30.0")
    assert said["attempts"].endswith("mean 0.67, max 1")
    assert [line.split()[0] for line in lines[-2:]] == ["3", "2"]
    assert "aborted, locked, fell" in said["3"]


def test_words_after_a_flight(tmp_path: Path) -> None:
    flight = FlightSummary(
        outcome="landed",
        reason="target not found in the allowed attempts",
        cause="target not found",
        duration_s=21.44,
        attempts=1,
        miss_m=None,
        battery_min_v=3.521,
        locked=True,
        fell=True,
        phases=(PhaseSpan("APPROACH", 0.0, 3.0), PhaseSpan("LANDED", 3.0, 3.0)),
    )
    text = summary_text(flight, tmp_path / "f.jsonl")
    assert text.splitlines() == [
        "LANDED: target not found in the allowed attempts [target not found]",
        "flight:    21.4 s, 1 attempt",
        "phases:    APPROACH 3.0 s > LANDED",
        "battery:   3.52 V at its lowest",
        "vehicle:   locked by its supervisor: inspect and restart it",
        "vehicle:   fell",
        f"log:       {tmp_path / 'f.jsonl'}",
    ]


def test_words_from_a_log(tmp_path: Path) -> None:
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header())
    records = list(synthetic.ticks())
    for record in records:
        writer.write(record)
    cut = read_log(writer.path)
    writer.close(synthetic.SUMMARY)
    text = summary_text(read_log(writer.path))
    assert text.startswith("PERCHED: hanging still with the motors off\nmiss:      3.1 mm\n")
    assert "SEARCH 0.5 s > ESTIMATE 0.5 s" in text
    unfinished = summarise_flight(cut)
    assert (unfinished.outcome, unfinished.reason) == ("unknown", "the log ends in PERCHED")
    assert unfinished.duration_s == pytest.approx(18.6, abs=0.05)
    assert unfinished.battery_min_v == pytest.approx(min(r["battery_v"] for r in records))
    with writer.path.open("ab") as stream:
        stream.write(b'{"kind":"ti')
    assert "log lost:  its tail, 11 unreadable bytes" in summary_text(read_log(writer.path))


def test_a_battery_that_is_not_measured_has_no_minimum(tmp_path: Path) -> None:
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header())
    writer.write({"t_s": 0.0, "phase": "APPROACH", "battery_v": 0.0})
    writer.close()
    assert summarise_flight(read_log(writer.path)).battery_min_v is None


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "100")
    plain, terminal = io.StringIO(), Terminal()
    for stream in (plain, terminal):
        with progress_bar(2, stream) as advance:
            advance(PERCHED)
            advance(LANDED)
    assert plain.getvalue() == ""
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    assert re.search(r"flights .* 2/2 .*/min .* left 1 perched 1 landed", text)


def test_progress_is_one_line_of_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "80")
    terminal = Terminal()
    earlier = [LANDED] * 12 + [ABORTED] * 3 + [PERCHED] * 900
    now_s = [0.0]
    with progress_bar(1000, terminal, earlier, lambda: now_s[0]) as advance:
        now_s[0] = 60.0
        for _ in range(10):
            advance(PERCHED)
    lines = re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue()))
    assert lines[-2].endswith("925/1000 10.0/min 0:07:30 left 12 landed 3 aborted 910 perched")
    assert len(lines[-2]) <= 80


def test_progress_elsewhere_is_a_line_now_and_then() -> None:
    now_s = [0.0]
    plain = io.StringIO()
    with progress_bar(100, plain, [LANDED], lambda: now_s[0]) as advance:
        for _ in range(12):
            now_s[0] += 2.0
            advance(PERCHED)
    assert plain.getvalue().splitlines() == [
        "perchctl: flown 6 of 100 30.0/min 0:03:08 left 1 landed 5 perched",
        "perchctl: flown 11 of 100 30.0/min 0:02:58 left 1 landed 10 perched",
    ]


def test_the_time_left_is_known_from_the_first_flight_on() -> None:
    now_s = [0.0]
    task = Task(TaskID(0), "", 20, 0, _get_time=lambda: now_s[0])
    task.start_time = 0.0
    now_s[0] = 90.0
    assert TimeLeft().render(task).plain == ""
    task.completed = 1
    assert TimeLeft().render(task).plain == "0:28:30 left"
    task.completed = 20
    assert TimeLeft().render(task).plain == "0:00:00 left"


def test_rounding_keeps_a_micrometre() -> None:
    figures = campaign_summary([replace(PERCHED, miss_m=float(np.float64(0.0012345678)))])
    assert figures["miss_m"]["max"] == 0.001235
