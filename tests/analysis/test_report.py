"""The report's page: whole, closed in itself, and true for every kind of log."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.analysis import FlightAnalysis
from perchctl.analysis.report import (
    ReportedFlight,
    captions_and_records,
    read_reported_flight,
    report_html,
)
from perchctl.profile import Profile
from perchctl.record import read_log
from perchctl.record.recorder import Recorder
from perchctl.vision import Frame
from tests.helpers import log as synthetic
from tests.helpers.commands import elsewhere, run  # noqa: F401 - a fixture
from tests.helpers.report_page import Page
from tests.helpers.told import Change, made


def told(change: Change = lambda record: None, **more: Any) -> ReportedFlight:
    return ReportedFlight(FlightAnalysis(made(change, **more)))


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the flight's plot, which takes most of a page's time."""
    monkeypatch.setattr("perchctl.analysis.report.flight_png", lambda flight: b"")


words_only = pytest.mark.usefixtures("undrawn")


FOUND = {
    "latency_s": 0.099,
    "latency_sigma_s": 0.003,
    "mount_turn_deg": [0.1, -1.0, -0.4],
    "mount_turn_sigma_deg": [0.3, 0.3, 0.8],
    "advice": ["set camera.latency_s to 0.099"],
}
KINDS: dict[str, tuple[dict[str, Any], str]] = {
    "perched": ({}, "What happened"),
    "killed": ({"summary": None}, "ends without its summary"),
    "first version": ({"version": 1}, "What happened"),
    "without a profile": ({"profile": None}, "What happened"),
    "odd profile": ({"profile": {"name": "x", "camera": 3, "planner": []}}, "What happened"),
    "found": (
        {
            "uri": "radio://0/80/2M/E7E7E7E7E7",
            "summary": synthetic.SUMMARY | FOUND,
        },
        "Set camera.latency_s to 0.099.",
    ),
    "found in the simulator": (
        {"summary": synthetic.SUMMARY | FOUND},
        "What happened",
    ),
    "full disk": (
        {"summary": {"outcome": "landed", "lost_records": 7, "problem": "the disk is full"}},
        "The log lacks 7 records: the disk is full.",
    ),
}


@words_only
@pytest.mark.parametrize("kind", KINDS)
def test_every_log_has_its_page(kind: str) -> None:
    changes, words = KINDS[kind]
    shown = Page(report_html([told(**changes)])).words
    assert words in shown
    assert kind == "found" or "set camera.latency_s" not in shown.lower()


def test_a_page_is_whole_with_its_plot_and_says_what_the_flight_was() -> None:
    page = Page(report_html([told()]))
    (plot,) = (a for a in page.loads if a.startswith("data:image/png;base64,"))
    assert base64.b64decode(plot.partition(",")[2]).startswith(b"\x89PNG")
    for part in ("Perched, 3.1 mm off centre", "ASCEND 6.0 s", "settled, heading, RMS"):
        assert part in page.words, part


def test_a_log_without_a_tick_says_so() -> None:
    log = made(summary=None)
    log.records.clear()
    words = Page(report_html([ReportedFlight(FlightAnalysis(log))])).words
    assert "The log has no ticks" in words
    assert "Unfinished: the end of the log is missing" in words


@words_only
def test_what_is_text_stays_text() -> None:
    evil = "<script>alert(1)</script>\"'&"

    def change(record: dict[str, Any]) -> None:
        record |= {"reason": evil, "hold": evil, "cmd": evil}
        if record["phase"] == "SEARCH":
            record["phase"] = evil

    end = {"outcome": evil, "reason": evil, "cause": evil, "advice": [evil]}
    log = made(change, end, uri=evil, source=evil, started_utc=evil, perchctl=evil)
    log.header["profile"]["name"] = evil
    html = report_html([ReportedFlight(FlightAnalysis(log)), ReportedFlight(FlightAnalysis(log))])
    assert "<script" not in html
    assert "alert(1)" in Page(html).words


@words_only
def test_several_flights_have_a_table_that_leads_to_each() -> None:
    flights = [told(), told(summary=None), told(summary={"outcome": "landed", "reason": "r"})]
    page = Page(report_html(flights))
    assert "3 flights: 1 perched, 1 unfinished, 1 landed" in page.words
    assert {f"#flight-{n}" for n in (1, 2, 3)} <= set(page.loads)


# --- the recording beside the log -------------------------------------------------------


def grey(number: int) -> np.ndarray:
    return np.full((48, 64), 20 + number % 200, np.uint8)


