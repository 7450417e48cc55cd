"""Whether a picture shows a marker's cells: all of them, most of them, or those that are seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.lens import distort, reach_of, undistort
from perchctl.vision.markers.corners import from_unit, mapped
from perchctl.vision.markers.detector import Covered
from perchctl.vision.markers.pattern import Pattern
from perchctl.vision.types import CameraModel

MIN_CONTRAST = 10.0  # grey levels
MARGIN = 0.1  # of the contrast that a cell must keep from the threshold
_MOST = 0.8  # of the cells, where others may be covered
_MIN_RESEMBLANCE = 0.6
_GLARE, _BRIGHTEST_GREY = 0.25, 250.0  # over white, of the contrast; as bright as can be
_LEAST_KNOWN = 0.6  # of all cells

KnownBy = Literal["all", "bits", "track", "other"]
"""By what it is known which marker it is: by all of its cells, by those that are seen, by its
place in the picture before too, or by the target's other marker."""
_UNKNOWN_BITS: dict[KnownBy, int] = {"bits": 1, "track": 4}  # other codewords differ in two


@dataclass(frozen=True, eq=False)
class VisibleCells:
    """Which of the cells of markers, one marker's after the other's, are seen, and which of these
    have the other colour, (cells,)."""

    known: NDArray[np.bool_]
    wrong: NDArray[np.bool_]


def visible_cells(
    image: NDArray[np.uint8],
    markers: Sequence[tuple[Array, Pattern]],
    camera: CameraModel,
    hidden: Covered | None = None,
    glares: bool = True,
) -> VisibleCells | None:
    """The cells of markers, each through its H (3, 3), own coordinates to normalised ones, that
    are neither beyond the picture's edge, behind what is `hidden` (h, w), nor, where it `glares`,
    in light that is far brighter than the rest. None without contrast."""
    h, w = image.shape
    rays = np.concatenate([mapped(H, pattern.spots) for H, pattern in markers])
    first = np.cumsum([0, *(len(pattern.white) for _, pattern in markers)])
    owner = np.concatenate([k + p.owner for k, (_, p) in zip(first, markers, strict=False)])
    is_white = np.concatenate([pattern.white for _, pattern in markers])
    spots_per_cell = np.concatenate([pattern.spots_per_cell for _, pattern in markers])
    at = np.rint(np.clip(np.nan_to_num(distort(rays, camera), nan=-1e4), -1e4, 1e4))
    seen = (at >= 0.0).all(axis=1) & (at <= (w - 1, h - 1)).all(axis=1)
    seen &= np.hypot(rays[:, 0], rays[:, 1]) < reach_of(camera)
    x, y = np.clip(at, 0.0, (w - 1, h - 1)).astype(np.intp).T
    if hidden is not None:
        seen &= ~hidden[y, x]
    grey = image[y, x].astype(np.float64)
    white = is_white[owner]
    if not ((seen & white).any() and (seen & ~white).any()):
        return None
    # The light may differ across the marker: white and black are the medians.
    high, low = (float(np.median(grey[seen & each])) for each in (white, ~white))
    contrast = high - low
    if contrast < MIN_CONTRAST:
        return None
    if glares:
        seen &= grey <= high + _GLARE * contrast
        if high < _BRIGHTEST_GREY - _GLARE * contrast:
            seen &= grey < _BRIGHTEST_GREY
    count = np.bincount(owner, weights=seen)
    means = np.bincount(owner, weights=grey * seen) / np.maximum(count, 1.0)
    known = count >= 0.5 * spots_per_cell
    share = (means - 0.5 * (high + low)) / contrast * np.where(is_white, 1.0, -1.0)
    return VisibleCells(known, known & (share < MARGIN))


def cells_agree(
    image: NDArray[np.uint8],
    corners_px: Array,
    pattern: Pattern,
    camera: CameraModel,
    known_by: KnownBy = "all",
    hidden: Covered | None = None,
) -> bool:
    """Whether the cells that are seen of the marker at these corners (4, 2) have their colour,
    clearly. How many that must be depends on what else says which marker it is."""
    H = from_unit(undistort(corners_px, camera))
    cells = visible_cells(image, [(H, pattern)], camera, hidden, glares=known_by != "all")
    if cells is None:
        return False
    known, wrong = cells.known, int(np.count_nonzero(cells.wrong))
    unknown = int(np.count_nonzero(pattern.inner & ~known))
    if known_by == "all":
        return wrong == 0 and bool(known.all())
    if np.count_nonzero(known) < _LEAST_KNOWN * len(known):
        return False
    if known_by == "other":
        return bool(wrong <= (1.0 - _MOST) * np.count_nonzero(known & pattern.inner))
    return wrong == 0 and unknown <= _UNKNOWN_BITS[known_by]


def resembles(image: NDArray[np.uint8], corners_px: Array, pattern: Pattern) -> bool:
    """Whether the grey values in the cells go with the pattern, blurred as they may be."""
    return float(resemblance(image, corners_px, pattern)[0]) > _MIN_RESEMBLANCE


def resemblance(image: NDArray[np.uint8], corners_px: Array, pattern: Pattern) -> Array:
    """Correlation of the cells' grey values with the pattern for corners (4, 2) rolled on
    by 0 to 3, as `np.roll` does; (4,), 0 without contrast."""
    like: Array = resemblances(image, from_unit(corners_px)[None], pattern)[0]
    return like


def resemblances(image: NDArray[np.uint8], squares: Array, pattern: Pattern) -> Array:
    """`resemblance` of many at a time: homographies (m, 3, 3) of the unit square to (m, 4)."""
    h, w = image.shape
    like = np.zeros((len(squares), 4))
    at = pattern.spots @ squares[:, :2, :2].transpose(0, 2, 1) + squares[:, None, :2, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        at /= pattern.spots @ squares[:, 2, :2, None] + squares[:, 2, 2, None, None]
        low, high = at.min(axis=1), at.max(axis=1)
        inside = (low >= 0.0).all(axis=1) & (high <= (w - 1, h - 1)).all(axis=1)
    nearest = (at[inside] + 0.5).astype(np.intp)
    grey = image[nearest[..., 1], nearest[..., 0]].astype(np.float64)
    grey -= grey.mean(axis=1, keepdims=True)
    spread = np.sqrt((grey * grey).sum(axis=1))[:, None]
    # Black and white each on about half of the spots are 2 spreads apart.
    contrast = spread >= 0.5 * MIN_CONTRAST * np.sqrt(grey.shape[1])
    like[inside] = grey @ pattern.soft.T / np.maximum(spread, 1e-9) * contrast
    return like
