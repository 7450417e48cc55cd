"""The paper's Kalman filter: by hand, at its edges, and as honest as it claims to be."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import Array, make_T, rot_z, rotation_from_rpy, wrap_rad
from perchctl.profile import KalmanConfig, TargetConfig
from perchctl.vision import MarkerPose, Pipeline, PipelineState, VehicleState
from perchctl.vision.filter import (
    MEASURED_STATE_ELEMENTS,
    POSITION_STATE_ELEMENTS,
    RATE_STATE_ELEMENTS,
    ROLL_PITCH_BIAS_COLUMNS,
    VELOCITY_STATE_ELEMENTS,
    VX_STATE_INDEX,
    X_STATE_INDEX,
    Y_STATE_INDEX,
    YAW_RATE_STATE_INDEX,
    YAW_STATE_INDEX,
    Z_STATE_INDEX,
    TrackMeasurement,
    make_filter_setup,
    start_track,
    step_track,
)
from perchctl.vision.pipeline import step_from_detections
from perchctl.vision.target_selection import make_track_measurement
from perchctl.vision.types import MarkerFilterState
from tests.helpers.seen import seen_from

CONFIG = KalmanConfig(noise="fixed")
SETUP = make_filter_setup(CONFIG)
H = np.eye(8)[MEASURED_STATE_ELEMENTS]


def test_gains_are_the_papers_units_in_si() -> None:
    setup = make_filter_setup(KalmanConfig(k1=0.09, k2=0.01, noise="fixed"))
    assert np.allclose(np.sqrt(np.diag(setup.R)), [math.radians(0.3), 0.003, 0.003, 0.003])
    assert np.allclose(
        np.sqrt(np.diag(setup.Q))[[X_STATE_INDEX, VX_STATE_INDEX, YAW_STATE_INDEX]],
        [0.001, 0.001, math.radians(0.1)],
    )
    assert np.count_nonzero(setup.R - np.diag(np.diag(setup.R))) == 0
    assert np.count_nonzero(setup.Q - np.diag(np.diag(setup.Q))) == 0


steps = st.lists(
    st.tuples(
        st.floats(0.005, 0.2),  # dt
        st.booleans(),  # seen
        st.tuples(*[st.floats(-0.5, 0.5)] * 4),
    ),
    min_size=1,
    max_size=25,
)


@given(steps=steps, k1=st.floats(0.001, 1.0), k2=st.floats(0.0001, 0.1))
@settings(max_examples=60, deadline=None)
def test_equals_a_filter_written_out_by_hand(steps, k1: float, k2: float) -> None:
    setup = make_filter_setup(KalmanConfig(k1=k1, k2=k2, n_max=100, alpha=0.85, noise="fixed"))
    z0 = np.array([0.1, 0.2, -0.1, 0.5])
    track: MarkerFilterState | None = start_track(TrackMeasurement(z0), 0.0, setup)
    x, P, t = np.zeros(8), setup.P0.copy(), 0.0
    x[[0, 2, 4, 6]] = z0
    for dt, was_seen, z in steps:
        t += dt
        track = step_track(track, TrackMeasurement(np.array(z)) if was_seen else None, t, setup)
        F = np.eye(8)
        F[[0, 2, 4, 6], [1, 3, 5, 7]] = t - (t - dt)
        if not was_seen:
            x[[1, 3, 5, 7]] *= 0.85
        x = F @ x
        P = F @ P @ F.T + setup.Q
        if was_seen:
            S = H @ P @ H.T + setup.R
            K = np.linalg.solve(S, H @ P).T
            innovation = np.array(z) - H @ x
            innovation[0] = wrap_rad(float(innovation[0]))
            x = x + K @ innovation
            P = (np.eye(8) - K @ H) @ P
        difference = track.x - x
        difference[YAW_STATE_INDEX] = wrap_rad(float(difference[YAW_STATE_INDEX]))
        assert np.abs(difference).max() < 1e-7
        assert np.abs(track.P - P).max() < 1e-9


@given(start=st.floats(-math.pi, math.pi), rate=st.floats(-2.0, 2.0))
@settings(max_examples=40, deadline=None)
def test_yaw_follows_across_the_wrap(start: float, rate: float) -> None:
    track = None
    for k in range(40):
        yaw = wrap_rad(start + rate * k / 30)
        track = step_track(track, TrackMeasurement(np.array([yaw, 0.0, 0.0, 0.5])), k / 30, SETUP)
    assert -math.pi < track.x[YAW_STATE_INDEX] <= math.pi
    assert abs(wrap_rad(float(track.x[YAW_STATE_INDEX]) - yaw)) < 0.15
    assert track.x[YAW_RATE_STATE_INDEX] == pytest.approx(rate, abs=0.4)


def test_velocities_decay_and_the_track_is_dropped_after_n_max() -> None:
    track: MarkerFilterState | None = MarkerFilterState(
        0.0, np.arange(8) / 10.0, np.eye(8) * 1e-4, 0
    )
    rates, position = track.x[RATE_STATE_ELEMENTS].copy(), track.x[POSITION_STATE_ELEMENTS].copy()
    for n in range(1, CONFIG.n_max + 1):
        track = step_track(track, None, n / 30, SETUP)
        assert track.unseen_frames == n
        assert np.allclose(track.x[RATE_STATE_ELEMENTS], rates * CONFIG.alpha**n)
        position = position + track.x[VELOCITY_STATE_ELEMENTS] / 30
        assert np.allclose(track.x[POSITION_STATE_ELEMENTS], position)
    assert step_track(track, None, (CONFIG.n_max + 1) / 30, SETUP) is None
    again = step_track(
        track, TrackMeasurement(np.array([0.0, 1.0, 2.0, 3.0])), (CONFIG.n_max + 1) / 30, SETUP
    )
    assert again.unseen_frames == 0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_measurement_that_is_not_finite_counts_as_unseen(bad: float) -> None:
    start = start_track(TrackMeasurement(np.zeros(4)), 0.0, SETUP)
    track = step_track(start, TrackMeasurement(np.array([0.0, bad, 0.0, 0.5])), 0.03, SETUP)
    assert track.unseen_frames == 1
    assert np.isfinite(track.x).all()
    assert step_track(None, TrackMeasurement(np.array([bad, 0, 0, 0])), 0.0, SETUP) is None


@pytest.mark.parametrize("t_s", [0.0, -0.5, math.nan])
def test_a_frame_that_is_not_newer_changes_nothing(t_s: float) -> None:
    start = start_track(TrackMeasurement(np.array([0.1, 0.2, 0.3, 0.4])), 0.0, SETUP)
    assert step_track(start, TrackMeasurement(np.ones(4)), t_s, SETUP) is start
    assert step_track(start, None, t_s, SETUP) is start


@pytest.mark.parametrize("t_s", [1.5, -1.5])
def test_a_long_gap_starts_afresh(t_s: float) -> None:
    start = start_track(TrackMeasurement(np.array([0.1, 0.2, 0.3, 0.4])), 0.0, SETUP)
    track = step_track(start, TrackMeasurement(np.ones(4)), t_s, SETUP)
    assert np.allclose(track.x[[YAW_STATE_INDEX, X_STATE_INDEX, Y_STATE_INDEX, Z_STATE_INDEX]], 1.0)
    assert np.array_equal(track.P, SETUP.P0)
    assert step_track(start, None, t_s, SETUP) is None


@given(
    jump_m=st.tuples(*[st.floats(-0.5, 0.5)] * 3).filter(lambda m: np.linalg.norm(m) > 0.1),
    velocity_mps=st.tuples(*[st.floats(-0.5, 0.5)] * 3),
)
@settings(max_examples=40, deadline=None)
def test_a_jump_beyond_the_motion_model_teaches_a_camera_no_speed(
    jump_m: tuple[float, float, float], velocity_mps: tuple[float, float, float]
) -> None:
    """The track restarts at the jump, and covers where it was predicted until it is confirmed."""
    setup, R = make_filter_setup(KalmanConfig()), np.diag([1e-3, 1e-3, 1e-3, 1e-3]) ** 2
    place, jump = np.array([0.1, 0.2, -0.1, 0.6]), np.array([0.0, *jump_m])
    steps = np.array([0.0, *velocity_mps]) / 30.0
    track: MarkerFilterState | None = None
    for k in range(20):
        track = step_track(track, TrackMeasurement(place + k * steps, R), k / 30.0, setup)
    jumped = place + 20 * steps + jump
    track = step_track(track, TrackMeasurement(jumped, R), 20 / 30.0, setup)
    assert np.allclose(track.x[MEASURED_STATE_ELEMENTS], jumped)
    assert np.abs(track.x[RATE_STATE_ELEMENTS]).max() == 0.0
    sigma_m = np.sqrt(track.P.diagonal()[POSITION_STATE_ELEMENTS])
    assert (sigma_m > 0.9 * np.abs(jump_m) - 0.01).all()
    confirmed = step_track(track, TrackMeasurement(jumped + steps, R), 21 / 30.0, setup)
    assert np.sqrt(confirmed.P.diagonal()[POSITION_STATE_ELEMENTS]).max() < 0.002
    # In the world of a state estimate a camera's motion is known.
    world, there = make_filter_setup(KalmanConfig(), is_world_frame=True), None
    for k in range(20):
        there = step_track(there, TrackMeasurement(place, R), k / 30.0, world)
    there = step_track(there, TrackMeasurement(place + jump, R), 20 / 30.0, world)
    assert not np.allclose(there.x[MEASURED_STATE_ELEMENTS], place + jump)


# --- What the filter claims is what it errs by, and it errs no more than each frame alone ------


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
                attitude = VehicleState(k / HZ, roll + bias_rad, pitch - bias_rad, yaw, here)
            seen = seen_from(T, TARGET_M, k / HZ, rng, scale=scale)
            state, output = step_from_detections(state, seen, attitude, setup)
            target, pose = output.target, next(iter(output.poses.values()), None)
            if target is None or pose is None:
                continue
            assert target.is_measured_in_newest_frame  # the gate takes no motion for a jump
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
        pytest.param(False, 0.0, 0.3, 1.0, 0.0, marks=pytest.mark.long),
        pytest.param(True, 0.0, 0.0, 1.0, 0.0, marks=pytest.mark.long),
        (True, BIAS_RAD, 0.3, 1.0, 0.0),
        pytest.param(False, 0.0, 0.3, 1.007, 0.005, marks=pytest.mark.long),
        pytest.param(True, 0.0, 0.0, 0.993, 0.005, marks=pytest.mark.long),
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
    constants = setup.track_setup.select_filter(in_world)
    true = VehicleState(0.0, *rpy, (0.3, -0.2, 1.0))
    wrong = VehicleState(0.0, rpy[0] + bias_rad[0], rpy[1] + bias_rad[1], rpy[2], true.position_m)
    in_body = rotation_from_rpy(rpy[0], rpy[1], 0.0).T @ e_m

    def measured(attitude: VehicleState) -> tuple[Array, Array]:
        level = rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, 0.0) @ in_body
        pose = MarkerPose(
            "joint", 0.0, np.zeros(3), np.zeros(3), level, 0.2, np.ones(3), 1.0, 0.0,
            level_frame_xyz_yaw_cov=1e-6 * np.eye(4),
        )  # fmt: skip
        found = make_track_measurement(pose, attitude, in_world, constants, setup.pose_setup)
        return found.z, found.yaw_xyz_shift_per_bias_sigma[:, ROLL_PITCH_BIAS_COLUMNS]

    (z, tilt), (moved, _) = measured(true), measured(wrong)
    expected = tilt @ np.array(bias_rad) / math.radians(0.3)
    # To first order in the bias, and as if roll turned about the level axis.
    turned = float(np.linalg.norm(bias_rad))
    assert (
        np.abs((moved - z) - expected).max() <= 0.1 * turned * (np.linalg.norm(e_m) + 0.05) + 1e-12
    )


def test_filterpy_is_loaded_with_the_setup_so_that_no_frame_waits_for_it() -> None:
    code = (
        "import sys; from perchctl.profile import KalmanConfig\n"
        "from perchctl.vision.filter import make_filter_setup\n"
        "before = 'filterpy' in sys.modules; make_filter_setup(KalmanConfig())\n"
        "print(before, 'filterpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
