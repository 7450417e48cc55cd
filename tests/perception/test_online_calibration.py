"""What a flight does with the latency that it measures: surely, within bounds, and slowly unless
it is quite another one."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import Phase
from perchctl.perception import History
from perchctl.perception.online_calibration import (
    CHANGED_S,
    SLEW,
    USED_SIGMA_S,
    OnlineCalibration,
    apply_latency,
    update_calibration,
)
from perchctl.profile import USED_LATENCY_S, CameraConfig
from perchctl.vision import CameraCalibrationErrors, CameraModel, MarkerPose, PoseSetup
from tests.helpers.mission import PROFILE, context_at, observation, state_in, telemetry

FRAME_S = 1 / 30
CAMERA = CameraModel((640, 480), np.diag([380.0, 380.0, 1.0]), np.zeros(5))
SETUP = PoseSetup(
    PROFILE.pose, PROFILE.target, PROFILE.camera.mount.T_body_cam,
    PROFILE.vehicle.gear_body_m, CAMERA,
)  # fmt: skip
START_S = CameraConfig(latency_s="measured").start_latency_s
POSE = MarkerPose(
    "joint", 0.0, np.array([math.pi, 0.0, 0.0]), np.array([0.0, 0.0, 1.2]), np.zeros(3), 0.0,
    np.full(3, 1e-3), 1e-3, 0.1, level_frame_xyz_yaw_cov=np.diag([1e-6] * 4),
)  # fmt: skip


def _seen(delay_s: float, sigma_s: float) -> CameraCalibrationErrors:
    return CameraCalibrationErrors(delay_s, sigma_s, (0.0, 0.0, 0.0), (0.01, 0.01, 0.01))


def _frames(
    start: OnlineCalibration, count: int, correction_s: float | None = None
) -> OnlineCalibration:
    """At rest under the target, without a new solve."""
    state = replace(start, last_picture_s=10.0)
    for k in range(1, count + 1):
        state = apply_latency(state, 10.0 + k * FRAME_S, START_S, correction_s)
    return state


@given(sigma_s=st.floats(0.0, 0.5))
def test_a_latency_is_never_less_known_than_before_it_was_measured(sigma_s: float) -> None:
    unknown_s = OnlineCalibration().delay_sigma_s
    found_s = OnlineCalibration(newest=_seen(0.0, sigma_s)).delay_sigma_s
    assert found_s == min(sigma_s, unknown_s)


def test_a_sure_latency_is_taken_over_slowly() -> None:
    """20 ms a second: what the target's place makes of that is what it makes of a drift."""
    start = OnlineCalibration(newest=_seen(0.04, 0.004))
    assert _frames(start, 1).applied_delay_s == pytest.approx(SLEW * FRAME_S)
    assert _frames(start, 45).applied_delay_s == pytest.approx(0.03, rel=0.01)
    assert _frames(start, 200).applied_delay_s == pytest.approx(0.04)


@pytest.mark.parametrize(
    ("newest", "used_s"),
    [
        (_seen(0.04, 1.01 * USED_SIGMA_S), 0.01),
        (None, 0.01),
        (_seen(math.nan, math.nan), 0.01),
        (_seen(-0.3, 0.004), USED_LATENCY_S[0] - START_S),
        (_seen(0.5, 0.004), USED_LATENCY_S[1] - START_S),
    ],
    ids=["unsure", "unknown", "no number", "too little", "too much"],
)
def test_only_a_sure_latency_is_used_and_within_bounds(
    newest: CameraCalibrationErrors | None, used_s: float
) -> None:
    start = OnlineCalibration(newest=newest, applied_delay_s=0.01)
    assert _frames(start, 600).applied_delay_s == pytest.approx(used_s)


@given(
    later_s=st.floats(USED_LATENCY_S[0] - START_S, USED_LATENCY_S[1] - START_S),
    was_s=st.none() | st.floats(-0.08, 0.1),
)
def test_another_latency_is_taken_over_within_half_a_second(
    later_s: float, was_s: float | None
) -> None:
    """Whatever the sums have found until then; those of another latency begin anew. Pictures never
    go back in time, and once it is there, what the sums find is followed slowly again."""
    newest = None if was_s is None else _seen(was_s, 0.004)
    start = OnlineCalibration(newest=newest, applied_delay_s=was_s or 0.0)
    times_s = [k * FRAME_S - _frames(start, k, later_s).applied_delay_s for k in range(16)]
    assert all(after > before for before, after in pairwise(times_s))
    there = _frames(start, 15, later_s)
    assert there.applied_delay_s == pytest.approx(later_s)
    assert there.coarse_delay_s is None
    contradicts = was_s is not None and abs(was_s - later_s) > CHANGED_S
    assert there.changed_s == ((was_s, later_s) if contradicts else None)
    assert (there.newest is None) is (was_s is None or contradicts)
    again = replace(there, newest=_seen(later_s + 0.02, 0.004))
    drift_s = _frames(again, 1).applied_delay_s - later_s
    assert drift_s <= SLEW * FRAME_S + 1e-12


def test_what_is_no_number_teaches_nothing() -> None:
    """A covariance that broke down."""
    history = History(tuple(telemetry(10.0 + 0.01 * k) for k in range(-40, 40)))
    broken = replace(POSE, level_frame_xyz_yaw_cov=np.full((4, 4), math.nan))
    start = OnlineCalibration()
    learned = update_calibration(start, 10.0, broken, history, SETUP, 0.005)
    assert learned.newest is None
    assert learned.sums.level is None


def test_a_later_picture_is_as_fresh_as_it_can_be() -> None:
    """ASCEND climbs by fresh pictures, and one cannot be newer than the latency that is used."""
    state = state_in(Phase.ASCEND)
    old = observation(10.02)
    assert old.target is not None
    limit_s = PROFILE.planner.ascend.fresh_s + PROFILE.camera.start_latency_s
    target = replace(old.target, last_measured_at_s=10.02 - limit_s - 0.03)
    stale = replace(old, target=target)
    assert not context_at(state, stale).belief.target.is_fresh
    assert context_at(
        state, replace(stale, camera_latency_above_profile_s=0.05)
    ).belief.target.is_fresh
