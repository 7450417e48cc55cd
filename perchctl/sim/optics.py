"""A camera's optics: its pixels' view rays, where they meet the target's plane, and its shade.

Pixel (0, 0) is the centre of the top-left pixel, as in OpenCV. Pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import CameraModel

Picture = NDArray[np.uint8]

FINE_PX, COARSE_PX = 2, 8
"""Distances of the nodes of the two ray grids; the image is padded to whole coarse blocks, each
with a coarse node in its centre."""

FAR_AWAY_M = 1e4
"""The coordinates given to rays that miss the plane."""
LEAST_RISE = 0.02
"""z of a ray (target axes, depth 1 in the view) that still meets the plane."""
_NOTHING = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Undistorted rays (x, y, 1) at nodes `stride` px apart, with one node around where they are
    further apart than one pixel.

    Node (j, i) then sits at pixel ``stride * (i - 1) + (stride - 1) / 2``: where
    cv2.resize by `stride` puts its sample centres.
    """

    stride: int
    xy: NDArray[np.float32]  # (rows, cols, 2)
    down: NDArray[np.float32]  # (rows,), 0 in the picture's first row, 1 in its last
    outline: NDArray[np.float32]  # (n, 2), rays around all of them

    @property
    def rays(self) -> NDArray[np.float32]:
        """(x, y, 1), shape (3, rows, cols)."""
        x, y = self.xy[..., 0], self.xy[..., 1]
        return np.stack([x, y, np.ones_like(x)])

    def window(self, rows: slice, cols: slice) -> RayGrid:
        """Return a part of the grid, whose outline stays that of the whole."""
        xy = np.ascontiguousarray(self.xy[rows, cols])
        return RayGrid(self.stride, xy, self.down[rows], self.outline)


def undistorted_rays(camera: CameraModel, pixels: Array) -> Array:
    """Return view rays (x, y) at depth one of pixels (n, 2), shape (n, 2)."""
    points = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
    criteria = (3, 100, 1e-12)  # by default OpenCV stops early, 0.12 px off in the corners
    if camera.model == "fisheye":
        rays = cv2.fisheye.undistortPoints(points, camera.K, camera.dist, criteria=criteria)
    else:
        rays = cv2.undistortPoints(points, camera.K, camera.dist, criteria=criteria)
    return np.asarray(rays, np.float64).reshape(-1, 2)


def ray_grid(camera: CameraModel, stride: int) -> RayGrid:
    """Return rays over the image, its size rounded up to whole coarse blocks."""
    cols, rows = (-(-side // COARSE_PX) * (COARSE_PX // stride) + 2 for side in camera.size_px)
    u = stride * (np.arange(cols) - 1) + (stride - 1) / 2.0
    v = stride * (np.arange(rows) - 1) + (stride - 1) / 2.0
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    xy = undistorted_rays(camera, pixels)
    down = np.asarray(v / (camera.size_px[1] - 1.0), np.float32)
    rays = np.ascontiguousarray(xy.reshape(rows, cols, 2), np.float32)
    outline = np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1]])
    return RayGrid(stride, rays, down, outline)


def plane_map(T_target_cam: Array) -> Array:
    """Return what maps a ray (x, y, 1) to (X w, Y w, w), where it meets the target's plane, (...,
    3, 3) of poses (..., 4, 4).

    From X = t + s R r with X_z = 0. A camera above the plane sees nothing of it
    (w is made negative).
    """
    R, t = T_target_cam[..., :3, :3], T_target_cam[..., :3, 3:]
    H = np.empty(R.shape)
    H[..., :2, :] = t[..., :2, :] * R[..., 2:, :] - t[..., 2:, :] * R[..., :2, :]
    above = t[..., 2, :] >= 0.0
    H[..., 2, :] = np.where(above, _NOTHING, R[..., 2, :]) if above.any() else R[..., 2, :]
    return H


