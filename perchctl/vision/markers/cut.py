"""The target so near, or so far aside, that no marker is wholly in the picture.

What is left of the drawing is aligned from where the target is expected
(`perchctl.vision.markers.visible`), and one marker's corners follow, of which some are outside
of the picture: with the covariance of what was seen, since some directions may be
hardly known. A part of a drawing looks like many things. So it is never a first sight of the
target, and it counts only if the picture looks like the drawing all over and nearly all edges
that should be in view are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort, undistort
from perchctl.vision.markers.corners import RefinedCorners
from perchctl.vision.markers.mask import Covered, hides
from perchctl.vision.markers.outline import Texture, outline_of, texture_of
from perchctl.vision.markers.overview import (
    Overview,
    drift_of,
    lattice_of,
    looks_like,
    overview_of,
)
from perchctl.vision.markers.pattern import Pattern
from perchctl.vision.markers.square import UNIT, within
from perchctl.vision.markers.visible import (
    RigidPose,
    Visible,
    corners_of,
    fitted,
    foreseen,
)
from perchctl.vision.types import CameraModel, Detections, MarkerName

MOST_AGE_S = 0.5
"""Since the target was last measured; after that what shows a part of it is no evidence."""
_EDGE_PX = 40  # from the picture's edge, where a marker may just have been cut
_LEAST_CELL_PX = 8.0  # of the small marker; smaller, and the large one is in view
_MIN_GLANCE = 0.6  # correlation where the prediction was moved to
_GOOD_GLANCE = 0.95  # then no other size is tried
_GROWTHS = (1.0, 0.94, 1.06)
_MIN_LIKENESS, _MIN_GAIN = 0.9, 20.0
_MIN_SHOWN = 0.75  # of the places in view
_MOST_RESIDUAL_PX = 1.2
_MOST_SPREAD = 0.04  # of the centre, in half sides
_FLOOR_PX = 0.02
_SMALL_PLACES = 12  # that make it the small marker that was seen
_INVERTED = 1e-3  # normalised; the lens model holds where its inverse is one


def prepare_cut_markers(patterns: Mapping[MarkerName, Pattern], camera: CameraModel) -> None:
    """Makes what `cut_markers` keeps of a target and a camera before it is in a hurry."""
    drawing = patterns["large"].drawing
    outline_of(drawing), texture_of(drawing), lattice_of(camera)


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
    ratio, centre = drawing.ratio, drawing.centre
    start = _start(expected, ratio, camera)
    if start is None or centre is None:
        return {}
    if 2.0 * ratio / len(centre) * camera.K[0, 0] / start.t[2] < _LEAST_CELL_PX:
        return {}
    covered = None if hidden is None else hidden.astype(np.uint8)
    view = overview_of(image, camera, covered)
    outline, texture = outline_of(drawing), texture_of(drawing)
    near = _moved_near(start, texture, view)
    if near is None:
        return {}
    found = fitted(image, near, outline, _print_sigma(patterns), camera, covered)
    if found is None or not _trusted(found):
        return {}
    like, gain = looks_like(found.pose.H, texture, view)
    if like < _MIN_LIKENESS or gain < _MIN_GAIN:
        return {}
    name = _stands_for(found)
    corners = _corners(found, ratio if name == "small" else 1.0, camera)
    return {} if corners is None else {name: corners}


def shows_enough_of_target(
    pose: RigidPose, patterns: Mapping[MarkerName, Pattern], camera: CameraModel
) -> bool:
    """Whether what a picture taken in that pose shows of the target is enough to measure it."""
    drawing = patterns["large"].drawing
    found = foreseen(pose, outline_of(drawing), _print_sigma(patterns), camera)
    if found is None or not _trusted(found):
        return False
    half = drawing.ratio if _stands_for(found) == "small" else 1.0
    return _corners(found, half, camera) is not None


def _print_sigma(patterns: Mapping[MarkerName, Pattern]) -> Array:
    """By how much the line at each place of the outline may be printed off its place (n,)."""
    outline = outline_of(patterns["large"].drawing)
    small, large = (patterns[name].rim.tolerance for name in ("small", "large"))
    return np.where(outline.small, small, large) * outline.cell


def _stands_for(found: Visible) -> MarkerName:
    return "small" if found.small >= _SMALL_PLACES else "large"


def _start(
    expected: Mapping[MarkerName, Array], ratio: float, camera: CameraModel
) -> RigidPose | None:
    """The pose that goes with expected corners. The small marker's are nearer to the picture,
    where the lens is known; its own are preferred."""
    name: MarkerName = "small" if "small" in expected else "large"
    rays = undistort(expected[name], camera)
    if not np.isfinite(rays).all():
        return None
    half = ratio if name == "small" else 1.0
    H = cv2.getPerspectiveTransform((half * UNIT).astype(np.float32), rays.astype(np.float32))
    if not np.isfinite(H).all():
        return None
    scale = 0.5 * float(np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    if scale < 1e-9:
        return None
    H = np.asarray(H, dtype=np.float64) / math.copysign(scale, H[2, 2])
    if H[2, 2] <= 0.0:
        return None
    U, _, V = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    R = np.asarray(U @ V, dtype=np.float64)
    return RigidPose(R, np.asarray(H[:, 2])) if np.linalg.det(R) > 0.0 else None


def _moved_near(start: RigidPose, texture: Texture, view: Overview) -> RigidPose | None:
    """The prediction moved to where the picture goes best with the drawing, None if it does
    nowhere near."""
    best, pose = _MIN_GLANCE, None
    for growth in _GROWTHS:
        t = start.t * (1.0, 1.0, 1.0 / growth)
        drift, glance = drift_of(RigidPose(start.R, t).H, texture, view)
        if glance > best:
            best, pose = glance, RigidPose(start.R, t + np.append(drift * t[2], 0.0))
        if best > _GOOD_GLANCE:
            break
    return pose


def _trusted(found: Visible) -> bool:
    """Whether nearly all edges in view are there, and tell enough of where the target is."""
    spread = math.sqrt(max(float(np.linalg.eigvalsh(found.cov[3:, 3:])[-1]), 0.0))
    return (
        found.shown >= _MIN_SHOWN * found.in_view
        and found.residual_px < _MOST_RESIDUAL_PX
        and spread < _MOST_SPREAD
    )


def _corners(found: Visible, half: float, camera: CameraModel) -> RefinedCorners | None:
    """Of the marker of that half side; None where the lens model does not reach as far."""
    found_at = corners_of(found.pose, half, camera)
    if found_at is None:
        return None
    x, J = found_at
    corners_px = distort(x, camera)
    if not np.abs(undistort(corners_px, camera) - x).max() < _INVERTED:
        return None
    cov_px2 = J @ found.cov @ J.T + _FLOOR_PX**2 * np.eye(8)
    sigma_px = math.sqrt(float(np.trace(cov_px2)) / 8.0)
    return RefinedCorners(corners_px, sigma_px, True, cov_px2=cov_px2)
