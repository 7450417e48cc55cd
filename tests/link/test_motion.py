"""A vehicle that is moved by hand: its packets as samples. The link itself is tested by the command
that uses it, tests/calibration/test_mount_live.py."""

from __future__ import annotations

import math
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perchctl.errors import TimedOut
from perchctl.link import MotionLink, motion
from perchctl.link.cflib_link import SILENCE_S
from perchctl.link.motion import MOTORS_BLOCK, TURN_BLOCK, Motions
from perchctl.profile import LinkConfig
from perchctl.vehicle import FLYING


def test_whether_motors_turn_is_the_newest_packet_s() -> None:
    motions = Motions(lambda: 0.0)
    for bits in (FLYING, 0, FLYING | 0x2):
        motions.on_motors(0, {"supervisor.info": bits})
        assert motions.motors_run == bool(bits)


def test_samples_are_in_radians_right_handed_and_of_one_moment() -> None:
    now = [5.0]
    motions = Motions(lambda: now[0])
    turned = {"stateEstimate.roll": 10.0, "stateEstimate.pitch": 20.0, "stateEstimate.yaw": -30.0}
    rates = {"gyro.x": 1.0, "gyro.y": 2.0, "gyro.z": 3.0}
    motions.on_turn(1000, turned | rates)
    now[0] += 0.015
    motions.on_turn(1015, turned | rates)
    first, second = motions.take()
    assert second.t_s - first.t_s == pytest.approx(0.015)
    rpy = (second.roll_rad, second.pitch_rad, second.yaw_rad)
    assert rpy == pytest.approx(np.radians([10.0, -20.0, -30.0]))
    assert second.gyro_radps == pytest.approx(np.radians([1.0, 2.0, 3.0]))
    assert motions.take() == []


@pytest.mark.parametrize("name", TURN_BLOCK)
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_turn_that_is_no_number_is_dropped_alone(name: str, number: float) -> None:
    """One in a carry would make all of it unsolvable."""
    motions = Motions(lambda: 5.0)
    for stamp, broken in ((1000, {}), (1010, {name: number}), (1020, {})):
        motions.on_turn(stamp, dict.fromkeys(TURN_BLOCK, 1.0) | broken)
    taken = motions.take()
    assert len(taken) == 2
    assert np.isfinite([[a.roll_rad, a.pitch_rad, a.yaw_rad, *a.gyro_radps] for a in taken]).all()


def sending(blocks: Iterable[str], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """In cflib's place: each block that is started comes once, if it is one of these. What
    takes each block's packets is in the answer then."""
    started: dict[str, Any] = {}

    def start(_log: Any, _uri: str, name: str, values: Any, _period_s: float, take: Any) -> None:
        started[name] = take
        if name in blocks:
            take(1000, dict.fromkeys(values, 0.0))

    monkeypatch.setattr(motion, "start_block", start)
    monkeypatch.setattr(motion, "check_firmware", lambda *_: None)
    monkeypatch.setattr(motion, "FIRST_SAMPLE_TIMEOUT_S", 0.0)
    return started


def connection() -> Any:
    toc = SimpleNamespace(get_element_by_complete_name=lambda name: name)
    return SimpleNamespace(cf=SimpleNamespace(log=SimpleNamespace(toc=toc)), lost=None)


@pytest.mark.parametrize(
    ("blocks", "missing"), [(["turn"], "whether its motors turn"), (["motors"], "how it is turned")]
)
def test_nothing_begins_before_both_blocks_came(
    blocks: list[str], missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the motors tells one of them only, and what is unknown is not still."""
    sending(blocks, monkeypatch)
    link = MotionLink("usb://0", LinkConfig(), lambda: 0.0)
    with pytest.raises(TimedOut, match=f"does not send {missing}$"):
        link._prepare(connection())


@pytest.mark.parametrize(
    ("stops", "lost"), [("motors", "whether its motors turn"), ("turn", "how it is turned")]
)
def test_a_block_that_ends_is_a_problem_while_the_other_goes_on(
    stops: str, lost: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    takers = sending(["turn", "motors"], monkeypatch)
    now = [0.0]
    link = MotionLink("usb://0", LinkConfig(), lambda: now[0])
    link._prepare(connection())
    whole = dict.fromkeys((*TURN_BLOCK, *MOTORS_BLOCK), 0.0)
    other = "turn" if stops == "motors" else "motors"
    while now[0] < SILENCE_S:
        assert link.problem(now[0]) is None
        now[0] += 0.1
        takers[other](1000 + round(1000 * now[0]), whole)
    assert link.problem(now[0]) == f"nothing heard for {now[0]:.1f} s of {lost}"
    takers[stops](1000 + round(1000 * now[0]), whole)
    assert link.problem(now[0]) is None


def test_both_blocks_are_waited_for_whichever_comes_first() -> None:
    whole = dict.fromkeys((*TURN_BLOCK, *MOTORS_BLOCK), 0.0)
    for turn_first in (True, False):
        motions = Motions(lambda: 0.0)
        takers = (motions.on_turn, motions.on_motors)
        for count, take in enumerate(takers if turn_first else takers[::-1], start=1):
            take(1000, whole)
            assert motions.both.is_set() == (count == 2)
