"""What the flight loop refuses before take-off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from perchctl.errors import Interrupted, InvalidValue, NotFound, SafetyAbort, TimedOut
from perchctl.mission import Operator
from perchctl.vehicle import (
    CRASHED,
    DECK_FAULT,
    FLYING,
    LOCKED,
    TUMBLED,
    PositionSetpoint,
)
from tests.helpers.loop_rig import Camera, Rig, Vehicle
from tests.helpers.mission import READY


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"supervisor": READY | LOCKED}, "locked"),
        ({"supervisor": READY | CRASHED}, "crash"),
        ({"supervisor": READY | TUMBLED}, "upside down"),
        ({"supervisor": READY | DECK_FAULT}, "deck"),
        ({"supervisor": READY | FLYING}, "flying already"),
        ({"supervisor": READY | 1 << 13}, "unknown bits .0x200E"),
        ({"battery_v": 3.4}, r"3\.40 V.*3\.80 V.*charge"),
    ],
    ids=["locked", "crashed", "tumbled", "deck", "flying", "unknown", "battery"],
)
def test_a_vehicle_that_may_not_fly_is_refused(changes: dict[str, Any], words: str) -> None:
    rig = Rig(Vehicle(lambda sample: replace(sample, **changes)))
    rig.refused(SafetyAbort, words)
    assert rig.link.now_s < 0.1  # at once


@pytest.mark.parametrize(
    ("rig", "words", "limit_s"),
    [
        (lambda: Rig(Vehicle(lambda sample: None)), "telemetry", 10.0),
        (
            lambda: Rig(Vehicle(lambda sample: replace(sample, position_variance_m2=0.5))),
            r"variance 0\.5.*positioning",
            10.0,
        ),
        (lambda: Rig(Vehicle(lambda sample: replace(sample, supervisor=0x06))), "0x0006", 10.0),
        (lambda: Rig(camera=Camera(lambda frame: None)), "picture .none has come", 8.0),
        (
            lambda: Rig(camera=Camera(lambda frame: replace(frame, t_s=frame.t_s - 5.0))),
            "picture .*5.* s late",
            8.0,
        ),
    ],
    ids=["no telemetry", "unsettled estimate", "may not fly", "no picture", "old pictures"],
)
def test_what_does_not_come_in_time_is_refused(
    rig: Callable[[], Rig], words: str, limit_s: float
) -> None:
    it = rig()
    it.refused(TimedOut, words)
    assert limit_s < it.link.now_s < limit_s + 0.2


def test_an_estimate_that_settles_is_waited_for() -> None:
    rig = Rig(
        Vehicle(lambda s: replace(s, position_variance_m2=0.5 if s.t_s < 3.0 else 1e-4)),
        operator=lambda: Operator.LAND if rig.link.said(PositionSetpoint) else Operator.NONE,
    )
    rig.fly()
    assert 3.0 <= rig.link.said(PositionSetpoint)[0] < 3.2


def test_pictures_of_another_size_are_refused() -> None:
    Rig(camera=Camera(size_px=(320, 240))).refused(InvalidValue, "320x240.*64x48")


def test_a_recording_that_has_ended_is_refused() -> None:
    Rig(camera=Camera(live=False, frames=1)).refused(NotFound, "ended before take-off")


def test_ctrl_c_on_the_ground_starts_nothing() -> None:
    Rig(operator=lambda: Operator.LAND).refused(Interrupted, "nothing was started")
