"""From corners to a pose: solved, with an honest spread, and for a print that is not as planned."""

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
from perchctl.profile import KalmanConfig, PoseConfig, TargetConfig
from perchctl.sim.renderer import add_analogue_faults
from perchctl.vision import (
    Frame,
    MarkerPose,
    Pipeline,
    PipelineState,
    PoseSetup,
    VehicleState,
    estimate_pose,
    project,
    square_corners,
    step,
)
from perchctl.vision.filter import PRINT_SIZE_CURL_BIAS_COLUMNS, make_filter_setup
from perchctl.vision.merge import are_marker_positions_inconsistent
from perchctl.vision.pose import target_normal_cam
from perchctl.vision.target_selection import make_track_measurement
from perchctl.vision.types import Detection
from tests.helpers.target_picture import CAMERA, pose_of, render

SIDES = {"large": 0.150, "small": 0.025}
MOUNT = make_T(rotation_from_rpy(0.05, -0.03, 1.2), (0.02, -0.01, 0.015))
GEAR = np.array([0.004, -0.003, 0.03])


def setup_with(mount: Array | None = None, gear: Array | None = None, **config) -> PoseSetup:
    return PoseSetup(
        PoseConfig(**config),
        TargetConfig(size_sigma=0.0, curl_per_m=0.0),
        np.eye(4) if mount is None else mount,
        np.zeros(3) if gear is None else gear,
        CAMERA,
    )


PLAIN = setup_with()


def marker(
    name: str,
    rvec: Array,
    tvec: Array,
    noise_px: float = 0.0,
    rng: np.random.Generator | None = None,
    sigma_px: float = 0.02,
    fits_lines: bool = False,
) -> Detection:
    """Corners that err on their own, or as intersections of lines that do."""
    corners = project(square_corners(SIDES[name]), rvec, tvec, CAMERA)
    if rng is not None and fits_lines:
        corners = corners + line_errors(corners, noise_px, rng)
    elif rng is not None:
        corners = corners + rng.normal(0.0, noise_px, corners.shape)
    return Detection(name, corners, sigma_px, fits_lines)


def line_errors(corners: Array, noise_px: float, rng: np.random.Generator) -> Array:
    """What corners (4, 2) move by where each side errs by offset and tilt, as a line fitted
    to many points does: `noise_px` at its ends."""
    side = np.roll(corners, -1, axis=0) - corners
    normal = np.stack([side[:, 1], -side[:, 0]], axis=1) / np.linalg.norm(side, axis=1)[:, None]
    offset = rng.normal(0.0, noise_px / 2.0, 4)
    tilt = rng.normal(0.0, noise_px * math.sqrt(3.0) / 2.0, 4)
    moved = []
    for i in range(4):
        across = np.stack([normal[i - 1], normal[i]])
        moved.append(np.linalg.solve(across, [offset[i - 1] + tilt[i - 1], offset[i] - tilt[i]]))
    return np.array(moved)


def posed(
    detections: list[Detection], attitude: VehicleState | None = None, setup: PoseSetup = PLAIN
) -> MarkerPose:
    pose = estimate_pose(detections, 0.0, attitude, setup)
    assert pose is not None
    return pose


near = st.tuples(
    st.floats(-0.1, 0.1),
    st.floats(-0.1, 0.1),
    st.floats(0.3, 1.0),
    st.floats(-math.pi, math.pi),
    st.floats(-0.25, 0.25),
    st.floats(-0.25, 0.25),
)


@given(values=near)
@settings(max_examples=60, deadline=None)
def test_the_pose_is_the_one_that_was_shown(values: tuple) -> None:
    rvec, tvec = pose_of(*values)
    for seen in (["large"], ["large", "small"]):
        detections = [marker(name, rvec, tvec) for name in seen]
        pose = posed(detections, VehicleState(0.0, *values[4:], 0.0))
        assert np.allclose(pose.tvec_m, tvec, atol=2e-5)
        assert pose.source == ("joint" if len(seen) == 2 else "large")
        assert pose.rms_reprojection_px < 0.01
        R = cv2.Rodrigues(pose.rvec_rad)[0] @ cv2.Rodrigues(rvec)[0].T
        assert math.acos(min(1.0, (np.trace(R) - 1) / 2)) < 2e-3


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, math.pi, -math.pi / 4])
def test_exactly_frontal_views_are_solved(yaw: float) -> None:
    rvec, tvec = pose_of(0.0, 0.0, 0.24, yaw)
    for seen in (["large"], ["small"], ["large", "small"]):
        detections = [marker(name, rvec, tvec) for name in seen]
        pose = posed(detections)
        assert np.allclose(pose.e_m, tvec, atol=1e-4)
        assert abs(wrap_rad(pose.e_yaw_rad - yaw)) < 1e-3


