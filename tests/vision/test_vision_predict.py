"""Where the target should be in the next picture, by the vehicle's own motion."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import R_MARKER_TARGET, Array
from perchctl.profile import CameraConfig, PoseConfig, TargetConfig
from perchctl.vision import Attitude, MarkerPose
from perchctl.vision.pose import make_pose_setup
from perchctl.vision.tracks import expected_corners
from perchctl.vision.types import Sighting
from tests.helpers.target_picture import CAMERA

SETUP = make_pose_setup(
    PoseConfig(), TargetConfig(), CameraConfig().mount.T_body_cam, (0.0, 0.0, 0.03), CAMERA
)
TARGET_M = np.array([0.0, 0.0, 2.0])
FRAME_S = 1.0 / 30.0


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


def errors_px(flight: Flight, frames: int, *, with_speed: bool = True) -> Iterator[float]:
    """By how much the large marker's corners are expected in the wrong place, by frame."""
    sight: Sighting | None = None
    for k in range(frames):
        attitude, pose = flight.at(k * FRAME_S)
        if not with_speed:
            attitude = replace(attitude, velocity_mps=None)
        if sight is not None:
            expected, _ = expected_corners(sight, pose.t_s, attitude, SETUP)
            assert expected is not None
            points = SETUP.object_points["large"]
            true = cv2.projectPoints(points, pose.rvec_rad, pose.tvec_m, CAMERA.K, CAMERA.dist)[0]
            yield float(np.abs(expected["large"] - true.reshape(4, 2)).max())
        sight = Sighting(pose, attitude)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**31))
def test_places_that_step_are_left_out_where_there_is_a_speed(seed: int) -> None:
    """2 mm of steps are 5 px at 0.2 m."""
    speeds = list(errors_px(Flight(seed, 2e-3, 5e-3), 60))
    places = list(errors_px(Flight(seed, 2e-3, 5e-3), 60, with_speed=False))
    assert rms(speeds) < 0.4 * rms(places)


def test_a_jump_of_the_estimates_world_moves_no_expectation() -> None:
    """The vehicle has not moved: what follows is expected where it is."""
    flight, found = Flight(1, 1e-4, 5e-3), []
    for k, error_px in enumerate(errors_px(flight, 60)):
        found.append(error_px)
        if k == 40:
            flight.jump_m = np.array([0.1, 0.0, 0.0])
    assert max(found) < 3.0


@pytest.mark.parametrize("with_speed", [True, False])
def test_a_smooth_way_is_foretold_by_places_and_by_speeds(with_speed: bool) -> None:
    assert max(errors_px(Flight(3, 0.0, 0.0), 5, with_speed=with_speed)) < 0.2
