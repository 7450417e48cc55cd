"""What the lens does to a marker's nodes, from a few of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import Array
from perchctl.vision.camera_model import undistort_px
from perchctl.vision.markers.grid import lens_shift_px, make_grid, projected, through_lens
from perchctl.vision.markers.square import from_unit
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
