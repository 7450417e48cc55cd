"""Which marker it is, by the cells that are seen of it: the picture ends in it, light glares on it,
or something is before it.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort, undistort
from perchctl.vision.markers.pattern import CELL_MARGIN, MIN_CONTRAST, MOST_CELLS, Pattern
from perchctl.vision.markers.square import from_unit, mapped
from perchctl.vision.types import CameraModel

KnownBy = Literal["bits", "track", "other"]
"""By what it is known which marker it is: by its cells alone, by its place in the picture before,
or by the target's other marker."""
_LEAST_KNOWN = 0.6  # of all cells
_GLARE, _CLIPPED_GREY = 0.25, 250.0  # over white, of the contrast; as bright as can be
_UNKNOWN_BITS: dict[KnownBy, int] = {"bits": 1, "track": 4}  # other codewords differ in two
_INVERTED_PX = 0.5  # the lens model holds where its inverse is one


def visible_cells_agree(
    image: NDArray[np.uint8],
    corners_px: Array,
    pattern: Pattern,
    camera: CameraModel,
    hidden: NDArray[np.bool_] | None,
    known_by: KnownBy,
) -> bool:
    """Whether the cells that are seen have their colour: not those beyond the picture's edge,
    behind what is `hidden` (h, w), or in light that glares. How many that must be depends on
    what else says which marker it is."""
    h, w = image.shape
    at = _spots_px(corners_px, pattern, camera)
    near = np.rint(np.clip(np.nan_to_num(at), 0.0, (w - 1, h - 1))).astype(np.intp)
    seen = _within(at, image.shape, 0.0)
    if hidden is not None:
        seen &= ~hidden[near[:, 1], near[:, 0]]
    grey = image[near[:, 1], near[:, 0]].astype(np.float64)
    white_spots = pattern.white[pattern.owner]
    if not ((seen & white_spots).any() and (seen & ~white_spots).any()):
        return False
    high = float(np.median(grey[seen & white_spots]))
    low = float(np.median(grey[seen & ~white_spots]))
    contrast = high - low
    if contrast < MIN_CONTRAST:
        return False
    seen &= grey <= high + _GLARE * contrast
    if high < _CLIPPED_GREY - _GLARE * contrast:
        seen &= grey < _CLIPPED_GREY
    count = np.bincount(pattern.owner, weights=seen)
    means = np.bincount(pattern.owner, weights=grey * seen) / np.maximum(count, 1.0)
    known = count >= 0.5 * pattern.spots_per_cell
    share = (means - 0.5 * (high + low)) / contrast * np.where(pattern.white, 1.0, -1.0)
    wrong = np.count_nonzero(known & (share < CELL_MARGIN))
    most_wrong = 0
    if known_by == "other":
        most_wrong = math.floor((1.0 - MOST_CELLS) * np.count_nonzero(known & pattern.inner))
    return bool(wrong <= most_wrong) and _enough(known, pattern, known_by)


def may_show_enough(
    start_px: Array,
    shape: tuple[int, ...],
    pattern: Pattern,
    camera: CameraModel,
    known_by: KnownBy,
    off_px: float,
) -> bool:
    """Whether so many cells may be in the picture as `visible_cells_agree` asks for, of a marker
    that is within `off_px` of corners (4, 2)."""
    seen = _within(_spots_px(start_px, pattern, camera), shape, off_px)
    count = np.bincount(pattern.owner, weights=seen)
    return _enough(count >= 0.5 * pattern.spots_per_cell, pattern, known_by)


def _spots_px(corners_px: Array, pattern: Pattern, camera: CameraModel) -> Array:
    """The spots of a marker at corners (4, 2) as the lens shows them, (n, 2); NaN where it does
    not reach. A marker that fills the picture is no square in it: its middle is a third of a cell
    from where its corners alone put it."""
    rays = undistort(corners_px, camera)
    if not np.isfinite(rays).all():
        return np.full((len(pattern.spots), 2), np.nan)
    spots = mapped(from_unit(rays), pattern.spots)
    at = distort(spots, camera)
    near = np.abs(undistort(at, camera) - spots).max(axis=1) * camera.K[0, 0] < _INVERTED_PX
    return np.where(near[:, None], at, np.nan)


def _within(at_px: Array, shape: tuple[int, ...], room_px: float) -> NDArray[np.bool_]:
    """Which points (n, 2) are in the picture, or no farther outside."""
    h, w = shape[:2]
    inside = (at_px >= -room_px) & (at_px <= (w - 1 + room_px, h - 1 + room_px))
    return np.asarray(inside.all(axis=1))


def _enough(known: NDArray[np.bool_], pattern: Pattern, known_by: KnownBy) -> bool:
    """Whether the known cells (cells,) tell which marker it is."""
    most_unknown = len(known) if known_by == "other" else _UNKNOWN_BITS[known_by]
    return bool(
        np.count_nonzero(pattern.inner & ~known) <= most_unknown
        and np.count_nonzero(known) >= _LEAST_KNOWN * len(known)
    )
