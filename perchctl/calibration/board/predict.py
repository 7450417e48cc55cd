"""Convert the error of a calibration to mm at the target.

The solved pose absorbs part of the calibration's error. The error at the target is therefore not
the error of the ray times the distance, but the change of the solved position. For a target at a
given position, let J be the derivative of its corners with respect to its pose, and L their
derivative with respect to the lens parameters. A lens error d then moves the solved pose by
-(J'J)^-1 J'L d. The translation of this step is the error at the target's centre, and the
covariance of the parameters gives its 95 % bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.board.adjust import SIGMAS_95, fit_poses, projection_derivatives
from perchctl.calibration.board.detect import BoardView
from perchctl.geometry import Array
from perchctl.vision import CameraModel, project, undistort_to_normalised

RANGES_M = (0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 1.25, 1.5)
LARGE_M, SMALL_M = 0.150, 0.025
CELLS = (24, 32)  # rows, columns of the coverage map
_FACING = np.array([np.pi, 0.0, 0.0])  # the marker's z towards the camera
_SQUARE: Array = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
_LIMIT_SHARE = 0.01
_LIMIT_FLOOR_MM = 1.0


@dataclass(frozen=True)
class ErrorAtRange:
    """95 % bound on the target's position error at distance z_m.

    mm95: the largest bound over the part of the image that the calibration boards covered and in
    which a whole marker is visible; axis_mm95: the bound straight ahead.
    """

    z_m: float
    mm95: float
    axis_mm95: float


def allowed_error_mm(z_m: float) -> float:
    """The position error that perching allows at distance `z_m`: 1 mm or, if larger, 1 %."""
    return max(_LIMIT_FLOOR_MM, 1e3 * _LIMIT_SHARE * z_m)


def covered_cells(views: Sequence[BoardView]) -> NDArray[np.bool_]:
    """A mask (rows, columns) of the image's grid cells that a board covers in some view."""
    rows, columns = CELLS
    cells_seen = np.zeros(CELLS, dtype=np.uint8)
    for view in views:
        cells = (view.corners_px + 0.5) / view.size_px * (columns, rows) - 0.5
        cv2.fillConvexPoly(cells_seen, cv2.convexHull(np.round(cells).astype(np.int32)), 1)
    return cells_seen.astype(np.bool_)


def predict_errors(
    camera: CameraModel,
    covariance: Array,
    covered: NDArray[np.bool_] | None = None,
    ranges_m: Sequence[float] = RANGES_M,
) -> tuple[ErrorAtRange, ...]:
    """Predict the target's position error at each distance from the covariance of the lens
    parameters, for markers wholly within `covered` cells (None: the whole image)."""
    result = []
    for z_m in ranges_m:
        lines_mm = []
        for place in _places(camera, z_m, covered):
            corners_m = _marker_m(camera, z_m)
            lens, pose = projection_derivatives(camera, np.concatenate([_FACING, place]), corners_m)
            # The corners in the image are fixed, so the pose changes to compensate for the lens
            # error.
            moved = np.linalg.lstsq(pose, lens, rcond=None)[0][3:]
            lines_mm.append(1e3 * SIGMAS_95 * np.sqrt(np.trace(moved @ covariance @ moved.T)))
        result.append(ErrorAtRange(z_m, float(max(lines_mm)), float(lines_mm[0])))
    return tuple(result)


def position_errors_mm(
    camera: CameraModel, truth: CameraModel, z_m: float, covered: NDArray[np.bool_] | None = None
) -> Array:
    """Return the position errors (n,) that result if images of a target are taken with the camera
    `truth` but evaluated with the model `camera` (inf if the target is outside its field of view).
    The n targets at distance z_m lie on a grid within the `covered` cells of the image (None: all);
    the first is on the axis."""
    corners_m = _marker_m(truth, z_m)
    places = _places(truth, z_m, covered)
    views = [
        BoardView("", truth.size_px, np.arange(4), corners_m, project(corners_m, _FACING, p, truth))
        for p in places
    ]
    solved = fit_poses(views, camera)
    if solved is None:
        return np.full(len(places), np.inf)
    return np.asarray(1e3 * np.linalg.norm(solved.poses[:, 3:] - places, axis=1))


def _marker_m(camera: CameraModel, z_m: float) -> Array:
    """Return the corners (4, 3) of the marker that is measured at the distance `z_m`, in the
    marker's own axes."""
    large_m = _SQUARE * LARGE_M
    return (
        large_m
        if _cells(camera, np.array([0.0, 0.0, z_m]), large_m) is not None
        else (_SQUARE * SMALL_M)
    )


def _places(camera: CameraModel, z_m: float, covered: NDArray[np.bool_] | None) -> Array:
    """Return target centres at the depth `z_m`, (n, 3), the first straight ahead."""
    w, h = camera.size_px
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 9), np.linspace(0, h - 1, 7)), axis=-1)
    rays = undistort_to_normalised(grid.reshape(-1, 2), camera)
    rays = rays[np.isfinite(rays).all(axis=1)]
    corners_m = _marker_m(camera, z_m)
    places = [np.array([0.0, 0.0, z_m])]
    for place in np.column_stack([rays, np.ones(len(rays))]) * z_m:
        cells = _cells(camera, place, corners_m)
        if cells is not None and (covered is None or covered[cells[:, 1], cells[:, 0]].all()):
            places.append(place)
    return np.array(places)


def _cells(camera: CameraModel, place: Array, corners_m: Array) -> NDArray[np.intp] | None:
    pixels = project(corners_m, _FACING, place, camera)
    w, h = camera.size_px
    if not ((pixels >= 0).all() and (pixels <= (w - 1, h - 1)).all()):
        return None
    # The polynomial of a lens maps points far outside the field of view back into the image.
    straight = corners_m[:, :2] * (1.0, -1.0) + place[:2]
    if not np.allclose(undistort_to_normalised(pixels, camera), straight / place[2], atol=1e-3):
        return None
    rows, columns = CELLS
    return np.floor((pixels + 0.5) / (w, h) * (columns, rows)).astype(np.intp)
