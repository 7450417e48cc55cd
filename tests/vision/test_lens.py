from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.vision import CameraModel, project, undistort_to_normalised
from perchctl.vision.lens import distort_to_px
from tests.helpers.target_picture import CAMERA

FISHEYE = CameraModel((640, 480), CAMERA.K, np.array([-0.02, 0.004, 0.001, -0.0005]), "fisheye")
RATIONAL = CameraModel(
    (640, 480),
    CAMERA.K,
    np.array([-0.1, 0.02, 0.0004, -0.0003, 0.001, 0.05, -0.01, 0.002]),
    "rational_polynomial",
)
pixels = st.tuples(st.floats(0, 639), st.floats(0, 479)) | st.just((639.0, 479.0))


@pytest.mark.parametrize("camera", [CAMERA, RATIONAL, FISHEYE], ids=lambda c: c.model)
@given(points=st.lists(pixels, min_size=1, max_size=8))
@settings(max_examples=40, deadline=None)
def test_distort_undoes_undistort(camera: CameraModel, points: list[tuple[float, float]]) -> None:
    px = np.array(points)
    assert np.abs(distort_to_px(undistort_to_normalised(px, camera), camera) - px).max() < 1e-6


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=lambda c: c.model)
def test_project_is_the_lens_applied_to_the_ray(camera: CameraModel) -> None:
    points = np.array([[0.05, -0.02, 0.0], [-0.03, 0.04, 0.01]])
    rvec, tvec = np.zeros(3), np.array([0.02, 0.01, 0.5])
    rays = (points + tvec)[:, :2] / (points + tvec)[:, 2:]
    assert np.allclose(project(points, rvec, tvec, camera), distort_to_px(rays, camera), atol=1e-9)
