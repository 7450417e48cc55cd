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
from perchctl.link.listening import MOTION_BLOCK
from perchctl.profile import LinkConfig
from perchctl.vehicle import FLYING

STILL = dict.fromkeys(MOTION_BLOCK, 0.0)


class Listened(MotionLink):
    """A link whose block sends when the test says so; `now_s` is its clock."""

    def __init__(self) -> None:
        super().__init__("usb://0", LinkConfig(), lambda: self.now_s)
        self.now_s = 5.0

    def hear(self, **values: float) -> None:
        self._on_motion(round(1000 * self.now_s), STILL | values)


def test_whether_motors_turn_is_the_newest_packet_s() -> None:
    link = Listened()
    for bits in (FLYING, 0, FLYING | 0x2):
        link.hear(**{"supervisor.info": bits, "gyro.x": math.nan})
        assert link.motors_run == bool(bits)


def test_samples_are_in_radians_right_handed_and_of_one_moment() -> None:
    link = Listened()
    turned = {"stateEstimate.roll": 10.0, "stateEstimate.pitch": 20.0, "stateEstimate.yaw": -30.0}
    rates = {"gyro.x": 1.0, "gyro.y": 2.0, "gyro.z": 3.0}
    link.hear(**turned, **rates)
    link.now_s += 0.015
    link.hear(**turned, **rates)
    first, second = link.samples()
    assert second.t_s - first.t_s == pytest.approx(0.015)
    rpy = (second.roll_rad, second.pitch_rad, second.yaw_rad)
    assert rpy == pytest.approx(np.radians([10.0, -20.0, -30.0]))
    assert second.gyro_radps == pytest.approx(np.radians([1.0, 2.0, 3.0]))
    assert link.samples() == []


@pytest.mark.parametrize("name", [name for name in MOTION_BLOCK if name != "supervisor.info"])
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_turn_that_is_no_number_is_dropped_alone(name: str, number: float) -> None:
    """One in a carry would make all of it unsolvable."""
    link = Listened()
    for broken in ({}, {name: number}, {}):
        link.hear(**broken)
        link.now_s += 0.01
    taken = link.samples()
    assert len(taken) == 2
    assert np.isfinite([[a.roll_rad, a.pitch_rad, a.yaw_rad, *a.gyro_radps] for a in taken]).all()


def test_nothing_begins_before_the_block_came_and_its_silence_is_a_problem(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is unknown is not still."""
    monkeypatch.setattr(listening, "start_block", lambda *_: None)
    monkeypatch.setattr(listening, "check_firmware", lambda *_: None)
    monkeypatch.setattr(listening, "is_logged", lambda *_: True)
    monkeypatch.setattr(listening, "FIRST_SAMPLE_TIMEOUT_S", 0.0)
    connection: Any = SimpleNamespace(cf=SimpleNamespace(log=None))
    link = Listened()
    with pytest.raises(TimedOut, match="sends no telemetry"):
        link._prepare(connection)
    link.hear()
    link._prepare(connection)
    assert link.problem(link.now_s + SILENCE_S) is None
    assert "nothing heard" in str(link.problem(link.now_s + SILENCE_S + 0.1))
    link.now_s += SILENCE_S + 0.1
    link.hear()
    assert link.problem(link.now_s) is None
