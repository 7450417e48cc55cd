"""What the filter claims is what it errs by, and it errs no more than each frame alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import (
    Array,
    make_T,
    rot_z,
    rotation_from_rpy,
    wrap_rad,
)
from perchctl.profile import KalmanConfig, TargetConfig
from perchctl.vision import Attitude, MarkerPose, Pipeline, PipelineState
from perchctl.vision.filter import TILTS, X, Y, Z, make_filter, process_noise
from perchctl.vision.pipeline import follow
from perchctl.vision.target_selection import measurement
from tests.helpers.seen import seen_from

Build = Callable[..., Pipeline]
TARGET_M = np.array([0.2, -0.1, 2.2])
BIAS_RAD = math.radians(0.3)
BINS_M = (0.0, 0.2, 0.6, 2.0)
HZ = 30.0


def body_at(t_s: float, phase: Array) -> tuple[Array, tuple[float, float, float]]:
    """Between 8 cm and 1.4 m under the target, at up to 0.5 m/s: position, roll pitch yaw."""
    z = 0.74 + 0.66 * math.cos(0.6 * t_s + phase[0])
    x, y = 0.2 * z * np.sin(0.9 * t_s + phase[1:3])
    roll, pitch = 0.05 * np.sin(2.0 * t_s + phase[3:5])
    return TARGET_M + np.array([x, y, -z]), (float(roll), float(pitch), 0.8 * math.sin(0.4 * t_s))


def errors(setup: Pipeline, in_world: bool, bias_rad: float, scale: float) -> Array:
    """Rows of range, filter's error, still's error (m), and the filter's squared error in
    units of its spread, a degree of freedom; of a print that is `scale` times as large."""
    rows = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        phase = rng.uniform(0.0, 2.0 * math.pi, 5)
        state = PipelineState()
        for k in range(360):
            position, (roll, pitch, yaw) = body_at(k / HZ, phase)
            T = make_T(rotation_from_rpy(roll, pitch, yaw), position)
            attitude = None
            if in_world:
                here = (float(position[0]), float(position[1]), float(position[2]))
                attitude = Attitude(k / HZ, roll + bias_rad, pitch - bias_rad, yaw, here)
            seen = seen_from(T, TARGET_M, k / HZ, rng, scale=scale)
            state, output = follow(state, seen, attitude, setup)
            target, pose = output.target, next(iter(output.poses.values()), None)
            if target is None or pose is None:
                continue
            assert target.measured  # the gate takes no motion for a jump
            way = TARGET_M - position
            e = rot_z(-yaw) @ way if in_world else T[:3, :3].T @ way
            turned = T[:3, :3].T[:, 0]
            heading = wrap_rad(-yaw) if in_world else math.atan2(turned[1], turned[0])
            off = np.append(target.e_m - e, wrap_rad(target.e_yaw_rad - heading))
            squared = (off / np.append(target.sigma_m, target.sigma_yaw_rad)) ** 2
            still = np.linalg.norm(pose.e_m - e)
            rows.append([way[2], np.linalg.norm(off[:3]), still, squared.mean()])
    return np.array(rows)


@pytest.mark.parametrize(
    ("in_world", "bias_rad", "sigma_deg", "scale", "size_sigma"),
    [
        (False, 0.0, 0.3, 1.0, 0.0),
        (True, 0.0, 0.0, 1.0, 0.0),
        (True, BIAS_RAD, 0.3, 1.0, 0.0),
        (False, 0.0, 0.3, 1.007, 0.005),
        (True, 0.0, 0.0, 0.993, 0.005),
    ],
)
def test_the_filter_is_no_worse_than_the_stills_and_knows_how_good_it_is(
    build: Build, in_world: bool, bias_rad: float, sigma_deg: float, scale: float,
    size_sigma: float,
) -> None:  # fmt: skip
    target = TargetConfig(size_sigma=size_sigma, curl_per_m=0.0)
    setup = build(kalman=KalmanConfig(attitude_sigma_deg=sigma_deg), target=target)
    rows = errors(setup, in_world, bias_rad, scale)
    for low, high in pairwise(BINS_M):
        _, filtered, still, squared = rows[(rows[:, 0] > low) & (rows[:, 0] <= high)].T
        assert len(filtered) > 50
        assert math.sqrt((filtered**2).mean()) <= 1.5 * math.sqrt((still**2).mean())
        assert 0.5 < squared.mean() < 2.0


angles = st.floats(-0.05, 0.05)


@given(
    rpy=st.tuples(angles, angles, st.floats(-3.0, 3.0)),
    e_m=st.tuples(*[st.floats(-1.5, 1.5)] * 3),
    bias_rad=st.tuples(*[st.floats(-0.005, 0.005)] * 2),
    in_world=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_the_consider_term_is_what_a_wrong_attitude_does(
    build: Build,
    rpy: tuple[float, float, float],
    e_m: tuple[float, float, float],
    bias_rad: tuple[float, float],
    in_world: bool,
) -> None:
    """A pose that is solved with roll and pitch off by a little is off by `tilt` times it."""
    setup = build(gear_body_m=(0.01, -0.02, 0.03), kalman=KalmanConfig(attitude_sigma_deg=0.3))
    constants = setup.tracks.constants(in_world)
    true = Attitude(0.0, *rpy, (0.3, -0.2, 1.0))
    wrong = Attitude(0.0, rpy[0] + bias_rad[0], rpy[1] + bias_rad[1], rpy[2], true.position_m)
    in_body = rotation_from_rpy(rpy[0], rpy[1], 0.0).T @ e_m

    def measured(attitude: Attitude) -> tuple[Array, Array]:
        level = rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, 0.0) @ in_body
        pose = MarkerPose(
            "joint", 0.0, np.zeros(3), np.zeros(3), level, 0.2, np.ones(3), 1.0, 0.0,
            cov=1e-6 * np.eye(4),
        )  # fmt: skip
        found = measurement(pose, attitude, in_world, constants, setup.pose)
        assert found.bias is not None
        return found.z, found.bias[:, TILTS]

    (z, tilt), (moved, _) = measured(true), measured(wrong)
    expected = tilt @ np.array(bias_rad) / math.radians(0.3)
    # To first order in the bias, and as if roll turned about the level axis.
    turned = float(np.linalg.norm(bias_rad))
    assert (
        np.abs((moved - z) - expected).max() <= 0.1 * turned * (np.linalg.norm(e_m) + 0.05) + 1e-12
    )


@given(dt_s=st.floats(0.001, 0.2), z_m=st.floats(0.05, 2.0), in_world=st.booleans())
def test_the_process_noise_of_a_step_is_that_of_its_halves(
    dt_s: float, z_m: float, in_world: bool
) -> None:
    """Physical units: it does not depend on how often frames come."""
    setup = make_filter(KalmanConfig(), in_world)
    place = np.array([0.0, 0.0, z_m])
    F = np.eye(8)
    F[[0, 2, 4, 6], [1, 3, 5, 7]] = dt_s / 2.0
    half = process_noise(dt_s / 2.0, place, setup)
    whole = process_noise(dt_s, place, setup)
    assert np.allclose(F @ half @ F.T + half, whole, rtol=1e-9, atol=0.0)
    assert np.linalg.eigvalsh(whole).min() > -1e-15
    spread = np.sqrt(np.diag(whole))[[X, Y, Z]]
    # Turning moves what is far to the side, not towards the camera.
    assert in_world or spread[0] > spread[2]
