from __future__ import annotations

import math

import numpy as np
import pytest

from perchctl.geometry import Array
from perchctl.vision import Detection, project, square_corners, undistort_px
from perchctl.vision.pose import (
    Points,
    PoseCandidate,
    Scored,
    TiltPrior,
    gauss_newton,
    make_points,
    mirror_solution,
    rotation_matrix,
)
from tests.helpers.target_picture import CAMERA, pose_of

TRUE = PoseCandidate(*pose_of(0.03, -0.02, 0.5, 0.4, 0.15, -0.1))
UNKNOWN = TiltPrior(None, math.radians(5.0))


def points(noise_px: float = 0.0) -> Points:
    corners = project(square_corners(0.15), TRUE.rvec, TRUE.tvec, CAMERA)
    corners = corners + np.random.default_rng(0).normal(0.0, 1.0, (4, 2)) * noise_px
    detection = Detection("large", corners, 0.05, False)
    return make_points([detection], square_corners(0.15), undistort_px(corners, CAMERA), CAMERA.K)


def normal(candidate: PoseCandidate) -> Array:
    return rotation_matrix(candidate.rvec)[:, 2]


def test_from_a_start_that_is_near_the_pose_is_found() -> None:
    found = gauss_newton(points(), PoseCandidate(TRUE.rvec + 0.03, TRUE.tvec + 0.01))
    assert isinstance(found, Scored)
    assert np.allclose(found.rvec, TRUE.rvec, atol=1e-4)
    assert np.allclose(found.tvec, TRUE.tvec, atol=1e-4)
    assert found.rms_px < 1e-2
    assert found.error_px.shape == (4, 2)
    assert found.jacobian.shape == (8, 6)


@pytest.mark.parametrize("tvec", [(0.0, 0.0, -0.5), (3.0, 3.0, 0.05), (np.nan, 0.0, 0.5)])
def test_from_a_start_that_is_not_nothing_settles(tvec: tuple[float, float, float]) -> None:
    found = gauss_newton(points(), PoseCandidate(TRUE.rvec, np.array(tvec)))
    assert found is None or found.rms_px > 1.0


def test_the_error_is_the_root_mean_square_over_the_corners() -> None:
    error_px = np.array([[3.0, 4.0], [0.0, 0.0], [0.0, 0.0], [0.0, 5.0]])
    scored = Scored(TRUE.rvec, TRUE.tvec, error_px, np.zeros((8, 6)))
    assert scored.rms_px == pytest.approx(math.sqrt(50.0 / 4.0))


def test_a_known_tilt_is_contradicted_beyond_its_spread_alone() -> None:
    other_rvec = mirror_solution(TRUE.rvec, TRUE.tvec)
    assert other_rvec is not None
    other = PoseCandidate(other_rvec, TRUE.tvec)
    known = TiltPrior(normal(TRUE), math.radians(5.0))
    assert not known.contradicts(TRUE)
    assert known.contradicts(other)
    assert not TiltPrior(normal(TRUE), math.pi).contradicts(other)
    assert not UNKNOWN.contradicts(other)


def test_corners_with_a_covariance_of_their_own_count_as_it_says() -> None:
    corners = project(square_corners(0.15), TRUE.rvec, TRUE.tvec, CAMERA)
    half = np.random.default_rng(1).normal(0.0, 0.1, (8, 8))
    cov_px2 = half @ half.T + 0.01 * np.eye(8)
    detection = Detection("large", corners, 0.05, True, cov_px2=cov_px2)
    made = make_points([detection], square_corners(0.15), undistort_px(corners, CAMERA), CAMERA.K)
    assert np.allclose(made.whitening @ cov_px2 @ made.whitening.T, np.eye(8), atol=1e-9)
