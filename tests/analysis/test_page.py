"""The page: whole, closed in itself, and true for every kind of log."""

from __future__ import annotations

import base64
import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from perchctl.analysis import FlightAnalysis
from perchctl.analysis.report import ReportedFlight, page_of
from tests.helpers.commands import elsewhere, run  # noqa: F401 - a fixture
from tests.helpers.told import Change, made, written

MOST_BYTES = 3_000_000
VOID = {"meta", "img", "br"}
LOADS = {"src", "href", "xlink:href", "action", "data", "srcset"}


class Page(HTMLParser):
    """Every element is closed in its turn; what is loaded, linked and named is kept."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.ids: list[str] = []
        self.text: list[str] = []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [value or "" for key, value in attrs if key in LOADS]
        self.ids += [value or "" for key, value in attrs if key == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())


def told(change: Change = lambda record: None, **more: Any) -> ReportedFlight:
    return ReportedFlight(FlightAnalysis(made(change, **more)))


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the flight's plot, which takes most of a page's time."""
    monkeypatch.setattr("perchctl.analysis.report.flight_png", lambda flight: b"")


words_only = pytest.mark.usefixtures("undrawn")


KINDS: dict[str, dict[str, Any]] = {
    "perched": {},
    "killed": {"summary": None},
    "first version": {"version": 1},
    "without a profile": {"profile": None},
    "odd profile": {"profile": {"name": "x", "camera": 3, "planner": []}},
}


def assert_closed(html: str) -> Page:
    page = Page(html)
    assert len(html.encode()) < MOST_BYTES
    assert "http:" not in html
    assert "https:" not in html
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert all(address.startswith(("#", "data:")) for address in page.loads)
    assert len(set(page.ids)) == len(page.ids)
    assert "url(" not in html
    assert {a[1:] for a in page.loads if a.startswith("#")} <= set(page.ids)
    return page


@words_only
@pytest.mark.parametrize("kind", KINDS)
def test_every_log_has_its_page(kind: str) -> None:
    words = assert_closed(page_of([told(**KINDS[kind])])).words
    assert "What happened" in words


def test_a_page_is_whole_with_its_plot_and_says_what_the_flight_was() -> None:
    page = assert_closed(page_of([told()]))
    (plot,) = (a for a in page.loads if a.startswith("data:image/png;base64,"))
    assert base64.b64decode(plot.partition(",")[2]).startswith(b"\x89PNG")
    words = page.words
    for part in (
        "Perched, 3.1 mm off centre",
        "What happened",
        "ASCEND 6.0 s",
        "no recording was made beside this log",
        "settled, heading, RMS",
        "miss 3.1 mm",
    ):
        assert part in words, part
    assert "external" not in words


def test_a_log_without_a_tick_says_so() -> None:
    log = made(summary=None)
    log.records.clear()
    words = Page(page_of([ReportedFlight(FlightAnalysis(log))])).words
    assert "The log holds no turn of a flight" in words
    assert "Unfinished: the log has no end" in words


@words_only
def test_what_the_log_lacks_is_told() -> None:
    end = {"outcome": "landed", "reason": "x", "lost_records": 7, "problem": "the disk is full"}
    words = Page(page_of([told(summary=end)])).words
    assert "The log lacks 7 records: the disk is full." in words
    assert "ends without its summary" in Page(page_of([told(summary=None)])).words


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
    html = page_of([ReportedFlight(FlightAnalysis(log)), ReportedFlight(FlightAnalysis(log))])
    page = Page(html)
    assert "script" not in page.tags
    assert "<script" not in html
    assert "alert(1)" in page.words


@words_only
def test_positions_from_outside_are_told_where_they_were_sent() -> None:
    def change(record: dict[str, Any]) -> None:
        record |= {"pos_sent": 100, "pos_hz": 100.0, "pos_age_s": 0.012}
        record |= {f"pos_{a}_m": record[f"{a}_m"] + 0.003 for a in "xyz"}
        if 6.0 < record["t_s"] < 7.0:
            record["pos_note"] = "the body is hidden"

    words = Page(page_of([told(change)])).words
    assert "external positions sent 100" in words
    assert "off the own estimate, 95 % 5.2 mm" in words
    assert "4.9 s No external position was sent for 1.0 s: the body is hidden" in words


@words_only
def test_several_flights_have_a_table_that_leads_to_each() -> None:
    flights = [told(), told(summary=None), told(summary={"outcome": "landed", "reason": "r"})]
    page = Page(page_of(flights))
    assert "3 flights: 1 perched, 1 unfinished, 1 landed" in page.words
    assert {f"#flight-{n}" for n in (1, 2, 3)} <= set(page.loads)
    assert {f"flight-{n}" for n in (1, 2, 3)} <= set(page.ids)


# --- the command ----------------------------------------------------------------------


@words_only
def test_the_command_writes_beside_the_log_and_replaces_nothing(tmp_path: Path) -> None:
    log = written(tmp_path / "deep" / "flight.jsonl")
    said = run("log", "report", str(log))
    html = log.with_suffix(".html").read_text(encoding="utf-8")
    assert "deep" not in html  # no folder of the computer is on it
    assert (said.code, said.stdout.strip()) == (0, str(log.with_suffix(".html")))
    again = run("log", "report", str(log))
    assert again.code == 30
    assert "already" in again.complaint
    assert run("log", "report", str(log), "-o", "page.pdf").code == 30
    other = written(tmp_path / "other.jsonl")
    said = run("log", "report", str(log), str(other), "-o", "both.html", "--json")
    answer = json.loads(said.stdout)
    assert answer["report"] == "both.html"
    assert [flight["outcome"] for flight in answer["flights"]] == ["perched", "perched"]
