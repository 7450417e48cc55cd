"""A turn of the loop as a value: whole, counted, and timed in real time only."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import pytest

from perchctl.analysis.decide import decide, first_of
from perchctl.flight import SENSED, WallClock, fly
from perchctl.flight.turns import Turns, TurnWatcher
from perchctl.mission import (
    Observation,
    Operator,
    Outcome,
    PlannerState,
    Tick,
    Turn,
    step_mission,
)
from perchctl.profile import Profile
from perchctl.vehicle import Command, Land
from tests.helpers.hangs import hang_in_the_planner, plan_by
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
    """After the landing; a replay demands that deciding on it raises again."""
    step = step_mission

    def fails(state: PlannerState, obs: Observation, profile: Profile) -> Any:
        if obs.t_s > 0.5:
            raise ZeroDivisionError("by the test")
        return step(state, obs, profile)

    plan_by(monkeypatch, fails)
    told, rig = Told(), Rig()
    with pytest.raises(ZeroDivisionError):
        fly(replace(rig.parts(), watchers=(told,)))
    assert rig.link.said(Land)
    last = told.turns[-1]
    assert last.observation is not None
    assert last.observation.t_s > 0.5
    assert (last.role, last.command, last.error) == ("failed", None, "ZeroDivisionError")
    flown = [tick.turn for tick in told.ticks if tick.turn is not None]
    assert last.number == flown[-1].number + 1
    assert not any(each.differs for each in decide([*flown, last], rig.profile))
    plan_by(monkeypatch, step)  # mended
    *others, again = decide([*flown, last], rig.profile)
    assert not any(each.differs for each in others)
    assert again.difference == ("error", "ZeroDivisionError", None)


def test_a_planner_that_fails_on_the_first_turn_fails_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(obs: Observation) -> PlannerState:
        raise ValueError("by the test")

    for module in ("perchctl.flight.loop", "perchctl.analysis.decide"):
        monkeypatch.setattr(f"{module}.start_mission", fails)
    told, rig = Told(), Rig()
    with pytest.raises(ValueError, match="by the test"):
        fly(replace(rig.parts(), watchers=(told,)))
    (again,) = decide(told.turns, rig.profile)
    assert (again.turn.role, again.error, again.differs) == ("failed", "ValueError", False)


def test_what_fails_behind_the_planner_is_not_the_planner_s() -> None:
    """The command may have been sent: the turn is told with it, and replays."""
    told, rig = Told(), Rig()
    send = rig.link.send

    def fails(command: Command) -> None:
        send(command)
        if rig.link.now_s > 0.5 and not isinstance(command, Land):
            raise ZeroDivisionError("by the test")

    rig.link.send = fails  # type: ignore[method-assign]
    with pytest.raises(ZeroDivisionError):
        fly(replace(rig.parts(), watchers=(told,)))
    last = told.turns[-1]
    assert (last.role, last.error) == ("flown", None)
    assert (last.t_s, last.command) in rig.link.sent
    flown = [tick.turn for tick in told.ticks if tick.turn is not None]
    assert not any(each.differs for each in decide([*flown, last], rig.profile))


def test_a_planner_that_was_interrupted_did_not_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    plan_by(monkeypatch, interrupted)
    told = Told()
    with pytest.raises(KeyboardInterrupt):
        fly(replace(Rig().parts(), watchers=(told,)))
    assert {turn.role for turn in told.turns} == {"waiting"}


@pytest.mark.parametrize(
    ("changes", "field"),
    [({"reason": "another word"}, "reason"), ({"outcome": Outcome.SAFETY}, "outcome")],
)
def test_a_planner_that_changes_only_what_it_says_is_found_out(
    changes: dict[str, Any], field: str
) -> None:
    rig = Rig()
    told = flown(rig, 0.3)
    turns = [tick.turn for tick in told.ticks if tick.turn is not None]
    turns[7] = replace(turns[7], **changes)
    found = first_of(decide(turns, rig.profile), 0.0)
    assert found is not None
    assert (found.tick, found.field) == (7, field)
    turns[7] = replace(turns[7], reason=None)  # of before version 4
    assert first_of(decide(turns, rig.profile), 0.0) is None


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


def test_in_real_time_its_parts_are_timed() -> None:
    times = iter([1.0, 1.01, 1.012, 1.0125, 1.02, 2.0, 2.01, 2.312, 2.313])
    turns = Turns(WallClock(), (), lambda: next(times))
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


def test_what_the_inputs_give_is_of_the_observation() -> None:
    assert set(SENSED) < {f.name for f in fields(Observation)}
