from __future__ import annotations

import math
from collections.abc import Callable
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
    DetectorConfig,
    KalmanConfig,
    MarkerConfig,
    MergeConfig,
    Mounting,
    PoseConfig,
    TargetConfig,
)
from perchctl.vision import (
    Attitude,
    Frame,
    Pipeline,
    PipelineOutput,
    PipelineState,
    Stage,
    estimate,
    estimate_pose,
    step,
)
from perchctl.vision.pose import PoseCandidate
from perchctl.vision.tracks import expected_corners
from perchctl.vision.types import Sighting
from tests.helpers.target_picture import pose_of, render

Build = Callable[..., Pipeline]
MOUNT = Mounting(position_m=(0.02, 0.0, 0.01), rpy_deg=(1.7, -1.1, 23.0))
GEAR = np.array([0.0, 0.0, 0.03])
TARGET = np.array([0.4, -0.2, 2.0])
TARGET_YAW = 2.5
EMPTY: NDArray[np.uint8] = np.full((480, 640), 120, np.uint8)


def view(attitude: Attitude) -> NDArray[np.uint8]:
    """What the mounted camera sees of the target in the world."""
    R = rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    T_world_cam = make_T(R, np.array(attitude.position_m)) @ MOUNT.T_body_cam
    T = invert_T(T_world_cam) @ make_T(rot_z(TARGET_YAW) @ R_MARKER_TARGET, TARGET)
    return render(np.asarray(cv2.Rodrigues(T[:3, :3])[0], dtype=float).ravel(), T[:3, 3])


def true_e(attitude: Attitude) -> tuple[Array, float]:
    R = rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    gear = np.array(attitude.position_m) + R @ GEAR
    return rot_z(-attitude.yaw_rad) @ (TARGET - gear), wrap_rad(TARGET_YAW - attitude.yaw_rad)


def fly(k: int) -> Attitude:
    """A vehicle that drifts, climbs, sways and turns: frame k at 30 Hz."""
    t = k / 30.0
    return Attitude(
        t,
        0.05 * math.sin(3 * t),
        0.04 * math.cos(2 * t),
        0.8 + 0.5 * t,
        (0.35 + 0.1 * t, -0.15 - 0.08 * t, 1.4 + 0.1 * t),
    )


def run(
    setup: Pipeline,
    frames: int,
    lost: Callable[[int], bool] = lambda k: False,
    blind: bool = False,
) -> list[PipelineOutput]:
    state, outputs = PipelineState(), []
    for k in range(frames):
        attitude = fly(k)
        image = EMPTY if lost(k) else view(attitude)
        frame = Frame(k, attitude.t_s, image)
        state, output = step(state, frame, None if blind else attitude, setup)
        outputs.append(output)
    return outputs


@pytest.mark.parametrize("method", ["joint", "weights"])
@pytest.mark.parametrize("frame", ["world", "level"])
def test_a_flight_past_the_target_is_measured(build: Build, method: str, frame: str) -> None:
    setup = build(
        kalman=KalmanConfig(frame=frame),  # type: ignore[arg-type]
        merge=MergeConfig(method=method),  # type: ignore[arg-type]
        mount=MOUNT,
        gear_body_m=GEAR,
    )
    outputs = run(setup, 12)
    # A constant-velocity filter of a turning frame lags; the world's target stands still.
    limit_m, limit_rad = (0.002, 0.01) if frame == "world" else (0.012, 0.03)
    for k, output in enumerate(outputs):
        e, yaw = true_e(fly(k))
        assert output.target is not None
        assert output.target.measured
        assert output.target.stage is Stage.BOTH
        assert np.abs(output.target.e_m - e).max() < limit_m
        assert abs(wrap_rad(output.target.e_yaw_rad - yaw)) < limit_rad
        assert output.target.world_m is not None
        assert np.abs(output.target.world_m - TARGET).max() < limit_m
        assert output.target.world_yaw_rad is not None
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
    setup = build(merge=MergeConfig(method=method), mount=MOUNT, gear_body_m=GEAR)  # type: ignore[arg-type]
    n_max = setup.kalman.n_max
    outputs = run(setup, 4 + n_max + 3, lost=lambda k: k >= 4)
    for n in range(1, n_max + 1):
        target = outputs[3 + n].target
        assert target is not None
        assert not target.measured
        assert target.unseen == n
        assert target.stage is Stage.NONE
        e, yaw = true_e(fly(3 + n))  # the vehicle flies on: e follows
        assert np.abs(target.e_m - e).max() < 0.01
        assert abs(wrap_rad(target.e_yaw_rad - yaw)) < 0.02
        assert outputs[3 + n].stage is Stage.NONE
        assert (target.sigma_m > outputs[3].target.sigma_m).all()  # type: ignore[union-attr]
    assert all(output.target is None for output in outputs[4 + n_max :])


