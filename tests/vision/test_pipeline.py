"""From pictures of a flight to the target, and where the next picture should show it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from perchctl.geometry import (
    R_MARKER_TARGET,
    Array,
    invert_T,
    make_T,
    rot_z,
    rotation_from_rpy,
    wrap_rad,
)
from perchctl.profile import (
    CameraConfig,
    KalmanConfig,
    MarkerConfig,
    MergeConfig,
    Mounting,
    PoseConfig,
    TargetConfig,
)
from perchctl.vision import (
    Frame,
    MarkerPose,
    Pipeline,
    PipelineOutput,
    PipelineState,
    PoseSetup,
    VehicleState,
    estimate,
    step,
)
from perchctl.vision.tracks import predict_corners, update_last_pose
from perchctl.vision.types import LastAcceptedPose, VisibleMarkers
from tests.helpers.target_picture import CAMERA, pose_of, render

Build = Callable[..., Pipeline]
MOUNT = Mounting(position_m=(0.02, 0.0, 0.01), rpy_deg=(1.7, -1.1, 23.0))
GEAR = np.array([0.0, 0.0, 0.03])
TARGET = np.array([0.4, -0.2, 2.0])
TARGET_YAW = 2.5
EMPTY: NDArray[np.uint8] = np.full((480, 640), 120, np.uint8)


def view(attitude: VehicleState) -> NDArray[np.uint8]:
    """What the mounted camera sees of the target in the world."""
    R = rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    T_world_cam = make_T(R, np.array(attitude.position_m)) @ MOUNT.T_body_cam
    T = invert_T(T_world_cam) @ make_T(rot_z(TARGET_YAW) @ R_MARKER_TARGET, TARGET)
    return render(np.asarray(cv2.Rodrigues(T[:3, :3])[0], dtype=float).ravel(), T[:3, 3])


def true_e(attitude: VehicleState) -> tuple[Array, float]:
    R = rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    gear = np.array(attitude.position_m) + R @ GEAR
    return rot_z(-attitude.yaw_rad) @ (TARGET - gear), wrap_rad(TARGET_YAW - attitude.yaw_rad)


def fly(k: int) -> VehicleState:
    """A vehicle that drifts, climbs, sways and turns: frame k at 30 Hz."""
    t = k / 30.0
    return VehicleState(
        t,
        0.05 * math.sin(3 * t),
        0.04 * math.cos(2 * t),
        0.8 + 0.5 * t,
        (0.35 + 0.1 * t, -0.15 - 0.08 * t, 1.4 + 0.1 * t),
    )


def run(
    setup: Pipeline, frames: int, lost: Callable[[int], bool] = lambda k: False, blind: bool = False
) -> list[PipelineOutput]:
    state, outputs = PipelineState(), []
    for k in range(frames):
        attitude = fly(k)
        image = EMPTY if lost(k) else view(attitude)
        frame = Frame(k, attitude.t_s, image)
        state, output = step(state, frame, None if blind else attitude, setup)
        outputs.append(output)
    return outputs


@pytest.mark.parametrize(
    ("frame", "method"),
    [
        ("world", "joint"),
        pytest.param("world", "weights", marks=pytest.mark.long),
        pytest.param("level", "joint", marks=pytest.mark.long),
        ("level", "weights"),
    ],
)
def test_a_flight_past_the_target_is_measured(build: Build, method: str, frame: str) -> None:
    setup = build(
        kalman=KalmanConfig(frame=frame),
        merge=MergeConfig(method=method),
        mount=MOUNT,
        gear_body_m=GEAR,
    )
    outputs = run(setup, 12)
    # A constant-velocity filter of a turning frame lags; the world's target stands still.
    limit_m, limit_rad = (0.002, 0.01) if frame == "world" else (0.012, 0.03)
    for k, output in enumerate(outputs):
        e, yaw = true_e(fly(k))
        assert output.target.is_measured_in_newest_frame
        assert output.target.stage is VisibleMarkers.BOTH
        assert np.abs(output.target.e_m - e).max() < limit_m
        assert abs(wrap_rad(output.target.e_yaw_rad - yaw)) < limit_rad
        assert np.abs(output.target.world_m - TARGET).max() < limit_m
        assert abs(wrap_rad(output.target.world_yaw_rad - TARGET_YAW)) < limit_rad
        assert (output.target.world_velocity_mps is not None) == (frame == "world")
        for pose in output.poses.values():
            assert np.abs(pose.e_m - e).max() < 0.01
        expected = {"joint"} if method == "joint" else {"large", "small"}
        assert set(output.poses) == expected


@pytest.mark.parametrize("method", ["joint", "weights"])
def test_while_unseen_the_target_coasts_in_the_world_and_is_then_given_up(
    build: Build, method: str
) -> None:
    setup = build(merge=MergeConfig(method=method), mount=MOUNT, gear_body_m=GEAR)
    n_max = setup.kalman.n_max
    outputs = run(setup, 4 + n_max + 3, lost=lambda k: k >= 4)
    for n in range(1, n_max + 1):
        target = outputs[3 + n].target
        assert not target.is_measured_in_newest_frame
        assert target.unseen_frames == n
        assert target.stage is VisibleMarkers.NONE
        e, yaw = true_e(fly(3 + n))  # the vehicle flies on: e follows
        assert np.abs(target.e_m - e).max() < 0.01
        assert abs(wrap_rad(target.e_yaw_rad - yaw)) < 0.02
        assert outputs[3 + n].stage is VisibleMarkers.NONE
        assert (target.sigma_m > outputs[3].target.sigma_m).all()
    assert all(output.target is None for output in outputs[4 + n_max :])


@pytest.mark.parametrize(
    ("seen", "stage"),
    [
        (("large",), VisibleMarkers.LARGE),
        (("small",), VisibleMarkers.SMALL),
        (("large", "small"), VisibleMarkers.BOTH),
    ],
)
@pytest.mark.parametrize("method", ["joint", "weights"])
def test_any_one_marker_feeds_the_target(
    build: Build, seen: tuple[str, ...], stage: VisibleMarkers, method: str
) -> None:
    setup = build(merge=MergeConfig(method=method))
    image = render(*pose_of(0.01, 0.02, 0.22, 0.2), markers=seen)
    _, output = step(PipelineState(), Frame(0, 0.0, image), None, setup)
    assert output.stage is stage
    assert output.target.stage is stage
    assert np.abs(output.target.e_m - [0.01, 0.02, 0.22]).max() < 0.001


@pytest.mark.parametrize(
    ("z_m", "stage"),
    [(0.30, VisibleMarkers.LARGE), (0.22, VisibleMarkers.BOTH), (0.17, VisibleMarkers.SMALL)],
)
@pytest.mark.parametrize("method", ["joint", "weights"])
def test_stages_by_range(build: Build, z_m: float, stage: VisibleMarkers, method: str) -> None:
    merge = MergeConfig(method=method, stages="range", z3_m=0.18)
    # z counts from the camera: the gear above it must not matter
    setup = build(merge=merge, gear_body_m=(0.0, 0.0, 0.05))
    image = render(*pose_of(0.0, 0.0, z_m))
    _, output = step(PipelineState(), Frame(0, 0.0, image), None, setup)
    assert output.stage is VisibleMarkers.BOTH
    assert output.target.stage is stage


@pytest.mark.parametrize("method", ["joint", "weights"])
def test_markers_that_contradict_are_counted_and_the_better_is_used(
    build: Build, method: str
) -> None:
    wrong = TargetConfig(small=MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=5, side_m=0.030))
    setup = build(merge=MergeConfig(method=method), target=wrong)
    state = PipelineState()
    for k in range(3):
        image = render(*pose_of(0.0, 0.0, 0.24))
        state, output = step(state, Frame(k, k / 30, image), None, setup)
        assert output.successive_frames_with_contradicting_markers == k + 1
        assert output.target.e_m[2] == pytest.approx(0.24, abs=0.001)
        assert output.target.stage is VisibleMarkers.LARGE


@given(
    angles=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-3.0, 3.0)),
    position_m=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    later_s=st.floats(0.0, 0.1),
)
@settings(max_examples=15, deadline=None)
def test_the_estimate_follows_the_vehicle(
    build: Build,
    angles: tuple[float, float, float],
    position_m: tuple[float, float, float],
    later_s: float,
) -> None:
    """The target stays in the world, wherever the vehicle is at the moment of asking."""
    setup, attitude = build(mount=MOUNT, gear_body_m=GEAR), fly(0)
    state, _ = step(PipelineState(), Frame(0, attitude.t_s, view(attitude)), attitude, setup)
    now = VehicleState(attitude.t_s + later_s, *angles, position_m)
    target = estimate(state, now.t_s, now, setup)
    assert target.world_m is not None
    e_m, e_yaw_rad = true_e(now)
    assert np.abs(target.e_m - e_m).max() < 0.003
    assert abs(wrap_rad(target.e_yaw_rad - e_yaw_rad)) < 0.01
    assert target.t_s == now.t_s
    assert target.last_measured_at_s == attitude.t_s


@pytest.mark.parametrize("frame", ["world", "level"])
def test_a_lost_target_is_remembered_in_the_world(build: Build, frame: str) -> None:
    setup = build(kalman=KalmanConfig(frame=frame), mount=MOUNT, gear_body_m=GEAR)
    state, last = PipelineState(), fly(3)
    for k in range(4 + setup.kalman.n_max + 2):
        attitude = fly(k)
        image = view(attitude) if k < 4 else EMPTY
        state, output = step(state, Frame(k, attitude.t_s, image), attitude, setup)
    assert output.target is None
    target = estimate(state, attitude.t_s + 5.0, attitude, setup)
    assert (target.tracked, target.is_measured_in_newest_frame) == (False, False)
    assert target.last_measured_at_s == last.t_s
    assert target.stage is VisibleMarkers.NONE
    limit_m = 0.01 if frame == "world" else 0.15  # level: the vehicle's own way while it coasts
    assert np.abs(target.e_m - true_e(attitude)[0]).max() < limit_m


def test_a_stream_without_the_target_is_looked_at_thoroughly_every_nth_frame(build: Build) -> None:
    """What only the thorough look finds: a target run together by blur."""
    sharp = render(*pose_of(0.1, 0.05, 2.3, 0.4)).astype(np.float32)
    hidden = np.clip(np.rint(cv2.GaussianBlur(sharp, (0, 0), 3.0)), 0, 255).astype(np.uint8)
    setup = build()
    _, first = step(PipelineState(), Frame(7, 0.0, hidden), None, setup)
    assert first.detections.large is not None
    state, found = PipelineState(), []
    for k in range(5):
        state, output = step(state, Frame(k, k / 30, EMPTY if k == 0 else hidden), None, setup)
        found.append(output.detections.large is not None)
    assert found == [False, False, False, False, True]
    assert state.successive_frames_without_markers == 0


def test_the_vehicles_motion_predicts_the_corners(build: Build) -> None:
    setup = build(mount=MOUNT, gear_body_m=GEAR)
    then, now = fly(0), fly(6)  # far, and turned, within one gap
    _, output = step(PipelineState(), Frame(0, then.t_s, view(then)), then, setup)
    sight = LastAcceptedPose(output.poses["joint"], then)
    expected, near = predict_corners(sight, now.t_s, now, setup.pose_setup)
    _, later = step(PipelineState(), Frame(1, now.t_s, view(now)), now, setup)
    for name in ("large", "small"):
        seen = later.detections.get(name)
        assert np.abs(expected[name] - seen.corners_px).max() < 1.0
    assert np.allclose(near.tvec_m, later.poses["joint"].tvec_m, atol=0.002)
    corners, unmoved = predict_corners(sight, now.t_s, None, setup.pose_setup)
    assert corners is None
    assert np.array_equal(unmoved.tvec_m, sight.pose.tvec_m)
    assert np.array_equal(unmoved.rvec_rad, sight.pose.rvec_rad)
    assert predict_corners(None, now.t_s, now, setup.pose_setup) == (None, None)
    assert predict_corners(sight, then.t_s + 5.0, now, setup.pose_setup) == (None, None)


# --- Which of the vehicle's two accounts of its way tells where the target goes is learned -----


SETUP = PoseSetup(
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

    def at(self, t_s: float) -> tuple[VehicleState, MarkerPose]:
        phase = 2.0 * t_s
        true_m = np.array([0.03 * math.sin(phase), 0.02 * math.cos(phase), 1.8])
        speed_mps = np.array([0.06 * math.cos(phase), -0.04 * math.sin(phase), 0.0])
        roll, pitch = 0.04 * math.sin(3.0 * t_s), 0.03 * math.cos(3.0 * t_s)
        x, y, z = true_m + self.jump_m + self._rng.normal(0.0, self._place_m, 3)
        vx, vy, vz = speed_mps + self._rng.normal(0.0, self._speed_mps, 3)
        attitude = VehicleState(t_s, roll, pitch, 0.3, (x, y, z), (vx, vy, vz))
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
    sight: LastAcceptedPose | None = None
    for k in range(frames):
        attitude, pose = flight.at(k * FRAME_S)
        if not told:
            attitude = replace(attitude, velocity_mps=None)
        if sight is not None:
            expected, _ = predict_corners(sight, pose.t_s, attitude, SETUP)
            points = SETUP.marker_corners_m["large"]
            true = cv2.projectPoints(points, pose.rvec_rad, pose.tvec_m, CAMERA.K, CAMERA.dist)[0]
            yield float(np.abs(expected["large"] - true.reshape(4, 2)).max())
        sight = update_last_pose(sight, pose, attitude, SETUP)


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@settings(max_examples=12, deadline=None, derandomize=True)
@given(st.integers(0, 2**31))
def test_places_that_step_are_overruled_by_speeds(seed: int) -> None:
    """2 mm of steps are 5 px at 0.2 m."""
    both = list(errors_px(Flight(seed, 2e-3, 5e-3), 90))[LEARNED:]
    places = list(errors_px(Flight(seed, 2e-3, 5e-3), 90, told=False))[LEARNED:]
    assert rms(both) < 0.4 * rms(places)


def test_a_jump_of_the_estimates_world_spoils_one_picture() -> None:
    """The vehicle has not moved: what follows is expected where it is."""
    flight = Flight(1, 1e-4, 5e-3)
    found = []
    for k, reprojection_error_px in enumerate(errors_px(flight, 60)):
        found.append(reprojection_error_px)
        if k == 40:
            flight.jump_m = np.array([0.1, 0.0, 0.0])
    assert found[41] > 20.0
    assert max(found[43:]) < 3.0