@given(
    position=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.5, 1.2)),
    attitude=st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-math.pi, math.pi)),
    offset=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    target_yaw=st.floats(-math.pi, math.pi),
)
@settings(max_examples=60, deadline=None)
def test_e_is_the_target_relative_to_the_gear_in_the_level_frame(
    position, attitude, offset, target_yaw
) -> None:
    roll, pitch, yaw = attitude
    p = np.array(position)
    target = np.array([p[0] + offset[0], p[1] + offset[1], 1.7])
    T_world_body = make_T(rotation_from_rpy(roll, pitch, yaw), p)
    T_world_marker = make_T(rot_z(target_yaw) @ R_MARKER_TARGET, target)
    T_cam_marker = invert_T(T_world_body @ MOUNT) @ T_world_marker
    rvec = np.asarray(cv2.Rodrigues(T_cam_marker[:3, :3])[0], dtype=float).ravel()
    setup = setup_with(MOUNT, GEAR)
    seen = marker("large", rvec, T_cam_marker[:3, 3])
    pose = posed([seen], VehicleState(0.0, roll, pitch, yaw, position), setup)
    gear_world = (T_world_body @ np.array([*GEAR, 1.0]))[:3]
    expected = rot_z(-yaw) @ (target - gear_world)
    assert np.allclose(pose.e_m, expected, atol=1e-4)
    assert abs(wrap_rad(pose.e_yaw_rad - wrap_rad(target_yaw - yaw))) < 2e-3


def tilts_deg(attitude: bool, previous: bool, draws: int = 60) -> Array:
    """Angle between the true and the found normal of a small, far, tilted marker."""
    rng = np.random.default_rng(3)
    roll, pitch = -0.2, -0.2
    rvec, tvec = pose_of(0.02, -0.03, 0.9, 0.5, roll, pitch)
    true = cv2.Rodrigues(rvec)[0][:, 2]
    result = []
    for _ in range(draws):
        detection = marker("small", rvec, tvec, 0.1, rng, sigma_px=0.1)
        known = VehicleState(0.0, roll, pitch, 0.0) if attitude else None
        pose = estimate_pose([detection], 0.0, known, PLAIN, true if previous else None)
        result.append(math.degrees(math.acos(min(1.0, float(target_normal_cam(pose) @ true)))))
    return np.array(result)


def test_attitude_or_the_frame_before_decides_the_tilt() -> None:
    alone = tilts_deg(False, False)
    levelled = tilts_deg(True, False)
    guided = tilts_deg(False, True)
    assert (alone > 20.0).mean() > 0.2  # the flips are real
    assert (levelled > 20.0).mean() < 0.05
    assert (guided > 20.0).mean() < 0.05
    assert levelled.mean() < 0.7 * alone.mean()


@pytest.mark.parametrize(
    "seen", [pytest.param(["large"], marks=pytest.mark.long), ["large", "small"]]
)
def test_the_covariance_is_that_of_the_errors(seen: list[str]) -> None:
    """Mean squared error in units of the covariance: its degrees of freedom, within 20 %."""
    rng = np.random.default_rng(8)
    squares = []
    for k in range(400):
        values = (*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.25, 0.6), *rng.uniform(-0.2, 0.2, 3))
        rvec, tvec = pose_of(*values)
        attitude = VehicleState(0.0, float(values[4]), float(values[5]), 0.0)
        noise = 0.02 if k % 2 else 0.06
        detections = [marker(n, rvec, tvec, noise, rng, noise, True) for n in seen]
        pose = posed(detections, attitude)
        true = rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, 0.0) @ tvec
        error = np.append(pose.e_m - true, wrap_rad(pose.e_yaw_rad - values[3]))
        squares.append(error @ np.linalg.solve(pose.level_frame_xyz_yaw_cov, error))
    assert 0.8 < np.mean(squares) / 4.0 < 1.2


def test_a_covariance_that_rounding_has_spoilt_still_gives_a_pose() -> None:
    rvec, tvec = pose_of(0.0, 0.0, 0.1)
    spoilt = replace(marker("large", rvec, tvec), cov_px2=1e18 * np.ones((8, 8)) - np.eye(8))
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(spoilt.cov_px2)
    assert np.allclose(posed([spoilt]).e_m, tvec, atol=1e-4)


