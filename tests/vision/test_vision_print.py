"""What a print that is not as the profile has it does to a pose, and that the pose claims it."""

from __future__ import annotations

import numpy as np
import pytest

from perchctl.geometry import make_T, rotation_from_rpy, wrap_rad
from perchctl.profile import KalmanConfig, PoseConfig, TargetConfig
from perchctl.vision import (
    Attitude,
    Detection,
    MarkerPose,
    PoseSetup,
    estimate_pose,
    project,
    square_corners,
)
from perchctl.vision.filter import PRINT, make_filter
from perchctl.vision.merge import disagree
from perchctl.vision.pose import make_pose_setup
from perchctl.vision.target_selection import measurement
from tests.helpers.target_picture import CAMERA, pose_of

SIDES = {"large": 0.150, "small": 0.025}
SEEN = [["large"], ["small"], ["large", "small"]]
MOUNT = make_T(rotation_from_rpy(0.05, -0.03, 1.2), (0.02, -0.01, 0.015))


def setup_of(**target: float) -> PoseSetup:
    return make_pose_setup(PoseConfig(), TargetConfig(**target), MOUNT, (0.01, 0.0, 0.03), CAMERA)  # type: ignore[arg-type]


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
        detections.append(Detection(name, px, 0.05, False))  # type: ignore[arg-type]
    pose = estimate_pose(detections, 0.0, Attitude(0.0, 0.05, -0.04, 0.3), setup)
    assert pose is not None
    return pose


@pytest.mark.parametrize("seen", SEEN)
def test_the_claim_is_what_a_size_off_by_one_standard_deviation_does(seen: list[str]) -> None:
    setup = setup_of(size_sigma=0.005, curl_per_m=0.0)
    true, smaller = solved(seen, setup), solved(seen, setup, scale=1.0 / 1.005)
    assert np.allclose(smaller.e_m - true.e_m, true.print_m[:, 0], rtol=0.02, atol=1e-6)
    assert np.linalg.norm(true.print_m[:, 0]) == pytest.approx(0.005 * 0.302, rel=0.02)
    known = solved(seen, setup_of(size_sigma=0.0, curl_per_m=0.0))
    assert np.allclose(true.sigma_m**2 - known.sigma_m**2, true.print_m[:, 0] ** 2)


@pytest.mark.parametrize("seen", SEEN)
def test_the_claim_is_what_a_curl_of_one_standard_deviation_does(seen: list[str]) -> None:
    setup = setup_of(size_sigma=0.0, curl_per_m=0.03)
    true, curled = solved(seen, setup), solved(seen, setup, curl_per_m=0.03)
    moved = curled.e_m - true.e_m
    assert np.allclose(moved, true.print_m[:, 1], rtol=0.1, atol=5e-6)
    if seen == ["large"]:
        assert np.linalg.norm(moved) == pytest.approx(0.03 * 2 * 0.075**2, rel=0.05)


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


def test_corners_that_err_are_no_curl() -> None:
    """A small marker that is no square tells nothing of the sheet."""
    rvec, tvec = pose_of(0.0, 0.0, 0.2, 0.4, 0.0, 0.0)
    detections = []
    for name, side_m in SIDES.items():
        px = project(square_corners(side_m), rvec, tvec, CAMERA)
        if name == "small":
            px = px + np.array([[0.5, 0.4], [-0.4, 0.3], [0.4, -0.3], [-0.3, -0.4]])
        detections.append(Detection(name, px, 0.02, True))  # type: ignore[arg-type]
    flat, curling = (
        estimate_pose(detections, 0.0, None, setup_of(size_sigma=0.0, curl_per_m=c))
        for c in (0.0, 0.03)
    )
    assert flat is not None
    assert curling is not None
    assert flat.chi2 > 10.0
    assert np.allclose(flat.e_m, curling.e_m, atol=1e-9)


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
        assert pose.cov is not None
        off = np.append(pose.e_m - true.e_m, wrap_rad(pose.e_yaw_rad - true.e_yaw_rad))
        squares.append(float(off @ np.linalg.solve(pose.cov, off)))
    assert np.mean(squares) < most + 4.0


def test_a_wrong_print_excuses_no_gap_between_the_markers() -> None:
    """Both are as wrong, and in the same direction."""
    place = (0.0, 0.0, 0.8, 0.0, 0.05, -0.04)
    setup = setup_of(size_sigma=0.1, curl_per_m=0.0)
    large = solved(["large"], setup, place)
    smaller = solved(["small"], setup, (0.0, 0.0, 1.0, 0.0, 0.05, -0.04))
    assert np.abs(large.e_m - smaller.e_m).max() < 4.0 * large.sigma_m.max()
    assert disagree(large, smaller, 0.03)


def test_the_print_s_errors_are_no_noise_of_a_measurement() -> None:
    """They do not change from frame to frame: no filter trusts a pose less for them, and no
    number of frames takes them away."""
    true, doubtful = setup_of(size_sigma=0.0, curl_per_m=0.0), setup_of(size_sigma=0.02)
    constants = make_filter(KalmanConfig())
    known, told = (
        measurement(solved(["large", "small"], setup), None, False, constants, setup)
        for setup in (true, doubtful)
    )
    assert known.R is not None
    assert told.R is not None
    assert told.bias is not None
    assert np.allclose(known.R, told.R, rtol=1e-6, atol=1e-15)
    assert np.linalg.norm(told.bias[1:, PRINT]) > 0.02 * 0.3
