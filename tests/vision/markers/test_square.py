from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import Array
from perchctl.vision.markers.corners import (
    UNIT,
    completed,
    doubled_area,
    from_unit,
    mapped,
    mean_side_px,
    nested,
    side_lengths_px,
    to_unit,
    within,
)
from tests.helpers.markers import SETUP, box, corners
from tests.helpers.target_picture import CAMERA


def test_one_marker_gives_the_place_of_the_other() -> None:
    assert np.abs(nested(corners("large"), 1 / 6, CAMERA) - corners("small")).max() < 0.01
    whole = completed({"small": corners("small")}, SETUP.ratio, CAMERA)
    assert np.abs(whole["large"] - corners("large")).max() < 0.01
    assert set(completed({"large": corners("large")}, SETUP.ratio, CAMERA)) == {"large", "small"}


quads = st.tuples(
    st.floats(100.0, 500.0), st.floats(100.0, 400.0), st.floats(20.0, 150.0), st.integers(0, 99)
).map(lambda v: box(*v[:3]) + np.random.default_rng(v[3]).uniform(-0.1, 0.1, (4, 2)) * v[2])


@given(quad=quads)
@settings(max_examples=40, deadline=None)
def test_both_homographies_of_the_unit_square_are_each_others_inverse(quad: Array) -> None:
    assert np.allclose(mapped(from_unit(quad), UNIT), quad, atol=1e-3)
    assert np.allclose(mapped(to_unit(quad), quad), UNIT, atol=1e-4)
    inside = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 3, 2))
    there_and_back = mapped(to_unit(quad), mapped(from_unit(quad), inside))
    assert there_and_back.shape == inside.shape
    assert np.allclose(there_and_back, inside, atol=1e-4)


@given(quad=quads, ratio=st.floats(0.1, 1.0))
@settings(max_examples=40, deadline=None)
def test_a_square_in_a_square_has_the_inverse_ratio_around_it(quad: Array, ratio: float) -> None:
    for camera in (None, CAMERA):
        inner = nested(quad, ratio, camera)
        assert np.allclose(nested(inner, 1.0 / ratio, camera), quad, atol=0.05)


def test_sides_and_area() -> None:
    quad = box(200.0, 100.0, 30.0)
    assert np.allclose(side_lengths_px(np.stack([quad, 2.0 * quad])), [[30.0] * 4, [60.0] * 4])
    assert mean_side_px(quad) == pytest.approx(30.0)
    assert np.allclose(doubled_area(np.stack([quad, quad[::-1]])), [1800.0, -1800.0])


def test_within_is_all_corners_finite_and_inside() -> None:
    shape = (480, 640)
    assert within(box(20.0, 20.0, 40.0), shape)
    assert within(box(619.0, 459.0, 40.0), shape)
    assert not within(box(19.0, 20.0, 40.0), shape)
    assert not within(box(619.0, 460.0, 40.0), shape)
    assert not within(np.full((4, 2), np.nan), shape)