def test_nothing_seen_is_no_target(build: Build) -> None:
    state, output = step(PipelineState(), Frame(0, 0.0, EMPTY), None, build())
    assert output.target is None
    assert output.poses == {}
    assert state.tracks == {}
    assert output.stage is Stage.NONE


def test_without_an_attitude_the_camera_counts_as_level(build: Build) -> None:
    setup = build(mount=MOUNT, gear_body_m=GEAR)
    rvec, tvec = pose_of(0.03, 0.02, 0.5, 0.3)
    state, output = step(PipelineState(), Frame(0, 0.0, render(rvec, tvec)), None, setup)
    assert output.target is not None
    T = MOUNT.T_body_cam
    expected = T[:3, :3] @ tvec + T[:3, 3] - GEAR
    assert np.abs(output.target.e_m - expected).max() < 0.001
    assert output.target.world_m is None
    assert not state.in_world


def test_tracks_do_not_mix_frames_when_the_attitude_comes_and_goes(build: Build) -> None:
    setup = build(mount=MOUNT, gear_body_m=GEAR)
    state = PipelineState()
    for k, known in enumerate([True, True, False, False, True]):
        attitude = fly(k)
        frame = Frame(k, attitude.t_s, view(attitude))
        state, output = step(state, frame, attitude if known else None, setup)
        assert state.in_world is known
        assert output.target is not None
        assert output.target.measured
        if known:
            assert np.abs(output.target.e_m - true_e(attitude)[0]).max() < 0.002


def test_the_same_frame_again_changes_no_track(build: Build) -> None:
    setup = build()
    frame = Frame(0, 0.0, render(*pose_of(0.0, 0.0, 0.4)))
    state, first = step(PipelineState(), frame, None, setup)
    again, second = step(state, Frame(1, -0.01, frame.image), None, setup)
    assert again.tracks["joint"] is state.tracks["joint"]
    assert first.target is not None
    assert first.target.measured
    assert second.target is not None
    assert not second.target.measured


def test_the_same_frames_give_the_same_bytes(build: Build) -> None:
    def bytes_of(output: PipelineOutput) -> bytes:
        assert output.target is not None
        return output.target.e_m.tobytes() + output.target.velocity_mps.tobytes()

    first = [bytes_of(o) for o in run(build(), 5)]
    setup = build()
    assert [bytes_of(o) for o in run(setup, 5)] == first
    assert [bytes_of(o) for o in run(setup, 5)] == first  # a used setup holds no memory


@pytest.mark.parametrize(
    ("seen", "stage"),
    [(("large",), Stage.LARGE), (("small",), Stage.SMALL), (("large", "small"), Stage.BOTH)],
)
@pytest.mark.parametrize("method", ["joint", "weights"])
def test_any_one_marker_feeds_the_target(
    build: Build, seen: tuple[str, ...], stage: Stage, method: str
) -> None:
    setup = build(merge=MergeConfig(method=method))  # type: ignore[arg-type]
    image = render(*pose_of(0.01, 0.02, 0.22, 0.2), markers=seen)
    _, output = step(PipelineState(), Frame(0, 0.0, image), None, setup)
    assert output.stage is stage
    assert output.target is not None
    assert output.target.stage is stage
    assert np.abs(output.target.e_m - [0.01, 0.02, 0.22]).max() < 0.001