def test_a_report_shows_the_picture_of_each_decision(tmp_path: Path) -> None:
    path = synthetic.write(tmp_path / "flight.jsonl", summary=synthetic.SUMMARY)
    recorder = Recorder.open(
        path.with_suffix(".mcap"), synthetic.header(), Profile(name="sim"), False
    )
    for record in made().records:
        if record["frame"] is not None:
            number, t_s = int(record["frame"]), float(record["frame_t_s"])
            recorder.write_frame(Frame(number, t_s, grey(number), t_s + 0.05))
    recorder.close()
    decisions = captions_and_records(FlightAnalysis(read_log(path)))
    assert [caption.partition(",")[0] for caption, _ in decisions.values()] == [
        "found", "aligned", "settled", "contact",
    ]  # fmt: skip
    pictures = read_reported_flight(path).pictures
    assert pictures is not None
    assert [p.caption for p in pictures] == [caption for caption, _ in decisions.values()]
    for shown, number in zip(pictures, decisions, strict=True):
        image = cv2.imdecode(np.frombuffer(shown.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert abs(int(image[-2, -2]) - int(grey(number)[0, 0])) <= 2


def test_a_recording_that_is_none_costs_the_pictures_only(tmp_path: Path) -> None:
    path = synthetic.write(tmp_path / "flight.jsonl", summary=synthetic.SUMMARY)
    path.with_suffix(".mcap").write_bytes(b"no recording at all")
    flight = read_reported_flight(path)
    assert flight.pictures == ()
    assert "flight.mcap" in flight.picture_problem
    assert str(tmp_path) not in flight.picture_problem
    assert flight.outcome == "perched"


# --- the command ----------------------------------------------------------------------


@words_only
def test_the_command_writes_beside_the_log_and_replaces_nothing(tmp_path: Path) -> None:
    log = synthetic.write(tmp_path / "deep" / "flight.jsonl", summary=synthetic.SUMMARY)
    said = run("log", "report", str(log))
    html = log.with_suffix(".html").read_text(encoding="utf-8")
    assert "deep" not in html  # no folder of the computer is on it
    assert (said.code, said.stdout.strip()) == (0, str(log.with_suffix(".html")))
    again = run("log", "report", str(log))
    assert again.code == 30
    assert "already" in again.complaint
    assert run("log", "report", str(log), "-o", "page.pdf").code == 30
    other = synthetic.write(tmp_path / "other.jsonl", summary=synthetic.SUMMARY)
    said = run("log", "report", str(log), str(other), "-o", "both.html", "--json")
    answer = json.loads(said.stdout)
    assert answer["report"] == "both.html"
    assert [flight["outcome"] for flight in answer["flights"]] == ["perched", "perched"]


@words_only
def test_a_fleets_folder_gives_one_page_with_all_vehicles(tmp_path: Path) -> None:
    for name in ("flight_1.jsonl", "flight_2.jsonl"):
        synthetic.write(tmp_path / name, summary=synthetic.SUMMARY)
    ended = {"hangs": True, "outcome": "perched", "miss_m": 0.002, "reason": "hanging still"}
    lost = {"hangs": False, "outcome": "failed", "miss_m": None, "reason": "killed", "log": None}
    record = {
        "vehicles": [
            {"name": "north", "log": "flight_2.jsonl", **ended},
            {"name": "east", "log": "flight_1.jsonl", **ended},
            {"name": "west", **lost},
        ]
    }
    path = tmp_path / "fleet.json"
    path.write_text(json.dumps(record), encoding="utf-8")
    said = run("log", "report", str(tmp_path))
    assert (said.code, said.stdout.strip()) == (0, str(tmp_path / "fleet.html"))
    assert said.stderr.splitlines() == [
        "perchctl: north       hangs, 2.0 mm from centre: hanging still (flight_2.jsonl)",
        "perchctl: east        hangs, 2.0 mm from centre: hanging still (flight_1.jsonl)",
        "perchctl: west        failed: killed (no log)",
        "perchctl: 2 flights: 2 perched",
    ]
    page = Page((tmp_path / "fleet.html").read_text(encoding="utf-8"))
    assert "north: Perched" in page.words
    path.write_text(json.dumps({"vehicles": [{"name": "west", **lost}]}), encoding="utf-8")
    assert run("log", "report", str(tmp_path)).code == 20
    for text in ("", "[]", "{}", '{"vehicles": [1]}', '{"vehicles": [{"name": "north"}]}'):
        path.write_text(text, encoding="utf-8")
        refused = run("log", "report", str(tmp_path))
        assert refused.code == 30
        assert "fleet.json is not the record of a fleet's flight" in refused.complaint
