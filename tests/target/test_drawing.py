"""The target's geometry: cells, rectangles and bitmaps agree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.profile import MarkerConfig, TargetConfig
from perchctl.target import draw_target
from perchctl.target.reading import PlainReader

targets = st.builds(
    lambda large_id, small_id, large_m, ratio: TargetConfig(
        large=MarkerConfig(dictionary="DICT_4X4_1000", id=large_id, side_m=large_m),
        small=MarkerConfig(
            dictionary="DICT_ARUCO_ORIGINAL", id=small_id, side_m=max(large_m * ratio, 0.004)
        ),
    ),
    st.integers(0, 999),
    st.integers(0, 1023),
    st.floats(0.05, 0.5),
    st.floats(0.1, 0.18),
)


def test_the_papers_target_in_millimetres() -> None:
    """And its rectangles lie where the bitmap is black."""
    drawing = draw_target(TargetConfig())
    assert drawing.sheet_side_m == pytest.approx(0.200)
    assert drawing.ring_m == pytest.approx(0.025 / 7)
    image = drawing.bitmap(1000.0)
    assert image.shape == (200, 200)
    black = image < 128
    assert not black[:25].any()
    assert black[25:175, 25:50].all(), "left border"
    centre = black[75:125, 75:125]
    assert not centre[:12].any(), "12.5 mm of quiet zone above the small marker"
    assert centre[13:37, 13:16].all(), "left border of the small marker"
    image = drawing.bitmap(2800.0)  # whole pixels for both markers' cells
    painted = np.full(image.shape, 255, np.uint8)
    for r in drawing.rectangles():
        across = np.rint(np.array([r.x0_m, r.x1_m]) * 2800.0 + len(image) / 2).astype(int)
        down = np.rint(len(image) / 2 - np.array([r.y1_m, r.y0_m]) * 2800.0).astype(int)
        painted[slice(*down), slice(*across)] = 0
    assert np.array_equal(painted, image)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(targets, st.floats(200.0, 3000.0))
def test_rectangles_are_disjoint_and_the_area_is_the_raster_s_at_any_resolution(
    target: TargetConfig, px_per_m: float
) -> None:
    drawing = draw_target(target)
    rectangles = drawing.rectangles()
    widths = np.diff(drawing.edges_m)
    area = float(widths @ drawing.black @ widths)
    assert sum((r.x1_m - r.x0_m) * (r.y1_m - r.y0_m) for r in rectangles) == pytest.approx(area)
    for i, a in enumerate(rectangles):
        for b in rectangles[:i]:
            apart_x = a.x1_m <= b.x0_m + 1e-12 or b.x1_m <= a.x0_m + 1e-12
            assert apart_x or a.y1_m <= b.y0_m + 1e-12 or b.y1_m <= a.y0_m + 1e-12
    size = int(np.ceil(drawing.sheet_side_m * px_per_m)) + 4
    for window_px in (1.0, 2.0):
        ink = drawing.ink_coverage(px_per_m, size, window_px)
        assert ink.min() >= -1e-12
        assert ink.max() <= 1.0 + 1e-12
        assert ink.sum() / px_per_m**2 == pytest.approx(area)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(targets)
def test_any_two_ids_are_both_read_from_the_bitmap(target: TargetConfig) -> None:
    """The white ring leaves the large marker readable and makes the small one so."""
    image = draw_target(target).bitmap(480.0 / target.large.side_m)
    assert set(PlainReader(target).read(image)) == {"large", "small"}
