"""What a calibration's error means in mm at the target.

The pose solve takes up a part of a wrong calibration: a wrong focal length becomes a
wrong height, not a wrong angle. So the error at the target is not the ray's error times
the distance but the change of the solved position. For a target at a place, with J the
derivative of its corners by its pose and L by the lens, a lens error d moves the solved
pose by -(J'J)^-1 J'L d; its translation is the error at the target's centre. Draws of d
from the parameters' covariance give the 95 % lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.board.adjust import (
    parameters_of,
    pixel_grid,
    poses_only,
    project_with_derivatives,
)
from perchctl.calibration.board.detect import BoardView
from perchctl.geometry import Array
from perchctl.vision import CameraModel, project, undistort

RANGES_M = (0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 1.25, 1.5)
LARGE_M, SMALL_M = 0.150, 0.025
CONFIDENCE = 0.95
DRAWS = 600
CELLS = (24, 32)  # rows, columns of the coverage map
_FACING = np.array([np.pi, 0.0, 0.0])  # the marker's z towards the camera
_SQUARE: Array = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
_LIMIT_SHARE = 0.01
_LIMIT_FLOOR_MM = 1.0


@dataclass(frozen=True)
class RangeError:
    """95 % line of the target's position error at one distance.

    mm95: the worst place of those where the target is seen whole and the boards were seen,
    so that it rests on corners and not on what the lens model says beyond them;
    axis_mm95: straight ahead of the camera.
    """

    z_m: float
    mm95: float
    axis_mm95: float


def limit_mm(z_m: float) -> float:
    """Return the error that perching allows: 1 mm, or 1 % of the distance where that is more. The
    gear settles within 4 mm a hand's breadth under the target, and an approach from 1.5 m
    tolerates centimetres."""
    return max(_LIMIT_FLOOR_MM, 1e3 * _LIMIT_SHARE * z_m)


def coverage(views: Sequence[BoardView]) -> NDArray[np.bool_]:
    """Return the cells of the picture (rows, columns) that lie inside of some board's corners."""
    rows, columns = CELLS
    cells_seen = np.zeros(CELLS, dtype=np.uint8)
    for view in views:
        cells = (view.corners_px + 0.5) / view.size_px * (columns, rows) - 0.5
        cv2.fillConvexPoly(cells_seen, cv2.convexHull(np.round(cells).astype(np.int32)), 1)
    return cells_seen.astype(np.bool_)


def predict_errors(
    camera: CameraModel,
    covariance: Array,
    ranges_m: Sequence[float] = RANGES_M,
    covered: NDArray[np.bool_] | None = None,
) -> tuple[RangeError, ...]:
    """Return the 95 % lines of the target's position error at each distance, where all of the
    target lies in `covered` cells of the picture (None: anywhere), and straight ahead."""
    errors = _draws(covariance)
    result = []
    for z_m in ranges_m:
        moved = np.array([_absorbed(camera, p) @ errors.T for p in _places(camera, z_m, covered)])
        mm = 1e3 * np.linalg.norm(moved, axis=1)  # (places, draws), the axis first
        worst = float(np.quantile(mm.max(axis=0), CONFIDENCE))
        result.append(RangeError(z_m, worst, float(np.quantile(mm[0], CONFIDENCE))))
    return tuple(result)


def position_errors_mm(
    camera: CameraModel,
    truth: CameraModel,
    z_m: float,
    covered: NDArray[np.bool_] | None = None,
) -> Array:
    """Return how far a target seen by `truth` is from where `camera` puts it, at each of the
    places of `truth`; the first is on the axis, (n,) mm."""
    errors = []
    for place in _places(truth, z_m, covered):
        corners_m = _target_m(truth, place)
        seen = project(corners_m, _FACING, place, truth)
        view = BoardView("", truth.size_px, np.arange(len(corners_m)), corners_m, seen)
        solved = poses_only([view], camera)
        errors.append(
            np.inf if solved is None else 1e3 * np.linalg.norm(solved.poses[0, 3:] - place)
        )
    return np.array(errors)


def _draws(covariance: Array) -> Array:
    """Return lens errors drawn from the covariance, (DRAWS, p); always the same."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    normal = np.random.default_rng(0).standard_normal((DRAWS, len(covariance)))
    return np.asarray(normal @ root.T)


def _places(camera: CameraModel, z_m: float, covered: NDArray[np.bool_] | None = None) -> Array:
    """Return target centres at that depth, (n, 3): straight ahead, then over the whole picture
    wherever all corners of a marker are in view; with `covered`, in covered cells."""
    middles = undistort(pixel_grid(camera.size_px, 9, 7), camera)
    there = np.column_stack([middles, np.ones(len(middles))]) * z_m
    there = there[np.isfinite(there).all(axis=1)]
    aside: list[Array] = []
    for side_m in (LARGE_M, SMALL_M):  # the large marker decides as long as it fits anywhere
        aside = aside or [place for place in there if _in_view(camera, place, side_m)]
    if covered is not None:
        aside = [place for place in aside if _is_covered(camera, place, covered)]
    return np.array([[0.0, 0.0, z_m], *aside])


def _target_m(camera: CameraModel, place: Array) -> Array:
    """Return the corners in the target's own axes that are in view there, (4 or 8, 3)."""
    sides = [side_m for side_m in (LARGE_M, SMALL_M) if _in_view(camera, place, side_m)]
    return np.concatenate([_SQUARE * side_m for side_m in sides or [SMALL_M]])


def _in_view(camera: CameraModel, place: Array, side_m: float) -> bool:
    """Return true if a marker of that side is wholly in the picture there."""
    pixels = project(_SQUARE * side_m, _FACING, place, camera)
    w, h = camera.size_px
    if not ((pixels >= 0).all() and (pixels <= (w - 1, h - 1)).all()):
        return False
    # Far outside its field a lens polynomial folds back into the picture.
    again = undistort(pixels, camera)
    straight = (_SQUARE * side_m)[:, :2] * (1.0, -1.0) + place[:2]
    return bool(np.allclose(again, straight / place[2], atol=1e-3))


def _is_covered(camera: CameraModel, place: Array, covered: NDArray[np.bool_]) -> bool:
    """Return true if all of the target's corners lie in covered cells."""
    seen = project(_target_m(camera, place), _FACING, place, camera)
    rows, columns = covered.shape
    cells = np.floor((seen + 0.5) / camera.size_px * (columns, rows)).astype(np.intp)
    x, y = np.clip(cells, 0, (columns - 1, rows - 1)).T
    return bool(covered[y, x].all())


def _absorbed(camera: CameraModel, place: Array) -> Array:
    """Return the change of the solved translation by a change of the lens parameters, (3, p)."""
    pose = np.concatenate([_FACING, place])
    corners_m = _target_m(camera, place)
    _, L, J = project_with_derivatives(camera.model, parameters_of(camera), pose, corners_m)
    # Corners stay where they are, so the pose moves against the lens.
    return np.asarray(-np.linalg.lstsq(J, L, rcond=None)[0][3:], dtype=np.float64)
