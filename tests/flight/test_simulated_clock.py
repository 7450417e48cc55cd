"""The clock of a simulated flight in real time: the simulator and the loop wait for each other."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.children import SharedTime
from perchctl.flight.clock import SIM_PATIENCE_S, SimulatedClock
from perchctl.sim import CONTROL_PERIOD_S
from perchctl.sim.host import LOOP_PATIENCE_S, HostRunner

CLOCK_MARGIN_S = SharedTime.MARGIN_S
PERIOD_S = 0.02
NEAR_S = CONTROL_PERIOD_S + 1e-9


class Host:
    """Counts steps; stands in for a vehicle where only the time matters."""

    elapsed_s = 0.0

    def __getattr__(self, _: str) -> Any:
        return self

    def step(self) -> None:
        self.elapsed_s += CONTROL_PERIOD_S


class Rig:
    """A loop and a simulator of one wall clock, which passes only where the test lets it."""

    def __init__(self) -> None:
        self.wall_s = 100.0
        self.host, self.shared, self.runs = Host(), SharedTime(0.0, math.inf), True
        self.runner = HostRunner(
            self.host, self.host, realtime=True, clock=lambda: self.wall_s,
            shared=self.shared,
        )  # type: ignore[arg-type] # fmt: skip
        self.clock = SimulatedClock(self.shared, lambda: self.wall_s, self.let_pass)

    def let_pass(self, for_s: float) -> None:
        """On the wall's clock; the simulator does what it would do meanwhile."""
        end_s = self.wall_s + for_s
        while self.wall_s < end_s - 1e-9:
            self.wall_s = min(self.wall_s + 0.001, end_s)
            if self.runs:
                self.runner.catch_up()

    def turns(self, count: int, work_s: float = 0.01) -> float:
        """Turns of a loop that computes for so long; how late the latest began."""
        latest_s, due_s = 0.0, self.clock.now()
        for _ in range(count):
            now_s = self.clock.now()
            latest_s = max(latest_s, now_s - due_s)
            self.let_pass(work_s)
            due_s += PERIOD_S
            if due_s < now_s:
                due_s = now_s + PERIOD_S
            self.clock.wait_until(due_s)
        return latest_s


@pytest.fixture
def free() -> Rig:
    return Rig()


@pytest.fixture
def rig(free: Rig) -> Iterator[Rig]:
    """With a loop that is waited for, and has begun."""
    with free.clock.waiting_for_loop():
        free.turns(10)
        yield free


def test_on_an_idle_computer_it_is_real_time(rig: Rig) -> None:
    assert rig.turns(90) <= NEAR_S
    assert rig.host.elapsed_s == pytest.approx(100 * PERIOD_S, abs=NEAR_S)
    assert rig.wall_s - 100.0 == pytest.approx(100 * PERIOD_S, abs=2 * NEAR_S)
    assert rig.clock.now() == pytest.approx(rig.wall_s, abs=NEAR_S)


def test_it_waits_for_a_busy_loop(rig: Rig) -> None:
    rig.turns(100, work_s=0.1)
    assert rig.turns(100, work_s=0.1) <= CLOCK_MARGIN_S + NEAR_S
    assert rig.host.elapsed_s < 0.5 * (rig.wall_s - 100.0)


def test_a_loop_that_hangs_does_not_stop_time(rig: Rig) -> None:
    before_s = rig.clock.now()
    rig.let_pass(LOOP_PATIENCE_S)
    assert rig.clock.now() - before_s <= CLOCK_MARGIN_S + NEAR_S
    rig.let_pass(3.0)  # the watchdog lands in it
    assert rig.clock.now() - before_s == pytest.approx(3.0, abs=0.1)
    rig.turns(2, work_s=0.1)
    assert rig.turns(8, work_s=0.1) <= CLOCK_MARGIN_S + NEAR_S


def test_it_waits_for_a_starved_simulator(free: Rig) -> None:
    free.turns(10)
    free.runs, before_s = False, free.clock.now()
    free.let_pass(0.9 * SIM_PATIENCE_S)
    assert free.clock.now() == before_s
    free.runs = True
    free.turns(10)
    assert free.clock.now() > before_s


def test_a_simulator_that_is_gone_does_not_stop_time_nor_turn_it_back(rig: Rig) -> None:
    rig.runs, before_s = False, rig.clock.now()
    rig.let_pass(SIM_PATIENCE_S)
    rig.turns(50, work_s=0.0)
    alone_s = rig.clock.now()
    assert alone_s - before_s == pytest.approx(50 * PERIOD_S, abs=NEAR_S)
    rig.runs = True
    rig.let_pass(0.01)
    assert alone_s <= rig.clock.now() <= alone_s + 0.1 + NEAR_S
    rig.turns(50)
    assert rig.clock.now() - alone_s == pytest.approx(50 * PERIOD_S, abs=0.1 + NEAR_S)
