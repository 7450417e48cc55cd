"""Markers where they are expected: no search, only proof.

Sides are fitted at the predicted corners, and every cell is read through the result's
homography: a strict proof (all cells right, none nearly wrong) at a tenth of the price of a
search. Where cells are too few pixels for edges or bits, the whole drawing is laid over
the picture instead, and must look like it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort, undistort
from perchctl.vision.markers.align import Alignment, align
from perchctl.vision.markers.corners import (
    RefinedCorners,
    Rim,
    doubled_area,
    refine_lines,
    side_lengths_px,
)
from perchctl.vision.markers.drawing import Drawing
from perchctl.vision.types import MARKERS, CameraModel, EdgeShift, MarkerName

LEAST_SIDE_PX = 7.0  # below it a marker is a spot
LEAST_LINE_CELL_PX = 2.5
GOOD_LINE_CELL_PX = 6.0  # from here on, lines are as exact as the drawing, and faster
GOOD_LINE_BLURS = 6.0  # a cell's width over the blur's sigma, likewise
_MARGIN = 0.1  # of the contrast that a cell must keep from the threshold
_MIN_RESEMBLANCE = 0.6
_ANCHOR = 0.12  # of the small marker's side
_MOST = 0.8
NESTED_SIGMA_PX = 0.6  # a place taken over from the other marker measures nothing
_MIN_CONTRAST = 10.0
_MIN_PATTERN, _MIN_LIKENESS = 0.9, 0.9
_STRENGTH = (0.6, 1.6)
_MAX_WORST_CELL = 0.3
_MAX_SIGMA = 0.06  # of the side
_SPOTS: Array = np.array([[-0.22, -0.22], [0.22, -0.22], [0.22, 0.22], [-0.22, 0.22]])


@dataclass(frozen=True, eq=False)
class Pattern:
    """How one marker looks.

    rim: inside of its border. drawing: all of it. spots (n, 1, 2): points in its own
    coordinates (see `perchctl.vision.markers.align`) at which its cells are read; owner (n,):
    the cell of each; white (cells,): what they must be; soft (4, n):
    what blur of half a cell makes of them at the spots, without mean and of unit length,
    for a marker whose corners are numbered on by 0 to 3.
    """

    rim: Rim
    drawing: Drawing
    spots: Array
    owner: NDArray[np.intp]
    spots_per_cell: Array
    soft: Array
    white: NDArray[np.bool_]


def pattern_of(rim: Rim, drawing: Drawing) -> Pattern:
    """Spots in every cell, but for those that another marker in the centre covers."""
    n = len(drawing.cells)
    middle = (2.0 * np.arange(n) + 1.0) / n - 1.0
    x, y = np.meshgrid(middle, middle)
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    spots = (centres[:, None] + _SPOTS * 2.0 / n).reshape(-1, 2)
    owner = np.repeat(np.arange(n * n), len(_SPOTS))
    free = np.abs(spots).max(axis=1) > 1.25 * drawing.ratio
    kept = np.unique(owner[free])
    turns, at = [], spots[free]
    for _ in range(4):
        soft = _softened(drawing, at)
        soft -= soft.mean()
        turns.append(soft / math.sqrt(float(soft @ soft)))
        at = np.stack([-at[:, 1], at[:, 0]], axis=1)
    own = np.searchsorted(kept, owner[free]).astype(np.intp)
    return Pattern(
        rim=rim,
        drawing=drawing,
        spots=np.ascontiguousarray(spots[free][:, None]),
        owner=own,
        spots_per_cell=np.bincount(own).astype(np.float64),
        soft=np.stack(turns),
        white=drawing.cells.ravel()[kept] > 0.5,
    )


def _softened(drawing: Drawing, spots: Array) -> Array:
    """Whiteness at the spots with a blur of half a cell."""
    n, fine = len(drawing.cells), 8
    sharp = np.kron(np.pad(drawing.cells, 2, constant_values=1.0), np.ones((fine, fine)))
    white = np.asarray(cv2.GaussianBlur(sharp, (0, 0), 0.5 * fine), dtype=np.float64)
    at = (((spots + 1.0) * 0.5 * n + 2.0) * fine).astype(np.intp)
    return np.asarray(white[at[:, 1], at[:, 0]])


def follow(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    shift: EdgeShift | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """The expected markers (corners (4, 2) px) that are proven by sides and cells; `shift` is
    what an earlier picture told of its edges."""
    names = [
        name
        for name in MARKERS
        if name in expected
        and within(expected[name], image.shape)
        and side_lengths_px(expected[name]).min() > LEAST_LINE_CELL_PX * patterns[name].rim.cells
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
        if float(side_lengths_px(small_px).mean()) > LEAST_SIDE_PX and resembles(
            image, small_px, patterns["small"]
        ):
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
    ratio = patterns["large"].drawing.ratio
    start = nested(small.corners_px, 1.0 / ratio, camera)
    if not within(start, image.shape):
        return None
    # A small marker says roughly where; the first fit says where to look closely.
    found = None
    for _ in range(2):
        found = refine_lines(image, start[None], [patterns["large"].rim], camera)[0]
        if found is None:
            return None
        start = found.corners_px
    assert found is not None
    centre = nested(found.corners_px, ratio, camera)
    off_px = float(np.abs(centre - small.corners_px).max())
    side_px = float(side_lengths_px(small.corners_px).mean())
    if off_px > max(_ANCHOR * side_px, 1.0) or not cells_mostly_agree(
        image, found.corners_px, patterns["large"]
    ):
        return None
    return found


def cells_mostly_agree(image: NDArray[np.uint8], corners_px: Array, pattern: Pattern) -> bool:
    """Whether nearly all cells have their colour, the others being covered."""
    grey = _read(image, corners_px, pattern)
    if grey is None:
        return False
    means = np.bincount(pattern.owner, weights=grey) / pattern.spots_per_cell
    high, low = np.median(means[pattern.white]), np.median(means[~pattern.white])
    if high - low < _MIN_CONTRAST:
        return False
    right = (means > 0.5 * (high + low)) == pattern.white
    return bool(right.mean() > _MOST)


def cells_agree(image: NDArray[np.uint8], corners_px: Array, pattern: Pattern) -> bool:
    """Whether every cell of the marker at these corners has its colour, clearly."""
    grey = _read(image, corners_px, pattern)
    if grey is None:
        return False
    means = np.bincount(pattern.owner, weights=grey) / pattern.spots_per_cell
    white, black = means[pattern.white], means[~pattern.white]
    # The light may differ across the marker: the medians say what white and black are.
    high = float(np.partition(white, len(white) // 2)[len(white) // 2])
    low = float(np.partition(black, len(black) // 2)[len(black) // 2])
    contrast = high - low
    if contrast < _MIN_CONTRAST:
        return False
    middle, margin = 0.5 * (high + low), _MARGIN * contrast
    return bool(white.min() > middle + margin and black.max() < middle - margin)


def resembles(image: NDArray[np.uint8], corners_px: Array, pattern: Pattern) -> bool:
    """Whether the grey values in the cells go with the pattern, blurred as they may be."""
    return float(resemblance(image, corners_px, pattern)[0]) > _MIN_RESEMBLANCE


def resemblance(image: NDArray[np.uint8], corners_px: Array, pattern: Pattern) -> Array:
    """Correlation of the cells' grey values with the pattern for corners (4, 2) rolled on
    by 0 to 3, as `np.roll` does; (4,), 0 without contrast."""
    grey = _read(image, corners_px, pattern)
    if grey is None:
        return np.zeros(4)
    grey -= grey.mean()
    spread = math.sqrt(float(grey @ grey))
    # Black and white each on about half of the spots are 2 spreads apart.
    if spread < 0.5 * _MIN_CONTRAST * math.sqrt(len(grey)):
        return np.zeros(4)
    return np.asarray(pattern.soft @ grey / spread)


def _read(
    image: NDArray[np.uint8], corners_px: Array, pattern: Pattern
) -> NDArray[np.float64] | None:
    """Grey values at the pattern's spots, None where one is outside of the picture."""
    H = cv2.getPerspectiveTransform(_UNIT, corners_px.astype(np.float32))
    at = cv2.perspectiveTransform(pattern.spots, H)[:, 0]
    (x0, y0), (x1, y1) = at.min(axis=0).tolist(), at.max(axis=0).tolist()
    h, w = image.shape
    if not (x0 >= 0.0 and y0 >= 0.0 and x1 <= w - 1 and y1 <= h - 1):
        return None
    nearest = (at + 0.5).astype(np.intp)
    return image[nearest[:, 1], nearest[:, 0]].astype(np.float64)


