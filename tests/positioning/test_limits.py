"""Limits of a capture's section that no capture could keep."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from perchctl.profile import PositioningConfig
from perchctl.profile.positioning import MOST_LATENCY_S


@pytest.mark.parametrize(
    "late",
    [{"rate_hz": 10.0, "latency_s": 0.04}, {"latency_s": 0.04, "hold_s": 0.06}, {"hold_s": 0.03}],
)
def test_a_hold_that_each_perfect_frame_would_reach_is_refused(late: dict[str, float]) -> None:
    with pytest.raises(ValidationError, match="a position is stale before the next one comes"):
        PositioningConfig(by="mocap", host="lab", **late)
    PositioningConfig(by="mocap", host="lab", **{**late, "hold_s": 0.4})


def test_a_capture_that_is_later_than_can_be_flown_by_is_refused() -> None:
    PositioningConfig(by="mocap", host="lab", latency_s=MOST_LATENCY_S)
    with pytest.raises(ValidationError, match=r"less than or equal to 0\.04"):
        PositioningConfig(by="mocap", host="lab", latency_s=0.07)