def trace(grid: RayGrid, to_plane: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return where the grid's rays meet the plane, (rows, cols, 2) m, and which do not.

    `to_plane` is the map (3, 3), or with a rolling shutter those of rows at equal distances
    from the picture's first to its last, (n, 3, 3).
    """
    if to_plane.ndim == 3:
        return _trace_by_row(grid, to_plane)
    if _all_rise(grid, to_plane):
        points = cv2.perspectiveTransform(grid.xy, to_plane)
        return np.asarray(points, np.float32), np.zeros(grid.xy.shape[:2], np.bool_)
    rays = grid.rays
    q = to_plane.astype(np.float32) @ rays.reshape(3, -1)
    return _met(q.reshape(3, *rays.shape[1:]))


def _trace_by_row(grid: RayGrid, maps: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    at = np.clip(grid.down, 0.0, 1.0) * (len(maps) - 1)
    low = np.minimum(at.astype(int), len(maps) - 2)
    share = (at - low)[:, None, None]
    H = ((1.0 - share) * maps[low] + share * maps[low + 1]).astype(np.float32)  # (rows, 3, 3)
    x, y = grid.xy[..., 0], grid.xy[..., 1]
    return _met(np.stack([H[:, i, :1] * x + H[:, i, 1:2] * y + H[:, i, 2:] for i in range(3)]))


def _met(q: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return points of (X w, Y w, w), shape (3, rows, cols)."""
    misses = q[2] < LEAST_RISE
    q[2, misses] = 1.0
    points = np.stack([q[0] / q[2], q[1] / q[2]], axis=-1)
    points[misses] = FAR_AWAY_M
    return np.asarray(points, np.float32), np.asarray(misses)


def _all_rise(grid: RayGrid, to_plane: Array) -> bool:
    """True if every ray meets the plane. The rise is linear over the rays, so it is least
    on the outline."""
    rise = to_plane[2].astype(np.float32)
    return bool(grid.outline.dot(rise[:2]).min() + rise[2] >= LEAST_RISE)


def local_px_per_m(nodes: NDArray[np.float32], row: int, col: int, stride: int) -> float:
    """Return the local scale of the picture around a node (geometric mean of both directions)."""
    row, col = min(max(row, 1), len(nodes) - 2), min(max(col, 1), nodes.shape[1] - 2)
    a = (nodes[row, col + 1] - nodes[row, col - 1]).astype(np.float64)
    b = (nodes[row + 1, col] - nodes[row - 1, col]).astype(np.float64)
    area = abs(a[0] * b[1] - a[1] * b[0])
    return 2.0 * stride / math.sqrt(max(area, 1e-12))


# --- What a lens makes of its pixels, for all pictures and all flights alike --------------------


VIGNETTING_EXPONENT = 0.6
"""Relative light is (1 + tan^2(angle))^-exponent; 2 would be the cos^4 law of a
bare lens, real ones correct most of it."""


def pixel_rays(fine: RayGrid) -> RayGrid:
    """Return the rays of all pixels; between the nodes they are interpolated (1e-4 px)."""
    xy = cv2.resize(fine.xy, None, fx=FINE_PX, fy=FINE_PX)[FINE_PX:-FINE_PX, FINE_PX:-FINE_PX]
    down = np.arange(len(xy)) * ((fine.down[2] - fine.down[1]) / FINE_PX)
    return RayGrid(1, np.asarray(xy, np.float32), np.asarray(down, np.float32), fine.outline)


@dataclass(frozen=True, eq=False)
class Lens:
    """`coarse` the rays of every eighth pixel, `pixels` of all of them; `shade` the relative light
    (height, width), 255 for all of it; `places` rays (3, 5) to the picture's middle and into its
    quarters; `focal_px` the mean of both directions."""

    coarse: RayGrid
    pixels: RayGrid
    shade: Picture
    places: Array
    focal_px: float


def lens_of(camera: CameraModel) -> Lens:
    """Return the camera's lens. Flights share it, since its rays take longer than 20 pictures."""
    return _lens(*camera.contents)


@lru_cache(maxsize=2)
def _lens(size_px: tuple[int, int], model: str, K: bytes, dist: bytes) -> Lens:
    camera = CameraModel(size_px, np.frombuffer(K).reshape(3, 3), np.frombuffer(dist), model)
    fine, coarse = ray_grid(camera, FINE_PX), ray_grid(camera, COARSE_PX)
    focal_px = float(camera.K[0, 0] + camera.K[1, 1]) / 2.0
    shade = vignetting(fine, size_px)
    return Lens(coarse, pixel_rays(fine), shade, _five_places(coarse), focal_px)


def _five_places(coarse: RayGrid) -> Array:
    rows, cols = coarse.xy.shape[:2]
    places = [(rows // 2, cols // 2)] + [
        (r, c) for r in (rows // 5, 4 * rows // 5) for c in (cols // 5, 4 * cols // 5)
    ]
    return np.array([[*coarse.xy[r, c], 1.0] for r, c in places], np.float64).T


def vignetting(fine: RayGrid, size_px: tuple[int, int]) -> Picture:
    """Return the lens's relative light, 255 for all of it; (height, width)."""
    r2 = (fine.rays[:2] ** 2).sum(axis=0)
    light = (255.0 * (1.0 + r2) ** -VIGNETTING_EXPONENT).astype(np.float32)
    full = cv2.resize(light, None, fx=FINE_PX, fy=FINE_PX)[FINE_PX:-FINE_PX, FINE_PX:-FINE_PX]
    return np.asarray(np.rint(full[: size_px[1], : size_px[0]]), np.uint8)
