"""What a flight does with the latency that it measures: slowly, surely, within bounds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from perchctl.mission import Phase
from perchctl.mission.context import Context
from perchctl.perception import History
from perchctl.perception.online_calibration import (
    SLEW,
    USED_SIGMA_S,
    OnlineCalibration,
    update_calibration,
)
from perchctl.profile import USED_LATENCY_S, CameraConfig
from perchctl.vision import CameraErrors, CameraModel, MarkerPose, PoseSetup
from tests.helpers.mission import PROFILE, observation, state_in, telemetry

FRAME_S = 1 / 30
CAMERA = CameraModel((640, 480), np.diag([380.0, 380.0, 1.0]), np.zeros(5))
SETUP = PoseSetup(
    PROFILE.pose, PROFILE.target, PROFILE.camera.mount.T_body_cam,
    PROFILE.vehicle.gear_body_m, CAMERA,
)  # fmt: skip
MEASURED, TOLD = CameraConfig(latency_s="measured"), CameraConfig(latency_s=0.07)
POSE = MarkerPose(
    "joint", 0.0, np.array([math.pi, 0.0, 0.0]), np.array([0.0, 0.0, 1.2]), np.zeros(3), 0.0,
    np.full(3, 1e-3), 1e-3, 0.1, cov=np.diag([1e-6] * 4),
)  # fmt: skip


def _seen(delay_s: float, sigma_s: float) -> CameraErrors:
    return CameraErrors(delay_s, sigma_s, (0.0, 0.0, 0.0), (0.01, 0.01, 0.01))


def _frames(
    start: OnlineCalibration, camera: CameraConfig, count: int, pose: MarkerPose = POSE
) -> OnlineCalibration:
    """At rest under the target, without a new solve."""
    history = History(tuple(telemetry(10.0 + 0.01 * k) for k in range(-40, 40)))
    state = replace(start, solved_s=1e9, last_picture_s=10.0)
    for k in range(1, count + 1):
        t_s = 10.0 + k * FRAME_S
        state = update_calibration(state, t_s, pose, history, SETUP, camera, 0.005)
    return state


def test_a_sure_latency_is_taken_over_slowly() -> None:
    """20 ms a second: what the target's place makes of that is what it makes of a drift."""
    start = OnlineCalibration(newest=_seen(0.04, 0.004))
    assert _frames(start, MEASURED, 1).applied_delay_s == pytest.approx(SLEW * FRAME_S)
    assert _frames(start, MEASURED, 45).applied_delay_s == pytest.approx(0.03, rel=0.01)
    assert _frames(start, MEASURED, 200).applied_delay_s == pytest.approx(0.04)


BEFORE_S = MEASURED.start_latency_s


@pytest.mark.parametrize(
    ("newest", "camera", "used_s"),
    [
        (_seen(0.04, 1.01 * USED_SIGMA_S), MEASURED, 0.01),
        (None, MEASURED, 0.01),
        (_seen(math.nan, math.nan), MEASURED, 0.01),
        (_seen(0.04, 0.004), TOLD, 0.01),
        (_seen(-0.3, 0.004), MEASURED, USED_LATENCY_S[0] - BEFORE_S),
        (_seen(0.5, 0.004), MEASURED, USED_LATENCY_S[1] - BEFORE_S),
    ],
    ids=["unsure", "unknown", "no number", "told by the profile", "too little", "too much"],
)
def test_only_a_sure_latency_is_used_and_within_bounds(
    newest: CameraErrors | None, camera: CameraConfig, used_s: float
) -> None:
    start = OnlineCalibration(newest=newest, applied_delay_s=0.01)
    assert _frames(start, camera, 600).applied_delay_s == pytest.approx(used_s)


def test_what_is_no_number_teaches_nothing() -> None:
    """A covariance that broke down."""
    history = History(tuple(telemetry(10.0 + 0.01 * k) for k in range(-40, 40)))
    broken = replace(POSE, cov=np.full((4, 4), math.nan))
    start = OnlineCalibration()
    learned = update_calibration(start, 10.0, broken, history, SETUP, MEASURED, 0.005)
    assert learned.newest is None
    assert learned.sums.level is None


def test_a_later_picture_is_as_fresh_as_it_can_be() -> None:
    """ASCEND climbs by fresh pictures, and one cannot be newer than the latency that is used."""
    state = state_in(Phase.ASCEND)
    old = observation(10.02)
    assert old.target is not None
    limit_s = PROFILE.planner.ascend.fresh_s + PROFILE.camera.start_latency_s
    target = replace(old.target, measured_s=10.02 - limit_s - 0.03)
    stale = replace(old, target=target)
    assert not Context(state, stale, PROFILE).fresh
    assert Context(state, replace(stale, delay_s=0.05), PROFILE).fresh
