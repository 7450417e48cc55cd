"""Disarming a vehicle that does not arm itself: when it is ordered, and when it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from perchctl.link.arming import DISARM_S, disarm
from perchctl.vehicle import ARMED, AUTO_ARM, CAN_ARM, CAN_FLY, FLYING, FRESH_S, Arm, Telemetry
from tests.helpers.mission import telemetry

DISARMED, IDLING, IN_FLIGHT = CAN_ARM, ARMED | CAN_FLY, ARMED | CAN_FLY | FLYING
LOSS_S = 0.5


@dataclass
class Bench:
    """A vehicle whose telemetry arrives 20 ms late and 100 times a second, until `silent_s`.

    An order takes effect `delay_s` after it was sent.
    """

    bits: int
    silent_s: float = float("inf")
    takes: Callable[[float], bool] = lambda now_s: True
    delay_s: float = 0.04
    now_s: float = 10.0
    sent: list[float] = field(default_factory=list)
    pending: list[tuple[float, int]] = field(default_factory=list)

    def newest(self) -> Telemetry:
        at_s = min(self.now_s, self.silent_s) - 0.02
        for due_s, bits in self.pending:
            if due_s <= at_s:
                self.bits = bits
        self.pending = [change for change in self.pending if change[0] > at_s]
        return telemetry(at_s, 0.0, supervisor=self.bits)

    def send(self, order: Arm) -> None:
        assert order == Arm(False)
        self.sent.append(self.now_s)
        if self.takes(self.now_s):
            self.pending.append((self.now_s + self.delay_s, DISARMED))

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s

    def disarm(self, *, was_ordered: bool) -> bool:
        done = disarm(
            self.newest, self.send, lambda: self.now_s, self.wait, was_ordered=was_ordered
        )
        assert self.now_s - 10.0 <= DISARM_S + 0.2
        return done


@pytest.mark.parametrize("was_ordered", [False, True])
@pytest.mark.parametrize("bits", [IDLING, ARMED])
def test_an_armed_vehicle_on_the_ground_is_disarmed(bits: int, was_ordered: bool) -> None:
    bench = Bench(bits)
    assert bench.disarm(was_ordered=was_ordered)
    assert bench.sent
    assert not bench.newest().has_bit(ARMED)


@pytest.mark.parametrize("bits", [AUTO_ARM | ARMED | CAN_FLY, AUTO_ARM | ARMED | CAN_FLY | FLYING])
@pytest.mark.parametrize("was_ordered", [False, True])
def test_a_vehicle_that_arms_itself_is_left_alone(bits: int, was_ordered: bool) -> None:
    """It would arm itself again, and in the air the order would drop it."""
    bench = Bench(bits)
    assert bench.disarm(was_ordered=was_ordered)
    assert bench.sent == []


def test_what_nobody_has_armed_is_sent_nothing() -> None:
    assert (bench := Bench(DISARMED)).disarm(was_ordered=False)
    assert bench.sent == []
    assert disarm(lambda: None, bench.send, lambda: 0.0, bench.wait, was_ordered=False)


@pytest.mark.parametrize("was_ordered", [False, True])
@pytest.mark.parametrize(
    "bench",
    [Bench(IN_FLIGHT), Bench(IDLING, silent_s=10.0 - FRESH_S)],
    ids=["it flies", "nothing is heard"],
)
def test_nothing_is_ordered_that_could_drop_it(bench: Bench, was_ordered: bool) -> None:
    """And it is not taken for disarmed."""
    bench.now_s, bench.sent = 10.0, []
    assert not bench.disarm(was_ordered=was_ordered)
    assert bench.sent == []


@pytest.mark.parametrize("lost_until_s", [0.0, 10.05])
def test_an_arming_request_under_way_is_caught_up_with(lost_until_s: float) -> None:
    """The telemetry still says disarmed while the request travels, and shortly after the order."""
    takes = lambda now_s: now_s > lost_until_s  # noqa: E731
    bench = Bench(DISARMED, takes=takes, pending=[(10.09, IDLING)])
    assert bench.disarm(was_ordered=True)
    bench.wait(1.0)
    assert not bench.newest().has_bit(ARMED)


def test_a_lost_order_is_repeated() -> None:
    bench = Bench(IDLING, takes=lambda now_s: now_s > 10.0 + LOSS_S)
    assert bench.disarm(was_ordered=True)
    assert len(bench.sent) > 4
    bench = Bench(IDLING, takes=lambda now_s: False)
    assert not bench.disarm(was_ordered=True)
