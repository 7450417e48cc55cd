"""A turn of the loop as a value: whole, counted, and timed in real time only."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from perchctl.analysis.decide import replay_decisions
from perchctl.flight import fly
from perchctl.mission import (
    Observation,
    OperatorRequest,
    PlannerState,
    SentCommand,
    Tick,
    TickRecord,
    step_mission,
)
from perchctl.profile import Profile
from perchctl.vehicle import Command, Land
from tests.helpers.hangs import hang_in_the_planner, plan_by
from tests.helpers.loop_rig import Rig, Vehicle
from tests.helpers.loop_rig import Watcher as LooksOn

BREAKS_S = 0.5


@dataclass
class Told(LooksOn):
    turns: list[TickRecord] = field(default_factory=list)

    def turn(self, turn: TickRecord) -> None:
        self.turns.append(turn)

    def sent(self, sent: SentCommand) -> None:
        return None

    @property
    def of_ticks(self) -> list[TickRecord]:
        return [tick.record for tick in self.ticks if tick.record is not None]

    @property
    def all(self) -> list[TickRecord]:
        return sorted((*self.turns, *self.of_ticks), key=lambda turn: turn.number)


def flown(rig: Rig, for_s: float = 0.3) -> Told:
    told = Told()
    rig.operator = lambda: OperatorRequest.LAND if rig.link.now_s > for_s else OperatorRequest.NONE
    fly(replace(rig.parts(), watchers=(told,)))
    return told


def broken(rig: Rig, error: type[BaseException], told: Told | None = None) -> Told:
    """A flight that ends by that error."""
    told = told or Told()
    with pytest.raises(error):
        fly(replace(rig.parts(), judges=(told,)))
    return told


def test_each_turn_is_told_once_and_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those with a tick by it; those before take-off, and those decided anew, by themselves."""
    link = Vehicle()
    hang_in_the_planner(link, monkeypatch, at_s=0.5)
    told = flown(Rig(link=link), 1.0)
    assert len(told.of_ticks) == len(told.ticks)
    assert {turn.role for turn in told.turns} == {"waiting", "redone"}
    assert [turn.number for turn in told.all] == list(range(len(told.all)))
    for tick, turn in zip(told.ticks, told.of_ticks, strict=True):
        assert turn.role == "flown"
        assert (turn.t_s, turn.command, turn.phase) == (tick.t_s, tick.command, tick.state.phase)
        assert turn.observation is not None
        assert turn.observation.target is tick.target
        assert turn.observation.telemetry is tick.telemetry
    assert next(turn for turn in told.turns if turn.role == "redone").command is not None


def test_what_the_planner_raised_on_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the landing; a replay demands that deciding on it raises again."""

    def fails(state: PlannerState, obs: Observation, profile: Profile, *table: Any) -> Any:
        if obs.t_s > BREAKS_S:
            raise ZeroDivisionError("by the test")
        return step_mission(state, obs, profile, *table)

    plan_by(monkeypatch, fails)
    rig = Rig()
    told = broken(rig, ZeroDivisionError)
    assert rig.link.said(Land)
    last = told.turns[-1]
    assert last.observation is not None
    assert last.observation.t_s > BREAKS_S
    assert (last.role, last.command, last.planner_exception_name) == (
        "failed",
        None,
        "ZeroDivisionError",
    )
    turns = [*told.of_ticks, last]
    assert last.number == turns[-2].number + 1
    assert not any(each.difference for each in replay_decisions(turns, rig.profile))
    plan_by(monkeypatch, step_mission)  # mended
    *others, again = replay_decisions(turns, rig.profile)
    assert not any(each.difference for each in others)
    assert again.difference == ("error", "ZeroDivisionError", None)


def test_what_fails_behind_the_planner_is_not_the_planner_s() -> None:
    """The command may have been sent: the turn is told with it, and replays."""
    rig = Rig()
    send = rig.link.send

    def fails(command: Command) -> None:
        send(command)
        if rig.link.now_s > BREAKS_S and not isinstance(command, Land):
            raise ZeroDivisionError("by the test")

    rig.link.send = fails  # type: ignore[method-assign]
    told = broken(rig, ZeroDivisionError)
    last = told.turns[-1]
    assert (last.role, last.planner_exception_name) == ("flown", None)
    assert (last.t_s, last.command) in rig.link.sent
    assert not any(
        each.difference for each in replay_decisions([*told.of_ticks, last], rig.profile)
    )


def test_an_interrupted_planner_did_not_fail_and_no_turn_is_told_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(tick: Tick) -> None:
        if tick.t_s > BREAKS_S:
            raise ZeroDivisionError

    told = broken(Rig(), ZeroDivisionError, Told(fails))
    assert {turn.role for turn in told.turns} == {"waiting"}

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    plan_by(monkeypatch, interrupted)
    assert {turn.role for turn in broken(Rig(), KeyboardInterrupt).turns} == {"waiting"}


def test_all_that_is_taken_in_is_in_the_turns() -> None:
    rig, given = Rig(), list[Any]()
    inside = rig.link.telemetry

    def telemetry() -> Any:
        given.extend(samples := inside())
        return samples

    rig.link.telemetry = telemetry  # type: ignore[method-assign]
    turns = flown(rig).all
    taken = [s for turn in turns for s in (*turn.inputs.samples, *turn.inputs.late_samples)]
    assert taken == given
    assert all(turn.inputs.frame is not None for turn in turns)
