"""The live page tells how old it is, what STOP did, and how the flight ended."""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from perchctl.commands import fly
from perchctl.display import FlightPage, LivePage, failed_card, summary_card
from perchctl.display.page import answered
from perchctl.errors import Interrupted
from perchctl.flight import FlyOptions, OperatorSwitch, SessionResult
from perchctl.log import FlightSummary, LogWatcher
from perchctl.mission import (
    Event,
    EventKind,
    FlightReport,
    Outcome,
    Phase,
    PlannerState,
    Tick,
    Watcher,
)
from perchctl.profile import load_profile
from perchctl.vehicle import Idle
from tests.helpers.log import telemetry
from tests.helpers.mission import note
from tests.helpers.recording import camera

START_S = 100.0


class Clock:
    def __init__(self) -> None:
        self.now_s = 50.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def page(clock: Clock) -> Iterator[LivePage]:
    served = LivePage(camera(), "perchctl test", on_stop=lambda: None, clock=clock)
    yield served
    served.close()


def state_of(page: LivePage) -> dict[str, Any]:
    connection = http.client.HTTPConnection("127.0.0.1", urlsplit(page.url).port or 0, timeout=5.0)
    try:
        connection.request("GET", "/state")
        return dict(json.loads(connection.getresponse().read()))
    finally:
        connection.close()


def tick(t_s: float, phase: Phase = Phase.ALIGN) -> Tick:
    state = PlannerState(phase=phase, entered_s=START_S, reason="pose is steady")
    return Tick(t_s, telemetry(t_s, 0.6), None, None, state, Idle(), 0.0, 0.01, 0.012)


def entered(after_s: float, phase: Phase, row: str = "", reason: str = "because") -> Event:
    return Event(START_S + after_s, EventKind.PHASE, reason, phase, row)


# --- how old it is ---------------------------------------------------------------------------


def test_the_numbers_tell_their_age(page: LivePage, clock: Clock) -> None:
    flight = FlightPage(page, 0.15)
    clock.now_s += 60.0
    assert state_of(page)["age_s"] is None  # connecting may take its time
    flight.tick(tick(START_S))
    assert state_of(page)["age_s"] == 0.0
    clock.now_s += 3.25  # the loop hangs, the page's threads do not
    assert state_of(page)["age_s"] == 3.25
    flight.tick(tick(START_S + 3.3))
    assert state_of(page)["age_s"] == 0.0


@pytest.mark.parametrize("phase", [Phase.PERCHED, Phase.LANDED, Phase.ABORTED])
def test_after_the_flight_nothing_is_due(page: LivePage, clock: Clock, phase: Phase) -> None:
    FlightPage(page, 0.15).tick(tick(START_S, phase))
    clock.now_s += 9.0
    assert state_of(page)["age_s"] is None


def test_the_page_looks_at_the_age_by_itself(page: LivePage) -> None:
    """Whatever hangs, its script is the browser's: a timer, and answers that are not waited for
    without end."""
    html = page._server.html
    script = html.partition("<script")[2]
    assert "setInterval(watch" in script
    assert script.count("...within(") == 2
    assert "no news for" in script
    assert html.index('id="old"') < html.index('id="live"')  # its sentence is not greyed with it


def test_stop_works_in_a_browser_without_bounds_for_answers(page: LivePage) -> None:
    """`AbortSignal.timeout` is of 2022: it is asked for before each use."""
    script = page._server.html.partition("<script")[2]
    uses = [line for line in script.splitlines() if "AbortSignal" in line]
    assert len(uses) == 1
    assert "AbortSignal.timeout ? {" in uses[0]


def test_stop_is_ready_again_at_a_program_that_was_gone_and_now_hangs(page: LivePage) -> None:
    """By the page's own script, where something runs it."""
    script = page._server.html.partition("<script")[2]
    assert 'showStop(silent ? known : "gone")' in script
    assert "known = stop;" in script


# --- what STOP did ---------------------------------------------------------------------------

