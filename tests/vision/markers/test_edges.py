"""Edges with a known place and blur, without a camera."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import Array
from perchctl.vision.markers.edge_fit import ALONG, PROFILES, STEPS, Edges, Surroundings, locate

HALF_PX, NEAR_PX, DEPTH_PX = 7.0, 7.0, 12.0
OFFSETS: Array = HALF_PX * np.linspace(-1.0, 1.0, STEPS + 1)


def soft_step(x: Array, blur_px: float) -> Array:
    return 0.5 * (1.0 + np.vectorize(math.erf)(x / (math.sqrt(2.0) * blur_px)))


def located(
    place_px: Array,
    blur_px: float,
    *,
    far_side: bool = False,
    noise: float = 0.0,
    shown: slice = slice(None),
) -> Edges:
    """One row of profiles (n,) with the edge at `place_px`; with `far_side`, white ends
    a cell further out. Others than those `shown` count for nothing."""
    x = OFFSETS - place_px[:, None]
    white = soft_step(x, blur_px)
    if far_side:
        white -= soft_step(x - DEPTH_PX, blur_px)
    grey = 30.0 + 170.0 * white
    grey += np.random.default_rng(0).normal(0.0, 1.0, grey.shape) * noise
    none = np.zeros((1, PROFILES))
    possible = np.zeros((1, PROFILES), dtype=np.bool_)
    possible[0, shown] = True
    around = Surroundings(
        depth_px=np.array([DEPTH_PX]),
        inside=none,
        outside=none + 1.0 if far_side else none,
        possible=possible,
    )
    return locate(grey[None].astype(np.float32), np.array([HALF_PX]), np.array([NEAR_PX]), around)


@pytest.mark.parametrize("blur_px", [0.8, 1.2, 2.0])
@pytest.mark.parametrize("place_px", [-1.3, 0.0, 0.4])
def test_a_lone_edge_is_found_with_its_blur(place_px: float, blur_px: float) -> None:
    edges = located(place_px + 0.5 * ALONG, blur_px)
    assert np.abs(edges.offset_px[0] - place_px - 0.5 * ALONG).max() < 0.02
    assert (edges.weight > 0.5).all()
    assert edges.blur_px[0] == pytest.approx(blur_px, rel=0.2)


def test_a_neighbouring_edge_does_not_push_it_away() -> None:
    edges = located(np.zeros(PROFILES), 2.0, far_side=True)
    assert np.abs(edges.offset_px).max() < 0.03


def test_noise_is_averaged_along_the_row() -> None:
    edges = located(np.zeros(PROFILES), 1.0, noise=6.0)
    mean = float((edges.weight * edges.offset_px).sum() / edges.weight.sum())
    assert abs(mean) < 0.05


def test_profiles_with_an_edge_elsewhere_are_outliers() -> None:
    place = np.zeros(PROFILES)
    place[5:9] = 3.0
    edges = located(place, 1.0)
    assert (edges.weight[0, 5:9] == 0.0).all()
    assert (np.delete(edges.weight[0], range(5, 9)) > 0.5).all()


@given(
    shown=st.integers(3, PROFILES).flatmap(
        lambda n: st.integers(0, PROFILES - n).map(lambda first: slice(first, first + n))
    ),
    place_px=st.floats(-4.0, 4.0),
    slope_px=st.floats(-0.5, 0.5),
    blur_px=st.floats(0.7, 1.5),
)
def test_a_side_of_which_little_is_shown_is_found_all_the_same(
    shown: slice, place_px: float, slope_px: float, blur_px: float
) -> None:
    """Of a marker that the picture cuts off: wherever the rest of the side would be."""
    place = place_px + slope_px * ALONG
    edges = located(place, blur_px, noise=4.0, shown=shown)
    weight = edges.weight[0]
    assert weight.sum() > 1.0
    assert abs(float((weight * (edges.offset_px[0] - place)).sum() / weight.sum())) < 0.2
