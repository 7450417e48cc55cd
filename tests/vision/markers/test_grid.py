"""What the lens does to a marker's nodes, from a few of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import Array
from perchctl.vision import undistort_px
from perchctl.vision.markers.corners import UNIT, corner_jacobian, from_unit, mapped
from perchctl.vision.markers.photometric_fit import (
    lens_shift_px,
    make_grid,
    projected,
    through_lens,
)
from tests.helpers.markers import box, corners
from tests.helpers.target_picture import CAMERA, pose_of


@given(st.floats(20.0, 620.0), st.floats(20.0, 460.0), st.floats(8.0, 60.0))
def test_a_small_marker_anywhere(cx: float, cy: float, side_px: float) -> None:
    grid, H = make_grid(30, 1.2), from_unit(undistort_px(box(cx, cy, side_px), CAMERA))
    assert np.abs(_exact(grid.uv1, H) - lens_shift_px(grid, H, CAMERA)).max() < 1e-4


@pytest.mark.parametrize("z_m", [0.14, 0.2, 0.5])
def test_a_large_marker_aslant(z_m: float) -> None:
    quad = corners("large", pose_of(0.02, -0.01, z_m, 0.6, 0.15, -0.2))
    grid, H = make_grid(44, 1.2), from_unit(undistort_px(quad, CAMERA))
    assert np.abs(_exact(grid.uv1, H) - lens_shift_px(grid, H, CAMERA)).max() < 0.01


def _exact(uv1: Array, H: Array) -> Array:
    pin = projected(H, uv1)
    return np.asarray(through_lens(pin, CAMERA) - pin)


@given(st.floats(20.0, 620.0), st.floats(20.0, 460.0), st.floats(8.0, 200.0), st.floats(-0.2, 0.2))
def test_the_corners_move_as_their_jacobian_says(
    cx: float, cy: float, side_px: float, slant: float
) -> None:
    H = from_unit(box(cx, cy, side_px)) @ np.array([[1, 0, 0], [0.1, 1, 0], [slant, -slant, 1.0]])
    step = 1e-6 * np.eye(8)
    moved = [(_moved(H, p) - _moved(H, -p)).ravel() / 2e-6 for p in step]
    assert np.allclose(corner_jacobian(H), np.array(moved).T, rtol=1e-5, atol=1e-4)


def _moved(H: Array, p: Array) -> Array:
    return mapped(H @ (np.eye(3) + np.append(p, 0.0).reshape(3, 3)), UNIT)
