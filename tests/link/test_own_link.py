"""Your own link: whatever it raises, however long it hangs, the watchdog's commands go out."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from perchctl.errors import ConnectionFailed, Note, TimedOut
from perchctl.link import GuardedLink
from perchctl.link.protocol import LANDING_WAIT_S
from perchctl.vehicle import (
    ARMED,
    AUTO_ARM,
    CAN_ARM,
    CAN_FLY,
    FLYING,
    Arm,
    Command,
    Idle,
    Land,
    PositionSetpoint,
    Telemetry,
)
from tests.helpers.waiting import until

LAND, PLACE = Land(-0.05, 2.0), PositionSetpoint(0.0, 0.0, 1.0, 0.0)


def sample(t_s: float, bits: int = 0) -> Telemetry:
    return Telemetry(t_s, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, 0.0, 1.0, 0.0, 4.0, bits)


class Vehicle:
    """A link of somebody's. `act[name]` is called in place of what a method returns."""

    def __init__(self) -> None:
        self.now_s, self.bits = 10.0, 0
        self.act: dict[str, Any] = {}
        self.sent: list[Command] = []
        self.closed = False
        self.link = GuardedLink(self, lambda: self.now_s)

    def _call(self, name: str, usual: Any) -> Any:
        return self.act[name]() if name in self.act else usual

    def connect(self) -> None: ...

    def decks(self) -> tuple[str, ...]:
        return ("bcFlow2",)

    def telemetry(self) -> list[Any]:
        return self._call("telemetry", [sample(self.now_s, self.bits)])

    def send(self, command: Command) -> None:
        self._call("send", None)
        self.sent.append(command)

    def problem(self, now_s: float) -> str | None:
        return self._call("problem", None)

    def close(self) -> None:
        self.closed = True
        self._call("close", None)

    def trouble(self) -> str:
        return self.link.problem(self.now_s) or ""


@pytest.fixture
def vehicle() -> Iterator[Vehicle]:
    vehicle = Vehicle()
    vehicle.link.connect()
    yield vehicle
    vehicle.act.clear()
    vehicle.link.close()


def raises(error: BaseException) -> Any:
    def call() -> None:
        raise error

    return call


def test_samples_and_commands_pass_and_the_guard_sees_what_waits(vehicle: Vehicle) -> None:
    asked: list[tuple[Any, int]] = []

    def guard(now_s: float, newest: Any, waiting: Any) -> Command | None:
        asked.append((newest, len(waiting)))
        return LAND if asked[-1][1] > 3 else None

    vehicle.link.send(Idle())
    vehicle.link.send(PLACE)
    vehicle.link.set_guard(guard)
    until(lambda: LAND in vehicle.sent)  # the loop hangs: it takes nothing in, and sends nothing
    assert vehicle.sent[0] == PLACE
    assert asked[-1][0].t_s == 10.0
    assert len(vehicle.link.telemetry()) > 3  # nothing is lost for the loop
    assert vehicle.trouble() == ""
    assert not vehicle.link.send_external(object())  # type: ignore[arg-type]


@pytest.mark.parametrize("error", [ZeroDivisionError("of its author"), SystemExit("of its author")])
@pytest.mark.parametrize("name", ["telemetry", "problem", "send"])
def test_what_it_raises_is_a_lost_link_that_goes_on_sending(
    name: str, error: BaseException, vehicle: Vehicle
) -> None:
    vehicle.act[name] = raises(error)
    vehicle.link.send(PLACE)

    def is_lost() -> bool:
        vehicle.now_s += 0.01
        return "of its author" in vehicle.trouble()

    until(is_lost)
    vehicle.act.pop("send", None)
    vehicle.link.set_guard(lambda *state: LAND)
    until(lambda: LAND in vehicle.sent)


@pytest.mark.parametrize(("name", "words"), [
    ("telemetry", "has not returned for 0.6 s"), ("problem", "has not returned for 0.6 s"),
    ("send", "no command has been sent for 0.6 s"),
])  # fmt: skip
def test_what_hangs_in_it_is_a_lost_link_that_goes_on_sending(
    name: str, words: str, vehicle: Vehicle
) -> None:
    free, inside = threading.Event(), threading.Event()

    def hang() -> Any:
        inside.set()
        free.wait()
        return [] if name == "telemetry" else None

    vehicle.act[name] = hang
    vehicle.link.send(PLACE)
    assert inside.wait(5.0)
    vehicle.now_s += 0.6
    until(lambda: words in vehicle.trouble())  # the sender's thread still has to see the new time
    if name != "send":
        vehicle.link.set_guard(lambda *state: LAND)
        until(lambda: LAND in vehicle.sent)
    free.set()
    vehicle.act.clear()
    until(lambda: vehicle.trouble() == "")


@pytest.mark.parametrize("wrong", ["x", sample(11.0), sample(float("nan"))])
def test_a_sample_of_another_type_or_clock_is_a_lost_link(wrong: Any, vehicle: Vehicle) -> None:
    vehicle.act["telemetry"] = lambda: [wrong]
    until(lambda: "raised" in vehicle.trouble())
    assert all(each.t_s == 10.0 for each in vehicle.link.telemetry())


