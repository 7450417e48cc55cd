"""The target so near, or so far aside, that no marker is wholly in the picture.

What is left of the drawing of both markers is fitted from where the target is expected, and one
marker's corners follow, of which some are outside of the picture: with the covariance of what was
seen, since some directions may be hardly known. What the edges do not show of the tilt is taken
from the prediction, with that one's spread. A part of a drawing looks like many things. So it is
never a first sight of the target, and it counts only if nearly all edges and cells that should be
in view are.

Lengths are in units of the large marker's half side.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, finite
from perchctl.vision.lens import distort, undistort
from perchctl.vision.markers.cells import visible_cells
from perchctl.vision.markers.corners import UNIT, RefinedCorners, increments, mapped, within
from perchctl.vision.markers.detector import Covered, hides
from perchctl.vision.markers.edge_fit import EdgeFit, corners_of, fit_edges, foreseen
from perchctl.vision.markers.pattern import Pattern, outline_of_both
from perchctl.vision.types import CameraModel, Detections, MarkerName

MOST_AGE_S = 0.5
"""Since the target was last measured; after that what shows a part of it is no evidence."""
_EDGE_PX = 40  # from the picture's edge, where a marker may just have been cut
_LEAST_CELL_PX = 8.0  # of the small marker; smaller, and the large one is in view
_OFF_PX = 60.0  # by which the prediction may be off: an ascent moves the picture by many pixels
_MIN_SHOWN = 0.75  # of the places in view
_MOST_RESIDUAL_PX = 1.2
_MOST_SPREAD = 0.04  # of the centre, in half sides
_SMALL_PLACES = 12  # that make it the small marker that was seen
_LEAST_CELLS, _MOST_WRONG = 6, 0.1  # of the cells in view
_INVERTED = 1e-3  # normalised; the lens model holds where its inverse is one
_FLOOR_PX = 0.02
_TILT_RAD, _TURN_RAD, _PLACE = math.radians(2.0), math.radians(20.0), 1.0  # of a prediction
_SIGMA: Array = np.array([_TILT_RAD, _TILT_RAD, _TURN_RAD, _PLACE, _PLACE, _PLACE])
_NOT_RIGID = 1e-3  # of an increment: what no turn and no move explains, the lens's errors


def is_cut(
    expected: Mapping[MarkerName, Array], shape: tuple[int, ...], hidden: Covered | None = None
) -> bool:
    """Whether none of the markers expected at corners (4, 2) px is wholly in the picture and
    free of the vehicle's gear, or may not be if the prediction is a little off."""
    h, w = shape[:2]
    inner = (h - 2 * _EDGE_PX, w - 2 * _EDGE_PX)
    whole = [c for c in expected.values() if within(c - _EDGE_PX, inner)]
    return bool(expected) and all(hides(hidden, c) for c in whole)


def may_be_whole(expected: Mapping[MarkerName, Array], shape: tuple[int, ...]) -> bool:
    """Whether one of the markers expected at corners (4, 2) px is wholly in the picture, or may
    be if the prediction is a little off: a search finds no others."""
    h, w = shape[:2]
    outer = (h + 2 * _EDGE_PX, w + 2 * _EDGE_PX)
    return any(within(corners + _EDGE_PX, outer) for corners in expected.values())


def measured_lately(previous: Detections | None, t_s: float) -> bool:
    """Whether the target was measured so short a time ago that a part of it is known again."""
    if previous is None or (previous.large is None and previous.small is None):
        return False
    return 0.0 < t_s - previous.t_s <= MOST_AGE_S


def cut_lately(previous: Detections | None, t_s: float, shape: tuple[int, ...]) -> bool:
    """Whether the target was measured lately, and no marker can have been wholly in the picture."""
    if previous is None or not measured_lately(previous, t_s):
        return False
    seen = {d.marker: d.corners_px for d in (previous.large, previous.small) if d is not None}
    return not may_be_whole(seen, shape)


