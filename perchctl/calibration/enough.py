"""Is there enough to calibrate from? If not, what to add."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.types import BoardView
from perchctl.errors import InvalidValue
from perchctl.geometry import Array

MIN_VIEWS = 5
GOOD_VIEWS = 10
MIN_TILT_DEG = 12.0
MIN_TILTED = 3
MIN_COVERED = 0.3
GOOD_COVERED = 0.7
MAX_FOCAL_ERROR = 0.01
CELLS = (24, 32)  # rows, columns of the coverage map
_NAMES = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)


def check_views(views: Sequence[BoardView], pictures: int) -> None:
    """Raises InvalidValue when there are too few views to begin with."""
    if len(views) < MIN_VIEWS:
        of = f"of {pictures} pictures" if pictures > len(views) else "pictures"
        raise InvalidValue(
            f"only {len(views)} {of} show the board, at least {MIN_VIEWS} are needed: add "
            f"{MIN_VIEWS - len(views)} or more (15 to 25 are good) with the board tilted by 20 to "
            f"45 deg in all directions, near and far, and in every corner of the picture"
        )


def check_variety(views: Sequence[BoardView], poses: Array) -> None:
    """Raises InvalidValue when views are all frontal or leave most of the image empty."""
    tilts = tilts_deg(poses)
    tilted = int((tilts >= MIN_TILT_DEG).sum())
    if tilted < MIN_TILTED:
        raise InvalidValue(
            f"{tilted} of {len(views)} views are tilted by more than {MIN_TILT_DEG:g} deg (the "
            f"most by {tilts.max():.0f}), so focal length and distance cannot be separated: add "
            f"{MIN_TILTED - tilted} or more with the board tilted by 20 to 45 deg, about both axes"
        )
    map_ = coverage(views)
    if map_.mean() < MIN_COVERED:
        raise InvalidValue(
            f"the boards cover {100 * map_.mean():.0f} % of the picture, at least "
            f"{100 * MIN_COVERED:.0f} % are needed: add views with the board "
            f"{uncovered_text(map_)} of the picture, or nearer"
        )


def check_focal(std: Array, parameters: Array) -> None:
    """Raises InvalidValue when the focal length remains unknown."""
    share = float((std[:2] / parameters[:2]).max())
    if not share <= MAX_FOCAL_ERROR:
        known = f"+-{100 * share:.1f} %" if np.isfinite(share) and share < 1 else "not at all"
        raise InvalidValue(
            f"the views fix the focal length only to {known} (at most "
            f"{100 * MAX_FOCAL_ERROR:g} % is accepted): add sharp views with the board tilted by "
            f"20 to 45 deg about both axes and filling half of the picture"
        )


def tilts_deg(poses: Array) -> Array:
    """How far each board (its pose (6,)) is turned out of the image plane, (v,)."""
    normals = np.array([cv2.Rodrigues(pose[:3])[0][2, 2] for pose in poses])
    return np.asarray(np.degrees(np.arccos(np.minimum(np.abs(normals), 1.0))), dtype=np.float64)


def coverage(views: Sequence[BoardView]) -> NDArray[np.bool_]:
    """Cells of the picture (rows, columns) that lie inside of some board's corners."""
    rows, columns = CELLS
    map_ = np.zeros(CELLS, dtype=np.uint8)
    for view in views:
        w, h = view.size_px
        cells = (view.corners_px + 0.5) / (w, h) * (columns, rows) - 0.5
        hull = cv2.convexHull(np.round(cells).astype(np.int32))
        cv2.fillConvexPoly(map_, hull, 1)
    return map_.astype(np.bool_)


def is_covered(map_: NDArray[np.bool_], points_px: Array, size_px: tuple[int, int]) -> bool:
    """Whether all of the points (n, 2) lie in covered cells."""
    rows, columns = map_.shape
    cells = np.floor((points_px + 0.5) / size_px * (columns, rows)).astype(np.intp)
    x, y = np.clip(cells, 0, (columns - 1, rows - 1)).T
    return bool(map_[y, x].all())


def uncovered_text(map_: NDArray[np.bool_]) -> str:
    """The emptier ninths of the picture, the emptiest first: 'at the top left and right'."""
    thirds = [
        (float(cell.mean()), name)
        for row, names in zip(np.array_split(map_, 3), _NAMES, strict=True)
        for cell, name in zip(np.array_split(row, 3, axis=1), names, strict=True)
    ]
    empty = [name for share, name in sorted(thirds) if share < 0.6][:4]
    if not empty:
        return "at the rims"
    return "at the " + (", ".join(empty[:-1]) + " and " + empty[-1] if empty[1:] else empty[0])
