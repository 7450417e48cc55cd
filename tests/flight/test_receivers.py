"""Whole flights by receivers that repeat and blank."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.mission import EventKind, Phase
from tests.helpers.flights import fly_short

PAL = {"camera_rate_hz": 25.0}


@pytest.mark.long
@pytest.mark.parametrize("scenario", [
    PAL | {"camera_receiver_hz": 60.0},
    PAL | {"camera_receiver_hz": 30.0},
    PAL | {"camera_receiver_hz": 60.0, "camera_fields": "top"},
    {"camera_blank_rate": 0.2},
])  # fmt: skip
def test_it_perches_and_is_never_held(scenario: dict[str, Any]) -> None:
    flown = fly_short(**scenario)
    assert flown.report.phase is Phase.PERCHED
    assert flown.flight.miss_m < 0.010
    assert not any(event.kind is EventKind.HOLD for event in flown.report.history)


@pytest.mark.long
def test_a_receiver_that_is_stuck_in_flight_ends_in_a_landing() -> None:
    flown = fly_short(**PAL, camera_receiver_hz=60.0, camera_freeze_at_s=6.0)
    assert flown.report.phase is Phase.LANDED
    reasons = {event.row: event.reason for event in flown.report.history}
    assert reasons["camera-gone"] == "the picture stands still"
    assert not flown.flight.fell
