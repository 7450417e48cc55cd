"""A turn of the loop as a value: whole, counted, and timed in real time only."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import pytest

from perchctl.flight.clock import WallClock
from perchctl.flight.loop import fly
from perchctl.flight.senses import SENSED
from perchctl.flight.turns import Turns
from perchctl.mission import planner
from perchctl.mission.state import Observation, Operator, PlannerState
from perchctl.mission.turn import Turn
from perchctl.mission.watch import Tick, TurnWatcher
from perchctl.profile import Profile
from perchctl.replay.decide import decide
from perchctl.vehicle import Land
from tests.helpers.hangs import hang_in_the_planner
from tests.helpers.loop_rig import Rig, Vehicle
from tests.helpers.loop_rig import Watcher as LooksOn


@dataclass
class Told(LooksOn):
    turns: list[Turn] = field(default_factory=list)

    def turn(self, turn: Turn) -> None:
        self.turns.append(turn)


def flown(rig: Rig, for_s: float = 1.0) -> Told:
    told, pressed = Told(), [Operator.NONE]

    def press(tick: Tick) -> None:
        if tick.t_s > for_s:
            pressed[0] = Operator.LAND

    told.on_tick = press
    rig.operator = lambda: pressed[0]
    fly(replace(rig.parts(), watchers=(told,)))
    return told


def test_each_turn_is_told_once_and_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those with a tick by it; those before take-off, and those decided anew, by themselves."""
    link = Vehicle()
    hang_in_the_planner(link, monkeypatch, at_s=0.5)
    told = flown(Rig(link=link), 0.3)
    with_tick = [tick.turn for tick in told.ticks if tick.turn is not None]
    assert len(with_tick) == len(told.ticks)
    assert {turn.role for turn in told.turns} == {"waiting", "redone"}
    numbers = sorted(turn.number for turn in (*told.turns, *with_tick))
    assert numbers == list(range(len(numbers)))
    for tick, turn in zip(told.ticks, with_tick, strict=True):
        assert turn.role == "flown"
        assert (turn.t_s, turn.command, turn.phase) == (tick.t_s, tick.command, tick.state.phase)
        assert turn.observation is not None
        assert turn.observation.target is tick.target
        assert turn.observation.telemetry is tick.telemetry
        assert turn.timing is None
    redone = next(turn for turn in told.turns if turn.role == "redone")
    assert redone.command is not None


def test_what_the_planner_raised_on_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the landing; deciding on it again raises again."""
    step = planner.step

    def fails(state: PlannerState, obs: Observation, profile: Profile) -> Any:
        if obs.t_s > 0.5:
            raise ZeroDivisionError("by the test")
        return step(state, obs, profile)

    monkeypatch.setattr(planner, "step", fails)
    told, rig = Told(), Rig()
    with pytest.raises(ZeroDivisionError):
        fly(replace(rig.parts(), watchers=(told,)))
    assert rig.link.said(Land)
    last = told.turns[-1]
    assert last.observation is not None
    assert last.observation.t_s > 0.5
    assert last.command is None
    flown = [tick.turn for tick in told.ticks if tick.turn is not None]
    assert last.number == flown[-1].number + 1
    with pytest.raises(ZeroDivisionError):
        list(decide([*flown, last], rig.profile))
    monkeypatch.setattr(planner, "step", step)  # mended
    assert not any(each.differs for each in decide([*flown, last], rig.profile))


def test_where_something_else_fails_no_turn_is_told_twice() -> None:
    told, rig = Told(), Rig()

    def fails(tick: Tick) -> None:
        if tick.t_s > 0.5:
            raise ZeroDivisionError

    told.on_tick = fails
    with pytest.raises(ZeroDivisionError):
        fly(replace(rig.parts(), watchers=(told,)))
    assert {turn.role for turn in told.turns} == {"waiting"}


def test_one_that_looks_on_at_ticks_only_is_told_no_others() -> None:
    assert isinstance(Told(), TurnWatcher)
    assert not isinstance(LooksOn(), TurnWatcher)


def test_all_that_is_taken_in_is_in_the_turns() -> None:
    rig = Rig()
    given = []
    inside = rig.link.telemetry

    def telemetry():  # type: ignore[no-untyped-def]
        given.extend(samples := inside())
        return samples

    rig.link.telemetry = telemetry  # type: ignore[method-assign]
    told = flown(rig, 0.3)
    turns = sorted(
        (*told.turns, *(t.turn for t in told.ticks if t.turn)), key=lambda turn: turn.number
    )
    taken = [s for turn in turns for s in (*turn.taken.samples, *turn.taken.late)]
    assert taken == given
    assert all(turn.taken.frame is not None for turn in turns)


def test_in_real_time_its_parts_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([1.01, 1.012, 1.0125, 1.02, 2.01, 2.312, 2.313])
    clock = WallClock()
    monkeypatch.setattr(clock, "now", lambda: next(times))
    turns = Turns(clock, ())
    turns.begin(1.0)
    for _ in range(3):
        turns.lap()
    timing = turns._timing()
    assert timing is not None
    parts = (timing.pipeline_s, timing.planner_s, timing.send_s, timing.turn_s)
    assert parts == pytest.approx((0.01, 0.002, 0.0005, 0.02))
    turns.begin(2.0)
    for _ in range(2):  # decided anew: it was not sent
        turns.lap()
    timing = turns._timing()
    assert timing is not None
    parts = (timing.pipeline_s, timing.planner_s, timing.send_s, timing.turn_s)
    assert parts == pytest.approx((0.01, 0.302, 0.0, 0.313))


def test_what_the_senses_give_is_of_the_observation() -> None:
    assert set(SENSED) < {f.name for f in fields(Observation)}
