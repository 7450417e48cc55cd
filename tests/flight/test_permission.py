"""A vehicle that waits for permission: to take off, ready, on the floor, and checked all along; and
to climb, below its target."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from perchctl.analysis import replay
from perchctl.errors import Interrupted, SafetyAbort
from perchctl.flight import fly, lockstep
from perchctl.flight.loop import PERMISSION_PERIOD_S
from perchctl.mission import OperatorRequest, Phase, Tick, Watcher
from perchctl.record import read_log
from perchctl.vehicle import Idle, Telemetry
from tests.helpers.flights import SEED, short_profile
from tests.helpers.loop_rig import Rig, Vehicle

PATIENCE_S = 100.0
"""Longer than any check before take-off is waited for."""


def first_command_s(rig: Rig) -> float:
    return next(t_s for t_s, command in rig.link.sent if not isinstance(command, Idle))


def test_it_stays_on_the_floor_until_it_may_take_off() -> None:
    rig, asked = Rig(), []

    def may_take_off(waiting: str) -> bool:
        asked.append(waiting)
        return rig.link.now_s > PATIENCE_S

    report = fly(replace(rig.parts(), may_take_off=may_take_off))
    assert report.phase is Phase.LANDED
    assert PATIENCE_S < first_command_s(rig) < PATIENCE_S + 2 * PERMISSION_PERIOD_S
    first_ready = asked.index("")
    assert not any(asked[first_ready:]), "ready once, it stays ready"
    assert len(asked) - first_ready < 1.2 * PATIENCE_S / PERMISSION_PERIOD_S


def test_permission_does_not_replace_its_own_checks() -> None:
    rig, asked = Rig(), []

    def may_take_off(waiting: str) -> bool:
        asked.append(waiting)
        return True

    fly(replace(rig.parts(), may_take_off=may_take_off))
    assert asked[-1] == ""
    assert all(asked[:-1]), "it took off in the first turn in which it was ready"


def test_a_word_while_it_waits_ends_it_on_the_ground() -> None:
    rig = Rig()
    rig.operator = lambda: (
        OperatorRequest.LAND if rig.link.now_s > PATIENCE_S else OperatorRequest.NONE
    )
    with pytest.raises(Interrupted, match="nothing was started"):
        fly(replace(rig.parts(), may_take_off=lambda waiting: False))
    assert all(isinstance(command, Idle) for _, command in rig.link.sent)


def test_it_goes_on_being_checked_while_it_waits() -> None:
    """A battery that runs down on the floor must not be found in the air."""

    def drained(sample: Telemetry) -> Telemetry:
        return replace(sample, battery_v=3.2) if sample.t_s > PATIENCE_S else sample

    rig = Rig(link=Vehicle(drained))
    with pytest.raises(SafetyAbort, match="battery"):
        fly(replace(rig.parts(), may_take_off=lambda waiting: False))
    assert all(isinstance(command, Idle) for _, command in rig.link.sent)


# --- Permission to climb ---


class WithheldFor(Watcher):
    """Withholds the climb for a time after the alignment has begun; `begins_s` are the times at
    which the phases began."""

    def __init__(self, for_s: float) -> None:
        self.begins_s: dict[Phase, float] = {}
        self._for_s, self._now_s = for_s, 0.0

    def read(self) -> str | None:
        since_s = self._now_s - self.begins_s.get(Phase.ALIGN, self._now_s)
        return "a neighbour is near" if since_s < self._for_s else None

    def tick(self, tick: Tick) -> None:
        self._now_s = tick.t_s
        self.begins_s.setdefault(tick.state.phase, tick.t_s)


@pytest.mark.long
def test_it_waits_below_its_target_until_it_may_climb_and_replays_alike(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
    withheld, path = WithheldFor(3.0), tmp_path / "flight.jsonl"
    parts = partial(lockstep.FlightParts, climb_withheld=withheld.read)
    monkeypatch.setattr(lockstep, "FlightParts", parts)
    flown = lockstep.fly_lockstep(short_profile(), SEED, path, watchers=(withheld,))
    assert flown.final_phase is Phase.PERCHED
    begins_s = withheld.begins_s
    assert 3.0 <= begins_s[Phase.ASCEND] - begins_s[Phase.ALIGN] < 4.0
    log = read_log(path)
    assert replay(log).is_identical
    reasons = {turn.observation.climb_withheld_reason for turn in log.turns if turn.observation}
    assert reasons == {None, "a neighbour is near"}