def aligned(
    image: NDArray[np.uint8],
    start_px: Array,
    pattern: Pattern,
    camera: CameraModel,
    reach: float = 0.6,
    blur_px: float = 1.5,
    max_sigma: float = _MAX_SIGMA,
) -> RefinedCorners | None:
    """The marker by its drawing, None unless the picture looks like it beyond doubt.

    `reach` is how far the corners may be from `start_px`, and `max_sigma` how vague they
    may stay, in sides.
    """
    side_px = float(side_lengths_px(start_px).mean())
    if not side_px >= LEAST_SIDE_PX:
        return None
    found = align(image, start_px, pattern.drawing, camera, blur_px)
    if found is None or not proven(found, max_sigma) or found.moved_px > max(reach * side_px, 3.0):
        return None
    sides = side_lengths_px(found.corners_px)
    if sides.min() < 0.6 * sides.max() or not 0.6 < float(sides.mean()) / side_px < 1.6:
        return None
    if float(doubled_area(found.corners_px[None])[0]) * float(doubled_area(start_px[None])[0]) <= 0:
        return None
    return RefinedCorners(found.corners_px, max(found.sigma_px, 0.015), True)


def proven(found: Alignment, max_sigma: float = _MAX_SIGMA) -> bool:
    """The gate. On pictures without the marker the pattern's correlation stays below
    0.72 where its strength is as it should be; on the marker, unless noise drowns it, it
    is above 0.95."""
    return (
        found.pattern > _MIN_PATTERN
        and found.likeness > _MIN_LIKENESS
        and _STRENGTH[0] < found.strength < _STRENGTH[1]
        and found.worst_cell < _MAX_WORST_CELL
        and found.sigma_px < max_sigma * float(side_lengths_px(found.corners_px).mean())
    )