BEGUN = [entered(0.0, Phase.APPROACH, reason="start"), entered(3.0, Phase.ALIGN, "estimated")]
ORDERED = entered(12.34, Phase.LANDING, "operator-land", "the operator asked to land")


@pytest.mark.parametrize(
    ("events", "pressed_s", "told"),
    [
        ([], None, ""),
        ([], 5.0, ""),
        (BEGUN, None, ""),
        (BEGUN, 112.3, "STOP has come; the flight has not answered yet"),
        ([*BEGUN, ORDERED], 112.3, "landing ordered at 12.3 s"),
        ([*BEGUN, ORDERED], None, "landing ordered at 12.3 s"),  # by Ctrl-C
        (
            [*BEGUN, ORDERED, entered(19.0, Phase.LANDED, "landed", "motors off")], 112.3,
            "landing ordered at 12.3 s; LANDED at 19.0 s: motors off",
        ),
        (
            [*BEGUN, ORDERED, entered(14.0, Phase.ABORTED, "operator-stop", "second Ctrl-C")],
            112.3, "landing ordered at 12.3 s; motors cut at 14.0 s",
        ),
        (
            [*BEGUN, ORDERED, entered(44.0, Phase.ABORTED, "landing-timeout", "not confirmed")],
            112.3, "landing ordered at 12.3 s; ABORTED at 44.0 s: not confirmed",
        ),
        (
            [*BEGUN, entered(11.0, Phase.LANDING, "battery-low", "battery at 2.9 V")], 112.3,
            "it lands already, since 11.0 s: battery at 2.9 V",
        ),
        ([*BEGUN, entered(11.0, Phase.LANDING, "battery-low", "low")], None, ""),
        (
            [*BEGUN, entered(12.3, Phase.PERCHED, "perched", "hanging still")], 112.3,
            "PERCHED at 12.3 s: hanging still",
        ),
    ],
)  # fmt: skip
def test_what_stop_did_is_what_the_flight_says(
    events: list[Event], pressed_s: float | None, told: str
) -> None:
    assert answered(events, pressed_s) == told


def test_a_click_alone_orders_nothing(page: LivePage) -> None:
    """What the page says is the flight's, from the turn on in which it had the click."""
    flight = FlightPage(page, 0.15)
    for event in BEGUN:
        flight.event(event)
    flight.tick(tick(START_S + 12.0))
    page.stop()
    assert state_of(page)["stop_did"] == ""
    flight.tick(tick(START_S + 12.3))
    assert "not answered yet" in state_of(page)["stop_did"]
    flight.event(ORDERED)
    flight.tick(tick(START_S + 12.4, Phase.LANDING))
    assert state_of(page)["stop_did"] == "landing ordered at 12.3 s"


# --- how it ended ----------------------------------------------------------------------------

SUMMARY = FlightSummary(
    "perched", "hanging still with the motors off", "perched", 24.5, 2, 0.0017, 3.31
)


def test_the_card_tells_outcome_reason_miss_and_where_to_look(tmp_path: Path) -> None:
    log = tmp_path / "my flights" / "flight.jsonl"
    card = summary_card(SUMMARY, log)
    assert (card["outcome"], card["good"]) == ("PERCHED", True)
    assert card["reason"] == SUMMARY.reason
    rows = dict(card["rows"])
    assert rows["miss"] == "1.7 mm"
    assert rows["log"] == str(log)
    assert rows["report"] == f"perchctl log report '{log}'"
    assert "cause" not in rows
    landed = replace(SUMMARY, outcome="landed", cause="safety abort", miss_m=None, locked=True)
    rows = dict(summary_card(landed, log)["rows"])
    assert rows["cause"] == "safety abort"
    assert "miss" not in rows
    assert "restart" in rows["vehicle"]


def test_a_flight_that_never_began_has_no_log(tmp_path: Path) -> None:
    card = failed_card(Interrupted("interrupted before take-off"), None)
    assert (card["outcome"], card["good"], card["rows"]) == ("FAILED", False, [])
    assert "report" in dict(failed_card(RuntimeError(), tmp_path)["rows"])


