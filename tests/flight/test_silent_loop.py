"""The flight loop hangs, and what it says when a landing could not be confirmed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perchctl.flight import loop
from perchctl.flight.watchdog import CUT_PERIOD_S
from perchctl.mission import EventKind, Operator, Outcome, Phase, SentCommand, Tick
from perchctl.vehicle import Command, EmergencyStop, Land, PositionSetpoint, Telemetry
from perchctl.vision import Frame
from tests.helpers.loop_rig import PROFILE, Broken, Camera, Rig, Vehicle, Watcher

HANG_AT_S = 2.5
LAND_AT_S = 4.5


class Guarded(Vehicle):
    """A scripted vehicle whose link asks the watchdog every 50 ms, as the real ones do."""

    watchdog: Any = None

    def __init__(self, changed: Callable[[Telemetry], Telemetry | None] = lambda s: s) -> None:
        super().__init__(changed)
        self.own: list[tuple[float, Command]] = []
        self._asked_s = 0.0

    def advance_to(self, t_s: float) -> None:
        while self.now_s < t_s - 1e-9:
            super().advance_to(min(self.now_s + 0.01, t_s))
            if self.watchdog is not None and self.now_s >= self._asked_s + 0.05 - 1e-9:
                self._asked_s = self.now_s
                arrived = [s for s in self._samples if s.t_s <= self.now_s - 0.01]
                command = self.watchdog.poll(self.now_s, arrived[-1] if arrived else None)
                if command is not None:
                    self.own.append((self.now_s, command))
                    self.send(command)
                    self.told(SentCommand(self.now_s, "watchdog", command))


def hanging_camera(link: Guarded, for_s: float) -> Camera:
    """One that takes `for_s` for one of its pictures."""
    hung: list[bool] = []

    def hang(frame: Frame) -> Frame:
        if not hung and frame.t_arrival_s > HANG_AT_S:
            hung.append(True)
            link.advance_to(link.now_s + for_s)
        return frame

    return Camera(hang)


def hung_rig(for_s: float) -> tuple[Rig, Guarded]:
    link = Guarded()
    rig = Rig(link, hanging_camera(link, for_s))
    rig.operator = lambda: Operator.LAND if link.now_s > HANG_AT_S + 2.0 + for_s else Operator.NONE
    return rig, link


def after_the_hang(rig: Rig) -> Tick:
    return next(t for t in rig.watcher.ticks if t.t_s > HANG_AT_S + 0.1)


def test_a_loop_that_hangs_in_the_camera_is_landed_and_goes_on_landing() -> None:
    rig, link = hung_rig(5.0)
    report = rig.fly()
    held = [t for t, c in link.own if isinstance(c, PositionSetpoint)]
    assert held[0] == pytest.approx(HANG_AT_S + 0.3, abs=0.08)
    assert np.diff(held).max() < 0.06  # at about 20 Hz
    (landed_s, _), *_ = [(t, c) for t, c in link.own if isinstance(c, Land)]
    assert landed_s == pytest.approx(HANG_AT_S + 1.0, abs=0.08)
    assert not [t for t in link.said(PositionSetpoint) if t > landed_s]  # nothing stale
    first = after_the_hang(rig)
    assert first.state.phase is Phase.LANDING
    assert first.loop_late_s > 4.9
    assert report.outcome is Outcome.SAFETY
    assert "the control loop was 5.0 s late" in report.reason


def test_a_hang_of_half_a_second_is_held_and_the_flight_goes_on_with_what_is_new() -> None:
    rig, link = hung_rig(0.6)
    report = rig.fly()
    assert link.own
    assert not [c for _, c in link.own if isinstance(c, Land)]
    first = after_the_hang(rig)
    assert first.t_s == pytest.approx(HANG_AT_S + 0.62, abs=0.05)  # not the time before it
    assert first.telemetry_age_s < 0.05
    assert "late" in first.state.hold
    assert report.outcome is Outcome.OPERATOR


def test_what_was_decided_before_a_hang_is_not_sent_after_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    link = Guarded()
    rig = Rig(link)
    rig.operator = lambda: Operator.LAND if link.now_s > LAND_AT_S else Operator.NONE
    real, stale = loop.step_mission, []

    def step(*arguments: Any) -> Any:
        new, command = real(*arguments)
        if not stale and link.now_s > HANG_AT_S:
            stale.append(command := replace(command, z_m=9.9))  # to be known again
            link.advance_to(link.now_s + 0.6)
        return new, command

    monkeypatch.setattr(loop, "step_mission", step)
    rig.fly()
    assert stale
    assert stale[0] not in [c for _, c in link.sent]


def test_a_landing_ordered_while_the_planner_thinks_is_not_taken_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The loop is 0.99 s late when its turn begins, and 1.01 s when it would send."""
    link = Guarded()
    rig = Rig(link)
    rig.operator = lambda: Operator.LAND if link.now_s > LAND_AT_S else Operator.NONE
    real, slow = loop.step_mission, []

    def step(state: Any, obs: Any, *more: Any) -> Any:
        if not slow and obs.loop_late_s > 0.5:
            slow.append(obs.loop_late_s)
            link.advance_to(link.now_s + 0.1)
        return real(state, obs, *more)

    monkeypatch.setattr(loop, "step_mission", step)
    rig.camera = hanging_camera(link, 0.97)
    report = rig.fly()
    assert slow
    assert slow[0] < PROFILE.safety.loop_late_land_s
    (landed_s, _), *_ = [(t, c) for t, c in link.own if isinstance(c, Land)]
    assert not [t for t in link.said(PositionSetpoint) if t > landed_s]
    assert "late" in report.reason


