"""Convert pixels to rays and back; no other module contains a lens model.

perchctl undistorts corners, never whole images: undistorting a frame before the detection would
lose markers at its edge and blur the others.
"""

from __future__ import annotations

import cv2
import numpy as np

from perchctl.geometry import Array
from perchctl.vision.types import CameraModel

# OpenCV's default stops after five iterations, with errors of up to 0.12 px in the image's corners.
# The tolerance, the last element, is in pixels.
_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-6)
_ZERO_VECTOR = np.zeros(3)


def undistort_to_normalised(points_px: Array, camera: CameraModel) -> Array:
    """Convert pixels (n, 2) of the distorted image to normalised coordinates (n, 2): x/z and y/z in
    the camera frame.

    A point outside the valid range of the lens model becomes NaN or a point far outside the image;
    no exception is raised.
    """
    points = np.ascontiguousarray(points_px, dtype=np.float64).reshape(-1, 1, 2)
    if len(points) == 0:
        return np.empty((0, 2))
    solve = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    return np.asarray(
        solve(points, camera.K, camera.dist, criteria=_UNDISTORT_CRITERIA), dtype=np.float64
    ).reshape(-1, 2)


def undistort_px(points_px: Array, camera: CameraModel) -> Array:
    """Convert pixels (n, 2) of the distorted image to pixels (n, 2) of an undistorted image, taken
    by a pinhole camera with the same `K`."""
    return normalised_to_pinhole_px(undistort_to_normalised(points_px, camera), camera)


def normalised_to_pinhole_px(points_normalised: Array, camera: CameraModel) -> Array:
    """Convert normalised coordinates (n, 2), x/z and y/z in the camera frame, to pixels (n, 2) of a
    pinhole camera with the camera's `K`."""
    K = camera.K
    result = np.empty_like(points_normalised)
    result[:, 0] = K[0, 0] * points_normalised[:, 0] + K[0, 1] * points_normalised[:, 1] + K[0, 2]
    result[:, 1] = K[1, 1] * points_normalised[:, 1] + K[1, 2]
    return result


def distort_to_px(points_normalised: Array, camera: CameraModel) -> Array:
    """Convert normalised coordinates (n, 2), x/z and y/z in the camera frame, to pixels (n, 2) of
    the distorted image; the inverse of `undistort_to_normalised`."""
    rays = np.ones((len(points_normalised), 1, 3))
    rays[:, 0, :2] = points_normalised
    return _project_points(rays, _ZERO_VECTOR, _ZERO_VECTOR, camera)


def project(points_m: Array, rvec_rad: Array, tvec_m: Array, camera: CameraModel) -> Array:
    """Project points (n, 3), m, to pixels (n, 2) of the distorted image. The rotation vector
    `rvec_rad` and the translation `tvec_m` are the pose of the points' frame in the camera frame.
    The pixels of points behind the camera are meaningless."""
    points = np.ascontiguousarray(points_m, dtype=np.float64).reshape(-1, 1, 3)
    rvec, tvec = np.asarray(rvec_rad, float).ravel(), np.asarray(tvec_m, float).ravel()
    return _project_points(points, rvec, tvec, camera)


def _project_points(points: Array, rvec: Array, tvec: Array, camera: CameraModel) -> Array:
    if len(points) == 0:
        return np.empty((0, 2))
    call = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
    image = np.asarray(call(points, rvec, tvec, camera.K, camera.dist)[0], dtype=np.float64)
    return image.reshape(-1, 2)