@pytest.mark.parametrize("name", ["telemetry", "problem", "send"])
def test_one_error_of_it_is_no_lost_link_for_ever(name: str, vehicle: Vehicle) -> None:
    vehicle.act[name] = raises(ZeroDivisionError("of its author"))
    vehicle.link.send(LAND)
    if name == "send":
        until(lambda: "of its author" in "".join(vehicle.link.new_notes()))
    else:
        until(lambda: "of its author" in vehicle.trouble())
    vehicle.act.clear()
    until(lambda: LAND in vehicle.sent and vehicle.trouble() == "")
    vehicle.now_s += 100.0
    until(lambda: vehicle.trouble() == "")


def test_its_own_word_is_passed_on_and_taken_back(vehicle: Vehicle) -> None:
    vehicle.act["problem"] = lambda: "its antenna is off"
    until(lambda: vehicle.trouble() == "its antenna is off")
    vehicle.act.clear()
    until(lambda: vehicle.trouble() == "")


def test_closing_sends_what_waits_and_waits_for_a_vehicle_that_flies(vehicle: Vehicle) -> None:
    vehicle.bits = FLYING
    until(lambda: any(each.has_bit(FLYING) for each in vehicle.link.telemetry()))
    vehicle.link.send(LAND)
    vehicle.act["close"] = raises(ZeroDivisionError())
    closing = threading.Thread(target=vehicle.link.close)
    closing.start()
    until(lambda: LAND in vehicle.sent)
    closing.join(0.3)
    assert not vehicle.closed
    vehicle.bits = 0
    closing.join(LANDING_WAIT_S / 2)
    assert vehicle.closed


def test_closing_hands_over_what_a_slow_link_has_not_taken_yet(vehicle: Vehicle) -> None:
    free, inside = threading.Event(), threading.Event()
    vehicle.act["send"] = lambda: inside.set() or free.wait(5.0)
    until(lambda: vehicle.link.telemetry() != [])  # it stands: nothing else is waited for
    for command in (PLACE, LAND):
        vehicle.link.send(command)
        assert inside.wait(5.0)
    closing = threading.Thread(target=vehicle.link.close)
    closing.start()
    closing.join(0.3)
    assert not vehicle.closed
    free.set()
    closing.join(LANDING_WAIT_S / 2)
    assert vehicle.sent == [PLACE, LAND]


@pytest.mark.parametrize("bits", [ARMED | CAN_FLY, CAN_ARM], ids=["armed", "not yet"])
def test_what_was_armed_for_the_flight_is_disarmed_as_the_link_is_closed(bits: int) -> None:
    vehicle = Vehicle()
    vehicle.bits = CAN_ARM

    def advance() -> None:
        vehicle.now_s += 0.01

    vehicle.act["problem"] = advance
    vehicle.link.connect()
    vehicle.link.send(Arm(True))
    until(lambda: Arm(True) in vehicle.sent)
    vehicle.bits = bits
    closing = threading.Thread(target=vehicle.link.close)
    closing.start()
    until(lambda: Arm(False) in vehicle.sent)
    assert not vehicle.closed
    vehicle.bits = CAN_ARM
    closing.join(5.0)
    assert vehicle.closed
    assert {type(command) for command in vehicle.sent} == {Arm}


@pytest.mark.parametrize("bits", [ARMED, ARMED | CAN_FLY], ids=["starting", "ready"])
def test_a_link_that_arms_as_it_connects_is_refused_and_disarmed(bits: int) -> None:
    """Its propellers would turn while the operator is asked."""
    vehicle = Vehicle()
    vehicle.bits = bits
    with pytest.raises(
        ConnectionFailed, match=r"already armed: keep away .* must not arm the vehicle"
    ):
        vehicle.link.connect()
    vehicle.act["send"] = lambda: setattr(vehicle, "bits", CAN_ARM)
    vehicle.act["problem"] = lambda: setattr(vehicle, "now_s", vehicle.now_s + 0.01)
    vehicle.link.close()
    assert set(vehicle.sent) == {Arm(False)}
    assert vehicle.closed


@pytest.mark.parametrize("bits", [CAN_ARM, AUTO_ARM | ARMED | CAN_FLY], ids=["waits", "by itself"])
def test_a_link_that_does_not_arm_is_connected(bits: int) -> None:
    vehicle = Vehicle()
    vehicle.bits = bits
    vehicle.link.connect()
    vehicle.link.close()
    assert vehicle.sent == []


@pytest.mark.parametrize(("gives", "words"), [
    (lambda: [], "delivers no telemetry$"), (raises(OSError("no port")), "no telemetry: .*no port"),
], ids=["none", "an error"])  # fmt: skip
def test_a_link_without_telemetry_is_refused_since_it_may_be_armed(
    gives: Any, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("perchctl.link.own_link.FIRST_SAMPLE_TIMEOUT_S", 0.1)
    vehicle = Vehicle()
    vehicle.act["telemetry"] = gives
    with pytest.raises(TimedOut, match=words):
        vehicle.link.connect()
    vehicle.act["telemetry"] = lambda: [sample(vehicle.now_s, CAN_ARM)]  # it stands: to be closed
    vehicle.link.close()


def test_a_vehicle_of_your_own_that_stays_armed_is_told_of() -> None:
    vehicle = Vehicle()
    vehicle.bits = CAN_ARM

    def advance() -> None:
        vehicle.now_s += 0.01

    vehicle.act["problem"] = advance
    vehicle.link.connect()
    vehicle.link.send(Arm(True))
    vehicle.bits = ARMED | CAN_FLY
    with pytest.warns(Note, match="may still be armed"):
        vehicle.link.close()
    assert vehicle.sent[-1] == Arm(False)
