"""Geometry of a marker's square in the image (sides, area, concentric squares), and its refined
corners.

The centred square is the marker in its own coordinates: corners at (-1, -1), (1, -1), (1, 1), (-1,
1) in the order of `Detection.corners_px`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.lens import distort_to_px, undistort_to_normalised
from perchctl.vision.types import CameraModel, EdgeShiftEstimate, MarkerName

CENTRED_SQUARE: Array = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Corners of the centred square, -1 to 1, in the marker's own coordinates, (4, 2)."""
# Index of the next and of the previous corner of each corner.
NEXT_CORNER, PREVIOUS_CORNER = (np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2]))
SIDE_OUTWARD_NORMALS: Array = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
"""Outward normal of each side in the marker's own coordinates."""
_CENTRED_SQUARE_F32 = CENTRED_SQUARE.astype(np.float32)
_CENTRED_SQUARE_HOMOGENEOUS: Array = np.column_stack([CENTRED_SQUARE, np.ones(4)])
_CORNER_JACOBIANS_WRT_HOMOGRAPHY_INCREMENT: Array = np.array(
    [
        [[u, v, 1, 0, 0, 0, -u * u, -u * v], [0, 0, 0, u, v, 1, -u * v, -v * v]]
        for u, v in CENTRED_SQUARE
    ]
)
"""Derivative of each corner with respect to the elements of a homography increment, in the marker's
own coordinates."""


def homography_from_centred_square(corners: Array) -> Array:
    """Return the homography (3, 3) that maps the centred square, with corners (-1, -1), (1, -1),
    (1, 1) and (-1, 1), to `corners` (4, 2) in this order."""
    H = cv2.getPerspectiveTransform(_CENTRED_SQUARE_F32, corners.astype(np.float32))
    return np.asarray(H, dtype=np.float64)


def homography_to_centred_square(corners: Array) -> Array:
    """Return the homography (3, 3) that maps `corners` (4, 2) to the corners (-1, -1), (1, -1), (1,
    1) and (-1, 1) of the centred square, in this order."""
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), _CENTRED_SQUARE_F32)
    return np.asarray(H, dtype=np.float64)


def apply_homography(H: Array, points: Array) -> Array:
    """Map points (..., 2) with the homography `H` (3, 3) and return them in the same shape."""
    images = cv2.perspectiveTransform(points.reshape(-1, 1, 2), H)
    return np.asarray(images, dtype=np.float64).reshape(points.shape)


def corners_jacobian_wrt_homography_increment(homography: Array) -> Array:
    """Return the Jacobian (8, 8) of the four corners of the centred square (-1 to 1) after
    projection by `homography` (3, 3). Its rows are the coordinates x0, y0, x1, y1, ... of the
    projected corners, and its columns the eight elements of the increment P in homography (I + P),
    row by row without the last one (see `increment_homography`), at P = 0."""
    q = _CENTRED_SQUARE_HOMOGENEOUS.dot(homography.T)
    x, d = q[:, :2] / q[:, 2:], q[:, 2, None, None]
    A = (homography[:2, :2] - x[:, :, None] * homography[2, :2]) / d
    return np.asarray((A @ _CORNER_JACOBIANS_WRT_HOMOGRAPHY_INCREMENT).reshape(8, 8))


def increment_homography(H: Array, homography_increment: Array) -> Array:
    """Return the homography H (I + P), (3, 3), scaled so that its last element is 1.
    `homography_increment` (8,) contains the first eight elements of P (3, 3), row by row; the last
    element of P is 0."""
    H = H @ np.array(
        [
            [1 + homography_increment[0], homography_increment[1], homography_increment[2]],
            [homography_increment[3], 1 + homography_increment[4], homography_increment[5]],
            [homography_increment[6], homography_increment[7], 1.0],
        ]
    )
    return np.asarray(H / H[2, 2])


def side_lengths_px(corners_px: Array) -> Array:
    """Return the side lengths (..., 4), px, of squares with corners (..., 4, 2). Side k runs from
    corner k to corner k + 1."""
    d = corners_px.take(NEXT_CORNER, axis=-2) - corners_px
    return np.asarray(np.hypot(d[..., 0], d[..., 1]), dtype=np.float64)


def mean_side_px(corners_px: Array) -> float:
    """Return the mean side length, px, of a square with corners (4, 2)."""
    a, b, c, d = corners_px.tolist()
    return (math.dist(a, b) + math.dist(b, c) + math.dist(c, d) + math.dist(d, a)) / 4.0


def signed_double_area_clockwise(corners: Array) -> Array:
    """Return twice the signed area (m,) of m quadrilaterals with corners (m, 4, 2), in squared
    units of the corners; positive if the corners are clockwise in the image (x right, y down)."""
    a, b = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def is_inside_image(
    corners_px: Array, image_shape: tuple[int, ...], margin_px: float = 0.0
) -> bool:
    """True if all corners (4, 2) px are at least `margin_px` inside the border of an image with the
    given `image_shape` (h, w). If `margin_px` is negative, corners may be outside the image, but by
    no more than its absolute value. False if a corner is NaN."""
    h, w = image_shape[:2]
    right, low = w - 1 - margin_px, h - 1 - margin_px
    # NaN yields False.
    return all(margin_px <= x <= right and margin_px <= y <= low for x, y in corners_px.tolist())