def test_corners_that_are_no_square_are_refused() -> None:
    rvec, tvec = pose_of(0.0, 0.0, 0.3)
    detection = marker("large", rvec, tvec)
    bent = detection.corners_px.copy()
    bent[0] += (25.0, -18.0)
    bent[2] += (30.0, 22.0)
    broken = Detection("large", bent[[0, 2, 1, 3]], 0.1, False)
    assert estimate_pose([broken], 0.0, None, PLAIN) is None
    shifted = Detection("small", marker("small", rvec, tvec).corners_px + 12.0, 0.02, True)
    assert estimate_pose([detection, shifted], 0.0, None, PLAIN) is None
    loose = setup_with(max_reprojection_px=50.0)
    assert estimate_pose([detection, shifted], 0.0, None, loose) is not None


@pytest.mark.parametrize(
    "corners",
    [
        np.full((4, 2), np.nan),
        np.full((4, 2), 100.0),
        np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [30.0, 0.0]]),
        np.array([[0.0, 0.0], [1e9, 0.0], [1e9, 1e9], [0.0, 1e9]]),
    ],
)
def test_useless_corners_give_no_pose_or_a_finite_one(corners: Array) -> None:
    detection = Detection("large", corners, 0.1, False)
    pose = estimate_pose([detection], 0.0, None, PLAIN)
    if pose is not None:
        assert np.isfinite(pose.e_m).all()
        assert math.isfinite(pose.e_yaw_rad)


# --- A print that is not as the profile has it -------------------------------------------------


def setup_of(**target: float) -> PoseSetup:
    return PoseSetup(PoseConfig(), TargetConfig(**target), MOUNT, (0.01, 0.0, 0.03), CAMERA)


def solved(
    seen: list[str],
    setup: PoseSetup,
    place: tuple[float, ...] = (0.03, -0.02, 0.3, 0.4, 0.05, -0.04),
    scale: float = 1.0,
    curl_per_m: float = 0.0,
    rng: np.random.Generator | None = None,
) -> MarkerPose:
    """The pose of a print that is `scale` times as large and curled."""
    rvec, tvec = pose_of(*place)
    detections = []
    for name in seen:
        corners = square_corners(scale * SIDES[name])
        corners[:, 2] = curl_per_m * (corners**2).sum(axis=1)
        px = project(corners, rvec, tvec, CAMERA)
        if rng is not None:
            px = px + rng.normal(0.0, 0.05, (4, 2))
        detections.append(Detection(name, px, 0.05, False))
    pose = estimate_pose(detections, 0.0, VehicleState(0.0, 0.05, -0.04, 0.3), setup)
    assert pose is not None
    return pose


def test_a_sheet_that_shows_its_curl_moves_the_pose_less() -> None:
    """The small marker in its middle is moved least; on a sheet that counts as flat the large
    one, far surer, outweighs it."""
    place = (0.03, -0.02, 0.2, 0.4, 0.05, -0.04)
    off_m, claims_m = [], []
    for claimed in (0.0, 0.03):
        setup = setup_of(size_sigma=0.0, curl_per_m=claimed)
        true, curled = (
            solved(["large", "small"], setup, place, curl_per_m=c, rng=np.random.default_rng(2))
            for c in (0.0, 0.18)
        )
        off_m.append(float(np.linalg.norm(curled.e_m - true.e_m)))
        claims_m.append(float(np.linalg.norm(curled.sigma_m)))
    assert off_m[0] > 1e-3
    assert off_m[1] < 0.5 * off_m[0]
    assert off_m[1] < 3.0 * claims_m[1]


@pytest.mark.parametrize(("scale", "most"), [(1.02, 16.0), (1.005, 4.0)])
def test_a_wrong_size_is_within_its_claim(scale: float, most: float) -> None:
    """Squared errors in units of the claim: of 2 %, four standard deviations, at most 16 over
    the noise's four; with sizes that count as measured it was thousands."""
    rng = np.random.default_rng(3)
    setup, squares = setup_of(), []
    for _ in range(60):
        place = (
            *rng.uniform(-0.1, 0.1, 2),
            rng.uniform(0.2, 1.0),
            *rng.uniform(-1, 1, 1),
            0.0,
            0.0,
        )
        pose = solved(["large", "small"], setup, place, scale, rng=rng)
        true = solved(["large", "small"], setup, place)
        off = np.append(pose.e_m - true.e_m, wrap_rad(pose.e_yaw_rad - true.e_yaw_rad))
        squares.append(float(off @ np.linalg.solve(pose.level_frame_xyz_yaw_cov, off)))
    assert np.mean(squares) < most + 4.0


