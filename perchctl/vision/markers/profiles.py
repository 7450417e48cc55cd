"""Grey profiles across the sides of markers.

They are sampled along each side's image through the lens, so that distortion does not
bend the side away from the samples. All rows (a row is one side of one marker) run
through the same arrays.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort
from perchctl.vision.types import CameraModel

PROFILES = 24  # across each side
STEPS = 16  # gradient samples in each profile
Floats = NDArray[np.float32]

ALONG: Array = np.linspace(-1.0, 1.0, PROFILES)  # a side, between its margins
_OFFSETS: Floats = np.linspace(-1.0, 1.0, STEPS + 1).astype(np.float32)
_ALONG_PROFILE: Floats = np.stack([np.ones_like(_OFFSETS), _OFFSETS])
MIDDLES: Floats = (_OFFSETS[1:] + _OFFSETS[:-1]) * np.float32(0.5)  # of the gradients
# Values and slopes at the profiles from a polynomial through the nodes.
_NODES: Array = np.array([-1.0, -0.7, 0.0, 0.7, 1.0])
_INVERSE: Array = np.linalg.inv(_NODES[:, None] ** np.arange(5.0))
_VALUES: Array = (ALONG[:, None] ** np.arange(5)) @ _INVERSE
_SLOPES: Array = (np.arange(1, 5) * ALONG[:, None] ** np.arange(4)) @ _INVERSE[1:]


_TO_THE_LEFT = np.array(-1j)


def places(lengths_px: Array) -> Array:
    """How far along its side (rows,) of that length each profile is: (rows, n) in 0..1;
    the ends keep clear of the neighbouring sides' blur."""
    margin = np.minimum(np.maximum(2.5 / lengths_px, 0.04), 0.25)[:, None]
    return np.asarray(margin + (0.5 - margin) * (1.0 + ALONG))


def side_profiles(starts: Array, ends: Array, s: Array, camera: CameraModel) -> tuple[Array, Array]:
    """Where the profiles cross the sides, in the picture, and the unit normals there,
    to the left of the way from start to end as the picture is seen (outwards for a
    marker whose corners run clockwise): each (rows, n, 2).

    A side's image through the lens is smooth: a few nodes define all of it.

    Args:
        starts, ends: of the sides in normalised coordinates, (rows, 2).
        s: places of the profiles along them, (rows, n), as of `places`.
    """
    first, last = s[:, :1], s[:, -1:]
    at = (0.5 * (first + last) + (0.5 * (last - first)) * _NODES)[..., None]
    points = starts[:, None] + at * (ends - starts)[:, None]
    nodes = distort(points.reshape(-1, 2), camera).reshape(points.shape)
    origin = np.matmul(_VALUES, nodes)
    # As complex numbers x + iy a quarter turn is one product.
    tangent = np.matmul(_SLOPES, nodes).view(np.complex128)
    normal = tangent * (_TO_THE_LEFT / np.maximum(np.abs(tangent), 1e-12))
    return origin, normal.view(np.float64)


def sample(image: NDArray[np.uint8], origin: Array, normal: Array, half_px: Array) -> Floats:
    """Grey values along the profiles, (rows, n, steps + 1): bilinear, the picture's rim
    repeated outside.

    On float pictures OpenCV 5 interpolates at the exact position; on bytes, other
    releases round it to 1/32 px, which is as large as the spread that is aimed at.
    """
    h, w = image.shape
    reach = float(half_px.max()) + 2.0
    flat = origin.reshape(-1, 2)
    (x0, y0), (x1, y1) = flat.min(axis=0).tolist(), flat.max(axis=0).tolist()
    left, top = min(max(int(x0 - reach), 0), w - 2), min(max(int(y0 - reach), 0), h - 2)
    right, bottom = min(int(x1 + reach) + 1, w), min(int(y1 + reach) + 1, h)
    right, bottom = max(right, left + 2), max(bottom, top + 2)
    patch = image[top:bottom, left:right].astype(np.float32)
    rows, n = origin.shape[:2]
    lines = np.empty((2, rows, n, 2), dtype=np.float32)  # of x and y: where, and which way
    np.subtract(origin[..., 0], left, out=lines[0, ..., 0], casting="same_kind")
    np.subtract(origin[..., 1], top, out=lines[1, ..., 0], casting="same_kind")
    np.multiply(normal[..., 0], half_px[:, None], out=lines[0, ..., 1], casting="same_kind")
    np.multiply(normal[..., 1], half_px[:, None], out=lines[1, ..., 1], casting="same_kind")
    x, y = (lines.reshape(-1, 2) @ _ALONG_PROFILE).reshape(2, rows, n * (STEPS + 1))
    grey = cv2.remap(patch, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, dtype=np.float32).reshape(rows, n, STEPS + 1)
