"""Latency and mounting out of a flight: known truths, honest intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from perchctl.geometry import Array, rotation_from_rpy
from perchctl.perception.online_calibration import (
    ATTITUDE_STEP_S,
    STAMPS_S,
    ConsistencySums,
    add_rows,
    consistency_rows,
    solve_consistency,
)
from perchctl.profile import Profile
from perchctl.vision import (
    CameraCalibrationErrors,
    CameraModel,
    MarkerPose,
    PoseSetup,
    VehicleState,
)

PROFILE = Profile()
CAMERA = CameraModel((640, 480), np.diag([380.0, 380.0, 1.0]), np.zeros(5))
ATTITUDE_SIGMA_RAD = math.radians(0.3)
TARGET_M = np.array([0.3, -0.2, 2.2])
FLIGHT_S, FRAME_S, SAMPLE_S = 12.0, 1 / 30, 0.01
NOISE_M, NOISE_MEMORY_S = 0.002, 0.3
TILT_RAD, TILT_MEMORY_S = math.radians(0.07), 1.0
POSE_M, POSE_RAD = 0.001, math.radians(0.2)
JITTER_S = 0.008


@dataclass(frozen=True)
class Truth:
    """Of one flight: what its profile does not say."""

    delay_s: float = 0.0
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    attitude_rad: tuple[float, float] = (0.0, 0.0)  # constant error of roll and pitch
    drift_mps: tuple[float, float] = (0.0, 0.0)
    jump_m: float = 0.0  # of the estimate's world, halfway
    rests: bool = False


SETUP = PoseSetup(
    PROFILE.pose, PROFILE.target, PROFILE.camera.mount.T_body_cam,
    PROFILE.vehicle.gear_body_m, CAMERA,
)  # fmt: skip


def _flown(t_s: float, truth: Truth, phase: Array) -> tuple[Array, Array]:
    """Where the vehicle truly is, and its roll, pitch and yaw: under the target from half a
    metre aside, turning to its heading, then up; and shaking all the time."""
    if truth.rests:
        return np.array([0.0, 0.0, 0.6]), np.zeros(3)
    s = np.clip((t_s - 1.0) / 3.0, 0.0, 1.0)
    s = s * s * (3.0 - 2.0 * s)
    up = np.clip((t_s - 6.0) / 5.0, 0.0, 1.0)
    shake = np.sin(np.array([3.1, 3.7, 1.1, 4.3, 5.0]) * t_s + phase)
    place = np.array([0.35 * s, -0.25 * s, 0.6 + 1.2 * up])
    place[:2] += 0.02 * shake[:2]
    return place, np.array([0.03 * shake[3], 0.03 * shake[4], 1.2 * s + 0.03 * shake[2]])


def _fly(truth: Truth, rng: np.random.Generator, told_s: float) -> ConsistencySums:
    """The sums after a flight whose pictures are late by `told_s`, as far as the profile knows,
    and by `truth.delay_s` more."""
    phase = rng.uniform(0.0, 2.0 * math.pi, 5)
    count = round(FLIGHT_S / SAMPLE_S)
    memory_s = np.array([NOISE_MEMORY_S, NOISE_MEMORY_S, TILT_MEMORY_S, TILT_MEMORY_S])
    keep = np.exp(-SAMPLE_S / memory_s)
    kick = np.array([NOISE_M, NOISE_M, TILT_RAD, TILT_RAD]) * np.sqrt(1.0 - keep**2)
    noise = np.zeros((count + 1, 4))
    for k, white in enumerate(rng.normal(size=(count, 4))):
        noise[k + 1] = keep * noise[k] + kick * white
    turned = rotation_from_rpy(*truth.turn_rad) @ SETUP.T_body_cam[:3, :3]
    place_m = SETUP.T_body_cam[:3, 3]

    def estimated(t_s: float) -> VehicleState:
        place, rpy = _flown(t_s, truth, phase)
        k = min(max(t_s / SAMPLE_S, 0.0), count - 1.0)
        low = math.floor(k)
        off = noise[low] + (k - low) * (noise[low + 1] - noise[low])
        place[:2] += off[:2]
        place[:2] += np.array(truth.drift_mps) * t_s + truth.jump_m * (t_s > FLIGHT_S / 2)
        rpy[:2] += off[2:] + truth.attitude_rad
        return VehicleState(t_s, *rpy, tuple(place))

    def velocity(t_s: float) -> tuple[float, float, float]:
        way = _flown(t_s + 1e-3, truth, phase)[0] - _flown(t_s - 1e-3, truth, phase)[0]
        return tuple(way / 2e-3 + np.array([*truth.drift_mps, 0.0]))

    sums = ConsistencySums()
    for i in range(10, round(FLIGHT_S / FRAME_S)):
        exposed_s = i * FRAME_S
        late_s = truth.delay_s + rng.normal(0.0, JITTER_S)
        place, rpy = _flown(exposed_s, truth, phase)
        R_world_cam = rotation_from_rpy(*rpy) @ turned
        way = R_world_cam.T @ (TARGET_M - place - rotation_from_rpy(*rpy) @ place_m)
        R_cam_marker = R_world_cam.T @ np.diag([1.0, -1.0, -1.0])
        spoilt = rotation_from_rpy(0.0, 0.0, rng.normal(0.0, POSE_RAD)) @ R_cam_marker
        way = way + rng.normal(0.0, POSE_M, 3)
        cov = np.diag([POSE_M**2] * 3 + [POSE_RAD**2])
        rvec = cv2.Rodrigues(spoilt)[0].ravel()
        pose = MarkerPose(
            "joint", exposed_s, rvec, way, np.zeros(3), 0.0, np.full(3, POSE_M), POSE_RAD, 0.1,
            level_frame_xyz_yaw_cov=cov,
        )  # fmt: skip
        t_s = exposed_s + late_s
        before, after = (
            estimated(t_s - told_s - ATTITUDE_STEP_S),
            estimated(t_s - told_s + ATTITUDE_STEP_S),
        )
        sums = add_rows(
            sums,
            t_s,
            *consistency_rows(pose, before, after, velocity(t_s - told_s), told_s, SETUP),
        )
    return sums


def _seen(truth: Truth, seed: int = 0, told_s: float = 0.0) -> CameraCalibrationErrors:
    sums = _fly(truth, np.random.default_rng(seed), told_s)
    found = solve_consistency(sums, ATTITUDE_SIGMA_RAD)
    assert found is not None
    return found


@pytest.mark.parametrize(
    "delay_s",
    [-0.05, *(pytest.param(delay_s, marks=pytest.mark.long) for delay_s in (0.0, 0.03)), 0.08],
)
def test_the_delay_is_found(delay_s: float) -> None:
    found = _seen(Truth(delay_s=delay_s))
    again = _seen(Truth(delay_s=delay_s), told_s=found.latency_above_profile_s)
    assert again.latency_above_profile_s == pytest.approx(delay_s, abs=0.004)
    assert again.latency_sigma_s < 0.006


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_each_turn_is_found_about_its_own_axis(axis: int) -> None:
    turn = [0.0, 0.0, 0.0]
    turn[axis] = math.radians(5.0)
    found = _seen(Truth(turn_rad=(turn[0], turn[1], turn[2])))
    for truth, seen, sigma in zip(
        turn,
        found.mount_rotation_from_profile_xyz_rad,
        found.mount_rotation_sigma_xyz_rad,
        strict=True,
    ):
        assert abs(seen - truth) < 3.0 * sigma
        assert sigma < math.radians(1.5)


@pytest.mark.long
def test_what_is_claimed_is_what_is_so() -> None:
    """Many flights, all errors at once: squared errors over claimed variances."""
    ratios = []
    for seed in range(24):
        rng = np.random.default_rng([seed, 77])
        delay_s, stamps_s = rng.uniform(-0.05, 0.05), rng.normal(0.0, STAMPS_S)
        turn, bias = rng.normal(0.0, 0.02, 3), rng.normal(0.0, ATTITUDE_SIGMA_RAD, 2)
        truth = Truth(
            delay_s=delay_s + stamps_s,
            turn_rad=tuple(turn),
            attitude_rad=tuple(bias),
            drift_mps=tuple(rng.normal(0.0, 0.01, 2)),
        )
        found = _seen(truth, seed, told_s=delay_s + rng.uniform(-0.01, 0.01))
        off = np.array(
            [
                found.latency_above_profile_s - delay_s,
                *(np.array(found.mount_rotation_from_profile_xyz_rad) - turn),
            ]
        )
        ratios.append((off / [found.latency_sigma_s, *found.mount_rotation_sigma_xyz_rad]) ** 2)
    mean = np.mean(ratios, axis=0)
    assert ((mean > 0.5) & (mean < 2.0)).all(), mean


def test_a_vehicle_at_rest_tells_nothing() -> None:
    found = _seen(Truth(delay_s=0.05, turn_rad=(0.1, 0.1, 0.5), rests=True))
    assert found.latency_sigma_s > 0.05
    assert min(found.mount_rotation_sigma_xyz_rad) > math.radians(3.0)


def test_a_world_that_jumps_spoils_nothing() -> None:
    found = _seen(Truth(delay_s=0.02, jump_m=0.3))
    assert found.latency_above_profile_s == pytest.approx(0.02, abs=0.006)
    assert (
        abs(found.mount_rotation_from_profile_xyz_rad[2])
        < 3.0 * found.mount_rotation_sigma_xyz_rad[2]
    )
