"""Lens models by name, and their projection with its derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import cv2
import numpy as np

from perchctl.geometry import Array
from perchctl.vision import CameraModel

ModelName = Literal["plumb_bob", "rational_polynomial", "fisheye"]
MODEL_NAMES: tuple[ModelName, ...] = get_args(ModelName)  # the simplest first
COEFFICIENTS: dict[str, int] = {"plumb_bob": 5, "rational_polynomial": 8, "fisheye": 4}
PARAMETERS: dict[str, tuple[str, ...]] = {
    "plumb_bob": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": (
        "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"
    ),
    "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}  # fmt: skip
_MIN_Z = 1e-6


def make_camera(model: str, size_px: tuple[int, int], parameters: Array) -> CameraModel:
    """A camera from fx, fy, cx, cy and the distortion, in the order of `PARAMETERS`."""
    fx, fy, cx, cy = (float(value) for value in parameters[:4])
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return CameraModel(size_px, K, np.array(parameters[4:], dtype=np.float64), model)


def parameters_of(camera: CameraModel) -> Array:
    """Inverse of `make_camera`; four coefficients of plumb_bob get k3 = 0."""
    K, dist = camera.K, camera.dist
    if camera.model == "plumb_bob" and dist.size == 4:
        dist = np.append(dist, 0.0)
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], dist])


def project_with_derivatives(
    model: str, parameters: Array, poses: Array, objects: Sequence[Array]
) -> list[tuple[Array, Array, Array]]:
    """For each view: pixels (n, 2), their derivative by the lens (n, 2, p) and by the
    pose's rvec and tvec (n, 2, 6)."""
    p = len(parameters)
    K = make_camera(model, (1, 1), parameters).K
    dist = np.ascontiguousarray(parameters[4:])
    result: list[tuple[Array, Array, Array]] = []
    for pose, points in zip(poses, objects, strict=True):
        rvec, tvec = pose[:3].copy(), pose[3:].copy()
        if model == "fisheye":
            image, J = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), rvec, tvec, K, dist)
            lens = J[:, [0, 1, 2, 3, 4, 5, 6, 7]]
            outside = J[:, 8:14]
        else:
            image, J = cv2.projectPoints(points, rvec, tvec, K, dist)
            lens, outside = J[:, 6 : 6 + p], J[:, :6]
        n = len(points)
        parts = (image.reshape(n, 2), lens.reshape(n, 2, p), outside.reshape(n, 2, 6))
        a, b, c = (np.asarray(part, dtype=np.float64) for part in parts)
        result.append((a, b, c))
    return result


def pixel_derivatives(camera: CameraModel, rays: Array) -> Array:
    """How pixels of fixed rays (n, 3) move with the lens parameters, (n, 2, p)."""
    [(_, lens, _)] = project_with_derivatives(
        camera.model, parameters_of(camera), np.zeros((1, 6)), [np.ascontiguousarray(rays)]
    )
    return lens


def rays_of(normalised: Array) -> Array:
    """Normalised coordinates (n, 2) as rays (n, 3)."""
    return np.column_stack([normalised, np.ones(len(normalised))])


def pixel_grid(size_px: tuple[int, int], columns: int = 17, rows: int = 13) -> Array:
    """Pixels over the whole image with its rims, (columns * rows, 2)."""
    x, y = np.meshgrid(
        np.linspace(0, size_px[0] - 1, columns), np.linspace(0, size_px[1] - 1, rows)
    )
    return np.column_stack([x.ravel(), y.ravel()])