def scale_square(
    corners_px: Array, new_to_given_side_ratio: float, camera: CameraModel | None = None
) -> Array:
    """Return the corners (4, 2) px of a square with the same centre and plane as the square
    `corners_px` (4, 2), both in the distorted image. The new side is `new_to_given_side_ratio`
    times the given side. If `camera` is None, lens distortion is ignored."""
    straight = corners_px if camera is None else undistort_to_normalised(corners_px, camera)
    found = apply_homography(
        homography_from_centred_square(straight),
        (_CENTRED_SQUARE_F32 * new_to_given_side_ratio).astype(np.float64),
    )
    return found if camera is None else distort_to_px(found, camera)


def add_missing_marker_corners(
    expected_corners_px: Mapping[MarkerName, Array],
    small_to_large_side_ratio: float,
    camera: CameraModel,
) -> dict[MarkerName, Array]:
    """Return the corners (4, 2) px of both markers in the distorted image. If one marker is
    missing, its corners are computed from the other one and `small_to_large_side_ratio`, the side
    of the small marker divided by the side of the large one. If both are missing, the result is
    empty."""
    both = dict(expected_corners_px)
    if "small" not in both and "large" in both:
        both["small"] = scale_square(both["large"], small_to_large_side_ratio, camera)
    elif "large" not in both and "small" in both:
        both["large"] = scale_square(both["small"], 1.0 / small_to_large_side_ratio, camera)
    return both


# --- Refined corners, and refinement of each corner from its own neighbourhood ---
# If each corner is refined from its own neighbourhood, the corners are biased inwards by 0.15 to
# 0.55 px, and the target seems too far away.


OPENCV_DETECTOR_CORNER_SIGMA_PX = 0.6
"""Standard deviation of corners from OpenCV's detector, px."""
SUBPIX_CORNER_SIGMA_PX = 0.25
"""Standard deviation of corners from `cv2.cornerSubPix`, px."""
SIGMA_OF_CORNERS_DERIVED_FROM_OTHER_MARKER_PX = 0.6
"""Standard deviation of corners that are derived from the other marker, not measured, px."""


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """A marker's refined corners and their uncertainty. The optional fields keep their default
    values if the method that refined the corners does not determine them.

    Attributes:
        corners_px: corners (4, 2), px in the distorted image, in the order of cv2.aruco.
        sigma_px: standard deviation of each corner coordinate, px.
        are_corners_fitted: True if the corners come from a fit of lines, of the marker's drawing or
            of the target's visible edges to the image; False if they come from OpenCV or from the
            other marker, which is less accurate.
        remaining_edge_shift_sigma_px: standard deviation, px, of the error that the growth of white
            over black leaves in the position of each edge: of the correction's error, or of the
            whole growth if it was not corrected.
        blurriest_side_blur_sigma_px, sharpest_side_blur_sigma_px: standard deviations of the
            Gaussian blur, px, of the marker's blurriest side and of its sharpest side.
        removed_edge_shift: an `EdgeShiftEstimate`, for which the corners are corrected: the
            distance in pixels by which white has grown over black at all edges of the image
            (blooming, gamma), and its standard deviation. It was measured in this frame or in an
            earlier one. None if the growth is unknown; the corners are then not corrected.
        cov_px2: covariance (8, 8), px^2 in the image of a pinhole camera, in the order x0, y0, x1,
            y1, ..., of corners that were inferred from a visible part of the marker; None for
            corners from other methods.
        row_jitter_sigma_px: standard deviation of the corners due to the jitter of image rows in
            analogue video, px.
    """

    corners_px: Array
    sigma_px: float
    are_corners_fitted: bool
    remaining_edge_shift_sigma_px: float = 0.0
    blurriest_side_blur_sigma_px: float = 0.0
    removed_edge_shift: EdgeShiftEstimate | None = None
    cov_px2: Array | None = None
    row_jitter_sigma_px: float = 0.0
    sharpest_side_blur_sigma_px: float = math.inf


def refine_subpix(
    image: NDArray[np.uint8], raw_corners_px: Array, cells_per_side: int
) -> RefinedCorners:
    """Refine the corners (4, 2) of one marker, px in the image, with `cv2.cornerSubPix`. If any
    corner moves out of its search window, return the raw corners with a larger standard deviation.

    Each corner p solves sum grad I(q) grad I(q)' (p - q) = 0 over the pixels q of a window that
    extends half a cell, 1 to 5 px, to each side. `cells_per_side` is the number of cells along a
    side of the marker, including the border; it yields the size of a cell. Blur moves the refined
    corners inwards by 0.15 to 0.3 px, and the target then seems too far away. The result's
    `are_corners_fitted` is therefore False.
    """
    side_px = float(side_lengths_px(raw_corners_px).min())
    half = int(np.clip(round(0.5 * side_px / cells_per_side), 1, 5))
    points = np.ascontiguousarray(raw_corners_px, dtype=np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
    cv2.cornerSubPix(image, points, (half, half), (-1, -1), criteria)
    moved = points.reshape(4, 2).astype(np.float64)
    moved_px = np.linalg.norm(moved - raw_corners_px, axis=1).max()
    if not np.isfinite(moved_px) or moved_px > half + 1.0:
        return RefinedCorners(raw_corners_px, OPENCV_DETECTOR_CORNER_SIGMA_PX, False)
    return RefinedCorners(moved, SUBPIX_CORNER_SIGMA_PX, False)