def cut_markers(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    hidden: Covered | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """The marker that what is in view of the target stands for, or none.

    `expected` are corners (4, 2) px, of one marker at least; `hidden` (h, w) is where the
    vehicle's own gear covers the picture.
    """
    drawing = patterns["large"].drawing
    start = _start(expected, drawing.ratio, camera)
    if start is None or drawing.centre is None:
        return {}
    if 2.0 * drawing.ratio / len(drawing.centre) * camera.K[0, 0] / start[2, 2] < _LEAST_CELL_PX:
        return {}
    found = fit_edges(
        image, start, outline_of_both(drawing), camera, hidden, _rigid_prior(start), _OFF_PX
    )
    if found is None or not _trusted(found):
        return {}
    if not _cells_agree(image, found.H, patterns, camera, hidden):
        return {}
    return _stands_for(found, patterns, camera)


def shows_enough_of_target(
    H: Array, patterns: Mapping[MarkerName, Pattern], camera: CameraModel
) -> bool:
    """Whether what a picture shows of a target that is seen through H (3, 3), from the large
    marker's own coordinates to normalised ones, is enough to measure it."""
    outline = outline_of_both(patterns["large"].drawing)
    found = foreseen(H, outline, camera, _rigid_prior(H))
    return found is not None and _trusted(found) and bool(_stands_for(found, patterns, camera))


def _start(expected: Mapping[MarkerName, Array], ratio: float, camera: CameraModel) -> Array | None:
    """The homography (3, 3) of a rigid target that goes with expected corners. The small marker's
    are nearer to the picture, where the lens is known; its own are preferred."""
    name: MarkerName = "small" if "small" in expected else "large"
    rays = undistort(expected[name], camera)
    if not finite(rays):
        return None
    half = ratio if name == "small" else 1.0
    H = cv2.getPerspectiveTransform((half * UNIT).astype(np.float32), rays.astype(np.float32))
    scale = 0.5 * float(np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    if not np.isfinite(H).all() or scale < 1e-9:
        return None
    H = np.asarray(H, dtype=np.float64) / math.copysign(scale, H[2, 2])
    if H[2, 2] <= 0.0:
        return None
    U, _, V = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    R = U @ V
    return np.column_stack([R[:, :2], H[:, 2]]) if np.linalg.det(R) > 0.0 else None


def _rigid_prior(H: Array) -> Array:
    """Information (8, 8) about the increment of a homography (3, 3) with the columns of a
    rotation and a translation: that of a turn about the drawing's centre and a move."""
    columns = [H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]
    changes = []
    for axis in np.eye(3):
        changes.append(np.column_stack([np.cross(axis, columns[0]), np.cross(axis, columns[1]),
                                        np.zeros(3)]))  # fmt: skip
    for axis in np.eye(3):
        changes.append(np.column_stack([np.zeros((3, 2)), axis]))
    inverse = np.linalg.inv(H)
    J = np.empty((8, 6))
    for k, change in enumerate(changes):
        P = inverse @ change
        # H (1 + P) has no scale: its last term is 0.
        J[:, k] = (P - P[2, 2] * np.eye(3)).ravel()[:8]
    cov = (J * _SIGMA**2) @ J.T + _NOT_RIGID**2 * np.eye(8)
    return np.asarray(np.linalg.inv(cov))


def _trusted(found: EdgeFit) -> bool:
    """Whether nearly all edges in view are there, and tell enough of where the target is."""
    J = increments(np.zeros((1, 2)))[0]
    spread = math.sqrt(max(float(np.linalg.eigvalsh(J @ found.cov @ J.T)[-1]), 0.0))
    return (
        found.shown >= _MIN_SHOWN * found.in_view
        and found.residual_px < _MOST_RESIDUAL_PX
        and spread < _MOST_SPREAD
    )


def _cells_agree(
    image: NDArray[np.uint8],
    H: Array,
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    hidden: Covered | None,
) -> bool:
    """Whether the cells of both markers that are in view have their colours."""
    ratio = patterns["large"].drawing.ratio
    markers = [(H, patterns["large"]), (H @ np.diag([ratio, ratio, 1.0]), patterns["small"])]
    cells = visible_cells(image, markers, camera, hidden)
    if cells is None:
        return False
    known, wrong = np.count_nonzero(cells.known), np.count_nonzero(cells.wrong)
    return bool(known >= _LEAST_CELLS and wrong <= _MOST_WRONG * known)


def _stands_for(
    found: EdgeFit, patterns: Mapping[MarkerName, Pattern], camera: CameraModel
) -> dict[MarkerName, RefinedCorners]:
    """The marker whose edges were seen; none where the lens model does not reach as far."""
    name: MarkerName = "small" if found.small >= _SMALL_PLACES else "large"
    half = patterns["large"].drawing.ratio if name == "small" else 1.0
    corners = corners_of(found, half, patterns[name], camera, whole=False)
    if corners is None:
        return {}
    rays = mapped(found.H, half * UNIT)
    if not np.abs(undistort(distort(rays, camera), camera) - rays).max() < _INVERTED:
        return {}
    return {name: corners}
