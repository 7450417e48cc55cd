"""The process of one vehicle: what it tells its parent, and what it takes from it."""

from __future__ import annotations

import pickle
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from perchctl.children import Channel
from perchctl.display import FlightPage, LivePage
from perchctl.errors import Interrupted, SafetyAbort
from perchctl.fleet import flight_options, load_fleet, make_plan, vehicle_process
from perchctl.fleet.messages import Order, Result, Stage, Status, VehicleOutcome
from perchctl.fleet.parent_watch import ParentSwitch
from perchctl.fleet.vehicle_process import ParentLine, StatusReporter
from perchctl.flight import FlyOptions
from perchctl.mission import Event, OperatorRequest, Phase, RestState, Tick
from perchctl.values import replace
from tests.helpers.live_page import press, tick
from tests.helpers.waiting import until


@pytest.fixture
def ends() -> Iterator[tuple[Channel, Channel]]:
    """The parent's and the vehicle's end of a line."""
    parent, vehicle = (Channel(each.detach()) for each in socket.socketpair())
    with parent, vehicle:
        yield parent, vehicle


@pytest.fixture
def options(tmp_path: Path) -> FlyOptions:
    return flight_options(make_plan(load_fleet()), tmp_path, 0, None)["north"]


def received(parent: Channel) -> tuple[list[Status], Result]:
    """All statuses and the result that a vehicle's process has sent."""
    statuses = []
    while not isinstance(message := parent.receive(5.0), Result):
        statuses.append(message)
    return statuses, message


# --- The result ---


class FakeLine:
    """A line to a parent that is not there."""

    def __init__(self) -> None:
        self.told: list[Status] = []

    def note_turn(self) -> None:
        pass

    def tell(self, status: Status) -> None:
        self.told.append(status)


@pytest.fixture
def reporter() -> StatusReporter:
    line: Any = FakeLine()
    return StatusReporter(line, ParentSwitch())


def test_a_vehicle_that_is_not_ready_says_what_it_is_waiting_for(reporter: StatusReporter) -> None:
    told = reporter._line.told  # type: ignore[attr-defined]
    assert not reporter.may_take_off("a good picture")
    assert not reporter.may_take_off("")
    assert [(s.stage.value, s.reason) for s in told] == [
        ("checking", "waiting for a good picture"),
        ("ready", ""),
    ]


