"""A vehicle that is moved by hand: its packets as samples. The link itself is tested by the command
that uses it, tests/calibration/test_mount_live.py."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perchctl.errors import TimedOut
from perchctl.link import MotionLink, listening
from perchctl.link.cflib_link import SILENCE_S
from perchctl.link.listening import MOTORS_BLOCK, TURN_BLOCK
from perchctl.profile import LinkConfig
from perchctl.vehicle import FLYING

OF_BLOCK = {"turn": "how it is turned", "motors": "whether its motors turn"}
STILL = dict.fromkeys((*TURN_BLOCK, *MOTORS_BLOCK), 0.0)


class Listened(MotionLink):
    """A link whose blocks send when the test says so; `now_s` is its clock."""

    def __init__(self) -> None:
        super().__init__("usb://0", LinkConfig(), lambda: self.now_s)
        self.now_s = 5.0

    def hear(self, block: str, **values: float) -> None:
        take = self._on_turn if block == "turn" else self._on_motors
        take(round(1000 * self.now_s), STILL | values)


def test_whether_motors_turn_is_the_newest_packet_s() -> None:
    link = Listened()
    for bits in (FLYING, 0, FLYING | 0x2):
        link.hear("motors", **{"supervisor.info": bits})
        assert link.motors_run == bool(bits)


def test_samples_are_in_radians_right_handed_and_of_one_moment() -> None:
    link = Listened()
    turned = {"stateEstimate.roll": 10.0, "stateEstimate.pitch": 20.0, "stateEstimate.yaw": -30.0}
    rates = {"gyro.x": 1.0, "gyro.y": 2.0, "gyro.z": 3.0}
    link.hear("turn", **turned, **rates)
    link.now_s += 0.015
    link.hear("turn", **turned, **rates)
    first, second = link.samples()
    assert second.t_s - first.t_s == pytest.approx(0.015)
    rpy = (second.roll_rad, second.pitch_rad, second.yaw_rad)
    assert rpy == pytest.approx(np.radians([10.0, -20.0, -30.0]))
    assert second.gyro_radps == pytest.approx(np.radians([1.0, 2.0, 3.0]))
    assert link.samples() == []


@pytest.mark.parametrize("name", TURN_BLOCK)
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_turn_that_is_no_number_is_dropped_alone(name: str, number: float) -> None:
    """One in a carry would make all of it unsolvable."""
    link = Listened()
    for broken in ({}, {name: number}, {}):
        link.hear("turn", **broken)
        link.now_s += 0.01
    taken = link.samples()
    assert len(taken) == 2
    assert np.isfinite([[a.roll_rad, a.pitch_rad, a.yaw_rad, *a.gyro_radps] for a in taken]).all()


@pytest.mark.parametrize("silent", OF_BLOCK)
def test_nothing_begins_before_both_blocks_came_and_each_is_missed_by_itself(
    silent: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of them says nothing of the other, and what is unknown is not still."""
    monkeypatch.setattr(listening, "start_block", lambda *_: None)
    monkeypatch.setattr(listening, "check_firmware", lambda *_: None)
    monkeypatch.setattr(listening, "is_logged", lambda *_: True)
    monkeypatch.setattr(listening, "FIRST_SAMPLE_TIMEOUT_S", 0.0)
    cf: Any = SimpleNamespace(log=None)
    link, other = Listened(), "turn" if silent == "motors" else "motors"
    link.hear(other)
    with pytest.raises(TimedOut, match=f"does not send {OF_BLOCK[silent]}$"):
        link._prepare(SimpleNamespace(cf=cf))  # type: ignore[arg-type]
    assert not link._heard_both.is_set()  # so it is waited for
    link.hear(silent)
    assert link._heard_both.is_set()
    link._prepare(SimpleNamespace(cf=cf))  # type: ignore[arg-type]
    end_s = link.now_s + SILENCE_S
    while link.now_s < end_s:
        assert link.problem(link.now_s) is None
        link.now_s += 0.1
        link.hear(other)
    assert link.problem(link.now_s) == (
        f"nothing heard for {link.now_s - 5.0:.1f} s of {OF_BLOCK[silent]}"
    )
    link.hear(silent)
    assert link.problem(link.now_s) is None
