"""The live page of a flight: what it shows, how old that is, what its buttons do, and its end."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.commands import fly
from perchctl.commands.fly import flight_page
from perchctl.display import FlightPage, FlightPanel, LivePage, Sketch
from perchctl.display.page import PAST_PERIOD_S, TRACE_S
from perchctl.display.serve import LAST_READ_S
from perchctl.errors import Interrupted
from perchctl.flight import FlyOptions, OperatorSwitch
from perchctl.mission import (
    Event,
    FlightReport,
    GearToTargetDistance,
    OperatorRequest,
    Outcome,
    Phase,
    RestState,
    RestStateReport,
    Watcher,
)
from perchctl.profile import load_profile
from perchctl.record import FlightSummary
from perchctl.vision import Frame, MarkerPose, PipelineOutput
from perchctl.vision.types import Detection, Detections, VisibleMarkers
from tests.helpers.live_page import CORNERS, ask, hover_tick, press, tick
from tests.helpers.mission import entered, note

START_S = 100.0
OVER = [Phase.PERCHED, Phase.LANDED, Phase.ABORTED]


def state_of(page: LivePage) -> dict[str, Any]:
    return dict(json.loads(ask(page.url, "/state")[1], parse_constant=pytest.fail))


def seen_in(frame: Frame) -> PipelineOutput:
    large = Detection("large", CORNERS, 0.1, True)
    pose = MarkerPose(
        "large", frame.t_s, np.array([np.pi, 0.0, 0.0]), np.array([0.0, 0.0, 0.3]),
        np.zeros(3), 0.0, np.ones(3), 1.0, 0.1,
    )  # fmt: skip
    detections = Detections(frame.index, frame.t_s, large=large)
    return PipelineOutput(detections, {"large": pose}, None, VisibleMarkers.LARGE)


# --- what it shows ---------------------------------------------------------------------------


def test_a_flight_is_shown_with_phase_battery_and_picture(page: LivePage) -> None:
    flight = FlightPage(page, 0.15, 0.03)
    frame = Frame(7, 1.0, np.full((480, 640), 90, np.uint8))
    assert state_of(page)["phase"] == "WAITING"
    flight.frame(frame)
    assert page.jpeg_after(0) is not None  # before the first tick too
    flight.tick(tick(START_S + 1.5, entered_s=START_S, output=seen_in(frame)))
    state = state_of(page)
    assert state["phase"] == "ALIGN"
    assert state["battery"] == "3.71 V"
    assert state["steps"][3] == state["phase"]  # of seven
    assert [row[0] for row in state["rows"]][:2] == ["error", "markers"]
    assert state["off_m"] == pytest.approx(np.hypot(-0.123, 0.045), abs=1e-3)
    assert (state["below_m"], state["height_m"]) == pytest.approx((1.234, 0.82), abs=1e-3)
    assert (state["large_m"], state["gear_m"]) == (0.15, 0.03)
    newest = page.jpeg_after(1)
    assert newest is not None
    decoded = cv2.imdecode(np.frombuffer(newest[1], np.uint8), cv2.IMREAD_COLOR)
    drawn = np.asarray(decoded).astype(int)
    assert np.abs(drawn[150, 250:350] - 90).max() > 50
    flight.tick(tick(e_m=(np.nan, np.inf, np.nan), hold="camera silent"))
    state = state_of(page)
    assert (state["below_m"], state["note"]) == (None, "held: camera silent")
    assert flight.problem is None


def test_from_the_contact_on_the_page_shows_the_offset_at_the_contact(page: LivePage) -> None:
    flight = FlightPage(page, 0.15, 0.03)
    contact = GearToTargetDistance(0.0024, 0.001)
    flight.tick(tick(START_S, "COMPLETE", tracked=False, contact=contact))
    state = state_of(page)
    assert (state["off_m"], state["below_m"]) == (0.0024, 0.0)
    assert state["rows"][0] == ["contact", "2.4 +- 1.0 mm off centre"]
    flight.tick(tick(START_S + 0.5, "LANDED", tracked=False, contact=contact))
    state = state_of(page)
    assert (state["off_m"], state["below_m"]) == (None, None)
    assert "error" not in dict(state["rows"])
    assert state["past"][0][1:] == [0.0024, 0.0]


def test_a_page_opened_in_mid_flight_gets_the_trace_so_far(page: LivePage) -> None:
    flight = FlightPage(page, 0.15, 0.03)
    for number in range(300):
        offset = None if number % 2 else (0.3, 0.4, 1.0)
        flight.tick(tick(START_S + 0.25 * number, e_m=offset, entered_s=START_S))
    past = state_of(page)["past"]
    assert len(past) == TRACE_S / PAST_PERIOD_S
    assert [age_s for age_s, _, _ in past] == pytest.approx(
        [0.25 + PAST_PERIOD_S * n for n in reversed(range(len(past)))]
    )
    assert past[-1][1:] == pytest.approx([0.5, 1.0])
    assert f"TRACE_S = {TRACE_S:g}," in ask(page.url)[1].decode()


def test_a_page_that_fails_is_no_reason_to_land(page: LivePage) -> None:
    flight = FlightPage(page, 0.15, 0.03)
    flight.frame(Frame(0, 0.0, np.zeros((480, 640), np.uint8)))
    flight.tick(None)  # type: ignore[arg-type]
    flight.event(note(0.0, "something"))
    page._changed = None  # type: ignore[assignment]
    FlightPage(page, 0.15, 0.03).frame(Frame(0, 0.0, None))  # type: ignore[arg-type]
    page._changed = threading.Condition()
    assert flight.problem is None
    flight.tick(tick(1.0, output="no output"))
    state_of(page)
    assert page.problem is not None


# --- how old it is ---------------------------------------------------------------------------


def test_the_numbers_tell_their_age(page: LivePage, clock: list[float]) -> None:
    flight = FlightPage(page, 0.15, 0.03)
    clock[0] += 60.0
    assert state_of(page)["age_s"] is None  # connecting may take its time
    flight.tick(tick(START_S))
    page.show(Sketch(np.zeros((480, 640), np.uint8)))
    state = state_of(page)
    assert (state["age_s"], state["fresh"]) == (0.0, True)
    clock[0] += 3.25  # the loop hangs, the page's threads do not
    state = state_of(page)
    assert (state["age_s"], state["fresh"]) == (3.25, False)


def test_a_hover_has_steps_of_its_own_and_is_done_once_it_lands(page: LivePage) -> None:
    flight = FlightPage(page, 0.15, 0.03)
    flight.tick(hover_tick())
    state = state_of(page)
    steps = ["APPROACH", "SEARCH", "ESTIMATE", "ALIGN", "ASCEND", "HOVER"]
    assert (state["steps"], state["done"]) == (steps, False)
    flight.tick(hover_tick("LANDING", Outcome.HOVERED))
    assert state_of(page)["done"]
    summary = FlightSummary("landed", "motors off", Outcome.HOVERED.value)
    flight.end(summary, Path("flight.jsonl"))
    assert state_of(page)["card"]["good"]


@pytest.mark.parametrize("phase", OVER)
def test_after_the_flight_nothing_is_due_and_nothing_to_stop(
    page: LivePage, clock: list[float], phase: Phase
) -> None:
    flight = FlightPage(page, 0.15, 0.03)
    assert press(page.url, page.token) == 200
    flight.tick(tick(START_S))
    assert state_of(page)["orders"] == "land"
    flight.tick(tick(START_S + 1.0, phase.value))
    clock[0] += 9.0
    state = state_of(page)
    assert (state["age_s"], state["orders"]) == (None, "over")


# --- the buttons -----------------------------------------------------------------------------

OPTIONS = FlyOptions(load_profile("sim"), Path("sim.yaml"), "sim://", "sim:")


def test_land_is_one_ctrl_c_and_never_two_and_cut_motors_stops_at_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    switch = OperatorSwitch(listening=True)
    with flight_page(OPTIONS, True, switch) as flight:
        assert flight is not None
        assert flight.page.url in capsys.readouterr().err
        assert switch.read() is OperatorRequest.NONE
        for _ in range(2):
            assert press(flight.page.url, flight.page.token) == 200
            assert switch.read() is OperatorRequest.LAND
        switch.press()
        assert switch.read() is OperatorRequest.LAND  # the first Ctrl-C repeats Land
        assert press(flight.page.url, flight.page.token, "cut") == 200
        assert switch.read() is OperatorRequest.CUT_MOTORS


# --- how it ended ----------------------------------------------------------------------------


def test_a_failed_flight_names_its_log_if_there_is_one_and_what_the_rescue_said(
    page: LivePage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited_s: list[float] = []
    monkeypatch.setattr(page._changed, "wait_for", lambda _, for_s: waited_s.append(for_s))
    flight = FlightPage(page, 0.15, 0.03)
    flight.fail(Interrupted("interrupted before take-off"), None)
    card = state_of(page)["card"]
    assert (card["outcome"], card["good"], card["rows"]) == ("FAILED", False, [])
    found = RestStateReport(RestState.UNKNOWN)
    flight.event(Event.make_rescue_note(START_S, RuntimeError(), found.state, found.text))
    flight.event(note(START_S, "the recording has ended (no space): the flight and its log go on"))
    flight.fail(RuntimeError("boom"), tmp_path)
    rows = state_of(page)["card"]["rows"]
    assert rows[0][1] == f"RuntimeError in flight: {RestState.UNKNOWN.value}"
    assert "report" in dict(rows)
    assert waited_s == [LAST_READ_S]  # for somebody who looks, as at the second end


@pytest.fixture
def options(tmp_path: Path) -> FlyOptions:
    profile = load_profile("sim")
    quiet = profile.model_copy(update={"log": profile.log.model_copy(update={"plot": False})})
    return FlyOptions(quiet, Path("sim.yaml"), "sim://", "sim:", log_dir=tmp_path / "my flights")


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


def test_the_page_of_a_flight_ends_with_its_card(
    options: FlyOptions,
    monkeypatch: pytest.MonkeyPatch,
    last_state: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """And what fell silent on the way is named."""
    monkeypatch.setattr(FlightPanel, "_draw_once", lambda self: 1 / 0)

    def session(_options: object, log: Watcher, display: Watcher, *more: Any) -> Any:
        _switch, page, asks = more
        assert not asks
        for watcher in (log, display, page):
            watcher.event(entered(START_S, Phase.APPROACH, "start"))
            watcher.tick(tick(START_S))
        report = FlightReport(
            Phase.LANDED, Outcome.TARGET_NOT_FOUND, "target not found", 0, 9.0, False
        )
        return replace(report, detached_watcher_messages=("a callback was detached",)), None

    monkeypatch.setattr(fly, "_session", session)
    assert fly.fly_and_report(options, as_json=False, view=True) == 50
    said = capsys.readouterr().err
    assert "perchctl: the display failed: ZeroDivisionError" in said
    assert "perchctl: a callback was detached" in said
    card = last_state["card"]
    assert card["outcome"] == "LANDED"
    assert card["reason"].startswith("target not found")
    (log,) = options.log_dir.glob("*.jsonl")
    rows = dict(card["rows"])
    assert (rows["log"], rows["report"]) == (str(log), f"perchctl log report '{log}'")
    assert last_state["phase"] == "ALIGN"  # what was shown last stays


def test_a_flight_that_ends_in_an_error_says_what_was_detached(
    options: FlyOptions, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def session(*parts: Any) -> Any:
        error = RuntimeError("boom")
        error.add_note("a callback was detached")
        raise error

    monkeypatch.setattr(fly, "_session", session)
    with pytest.raises(RuntimeError, match="boom"):
        fly.fly_and_report(options, as_json=False, view=False)
    assert "perchctl: a callback was detached" in capsys.readouterr().err
