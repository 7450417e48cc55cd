"""A vehicle's operator is its parent: its orders, its silence, and its death; on a clock that
nobody waits for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest

from perchctl.fleet.messages import BEAT_S, Order
from perchctl.fleet.parent_watch import (
    LONGEST_WATCH_STEP_S,
    PARENT_SILENCE_S,
    PERMISSION_FRESH_S,
    ParentSwitch,
)
from perchctl.mission import OperatorRequest

READ_S = 0.02
"""Between two readings by the flight loop."""


@dataclass
class Clock:
    now_s: float = 100.0

    def __call__(self) -> float:
        return self.now_s


def readings(
    switch: ParentSwitch, clock: Clock, for_s: float, every_s: float = READ_S
) -> OperatorRequest:
    """The word at the end of a time in which it was read regularly."""
    word, end_s = switch.read(), clock.now_s + for_s
    while clock.now_s < end_s:
        clock.now_s += every_s
        word = switch.read()
    return word


def listening() -> tuple[ParentSwitch, Clock]:
    clock = Clock()
    switch = ParentSwitch(clock=clock)
    switch.take(Order(may_take_off=True))
    return switch, clock


def test_a_parent_that_dies_in_silence_lands_the_vehicle_within_a_second() -> None:
    switch, clock = listening()
    assert readings(switch, clock, PARENT_SILENCE_S - 0.1) is OperatorRequest.NONE
    assert readings(switch, clock, 0.1 + 2 * READ_S) is OperatorRequest.LAND
    assert not switch.may_take_off
    assert "silent for 1 s" in (switch.lost or "")


def test_a_parent_that_is_gone_lands_it_at_once() -> None:
    switch, _ = listening()
    switch.lose_parent()
    assert switch.read() is OperatorRequest.LAND
    assert not switch.may_take_off


def test_a_parent_that_comes_back_does_not_take_the_landing_back() -> None:
    switch, clock = listening()
    readings(switch, clock, 2 * PARENT_SILENCE_S)
    switch.take(Order(may_take_off=True))
    assert switch.read() is OperatorRequest.LAND
    assert not switch.may_take_off
    switch.take(Order(word=OperatorRequest.CUT_MOTORS))
    assert switch.read() is OperatorRequest.CUT_MOTORS


def test_signs_of_life_keep_it_flying_for_ever() -> None:
    switch, clock = listening()
    for _ in range(1000):
        switch.take(Order(may_take_off=True))
        assert readings(switch, clock, 5 * BEAT_S) is OperatorRequest.NONE


def test_its_own_pause_is_not_the_parents_silence() -> None:
    """A process that was suspended finds its parent's messages, but not in its first reading."""
    switch, clock = listening()
    readings(switch, clock, PARENT_SILENCE_S / 2)
    clock.now_s += 60.0
    assert switch.read() is OperatorRequest.NONE
    switch.take(Order(may_take_off=True))
    assert readings(switch, clock, PARENT_SILENCE_S - 2 * READ_S) is OperatorRequest.NONE


def test_a_slow_loop_notices_a_silent_parent_too() -> None:
    """The link's watchdog reads 20 times a second while the loop hangs."""
    switch, clock = listening()
    assert readings(switch, clock, 2 * PARENT_SILENCE_S, every_s=2 * LONGEST_WATCH_STEP_S) is (
        OperatorRequest.NONE
    )
    assert readings(switch, clock, 2 * LONGEST_WATCH_STEP_S, every_s=0.05) is OperatorRequest.LAND


@pytest.mark.parametrize("word", [OperatorRequest.LAND, OperatorRequest.CUT_MOTORS])
def test_a_word_comes_before_a_permission_and_is_never_taken_back(word: OperatorRequest) -> None:
    switch, _ = listening()
    switch.take(Order(may_take_off=True, word=word))
    assert not switch.may_take_off
    switch.take(Order(may_take_off=False, word=OperatorRequest.NONE))
    assert switch.read() is word


def test_permission_is_taken_back_on_the_floor() -> None:
    switch, _ = listening()
    assert switch.may_take_off
    switch.take(Order())
    assert not switch.may_take_off
    assert switch.read() is OperatorRequest.NONE


# --- Permission to climb ---


def test_a_permission_to_climb_counts_while_it_is_fresh() -> None:
    clock = Clock()
    switch = ParentSwitch(clock=clock)
    assert switch.climb_withheld() is not None, "before the first order"
    switch.take(Order(may_climb=True, sent_s=clock.now_s))
    assert switch.climb_withheld() is None
    clock.now_s += PERMISSION_FRESH_S - 0.01
    assert switch.climb_withheld() is None
    clock.now_s += 0.02
    assert "old" in (switch.climb_withheld() or "")
    switch.take(Order(may_climb=True, sent_s=clock.now_s))
    assert switch.climb_withheld() is None, "it is repeated"
    switch.take(Order(why_not_climb="east is too near", sent_s=clock.now_s))
    assert switch.climb_withheld() == "east is too near"


@pytest.mark.parametrize("sent_s", [-math.inf, 98.0, 101.0, math.nan])
def test_a_permission_that_arrives_late_or_has_no_time_does_not_count(sent_s: float) -> None:
    switch = ParentSwitch(clock=Clock())
    switch.take(Order(may_climb=True, sent_s=sent_s))
    assert switch.climb_withheld() is not None


def test_a_lost_parent_permits_nothing() -> None:
    clock = Clock()
    switch = ParentSwitch(clock=clock)
    switch.lose_parent("it is gone")
    switch.take(Order(may_climb=True, sent_s=clock.now_s))
    assert switch.climb_withheld() == "it is gone"
