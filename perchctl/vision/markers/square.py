"""A marker's square in the picture: its sides, its area, and the squares that share its centre.

The unit square is a marker in its own coordinates: corners at (-1, -1), (1, -1), (1, 1),
(-1, 1) in the order of `Detection.corners_px`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import cv2
import numpy as np

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort, undistort
from perchctl.vision.types import CameraModel, MarkerName

UNIT: Array = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
NEXT, BEFORE = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])  # corner i's neighbours
_UNIT32 = UNIT.astype(np.float32)
_UNIT1: Array = np.column_stack([UNIT, np.ones(4)])
_INCREMENTS: Array = np.array(
    [[[u, v, 1, 0, 0, 0, -u * u, -u * v], [0, 0, 0, u, v, 1, -u * v, -v * v]] for u, v in UNIT]
)
"""Of each corner, how far an increment's terms move it in the marker's own coordinates."""


def from_unit(corners: Array) -> Array:
    """Homography (3, 3) of the unit square to corners (4, 2)."""
    H = cv2.getPerspectiveTransform(_UNIT32, corners.astype(np.float32))
    return np.asarray(H, dtype=np.float64)


def to_unit(corners: Array) -> Array:
    """Homography (3, 3) of corners (4, 2) to the unit square."""
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), _UNIT32)
    return np.asarray(H, dtype=np.float64)


def mapped(H: Array, points: Array) -> Array:
    """Points (..., 2) through a homography."""
    images = cv2.perspectiveTransform(points.reshape(-1, 1, 2), H)
    return np.asarray(images, dtype=np.float64).reshape(points.shape)


def corner_jacobian(H: Array) -> Array:
    """Change (8, 8) of the four corners that H (3, 3) makes of the unit square with the terms of
    an increment P, H (1 + P): its rows one after the other, without the last term."""
    q = _UNIT1.dot(H.T)
    x, d = q[:, :2] / q[:, 2:], q[:, 2, None, None]
    A = (H[:2, :2] - x[:, :, None] * H[2, :2]) / d
    return np.asarray((A @ _INCREMENTS).reshape(8, 8))


def side_lengths_px(corners_px: Array) -> Array:
    """Lengths of the four sides, (..., 4)."""
    d = corners_px.take(NEXT, axis=-2) - corners_px
    return np.asarray(np.hypot(d[..., 0], d[..., 1]), dtype=np.float64)


def mean_side_px(corners_px: Array) -> float:
    """Mean length of the sides of one square (4, 2)."""
    a, b, c, d = corners_px.tolist()
    return (math.dist(a, b) + math.dist(b, c) + math.dist(c, d) + math.dist(d, a)) / 4.0


def shortest_side_px(corners_px: Array) -> float:
    """Of the sides of one square (4, 2); NaN where a corner is."""
    a, b, c, d = corners_px.tolist()
    return min(math.dist(a, b), math.dist(b, c), math.dist(c, d), math.dist(d, a))


def doubled_area(corners: Array) -> Array:
    """Positive for corners (m, 4, 2) that run clockwise as the picture is seen, (m,)."""
    a, b = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def within(corners_px: Array, shape: tuple[int, ...], room_px: float = 0.0) -> bool:
    """Whether all corners (4, 2) are finite and inside a picture of that shape, at least
    `room_px` from its edge."""
    h, w = shape[:2]
    right, low = w - 1 - room_px, h - 1 - room_px
    # False for NaN.
    return all(room_px <= x <= right and room_px <= y <= low for x, y in corners_px.tolist())


def nested(corners_px: Array, ratio: float, camera: CameraModel | None = None) -> Array:
    """Corners (4, 2) of a square `ratio` times as large with the same centre and plane;
    without a camera, as if the lens did not bend the square's sides."""
    straight = corners_px if camera is None else undistort(corners_px, camera)
    found = mapped(from_unit(straight), (_UNIT32 * ratio).astype(np.float64))
    return found if camera is None else distort(found, camera)


def completed(
    expected: Mapping[MarkerName, Array], ratio: float, camera: CameraModel
) -> dict[MarkerName, Array]:
    """With the other marker where the one that is expected puts it; `ratio` is the small
    marker's side over the large one's."""
    both = dict(expected)
    if "small" not in both and "large" in both:
        both["small"] = nested(both["large"], ratio, camera)
    elif "large" not in both and "small" in both:
        both["large"] = nested(both["small"], 1.0 / ratio, camera)
    return both