def test_a_wrong_print_excuses_no_gap_between_the_markers() -> None:
    """Both are as wrong, and in the same direction."""
    place = (0.0, 0.0, 0.8, 0.0, 0.05, -0.04)
    setup = setup_of(size_sigma=0.1, curl_per_m=0.0)
    large = solved(["large"], setup, place)
    smaller = solved(["small"], setup, (0.0, 0.0, 1.0, 0.0, 0.05, -0.04))
    assert np.abs(large.e_m - smaller.e_m).max() < 4.0 * large.sigma_m.max()
    assert are_marker_positions_inconsistent(large, smaller, 0.03)


def test_the_print_s_errors_are_no_noise_of_a_measurement() -> None:
    """They do not change from frame to frame: no filter trusts a pose less for them, and no
    number of frames takes them away."""
    true, doubtful = setup_of(size_sigma=0.0, curl_per_m=0.0), setup_of(size_sigma=0.02)
    constants = make_filter_setup(KalmanConfig())
    known, told = (
        make_track_measurement(solved(["large", "small"], setup), None, False, constants, setup)
        for setup in (true, doubtful)
    )
    assert known.R is not None
    assert told.R is not None
    assert np.allclose(known.R, told.R, rtol=1e-6, atol=1e-15)
    assert (
        np.linalg.norm(told.yaw_xyz_shift_per_bias_sigma[1:, PRINT_SIZE_CURL_BIAS_COLUMNS])
        > 0.02 * 0.3
    )


# --- The spread that a picture's pose claims is what it errs by --------------------------------


Build = Callable[..., Pipeline]
DetectorInput = Callable[[Array, Array, int], NDArray[np.uint8]]
TRUE_PRINT = TargetConfig(size_sigma=0.0, curl_per_m=0.0)
BINS_M = ((0.05, 0.09), (0.1, 0.18), (0.2, 0.4), (0.5, 1.0))


def squared(
    setup: Pipeline, low_m: float, high_m: float, picture: DetectorInput, count: int
) -> float:
    """Mean squared error of (x, y, z, yaw) in units of its spread, a degree of freedom."""
    rng = np.random.default_rng(4)
    found = []
    for k in range(count):
        z = math.exp(rng.uniform(math.log(low_m), math.log(high_m)))
        x, y = rng.uniform(-0.15, 0.15, 2) * z
        yaw, roll, pitch = rng.uniform(-1, 1, 3) * (math.pi, 0.1, 0.1)
        rvec, tvec = pose_of(x, y, z, yaw, roll, pitch)
        image = picture(rvec, tvec, k)
        poses = step(PipelineState(), Frame(0, 0.0, image), None, setup)[1].poses
        pose: MarkerPose = next(poses[n] for n in ("joint", "large", "small") if n in poses)
        turned = seen_heading(rvec)
        off = np.append(pose.e_m - tvec, wrap_rad(pose.e_yaw_rad - turned))
        found.append(float(off @ np.linalg.solve(pose.level_frame_xyz_yaw_cov, off)) / 4.0)
    return float(np.mean(found))


def seen_heading(rvec: Array) -> float:
    R = cv2.Rodrigues(rvec)[0]
    return math.atan2(R[1, 0], R[0, 0])


@pytest.mark.long
@pytest.mark.parametrize("blur_px", [0.8, 2.5])
@pytest.mark.parametrize(("low_m", "high_m"), BINS_M)
def test_the_claimed_spread_is_the_error_s_by_range_and_blur(
    build: Build, low_m: float, high_m: float, blur_px: float
) -> None:
    def picture(rvec: Array, tvec: Array, k: int) -> NDArray[np.uint8]:
        return render(rvec, tvec, blur_px=blur_px, noise=5.0 + 3.0 * (k % 2), seed=k)

    mean = squared(build(target=TRUE_PRINT), low_m, high_m, picture, 16)
    # Half to one and a half, as far as 16 pictures show it (to 0.18); once it was 0.1 to 4.
    assert 0.35 < mean < 1.7


@pytest.mark.long
def test_the_claimed_spread_is_the_error_s_where_rows_shake(build: Build) -> None:
    """An analogue link's lines tremble, both upright sides of a marker alike."""

    def picture(rvec: Array, tvec: Array, k: int) -> NDArray[np.uint8]:
        clean = render(rvec, tvec, blur_px=0.8, noise=2.0, seed=k)
        return add_analogue_faults(clean, 0.3, np.random.default_rng(k))

    assert squared(build(target=TRUE_PRINT), 0.3, 0.6, picture, 24) < 1.5
