"""Every output counts its times from the first flown turn."""

from __future__ import annotations

import csv
from io import StringIO
from pathlib import Path

import pytest

from perchctl.analysis import FlightAnalysis, replay, show_record
from perchctl.mission import planner
from perchctl.mission.phases.ascend import SETTLED_AT_STANDOFF
from perchctl.record import FlightLog
from perchctl.record.fields import FIELDS
from tests.replay.test_corpus import corpus

SOONER_S = 5.0
"""The log was begun that long before the first turn."""


def with_ticks() -> FlightLog:
    """A flight of the corpus, with ticks."""
    kept = corpus("perched")
    records = [
        dict.fromkeys(FIELDS)
        | {"t_s": turn["t_s"], "phase": turn["phase"], "ex_m": 0.0, "tracked": True}
        for turn in kept.turn_records
        if turn["role"] == "flown"
    ]
    header = kept.header | {"t0_s": records[0]["t_s"] - SOONER_S}
    return FlightLog(Path("f.jsonl"), header, records, kept.events, kept.summary, False,
                     turn_records=kept.turn_records)  # fmt: skip


def test_all_outputs_of_a_log_have_one_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    log = with_ticks()
    at_s = next(span.start_s for span in log.phases if span.phase == "PERCH")
    assert log.to_flight_s(float(log.records[0]["t_s"])) == 0.0
    assert log.start_s == corpus("perched").start_s  # without ticks by the first flown turn
    rows = csv.DictReader(StringIO(log.csv()))
    shown = show_record(FlightAnalysis(log))["phases"]
    others = tuple(
        each for each in planner.PHASE_TIMED_CONDITIONS if each is not SETTLED_AT_STANDOFF
    )
    monkeypatch.setattr(planner, "PHASE_TIMED_CONDITIONS", others)
    decided_otherwise = replay(log).differences[0]
    said = {
        "show": next(p["start_s"] for p in shown if p["phase"] == "PERCH"),
        "table": next(float(row["t_s"]) for row in rows if row["phase"] == "PERCH"),
        "replay": decided_otherwise.t_s,
    }
    assert said == pytest.approx(dict.fromkeys(said, at_s), abs=2e-6)