# --- the end that nobody saw ------------------------------------------------------------------


def test_a_landing_that_nobody_saw_is_no_landing() -> None:
    rig = Rig(Vehicle(lambda s: None if s.t_s > 2.0 else s))
    report = rig.fly()
    assert report.phase is Phase.ABORTED
    assert report.outcome is Outcome.SAFETY
    assert "no telemetry for 1.0 s; the landing was ordered but could not" in report.reason
    assert "could not be confirmed: nothing was heard from the vehicle for 3" in report.reason
    assert "motors off" not in report.reason


def test_a_vehicle_that_goes_on_flying_is_no_landing_either() -> None:
    rig = Rig(Vehicle(lambda s: replace(s, thrust=50000.0)))
    rig.operator = lambda: Operator.LAND if rig.link.now_s > 2.0 else Operator.NONE
    report = rig.fly()
    assert report.phase is Phase.ABORTED
    assert "by its telemetry the vehicle still flies" in report.reason


@pytest.mark.parametrize("heard", [True, False])
def test_after_an_error_it_is_said_whether_the_landing_was_seen(heard: bool) -> None:
    def leave(tick: Tick) -> None:
        if tick.t_s > 1.5:
            raise Broken("by the test")

    link = Guarded(lambda s: s if heard or s.t_s < 1.5 else None)
    rig = Rig(link, watcher=Watcher(leave))
    with pytest.raises(Broken):
        rig.fly()
    assert link.own == []  # no setpoint that would take the landing back
    said = rig.watcher.events[-1]
    assert said.kind is EventKind.NOTE
    assert "Broken in flight" in said.reason
    assert ("motors are off" in said.reason) is heard
    assert ("could not be confirmed" in said.reason) is not heard


def test_the_operators_stop_in_a_rescue_is_repeated() -> None:
    """Until the vehicle says that it is locked, and also while the link is closing."""
    link = Guarded()

    def leave(tick: Tick) -> None:
        if tick.t_s > 1.5:
            raise Broken

    rig = Rig(link, watcher=Watcher(leave))
    rig.operator = lambda: Operator.STOP if link.now_s > 1.8 else Operator.NONE
    with pytest.raises(Broken):
        rig.fly()
    ended_s = link.now_s
    link.advance_to(ended_s + 1.0)
    cuts = [t for t in link.said(EmergencyStop) if t > ended_s + 0.01]
    assert len(cuts) == pytest.approx(1.0 / CUT_PERIOD_S, abs=1)


def test_a_log_that_fails_is_said_once_in_the_flight() -> None:
    rig = Rig(operator=lambda: Operator.LAND if rig.link.now_s > 3.0 else Operator.NONE)

    def fill(tick: Tick) -> None:
        if tick.t_s > 2.0:
            rig.watcher.problem = "no space left"

    rig.watcher.on_tick = fill
    rig.fly()
    said = [e for e in rig.watcher.events if "incomplete" in e.reason]
    assert [e.kind for e in said] == [EventKind.NOTE]
    assert said[0].t_s == pytest.approx(2.02, abs=0.03)
    assert "no space left" in said[0].reason