def test_the_joint_track_goes_on_from_marker_to_marker(build: Build) -> None:
    setup, state = build(), PipelineState()
    for k, seen in enumerate([("large",), ("large", "small"), ("small",), ("small",)]):
        image = render(*pose_of(0.0, 0.0, 0.22), markers=seen)
        state, output = step(state, Frame(k, k / 30, image), None, setup)
        assert set(state.tracks) == {"joint"}
        assert output.target is not None
        assert output.target.unseen == 0
        assert np.abs(output.target.e_m - [0.0, 0.0, 0.22]).max() < 0.001


def test_a_marker_that_is_unseen_coasts_while_the_other_is_used(build: Build) -> None:
    setup, state = build(merge=MergeConfig(method="weights")), PipelineState()
    for k, seen in enumerate([("large", "small"), ("large",), ("large",)]):
        image = render(*pose_of(0.0, 0.0, 0.22), markers=seen)
        state, output = step(state, Frame(k, k / 30, image), None, setup)
    assert state.tracks["small"].unseen == 2
    assert state.tracks["large"].unseen == 0
    assert output.target is not None
    assert output.target.measured
    assert output.target.stage is Stage.LARGE


@pytest.mark.parametrize(
    ("z_m", "stage"), [(0.30, Stage.LARGE), (0.22, Stage.BOTH), (0.17, Stage.SMALL)]
)
@pytest.mark.parametrize("method", ["joint", "weights"])
def test_stages_by_range(build: Build, z_m: float, stage: Stage, method: str) -> None:
    merge = MergeConfig(method=method, stages="range", z3_m=0.18)  # type: ignore[arg-type]
    # z counts from the camera: the gear above it must not matter
    setup = build(merge=merge, gear_body_m=(0.0, 0.0, 0.05))
    image = render(*pose_of(0.0, 0.0, z_m))
    _, output = step(PipelineState(), Frame(0, 0.0, image), None, setup)
    assert output.stage is Stage.BOTH
    assert output.target is not None
    assert output.target.stage is stage


@pytest.mark.parametrize("method", ["joint", "weights"])
def test_markers_that_contradict_are_counted_and_the_better_is_used(
    build: Build, method: str
) -> None:
    wrong = TargetConfig(small=MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=5, side_m=0.030))
    setup = build(merge=MergeConfig(method=method), target=wrong)  # type: ignore[arg-type]
    state = PipelineState()
    for k in range(3):
        image = render(*pose_of(0.0, 0.0, 0.24))
        state, output = step(state, Frame(k, k / 30, image), None, setup)
        assert output.disagreeing_frames == k + 1
        assert output.target is not None
        assert output.target.e_m[2] == pytest.approx(0.24, abs=0.001)
        assert output.target.stage is Stage.LARGE


def test_a_wild_step_in_time_starts_the_tracks_afresh(build: Build) -> None:
    setup = build()
    image = render(*pose_of(0.0, 0.0, 0.4))
    state, _ = step(PipelineState(), Frame(0, 0.0, image), None, setup)
    moved = render(*pose_of(0.1, 0.0, 0.5))
    state, output = step(state, Frame(1, 30.0, moved), None, setup)
    assert output.target is not None
    assert np.abs(output.target.e_m - [0.1, 0.0, 0.5]).max() < 0.002
    assert np.allclose(output.target.velocity_mps, 0.0)


def test_velocity_is_in_level_axes(build: Build) -> None:
    """A target carried through the world along x, seen by a vehicle that faces y."""
    setup, state = build(kalman=KalmanConfig(k1=0.001, k2=1.0)), PipelineState()
    for k in range(12):
        attitude = Attitude(k / 30, 0.0, 0.0, math.pi / 2, (0.0, 0.0, 1.0))
        e = rot_z(-math.pi / 2) @ np.array([0.3 * k / 30, 0.0, 0.5])
        image = render(*pose_of(*e))
        state, output = step(state, Frame(k, k / 30, image), attitude, setup)
    assert output.target is not None
    assert output.target.world_velocity_mps is not None
    assert output.target.world_velocity_mps[0] > 0.08
    assert np.abs(output.target.world_velocity_mps[1:]).max() < 0.01
    assert output.target.velocity_mps[1] == pytest.approx(-output.target.world_velocity_mps[0])
    assert np.abs(output.target.velocity_mps[[0, 2]]).max() < 0.01


