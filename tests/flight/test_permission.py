"""A vehicle that waits for permission to take off: ready, on the floor, and checked all along."""

from __future__ import annotations

from dataclasses import replace

import pytest

from perchctl.errors import Interrupted, SafetyAbort
from perchctl.flight import fly
from perchctl.flight.loop import PERMISSION_PERIOD_S
from perchctl.mission import OperatorRequest, Phase
from perchctl.vehicle import Idle, Telemetry
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