def test_an_error_in_flight_tells_what_the_rescue_said(page: LivePage) -> None:
    flight = FlightPage(page, 0.15)
    flight.event(note(START_S, "RuntimeError in flight: it is down, or hangs: the motors are off"))
    flight.event(note(START_S, "the recording has ended (no space): the flight and its log go on"))
    flight.end(failed_card(RuntimeError("boom"), None))
    assert state_of(page)["card"]["rows"][0][1].endswith("the motors are off")


def test_nobody_is_waited_for_where_nobody_looks(page: LivePage) -> None:
    page.end({"outcome": "LANDED"})  # returns at once: no reader would ever wake it
    state = state_of(page)
    assert state["card"] == {"outcome": "LANDED"}
    assert state["stop"] == "over"
    assert state["age_s"] is None


def test_who_looks_gets_the_card_before_the_page_goes(page: LivePage) -> None:
    state_of(page)
    ended = threading.Event()

    def end() -> None:
        page.end({"outcome": "LANDED"})
        ended.set()

    thread = threading.Thread(target=end)
    thread.start()
    while state_of(page)["card"] is None:
        pass
    thread.join(5.0)
    assert ended.is_set()


def options_in(folder: Path) -> FlyOptions:
    profile = load_profile("sim")
    quiet = profile.model_copy(update={"log": profile.log.model_copy(update={"plot": False})})
    return FlyOptions(quiet, Path("sim.yaml"), "sim://", "sim:", log_dir=folder)


@pytest.fixture
def last_state(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the page served last, once it is closed."""
    last: dict[str, Any] = {}
    real = LivePage.close

    def close(self: LivePage) -> None:
        last.update(self.state())
        real(self)

    monkeypatch.setattr(LivePage, "close", close)
    return last


Session = Callable[..., SessionResult]


def test_the_page_of_a_flight_ends_with_its_card(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last_state: dict[str, Any]
) -> None:
    def session(
        options: FlyOptions,
        log: LogWatcher,
        display: Watcher,
        switch: OperatorSwitch,
        page: FlightPage,
        asks: bool,
    ) -> SessionResult:
        assert not asks
        for watcher in (log, display, page):
            watcher.event(BEGUN[0])
            watcher.tick(tick(START_S))
        report = FlightReport(
            Phase.LANDED, Outcome.TARGET_NOT_FOUND, "target not found", 0, 9.0, False
        )
        return SessionResult(report)

    monkeypatch.setattr(fly, "_session", session)
    assert fly.fly_and_report(options_in(tmp_path), as_json=False, port=0) == 50
    card = last_state["card"]
    assert (card["outcome"], card["reason"]) == ("LANDED", "target not found")
    (log,) = tmp_path.glob("*.jsonl")
    assert dict(card["rows"])["log"] == str(log)
    assert last_state["phase"] == "ALIGN"  # what was shown last stays


def test_the_page_of_a_flight_that_failed_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last_state: dict[str, Any]
) -> None:
    def session(*_: object) -> SessionResult:
        raise Interrupted("interrupted before take-off: nothing was started")

    ended: list[str] = []
    page_end, abandon = FlightPage.end, LogWatcher.abandon
    monkeypatch.setattr(FlightPage, "end", lambda *a: (ended.append("page"), page_end(*a)))
    monkeypatch.setattr(LogWatcher, "abandon", lambda *a: (ended.append("log"), abandon(*a)))
    monkeypatch.setattr(fly, "_session", session)
    with pytest.raises(Interrupted):
        fly.fly_and_report(options_in(tmp_path), as_json=False, port=0)
    assert last_state["card"]["outcome"] == "FAILED"
    assert "nothing was started" in last_state["card"]["reason"]
    assert last_state["card"]["rows"] == []  # no tick, no log
    assert ended == ["page", "log"]  # the log's end may wait for a disk
