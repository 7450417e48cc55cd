"""Every output counts its times from the first flown turn."""

from __future__ import annotations

import csv
import gzip
import json
from io import StringIO
from pathlib import Path

import pytest

from perchctl.analysis import FlightAnalysis, replay, show_record
from perchctl.mission import conditions
from perchctl.record import json_line, read_log
from tests.replay.test_corpus import FOLDER

SOONER_S = 5.0
"""The log was begun that long before the first turn."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A flight of the corpus, with ticks."""
    kept = gzip.decompress((FOLDER / "perched.jsonl.gz").read_bytes()).splitlines()
    lines, begun = [], False
    for record in map(json.loads, kept):
        lines.append(record)
        if record["kind"] == "turn" and record["role"] == "flown":
            if not begun:
                lines[0]["t0_s"], begun = record["t_s"] - SOONER_S, True
            tick = {"kind": "tick", "t_s": record["t_s"], "phase": record["phase"]}
            lines.append(tick | {"ex_m": 0.0, "tracked": True})
    path = tmp_path / "f.jsonl"
    path.write_bytes(b"".join(map(json_line, lines)))
    return path


def test_all_outputs_of_a_log_have_one_zero(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = read_log(path)
    flight = FlightAnalysis(log)
    at_s = next(span.start_s for span in log.phases if span.phase == "PERCH")
    assert log.since(float(log.records[0]["t_s"])) == 0.0
    assert at_s > SOONER_S

    rows = list(csv.DictReader(StringIO(log.csv())))
    monkeypatch.setitem(conditions.CONDITIONS, conditions.Condition.SETTLED, lambda c: False)
    decided_otherwise = replay(log).first
    assert decided_otherwise is not None
    said = {
        "show": next(p["start_s"] for p in show_record(flight)["phases"] if p["phase"] == "PERCH"),
        "table": next(float(row["t_s"]) for row in rows if row["phase"] == "PERCH"),
        "replay": decided_otherwise.t_s,
    }
    assert said == pytest.approx(dict.fromkeys(said, at_s), abs=2e-6)


def test_without_ticks_the_first_flown_turn_is_the_zero() -> None:
    log = read_log(FOLDER / "perched.jsonl.gz")
    assert log.start_s == next(turn.t_s for turn in log.turns if turn.role == "flown")