def test_a_status_that_cannot_be_made_is_an_unknown_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A watcher that raises is detached; its parent would then end the process in the air."""

    def fail(_: Tick) -> Status:
        raise RuntimeError("nobody foresaw this")

    line: Any = FakeLine()
    monkeypatch.setattr(vehicle_process, "flight_status", fail)
    StatusReporter(line, ParentSwitch()).tick(tick())
    (status,) = line.told
    assert (status.stage, status.phase, status.place_m) == (Stage.FLYING, Phase.ALIGN, None)
    assert status.reason.startswith("its status is unknown: RuntimeError: nobody foresaw this")


def test_the_parent_hears_where_the_pictures_are(options: FlyOptions) -> None:
    line: Any = FakeLine()
    reporter = StatusReporter(line, ParentSwitch())
    reporter.serve_pictures(options)
    (watcher,) = reporter.watchers
    assert isinstance(watcher, FlightPage)
    try:
        reporter.may_take_off("")
        reporter.tick(tick())
        assert [status.picture_port for status in line.told] == [watcher.page.port] * 2
        assert press(watcher.page.url, watcher.page.token) == 403, "the parent is the operator"
    finally:
        watcher.page.close()


def test_pictures_that_cannot_be_served_are_no_reason_not_to_fly(
    reporter: StatusReporter, options: FlyOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError("no port is free")

    monkeypatch.setattr(LivePage, "__init__", fail)
    reporter.serve_pictures(options)
    assert reporter.watchers == ()


def result_at(reporter: StatusReporter, last: Tick) -> Result:
    """Of a flight whose last tick this was."""
    reporter.tick(last)
    return reporter.result_of_error(SafetyAbort("so it was"))


def test_the_last_place_is_told_only_if_it_is_known(reporter: StatusReporter) -> None:
    """The parent believes who says that it stands at its home, and lets its neighbour take off."""
    good = tick()
    assert result_at(reporter, good).place_m == good.telemetry.position_m[:2]
    belief = good.state.belief
    diverged = replace(
        good, state=replace(good.state, belief=replace(belief, is_position_diverged=True))
    )
    assert result_at(reporter, diverged).place_m is None
    later = replace(belief.obs, t_s=belief.obs.t_s + 30.0)
    old = replace(good, state=replace(good.state, belief=replace(belief, obs=later)))
    assert result_at(reporter, old).place_m is None


def test_a_vehicle_that_was_rescued_before_its_first_tick_has_flown(
    reporter: StatusReporter,
) -> None:
    error = RuntimeError("nobody foresaw this")
    assert not reporter.result_of_error(error).has_flown
    reporter.event(Event.make_rescue_note(1.0, error, RestState.UNKNOWN, "it may fly"))
    result = reporter.result_of_error(error)
    assert (result.has_flown, result.place_m) == (True, None)


def test_a_landing_without_a_parent_is_a_safety_abort_and_not_the_operators() -> None:
    line: Any = FakeLine()
    switch = ParentSwitch()
    reporter = StatusReporter(line, switch)
    landed = Interrupted("operator")
    reporter.tick(tick())
    assert reporter.result_of_error(landed).exit_code == 130
    switch.lose_parent()
    assert reporter.result_of_error(landed).exit_code == 52
    grounded = StatusReporter(line, switch)
    assert grounded.result_of_error(landed).exit_code == 130


def test_a_second_error_does_not_hide_that_the_vehicle_has_flown(
    ends: tuple[Channel, Channel], options: FlyOptions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal comes while the log of a flight that raised is being closed."""

    def fly_session(options: FlyOptions, watchers: Any, *_: object, **__: object) -> None:
        for watcher in watchers:
            watcher.tick(tick())
        raise RuntimeError("nobody foresaw this")

    def abandon(log: object, reason: str) -> None:
        raise Interrupted("a second signal")

    parent, vehicle = ends
    monkeypatch.setattr(vehicle_process, "fly_session", fly_session)
    monkeypatch.setattr(vehicle_process.LogWatcher, "abandon", abandon)
    monkeypatch.setattr(vehicle_process.os, "_exit", lambda code: None)
    parent.send(options)
    vehicle_process.main(vehicle)
    _, result = received(parent)
    assert result.has_flown
    assert (result.outcome, result.exit_code) == (VehicleOutcome.FAILED, 1)
    assert "nobody foresaw this" in result.reason, "the first error"
    assert result.log is not None
    assert Path(result.log).is_file()


# --- What comes from the parent ---


@pytest.fixture
def line(ends: tuple[Channel, Channel]) -> Iterator[tuple[Channel, ParentSwitch]]:
    """The parent's end of a vehicle's line, and the switch that it operates."""
    parent, vehicle = ends
    switch = ParentSwitch(listening=True)
    kept = ParentLine(vehicle, switch)
    yield parent, switch
    kept.finish(Result(exit_code=0, outcome=VehicleOutcome.PERCHED, reason="over"))


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (pickle.dumps("land"), "the parent sent a str instead of an order"),
        (pickle.dumps(Order(word="land")), "the parent sent a Order instead"),  # type: ignore[arg-type]
        (b"no pickle", "a message from the parent process is unreadable"),
    ],
    ids=["text", "word", "bytes"],
)
def test_what_is_no_order_lands_and_the_motors_can_still_be_cut(
    line: tuple[Channel, ParentSwitch], sent: bytes, why: str
) -> None:
    parent, switch = line
    parent.send(Order(may_take_off=True))
    until(lambda: switch.may_take_off)
    parent.send_bytes(sent)
    until(lambda: switch.lost)
    assert (switch.lost or "").startswith(why)
    parent.send(Order(may_take_off=True))
    parent.send(Order(may_take_off=True))
    assert switch.read() is OperatorRequest.LAND
    assert not switch.may_take_off
    parent.send(Order(may_climb=True, sent_s=time.monotonic()))
    assert switch.climb_withheld() == switch.lost
    parent.send(Order(word=OperatorRequest.CUT_MOTORS))
    until(lambda: switch.read() is OperatorRequest.CUT_MOTORS)
    assert isinstance(parent.receive(1.0), Status), "it goes on telling where it is"


def test_a_parent_that_is_gone_lands_the_vehicle(line: tuple[Channel, ParentSwitch]) -> None:
    parent, switch = line
    parent.close()
    until(lambda: switch.lost)
    assert switch.lost == "the parent process is gone"
    assert switch.read() is OperatorRequest.LAND