def test_a_joint_pose_that_fits_is_enough(build: Build) -> None:
    setup = build(mount=MOUNT, gear_body_m=GEAR)
    attitude = fly(0)
    _, output = step(PipelineState(), Frame(0, attitude.t_s, view(attitude)), attitude, setup)
    assert list(output.poses) == ["joint"]


def test_single_poses_are_those_solved_for_themselves(build: Build) -> None:
    setup = build(mount=MOUNT, gear_body_m=GEAR, pose=PoseConfig(each_marker=True))
    attitude = fly(0)
    _, output = step(PipelineState(), Frame(0, attitude.t_s, view(attitude)), attitude, setup)
    joint = output.poses["joint"]
    start = PoseCandidate(joint.rvec_rad, joint.tvec_m)
    for name in ("large", "small"):
        detection = output.detections.get(name)  # type: ignore[arg-type]
        assert detection is not None
        alone = estimate_pose([detection], attitude.t_s, attitude, setup.pose, None, start)
        assert alone is not None
        assert np.array_equal(output.poses[name].e_m, alone.e_m)
    assert list(output.poses) == ["joint", "large", "small"]
    assert output.poses["joint"] is joint


@pytest.mark.parametrize("frame", ["world", "level"])
def test_the_estimate_at_the_frame_is_the_frames(build: Build, frame: str) -> None:
    setup = build(kalman=KalmanConfig(frame=frame), mount=MOUNT, gear_body_m=GEAR)  # type: ignore[arg-type]
    state = PipelineState()
    for k in range(4):
        attitude = fly(k)
        state, output = step(state, Frame(k, attitude.t_s, view(attitude)), attitude, setup)
        assert output.target is not None
        target = estimate(state, attitude.t_s, attitude, setup)
        assert target is not None
        assert np.allclose(target.e_m, output.target.e_m, atol=1e-12)
        assert target.e_yaw_rad == pytest.approx(output.target.e_yaw_rad)
        assert (target.measured, target.tracked, target.unseen) == (True, True, 0)


@given(
    angles=st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-3.0, 3.0)),
    position_m=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    later_s=st.floats(0.0, 0.1),
)
@settings(max_examples=30, deadline=None)
def test_the_estimate_follows_the_vehicle(
    build: Build,
    angles: tuple[float, float, float],
    position_m: tuple[float, float, float],
    later_s: float,
) -> None:
    """The target stays in the world, wherever the vehicle is at the moment of asking."""
    setup, attitude = build(mount=MOUNT, gear_body_m=GEAR), fly(0)
    state, _ = step(PipelineState(), Frame(0, attitude.t_s, view(attitude)), attitude, setup)
    now = Attitude(attitude.t_s + later_s, *angles, position_m)
    target = estimate(state, now.t_s, now, setup)
    assert target is not None
    assert target.world_m is not None
    e_m, e_yaw_rad = true_e(now)
    assert np.abs(target.e_m - e_m).max() < 0.003
    assert abs(wrap_rad(target.e_yaw_rad - e_yaw_rad)) < 0.01
    assert target.t_s == now.t_s
    assert target.measured_s == attitude.t_s


@pytest.mark.parametrize("frame", ["world", "level"])
def test_a_lost_target_is_remembered_in_the_world(build: Build, frame: str) -> None:
    setup = build(kalman=KalmanConfig(frame=frame), mount=MOUNT, gear_body_m=GEAR)  # type: ignore[arg-type]
    state, last = PipelineState(), fly(3)
    for k in range(4 + setup.kalman.n_max + 2):
        attitude = fly(k)
        image = view(attitude) if k < 4 else EMPTY
        state, output = step(state, Frame(k, attitude.t_s, image), attitude, setup)
    assert output.target is None
    target = estimate(state, attitude.t_s + 5.0, attitude, setup)
    assert target is not None
    assert (target.tracked, target.measured) == (False, False)
    assert target.measured_s == last.t_s
    assert target.stage is Stage.NONE
    limit_m = 0.01 if frame == "world" else 0.15  # level: the vehicle's own way while it coasts
    assert np.abs(target.e_m - true_e(attitude)[0]).max() < limit_m


