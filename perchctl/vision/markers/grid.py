"""A grid over a marker in its own coordinates, and the picture read at its nodes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort
from perchctl.vision.types import CameraModel

_FEW = 9  # a side


@dataclass(frozen=True, eq=False)
class Grid:
    """n by n nodes, `axis` (n,) in both directions, u and v (n * n,) of each node."""

    n: int
    axis: Array
    u: Array
    v: Array


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of the picture: its grey values and its first pixel (x, y)."""

    grey: NDArray[np.float32]
    first: NDArray[np.intp]


@lru_cache(maxsize=64)
def make_grid(n: int, reach: float) -> Grid:
    """Nodes in the middle of n by n equal parts of the square from -reach to reach."""
    axis = reach * ((2.0 * np.arange(n) + 1.0) / n - 1.0)
    u, v = np.meshgrid(axis, axis)
    return Grid(n, axis, u.ravel(), v.ravel())


def projected(H: Array, u: Array, v: Array) -> Array:
    """Own coordinates through a homography to pinhole pixels, (n, 2)."""
    d = H[2, 0] * u + H[2, 1] * v + H[2, 2]
    x = (H[0, 0] * u + H[0, 1] * v + H[0, 2]) / d
    y = (H[1, 0] * u + H[1, 1] * v + H[1, 2]) / d
    return np.stack([x, y], axis=1)


def through_lens(pin_px: Array, camera: CameraModel) -> Array:
    """Pinhole pixels (n, 2) to pixels of the real lens."""
    K = camera.K
    y = (pin_px[:, 1] - K[1, 2]) / K[1, 1]
    x = (pin_px[:, 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return distort(np.stack([x, y], axis=1), camera)


def lens_shift_px(grid: Grid, H: Array, camera: CameraModel) -> Array:
    """How far the lens moves each node that is seen through H, (n * n, 2). A lens moves
    neighbours alike: it is computed for a few nodes, and the rest by the polynomial through
    these."""
    u, v, between = _few(grid)
    pin = projected(H, u, v)
    shift = (through_lens(pin, camera) - pin).T.reshape(2, _FEW, _FEW)
    return np.asarray((between @ shift @ between.T).reshape(2, -1).T)


@lru_cache(maxsize=64)
def _few(grid: Grid) -> tuple[Array, Array, Array]:
    """Chebyshev's nodes over the grid, u and v (_FEW^2,), and the weights (n, _FEW) that a
    row's nodes give to its values there."""
    reach = float(grid.axis[-1])
    x = chebyshev.chebpts2(_FEW)
    u, v = np.meshgrid(reach * x, reach * x)
    degree = _FEW - 1
    through = np.linalg.inv(chebyshev.chebvander(x, degree))
    return u.ravel(), v.ravel(), chebyshev.chebvander(grid.axis / reach, degree) @ through


def patch_around(image: NDArray[np.uint8], grid: Grid, H: Array, lens_px: Array) -> Patch | None:
    """The part of the picture that the nodes may reach, None where they leave it."""
    h, w = image.shape
    x, y = (projected(H, grid.u, grid.v) + lens_px).T.copy()  # in rows: a tenth of the time
    least, most = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    if not (least.min() >= -1.0 and (most <= (w, h)).all()):
        return None
    room = 0.15 * float((most - least).max()) + 3.0
    low = np.clip(least - room, 0, (w - 2, h - 2)).astype(np.intp)
    high = np.clip(most + room + 1.0, low + 2, (w, h)).astype(np.intp)
    return Patch(image[low[1] : high[1], low[0] : high[0]].astype(np.float32), low)


def read(patch: Patch, grid: Grid, H: Array, offset_px: Array) -> Array:
    """Grey values at the nodes, (n * n,); `offset_px` is the lens's shift less the patch's
    first pixel."""
    at = (projected(H, grid.u, grid.v) + offset_px).astype(np.float32)
    x, y = (np.ascontiguousarray(at[:, k]).reshape(grid.n, grid.n) for k in (0, 1))
    grey = cv2.remap(patch.grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, dtype=np.float64).ravel()