def completed(
    expected: Mapping[MarkerName, Array], ratio: float, camera: CameraModel
) -> dict[MarkerName, Array]:
    """With the other marker where the one that is known puts it."""
    both = dict(expected)
    if "small" not in both and "large" in both:
        both["small"] = nested(both["large"], ratio, camera)
    elif "large" not in both and "small" in both:
        both["large"] = nested(both["small"], 1.0 / ratio, camera)
    return both


def nested(corners_px: Array, ratio: float, camera: CameraModel | None = None) -> Array:
    """Corners (4, 2) of a square `ratio` times as large with the same centre and plane;
    without a camera, as if the lens did not bend the square's sides."""
    straight = corners_px if camera is None else undistort(corners_px, camera)
    H = cv2.getPerspectiveTransform(_UNIT, straight.astype(np.float32))
    inner = cv2.perspectiveTransform((_UNIT * ratio).reshape(-1, 1, 2).astype(np.float64), H)
    found = np.asarray(inner, dtype=np.float64).reshape(4, 2)
    return found if camera is None else distort(found, camera)


def within(corners_px: Array, shape: tuple[int, ...]) -> bool:
    h, w = shape[:2]
    return bool(
        np.isfinite(corners_px).all()
        and corners_px.min() >= 0.0
        and (corners_px.max(axis=0) <= (w - 1, h - 1)).all()
    )


_UNIT = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float32)
