"""What lines alone left vague, or one of the two markers unseen: measured by the drawing,
where the other marker puts it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.by_drawing import aligned
from perchctl.vision.markers.corners import NESTED_SIGMA_PX, RefinedCorners
from perchctl.vision.markers.follow import around
from perchctl.vision.markers.mask import hides
from perchctl.vision.markers.pattern import Pattern, resembles
from perchctl.vision.markers.square import mean_side_px, nested, within
from perchctl.vision.types import MARKERS, CameraModel, MarkerName

_GOOD_CELL_PX = 6.0  # from here on, lines are as exact as the drawing, and faster
_GOOD_BLURS = 6.0  # a cell's width over the blur's sigma, likewise
_REACH = 0.3  # of the side
# Where the other marker shows that it must be there, it may be vague.
_MAX_SIGMA_ALONE, _MAX_SIGMA = 0.06, 0.12  # of the side
_BLUR_PX = 1.5  # to start with, where it is not known
_ACROSS_PX = 0.37
"""Sigma. Sides have a pixel's own width and that of reading it in their blur, the drawing has not:
0.81 px where it settles at 0.72, of far markers in flight."""
_OTHER: dict[MarkerName, MarkerName] = {"large": "small", "small": "large"}


def lines_suffice(seen: RefinedCorners, pattern: Pattern) -> bool:
    """Whether no drawing could give better corners."""
    cell_px = mean_side_px(seen.corners_px) / pattern.rim.cells
    return seen.refined and cell_px >= max(_GOOD_CELL_PX, _GOOD_BLURS * seen.blur_px)


def improved(
    image: NDArray[np.uint8],
    seen: Mapping[MarkerName, RefinedCorners],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    searched: bool = False,
    hidden: NDArray[np.bool_] | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """The markers that were seen, with better corners and with the other marker if it shows.

    `hidden` (h, w) is where there is something else: a drawing is not laid over that. What a
    search found, its bits read one by one, stays only where lines suffice, the drawing
    confirms it, or the other marker was seen with it."""
    better = dict(seen)
    if "small" in better and "large" not in better:
        large = around(image, better["small"], patterns, camera, hidden)
        if large is not None:
            better["large"] = large
    for name in MARKERS:
        start = _start(name, better, patterns, camera)
        if start is None or not within(start, image.shape) or hides(hidden, start):
            continue
        alone = _OTHER[name] not in better
        max_sigma = _MAX_SIGMA_ALONE if alone else _MAX_SIGMA
        exact = aligned(
            image, start, patterns[name], camera, _REACH, _blur_px(better.get(name)),
            max_sigma=max_sigma, alone=alone,
        )  # fmt: skip
        if exact is not None:
            better[name] = exact
        elif alone and searched:
            better.pop(name, None)
        elif name not in better and resembles(image, start, patterns[name]):
            better[name] = RefinedCorners(start, NESTED_SIGMA_PX, False)
    return better


def _blur_px(seen: RefinedCorners | None) -> float:
    """That of the sides, where lines were fitted: the fit of the drawing gets there sooner."""
    if seen is None or not seen.refined or seen.blur_px <= 0.0:
        return _BLUR_PX
    return min(math.sqrt(max(seen.blur_px**2 - _ACROSS_PX**2, 0.0)), _BLUR_PX)


def _start(
    name: MarkerName,
    seen: Mapping[MarkerName, RefinedCorners],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
) -> Array | None:
    """Corners (4, 2) px from which the drawing should be aligned, None where that is of no
    use."""
    this, other = seen.get(name), seen.get(_OTHER[name])
    if this is not None:
        if this.cov_px2 is not None:
            return None  # what hides a part of it would spoil the drawing, too
        # Small cells matter only where no larger ones were measured.
        enough = lines_suffice(this, patterns[name]) or (name == "small" and other is not None)
        return None if this.refined and enough else this.corners_px
    if name == "small" and other is not None and other.refined:
        return nested(other.corners_px, patterns["large"].drawing.ratio, camera)
    return None
