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
    """n by n nodes, `axis` (n,) in both directions; u, v and 1 of each node, (3, n * n)."""

    n: int
    axis: Array
    uv1: Array

    @property
    def u(self) -> Array:
        u: Array = self.uv1[0]
        return u

    @property
    def v(self) -> Array:
        v: Array = self.uv1[1]
        return v


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of the picture: its grey values and its first pixel (x, y)."""

    grey: NDArray[np.float32]
    first: NDArray[np.intp]


@lru_cache(maxsize=64)
def make_grid(n: int, reach: float) -> Grid:
    """Nodes in the middle of n by n equal parts of the square from -reach to reach."""
    axis = reach * ((2.0 * np.arange(n) + 1.0) / n - 1.0)
    return Grid(n, axis, _crossings(axis))


def _crossings(axis: Array) -> Array:
    u, v = np.meshgrid(axis, axis)
    return np.stack([u.ravel(), v.ravel(), np.ones(u.size)])


def projected(H: Array, uv1: Array) -> Array:
    """Own coordinates (3, n) through a homography to pinhole pixels, x and y (2, n)."""
    q = H.dot(uv1)
    return np.asarray(q[:2] / q[2])


def through_lens(pin_px: Array, camera: CameraModel) -> Array:
    """Pinhole pixels (2, n) to pixels of the real lens."""
    K = camera.K
    rays = np.empty((pin_px.shape[1], 2))
    rays[:, 1] = (pin_px[1] - K[1, 2]) / K[1, 1]
    rays[:, 0] = (pin_px[0] - K[0, 2] - K[0, 1] * rays[:, 1]) / K[0, 0]
    return distort(rays, camera).T


def lens_shift_px(grid: Grid, H: Array, camera: CameraModel) -> Array:
    """How far the lens moves each node that is seen through H, (2, n * n). A lens moves
    neighbours alike: it is computed for a few nodes, and the rest by the polynomial through
    these."""
    uv1, between = _few(grid)
    pin = projected(H, uv1)
    shift = (through_lens(pin, camera) - pin).reshape(2, _FEW, _FEW)
    return np.asarray((between @ shift @ between.T).reshape(2, -1))


@lru_cache(maxsize=64)
def _few(grid: Grid) -> tuple[Array, Array]:
    """Chebyshev's nodes over the grid (3, _FEW^2), and the weights (n, _FEW) that a row's nodes
    give to its values there."""
    reach = float(grid.axis[-1])
    x = chebyshev.chebpts2(_FEW)
    degree = _FEW - 1
    through = np.linalg.inv(chebyshev.chebvander(x, degree))
    return _crossings(reach * x), chebyshev.chebvander(grid.axis / reach, degree) @ through


def patch_around(image: NDArray[np.uint8], grid: Grid, H: Array, lens_px: Array) -> Patch | None:
    """The part of the picture that the nodes may reach, None where they leave it."""
    h, w = image.shape
    x, y = projected(H, grid.uv1) + lens_px
    least, most = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    if not (least.min() >= -1.0 and (most <= (w, h)).all()):
        return None
    room = 0.15 * float((most - least).max()) + 3.0
    low = np.clip(least - room, 0, (w - 2, h - 2)).astype(np.intp)
    high = np.clip(most + room + 1.0, low + 2, (w, h)).astype(np.intp)
    return Patch(image[low[1] : high[1], low[0] : high[0]].astype(np.float32), low)


def read(patch: Patch, grid: Grid, H: Array, offset_px: Array) -> Array:
    """Grey values at the nodes, (n * n,); `offset_px` (2, n * n) is the lens's shift less the
    patch's first pixel."""
    at = (projected(H, grid.uv1) + offset_px).astype(np.float32)
    x, y = at.reshape(2, grid.n, grid.n)
    grey = cv2.remap(patch.grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, dtype=np.float64).ravel()
