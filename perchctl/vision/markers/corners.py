"""A marker's corners as they were refined, and each by its own neighbourhood.

That is the way where no lines can be fitted (`perchctl.vision.markers.lines`): such a
corner is pulled inwards (0.15 to 0.55 px), which makes the target look far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.square import side_lengths_px
from perchctl.vision.types import EdgeShift

RAW_SIGMA_PX = 0.6
SUBPIX_SIGMA_PX = 0.25
NESTED_SIGMA_PX = 0.6  # a place taken over from the other marker measures nothing


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """corners_px (4, 2), their spread, whether lines or the drawing were fitted, the spread
    of a shift that is common to all sides (outwards), the edges' blur, in px, the shift
    that was taken out, where the corners follow from a part of the drawing their covariance
    (8, 8) in pixels of a pinhole, x and y of each corner by turns, the spread by rows that
    shake along themselves, and the blur of the sharpest side."""

    corners_px: Array
    sigma_px: float
    refined: bool
    shift_sigma_px: float = 0.0
    blur_px: float = 0.0
    edge_shift: EdgeShift | None = None
    cov_px2: Array | None = None
    row_sigma_px: float = 0.0
    least_blur_px: float = math.inf


def refine_each(image: NDArray[np.uint8], raw_px: Array, cells: int) -> RefinedCorners:
    """Corners (4, 2) of a marker `cells` wide by `cv2.cornerSubPix`; the raw ones where it
    leads away."""
    side_px = float(side_lengths_px(raw_px).min())
    half = int(np.clip(round(0.5 * side_px / cells), 1, 5))
    points = np.ascontiguousarray(raw_px, dtype=np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
    cv2.cornerSubPix(image, points, (half, half), (-1, -1), criteria)
    moved = points.reshape(4, 2).astype(np.float64)
    moved_px = np.linalg.norm(moved - raw_px, axis=1).max()
    if not np.isfinite(moved_px) or moved_px > half + 1.0:
        return RefinedCorners(raw_px, RAW_SIGMA_PX, False)
    return RefinedCorners(moved, SUBPIX_SIGMA_PX, False)
