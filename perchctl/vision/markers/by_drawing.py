"""A marker measured by its drawing, and taken only if the picture looks like it beyond doubt."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.align import Alignment, align
from perchctl.vision.markers.corners import RefinedCorners
from perchctl.vision.markers.lines import CLIPPED_GREY, CLIPPED_SHARE, CLIPPED_SIGMA_PX
from perchctl.vision.markers.pattern import LEAST_SIDE_PX, Pattern
from perchctl.vision.markers.square import doubled_area, mean_side_px, side_lengths_px
from perchctl.vision.types import CameraModel

_MIN_SIGMA_PX = 0.015
_BLUR_SIGMA = 0.012  # of the blur: no picture is its drawing with an even blur
_MIN_PATTERN, _MIN_LIKENESS = 0.9, 0.9
_MIN_STRENGTH, _MAX_STRENGTH = 0.6, 1.6
_MAX_WORST_CELL = 0.3
_MAX_FLIP, _MAX_FLIP_SIGMA = 0.4, 0.35
_MAX_SIGMA = 0.06  # of the side
_MIN_REACH_PX = 3.0
_MIN_GROWTH, _MAX_GROWTH = 0.6, 1.6  # of the mean side
_MIN_EVENNESS = 0.6  # shortest side over the longest


def aligned(
    image: NDArray[np.uint8],
    start_px: Array,
    pattern: Pattern,
    camera: CameraModel,
    reach: float = 0.6,
    blur_px: float = 1.5,
    max_sigma: float = _MAX_SIGMA,
    alone: bool = True,
) -> RefinedCorners | None:
    """The marker by its drawing, None unless the picture looks like it.

    `reach` is how far the corners may be from `start_px`, and `max_sigma` how vague they
    may stay, in sides. Where the other marker shows which one it must be (not `alone`), its
    codeword need not be told apart from others.
    """
    side_px = mean_side_px(start_px)
    if not side_px >= LEAST_SIDE_PX:
        return None
    found = align(image, start_px, pattern.drawing, camera, blur_px)
    if (
        found is None
        or not verified(found, max_sigma)
        or (alone and not told_apart(found))
        or found.moved_px > max(reach * side_px, _MIN_REACH_PX)
        or not _same_square(start_px, found.corners_px)
    ):
        return None
    sigma_px = math.hypot(max(found.sigma_px, _MIN_SIGMA_PX), _BLUR_SIGMA * found.blur_px)
    if _is_clipped(image, found.corners_px):
        sigma_px = math.hypot(sigma_px, CLIPPED_SIGMA_PX)
    return RefinedCorners(found.corners_px, sigma_px, True)


def _is_clipped(image: NDArray[np.uint8], corners_px: Array) -> bool:
    """Whether the marker's white is: no light makes its drawing then."""
    (left, top), (right, bottom) = corners_px.min(axis=0), corners_px.max(axis=0)
    part = image[max(int(top), 0) : int(bottom) + 1, max(int(left), 0) : int(right) + 1]
    return int(np.count_nonzero(part > CLIPPED_GREY)) > CLIPPED_SHARE * part.size


def verified(found: Alignment, max_sigma: float = _MAX_SIGMA) -> bool:
    """The gate. On pictures without the marker the pattern's correlation stays below
    0.72 where its strength is as it should be; on the marker, unless noise drowns it, it
    is above 0.95."""
    return (
        found.pattern > _MIN_PATTERN
        and found.likeness > _MIN_LIKENESS
        and _MIN_STRENGTH < found.strength < _MAX_STRENGTH
        and found.worst_cell < _MAX_WORST_CELL
        and found.sigma_px < max_sigma * mean_side_px(found.corners_px)
    )


def told_apart(found: Alignment) -> bool:
    """Whether another codeword would look different, and this one is seen. Of 36 others that
    the gate before this one took for the marker, all had a flip above 0.5."""
    return found.flip < _MAX_FLIP and found.flip_sigma < _MAX_FLIP_SIGMA


def _same_square(start_px: Array, corners_px: Array) -> bool:
    """Whether a square is still one, of about the same size, and the same way round."""
    sides_px = side_lengths_px(corners_px)
    growth = float(sides_px.mean()) / mean_side_px(start_px)
    turn = float(doubled_area(corners_px[None])[0]) * float(doubled_area(start_px[None])[0])
    return bool(
        sides_px.min() >= _MIN_EVENNESS * sides_px.max()
        and _MIN_GROWTH < growth < _MAX_GROWTH
        and turn > 0.0
    )
