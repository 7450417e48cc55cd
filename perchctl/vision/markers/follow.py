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
from perchctl.vision.markers.partly import seen_partly, wholly_seen
from perchctl.vision.markers.pattern import (
    LEAST_SIDE_PX,
    Pattern,
    cells_agree,
    cells_mostly_agree,
    resembles,
)
from perchctl.vision.markers.seen_edges import ROOM_PX
from perchctl.vision.markers.square import mean_side_px, nested, shortest_side_px, within
from perchctl.vision.types import MARKERS, CameraModel, EdgeShift, MarkerName

_LEAST_CELL_PX = 2.5  # for lines
_ANCHOR = 0.12  # of the small marker's side


def follow(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    shift: EdgeShift | None = None,
    hidden: NDArray[np.bool_] | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """The expected markers (corners (4, 2) px) that are verified by all sides and cells; `shift`
    is what was measured of the edges in an earlier picture, `hidden` (h, w) where there is
    something else."""
    names = [
        name
        for name in MARKERS
        if name in expected
        and within(expected[name], image.shape, ROOM_PX)
        and shortest_side_px(expected[name]) > _LEAST_CELL_PX * patterns[name].rim.cells
    ]
    if not names:
        return {}
    raw = np.array([expected[name] for name in names])
    fitted = refine_lines(image, raw, [patterns[name].rim for name in names], camera, shift)
    return {
        name: result
        for name, result in zip(names, fitted, strict=True)
        if result is not None
        and wholly_seen(result, image.shape, hidden)
        and cells_agree(image, result.corners_px, patterns[name])
    }


def follow_partly(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    seen: Mapping[MarkerName, RefinedCorners],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    shift: EdgeShift | None = None,
    hidden: NDArray[np.bool_] | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """With those that `follow` did not verify, by what is seen of them. Where the small marker
    was met, the large one is looked for around it instead of where it was expected."""
    places, seen = dict(expected), dict(seen)
    if "small" in seen and "large" not in seen:
        places["large"] = nested(
            seen["small"].corners_px, 1.0 / patterns["large"].drawing.ratio, camera
        )
    for name in MARKERS:
        if name in places and name not in seen:
            partly = seen_partly(
                image, places[name], patterns[name], camera, "track", hidden, shift
            )
            if partly is not None:
                seen[name] = partly
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
    hidden: NDArray[np.bool_] | None = None,
) -> RefinedCorners | None:
    """The large marker around a small one that was found: something may cover a part of
    it, and it may be cut off by the picture's edge, so long as its sides are lines where they
    are seen and most cells show."""
    pattern = patterns["large"]
    start = nested(small.corners_px, 1.0 / pattern.drawing.ratio, camera)
    if not np.isfinite(start).all():
        return None
    found: RefinedCorners | None = None
    if within(start, image.shape, ROOM_PX):
        # A small marker gives a rough place; the first fit is where to look closely.
        found = refine_lines(image, start[None], [pattern.rim], camera)[0]
        if found is not None:
            found = refine_lines(image, found.corners_px[None], [pattern.rim], camera)[0]
        if (
            found is not None
            and wholly_seen(found, image.shape, hidden)
            and _centred(found, small, pattern, camera)
            and cells_mostly_agree(image, found.corners_px, pattern)
        ):
            return found
    if found is not None:
        start = found.corners_px
    partly = seen_partly(image, start, pattern, camera, "other", hidden)
    return partly if partly and _centred(partly, small, pattern, camera) else None


def _centred(
    large: RefinedCorners, small: RefinedCorners, pattern: Pattern, camera: CameraModel
) -> bool:
    """Whether the small marker is where the large one has it."""
    centre = nested(large.corners_px, pattern.drawing.ratio, camera)
    off_px = float(np.abs(centre - small.corners_px).max())
    return off_px <= max(_ANCHOR * mean_side_px(small.corners_px), 1.0)