def test_nothing_seen_is_no_estimate(build: Build) -> None:
    setup = build()
    state, _ = step(PipelineState(), Frame(0, 0.0, EMPTY), None, setup)
    assert estimate(state, 0.1, fly(0), setup) is None


def test_the_vehicles_motion_predicts_the_corners(build: Build) -> None:
    setup = build(mount=MOUNT, gear_body_m=GEAR)
    then, now = fly(0), fly(6)  # far, and turned, within one gap
    _, output = step(PipelineState(), Frame(0, then.t_s, view(then)), then, setup)
    sight = Sighting(output.poses["joint"], then)
    expected, near = expected_corners(sight, now.t_s, now, setup.pose)
    assert expected is not None
    assert near is not None
    _, later = step(PipelineState(), Frame(1, now.t_s, view(now)), now, setup)
    for name in ("large", "small"):
        seen = later.detections.get(name)  # type: ignore[arg-type]
        assert seen is not None
        assert np.abs(expected[name] - seen.corners_px).max() < 1.0  # type: ignore[index]
    assert np.allclose(near.tvec, later.poses["joint"].tvec_m, atol=0.002)
    corners, unmoved = expected_corners(sight, now.t_s, None, setup.pose)
    assert corners is None
    assert unmoved is not None
    assert np.array_equal(unmoved.tvec, sight.pose.tvec_m)
    assert np.array_equal(unmoved.rvec, sight.pose.rvec_rad)
    assert expected_corners(None, now.t_s, now, setup.pose) == (None, None)
    assert expected_corners(sight, then.t_s + 5.0, now, setup.pose) == (None, None)


@pytest.mark.parametrize("method", ["joint", "weights"])
def test_measured_noise_follows_the_pose_and_fixed_noise_does_not(
    build: Build, method: str
) -> None:
    """Near, the measurement is worth more than k1 says: the filter's spread shows it."""

    def sigma(noise: str, z_m: float) -> Array:
        kalman = KalmanConfig(noise=noise, attitude_sigma_deg=0.2)  # type: ignore[arg-type]
        setup = build(kalman=kalman, merge=MergeConfig(method=method))  # type: ignore[arg-type]
        state = PipelineState()
        attitude = Attitude(0.0, 0.0, 0.0, 0.0)
        for k in range(4):
            frame = Frame(k, k / 30, render(*pose_of(0.0, 0.0, z_m), noise=3.0, seed=k))
            state, output = step(state, frame, replace(attitude, t_s=k / 30), setup)
        assert output.target is not None
        assert np.abs(output.target.e_m - [0.0, 0.0, z_m]).max() < 0.004
        return output.target.sigma_m

    assert sigma("measured", 0.24)[0] < 0.8 * sigma("measured", 0.7)[0]
    assert np.allclose(sigma("fixed", 0.24), sigma("fixed", 0.7), rtol=0.01)


def test_a_stream_without_the_target_is_looked_at_thoroughly_every_nth_frame(build: Build) -> None:
    """What only the thorough look finds: a target run together by blur."""
    sharp = render(*pose_of(0.1, 0.05, 2.3, 0.4)).astype(np.float32)
    hidden = np.clip(np.rint(cv2.GaussianBlur(sharp, (0, 0), 3.0)), 0, 255).astype(np.uint8)
    setup = build(detector=DetectorConfig(blurred_every=3))
    _, first = step(PipelineState(), Frame(7, 0.0, hidden), None, setup)
    assert first.detections.large is not None
    state, found = PipelineState(), []
    for k in range(4):
        state, output = step(state, Frame(k, k / 30, EMPTY if k == 0 else hidden), None, setup)
        found.append(output.detections.large is not None)
    assert found == [False, False, False, True]
    assert state.empty_frames == 0
