"""The numbers of a flight, and how they are shown and listed."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import pytest

from perchctl.analysis import FlightAnalysis, newest_logs, show_record, show_text
from perchctl.analysis.flight import contact_ascent
from perchctl.analysis.show import COLUMNS
from perchctl.mission import Event, EventKind, GearToTargetDistance, Phase
from perchctl.record import FlightLog, read_log
from tests.helpers import log as synthetic
from tests.helpers.mission import note


def log_of(records: list[dict[str, object]]) -> FlightLog:
    return FlightLog(Path("f.jsonl"), {}, records, [], None, True)  # type: ignore[arg-type]


def test_settled_is_the_last_second_before_the_last_contact() -> None:
    def tick(t_s: float, phase: str, e_m: float) -> dict[str, object]:
        return {"t_s": t_s, "phase": phase, "ex_m": e_m, "ey_m": e_m, "eyaw_rad": 2 * e_m}

    records = [
        *(tick(0.1 * i, "ASCEND", 9.0) for i in range(30)),
        tick(3.0, "PERCH", 9.0),
        tick(3.1, "RECOVER", 9.0),
        *(tick(4.0 + 0.1 * i, "ASCEND", 9.0 if i < 10 else 0.003) for i in range(20)),
        tick(6.0, "PERCH", 9.0),
    ]
    contact = contact_ascent(log_of(records).phases)
    assert contact is not None
    assert contact.start_s == 4.0
    found = FlightAnalysis(log_of(records)).measures
    assert found.settled_xy_rms_m == pytest.approx(0.003 * math.sqrt(2))
    assert found.settled_yaw_rms_rad == pytest.approx(0.006)
    assert (found.value_text("settled_xy_rms_m"), found.value_text("miss_m")) == ("4.2", "-")
    assert FlightAnalysis(log_of(records[:3])).measures.settled_xy_rms_m is None


def test_a_hold_whose_numbers_grow_is_one() -> None:
    holds = [
        (0.0, "ALIGN", None),
        (0.1, "ALIGN", "no picture for 0.5 s"),
        (0.2, "ALIGN", "no picture for 0.6 s"),
        (0.3, "ALIGN", "telemetry is old"),
        (0.4, "ALIGN", None),
        (0.5, "ALIGN", "telemetry is old"),
        (0.6, "ASCEND", "telemetry is old"),
        (0.7, "ASCEND", None),
    ]
    log = log_of([{"t_s": t_s, "phase": phase, "hold": hold} for t_s, phase, hold in holds])
    found = [(h.start_s, h.end_s, h.phase, h.reason) for h in FlightAnalysis(log).position_holds]
    assert found == [
        (0.1, 0.3, "ALIGN", "no picture for 0.6 s"),
        (0.3, 0.4, "ALIGN", "telemetry is old"),
        (0.5, 0.6, "ALIGN", "telemetry is old"),
        (0.6, 0.7, "ASCEND", "telemetry is old"),
    ]


def test_the_text_fits_a_terminal_and_obeys_nothing(tmp_path: Path) -> None:
    path = synthetic.write(
        tmp_path / "f.jsonl", summary=synthetic.SUMMARY, events=[note(1.2, "a \x1b[31mnote")]
    )
    flight = FlightAnalysis(read_log(path))
    text, record = show_text(flight), show_record(flight)
    assert text.startswith("PERCHED: hanging still with the motors off\n")
    offset = GearToTargetDistance(0.0032, 0.0034)
    assert ("contact", "3.2 +- 3.4 mm off centre, estimated from the camera") in replace(
        flight.summary, contact=offset
    ).rows()
    assert "\nmiss:      3.1 mm off centre, according to the simulator\n" in text
    assert max(map(len, text.splitlines())) <= COLUMNS
    assert "a ?[31mnote" in text
    assert "\x1b" not in text
    assert [p["phase"] for p in record["phases"]] == [phase for phase, _, _ in synthetic.PLAN]
    assert (record["phases"][0]["start_s"], record["phases"][0]["duration_s"]) == (0.0, 3.0)
    assert record["notes"] == [{"t_s": 0.1, "note": "a \x1b[31mnote"}]
    assert record["whole"]


def test_an_injected_fault_is_named(tmp_path: Path) -> None:
    fault = "kick, 1.7 s after ALIGN began: a blow (push: for_s=0.04)"
    flight = FlightAnalysis(read_log(synthetic.write(tmp_path / "f.jsonl", {"fault": fault})))
    assert f"injected: {fault}" in " ".join(show_text(flight).split())
    assert show_record(flight)["fault"] == fault
    healthy = FlightAnalysis(read_log(synthetic.write(tmp_path / "g.jsonl")))
    assert "injected" not in show_text(healthy)
    assert show_record(healthy)["fault"] is None


def test_the_rows_that_were_taken_and_an_end_without_a_tick_are_told(tmp_path: Path) -> None:
    events = [
        Event(
            4.1,
            EventKind.PHASE,
            "hovering in the perching area",
            Phase.SEARCH,
            transition_name="approached",
        ),
        Event(
            5.2,
            EventKind.PHASE,
            "the operator cut the motors",
            Phase.ABORTED,
            transition_name="operator",
        ),
    ]
    log = read_log(synthetic.write(tmp_path / "f.jsonl", most=200, events=events))
    assert "hovering in the perching area (approached)" in show_text(FlightAnalysis(log))
    *_, before, end = log.phases
    assert (end.phase, end.row, end.duration_s) == ("ABORTED", "operator", 0.0)
    assert (before.phase, before.end_s) == ("ESTIMATE", log.end_s)


def test_the_newest_log_is_by_its_last_record(tmp_path: Path) -> None:
    old = synthetic.write(tmp_path / "flight_old.jsonl", summary=synthetic.SUMMARY, most=5)
    killed = synthetic.write(tmp_path / "flight_killed.jsonl", most=80)
    other = synthetic.write(tmp_path / "flight_new.jsonl", {"version": 99}, most=5)
    gone, empty = tmp_path / "flight_gone.jsonl", tmp_path / "flight_empty.jsonl"
    empty.write_bytes(b"")
    gone.symlink_to(tmp_path / "nowhere.jsonl")
    (tmp_path / "hand.jsonl").write_text('{"part": "carry"}\n')
    for age, path in enumerate((empty, killed, other, old)):
        os.utime(path, (1000 - age, 1000 - age))
    assert newest_logs(tmp_path) == [empty, killed, other, old, gone]
    assert newest_logs(tmp_path, 1) == [empty]
