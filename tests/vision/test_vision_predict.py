"""Which of the vehicle's two accounts of its way tells where the target goes is learned."""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import R_MARKER_TARGET, Array
from perchctl.profile import CameraConfig, PoseConfig, TargetConfig
from perchctl.vision import Attitude, MarkerPose
from perchctl.vision.pose import make_pose_setup
from perchctl.vision.tracks import expected_corners, update_sight
from perchctl.vision.types import Sighting
from tests.helpers.target_picture import CAMERA

SETUP = make_pose_setup(
    PoseConfig(), TargetConfig(), CameraConfig().mount.T_body_cam, (0.0, 0.0, 0.03), CAMERA
)
TARGET_M = np.array([0.0, 0.0, 2.0])
FRAME_S = 1.0 / 30.0
LEARNED = 30
"""Frames after which it must have been."""


class Flight:
    """0.2 m under the target, now here, now there; each account with errors of its own."""

    def __init__(self, seed: int, place_m: float, speed_mps: float) -> None:
        self._rng = np.random.default_rng(seed)
        self._place_m, self._speed_mps = place_m, speed_mps
        self.jump_m: Array = np.zeros(3)

    def at(self, t_s: float) -> tuple[Attitude, MarkerPose]:
        phase = 2.0 * t_s
        true_m = np.array([0.03 * math.sin(phase), 0.02 * math.cos(phase), 1.8])
        speed_mps = np.array([0.06 * math.cos(phase), -0.04 * math.sin(phase), 0.0])
        roll, pitch = 0.04 * math.sin(3.0 * t_s), 0.03 * math.cos(3.0 * t_s)
        x, y, z = true_m + self.jump_m + self._rng.normal(0.0, self._place_m, 3)
        vx, vy, vz = speed_mps + self._rng.normal(0.0, self._speed_mps, 3)
        attitude = Attitude(t_s, roll, pitch, 0.3, (x, y, z), (vx, vy, vz))
        R_world_cam = attitude.R_world_body @ SETUP.T_body_cam[:3, :3]
        eye_m = true_m + attitude.R_world_body @ SETUP.T_body_cam[:3, 3]
        rvec = cv2.Rodrigues(R_world_cam.T @ R_MARKER_TARGET)[0].ravel()
        still = np.zeros(3)
        pose = MarkerPose(
            "joint", t_s, rvec, R_world_cam.T @ (TARGET_M - eye_m), still, 0.0, still, 0.0, 0.1
        )
        return attitude, pose


def errors_px(flight: Flight, frames: int, *, told: bool = True) -> Iterator[float]:
    """By how much the large marker's corners are expected in the wrong place, by frame."""
    sight: Sighting | None = None
    for k in range(frames):
        attitude, pose = flight.at(k * FRAME_S)
        if not told:
            attitude = Attitude(
                attitude.t_s, attitude.roll_rad, attitude.pitch_rad, 0.3, attitude.position_m
            )
        if sight is not None:
            expected, _ = expected_corners(sight, pose.t_s, attitude, SETUP)
            assert expected is not None
            points = SETUP.object_points["large"]
            true = cv2.projectPoints(points, pose.rvec_rad, pose.tvec_m, CAMERA.K, CAMERA.dist)[0]
            yield float(np.abs(expected["large"] - true.reshape(4, 2)).max())
        sight = update_sight(sight, pose, attitude, SETUP)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**31))
def test_places_that_step_are_overruled_by_speeds(seed: int) -> None:
    """2 mm of steps are 5 px at 0.2 m."""
    both = list(errors_px(Flight(seed, 2e-3, 5e-3), 90))[LEARNED:]
    places = list(errors_px(Flight(seed, 2e-3, 5e-3), 90, told=False))[LEARNED:]
    assert rms(both) < 0.4 * rms(places)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**31))
def test_speeds_that_are_wrong_are_overruled_by_places(seed: int) -> None:
    both = list(errors_px(Flight(seed, 1e-4, 0.15), 90))[LEARNED:]
    places = list(errors_px(Flight(seed, 1e-4, 0.15), 90, told=False))[LEARNED:]
    assert rms(both) < 1.5 * rms(places)


def test_a_jump_of_the_estimates_world_spoils_one_picture() -> None:
    """The vehicle has not moved: what follows is expected where it is."""
    flight = Flight(1, 1e-4, 5e-3)
    found = []
    for k, error_px in enumerate(errors_px(flight, 60)):
        found.append(error_px)
        if k == 40:
            flight.jump_m = np.array([0.1, 0.0, 0.0])
    assert found[41] > 20.0
    assert max(found[43:]) < 3.0


@pytest.mark.parametrize("gap_s", [-0.1, 0.0, 5.0])
def test_what_is_not_of_now_teaches_nothing(gap_s: float) -> None:
    flight = Flight(2, 2e-3, 5e-3)
    attitude, pose = flight.at(1.0)
    before = Sighting(pose, attitude, (1e-4, 2e-4))
    later, seen = flight.at(1.0 + gap_s)
    assert update_sight(before, seen, later, SETUP).off_rad2 == before.off_rad2
    assert update_sight(before, seen, None, SETUP).off_rad2 == before.off_rad2


def test_two_accounts_that_never_erred_count_alike() -> None:
    """Places and speeds of one smooth way."""
    assert max(errors_px(Flight(3, 0.0, 0.0), 5)) < 0.2
