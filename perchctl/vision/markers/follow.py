"""Markers where they are expected: no search, only verification.

Sides are fitted at the predicted corners, and every cell is read through the result's
homography: a strict check (all cells right, none nearly wrong) at a tenth of the price of
a search.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.corners import NESTED_SIGMA_PX, RefinedCorners
from perchctl.vision.markers.lines import refine_lines
from perchctl.vision.markers.pattern import (
    LEAST_SIDE_PX,
    Pattern,
    cells_agree,
    cells_mostly_agree,
    resembles,
)
from perchctl.vision.markers.square import mean_side_px, nested, side_lengths_px, within
from perchctl.vision.types import MARKERS, CameraModel, EdgeShift, MarkerName

_LEAST_CELL_PX = 2.5  # for lines
_ANCHOR = 0.12  # of the small marker's side


def follow(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    shift: EdgeShift | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """The expected markers (corners (4, 2) px) that are verified by sides and cells; `shift`
    is what was measured of the edges in an earlier picture."""
    names = [
        name
        for name in MARKERS
        if name in expected
        and within(expected[name], image.shape)
        and side_lengths_px(expected[name]).min() > _LEAST_CELL_PX * patterns[name].rim.cells
    ]
    if not names:
        return {}
    raw = np.stack([expected[name] for name in names])
    fitted = refine_lines(image, raw, [patterns[name].rim for name in names], camera, shift)
    seen = {
        name: result
        for name, result in zip(names, fitted, strict=True)
        if result is not None and cells_agree(image, result.corners_px, patterns[name])
    }
    large = seen.get("large")
    if large is not None and "small" not in seen:
        # Too small for lines, but where it must be: enough to know that it is there.
        small_px = nested(large.corners_px, patterns["large"].drawing.ratio, camera)
        if mean_side_px(small_px) > LEAST_SIDE_PX and resembles(image, small_px, patterns["small"]):
            seen["small"] = RefinedCorners(small_px, NESTED_SIGMA_PX, False)
    return seen


def around(
    image: NDArray[np.uint8],
    small: RefinedCorners,
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
) -> RefinedCorners | None:
    """The large marker around a small one that was found: something may cover a part of
    it, so long as its sides are lines for the most part and most cells show."""
    pattern = patterns["large"]
    ratio = pattern.drawing.ratio
    start = nested(small.corners_px, 1.0 / ratio, camera)
    if not within(start, image.shape):
        return None
    # A small marker gives a rough place; the first fit is where to look closely.
    found = refine_lines(image, start[None], [pattern.rim], camera)[0]
    if found is not None:
        found = refine_lines(image, found.corners_px[None], [pattern.rim], camera)[0]
    if found is None:
        return None
    centre = nested(found.corners_px, ratio, camera)
    off_px = float(np.abs(centre - small.corners_px).max())
    near = off_px <= max(_ANCHOR * mean_side_px(small.corners_px), 1.0)
    return found if near and cells_mostly_agree(image, found.corners_px, pattern) else None
