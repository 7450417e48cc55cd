"""A camera's optics: the view rays of its pixels, their intersections with the target's plane, and
its vignetting.

Pixel (0, 0) is the centre of the top-left pixel, as in OpenCV. Pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import CameraModel

Picture = NDArray[np.uint8]

FINE_PX, COARSE_PX = 2, 8
"""Distances between the nodes of the two ray grids, px."""

FAR_AWAY_M = 1e4
"""Coordinate assigned to rays that miss the plane."""
LEAST_RISE = 0.02
"""Smallest z of a ray (target axes, depth 1 in the view) that still meets the plane."""


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Undistorted rays (x, y, 1) at nodes `stride` px apart.

    With a stride above 1 px, a margin of one node surrounds the image.

    Node (j, i) then sits at pixel ``stride * (i - 1) + (stride - 1) / 2``: where
    cv2.resize by `stride` puts its sample centres.
    """

    xy: NDArray[np.float32]  # (rows, cols, 2)
    row_share: NDArray[np.float32]  # (rows,), 0 in the image's first row, 1 in its last
    boundary_xy: NDArray[np.float32]  # (n, 2), the outermost rays


def ray_grid(camera: CameraModel, stride: int) -> RayGrid:
    """Return rays that cover the image, whose size is rounded up to whole coarse blocks."""
    cols, rows = (-(-side // COARSE_PX) * (COARSE_PX // stride) + 2 for side in camera.size_px)
    u = stride * (np.arange(cols) - 1) + (stride - 1) / 2.0
    v = stride * (np.arange(rows) - 1) + (stride - 1) / 2.0
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 1, 2)
    undistort: Any = cv2.undistortPoints
    if camera.model == "fisheye":
        undistort = cv2.fisheye.undistortPoints
    # by default, OpenCV stops iterating early, with errors of 0.12 px in the corners
    criteria = (3, 100, 1e-12)
    xy = undistort(pixels, camera.K, camera.dist, criteria=criteria)
    rays = np.ascontiguousarray(np.reshape(xy, (rows, cols, 2)), np.float32)
    down = np.asarray(v / (camera.size_px[1] - 1.0), np.float32)
    return RayGrid(rays, down, np.concatenate([rays[0], rays[-1], rays[:, 0], rays[:, -1]]))


def ray_to_plane_map(T_target_cam: Array) -> Array:
    """The homographies (..., 3, 3) from rays (x, y, 1) to homogeneous points (X w, Y w, w)
    of the target's plane, for poses (..., 4, 4).

    The homographies follow from X = t + s R r with X_z = 0. A camera above the plane does not see
    it (w is made negative).
    """
    R, t = T_target_cam[..., :3, :3], T_target_cam[..., :3, 3:]
    H = np.empty(R.shape)
    H[..., :2, :] = t[..., :2, :] * R[..., 2:, :] - t[..., 2:, :] * R[..., :2, :]
    H[..., 2, :] = np.where(t[..., 2, :] >= 0.0, (0.0, 0.0, -1.0), R[..., 2, :])
    return H


def trace_rays(grid: RayGrid, to_plane: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The points where the grid's rays meet the plane, (rows, cols, 2) m, and True for each
    ray that misses it, (rows, cols).

    `to_plane` is the map (3, 3) of `ray_to_plane_map`, or with a rolling shutter the maps (n, 3, 3)
    of n rows at equal distances from the image's first to its last.
    """
    x, y = grid.xy[..., 0], grid.xy[..., 1]
    if to_plane.ndim == 2:
        # The rise is linear in a ray's x and y, so its minimum is among the outermost rays.
        rise = to_plane[2].astype(np.float32)
        if grid.boundary_xy.dot(rise[:2]).min() + rise[2] >= LEAST_RISE:
            points = cv2.perspectiveTransform(grid.xy, to_plane)
            return np.asarray(points, np.float32), np.zeros(x.shape, np.bool_)
        rays = np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
        q = (to_plane.astype(np.float32) @ rays).reshape(3, *x.shape)
    else:
        at = np.clip(grid.row_share, 0.0, 1.0) * (len(to_plane) - 1)
        low = np.minimum(at.astype(int), len(to_plane) - 2)
        share = (at - low)[:, None, None]
        H = (1.0 - share) * to_plane[low] + share * to_plane[low + 1]  # (rows, 3, 3)
        H = H.astype(np.float32)
        q = np.stack([H[:, i, :1] * x + H[:, i, 1:2] * y + H[:, i, 2:] for i in range(3)])
    misses = q[2] < LEAST_RISE
    q[2, misses] = 1.0
    points = np.stack([q[0] / q[2], q[1] / q[2]], axis=-1)
    points[misses] = FAR_AWAY_M
    return np.asarray(points, np.float32), np.asarray(misses)


def local_px_per_m(nodes: NDArray[np.float32], row: int, col: int, stride: int) -> float:
    """Return the pixels per metre around each node, the mean of both directions, from the nodes'
    points in m."""
    row, col = min(max(row, 1), len(nodes) - 2), min(max(col, 1), nodes.shape[1] - 2)
    a = (nodes[row, col + 1] - nodes[row, col - 1]).astype(np.float64)
    b = (nodes[row + 1, col] - nodes[row - 1, col]).astype(np.float64)
    area = abs(a[0] * b[1] - a[1] * b[0])
    return 2.0 * stride / math.sqrt(max(area, 1e-12))


# --- The mapping of a lens, shared by all images and flights ---


VIGNETTING_EXPONENT = 0.6
"""Exponent of the vignetting: relative light is (1 + tan^2(angle))^-exponent."""


@dataclass(frozen=True, eq=False)
class Lens:
    """`coarse` holds the rays of every eighth pixel, `pixels` the rays of all; `shade` is the
    vignetting (height, width), 255 for no loss; `sample_rays` (3, 5) go through the image's
    middle and its quarters; `focal_px` is the mean focal length of x and y."""

    coarse: RayGrid
    pixels: RayGrid
    shade: Picture
    sample_rays: Array
    focal_px: float


def shared_lens(camera: CameraModel) -> Lens:
    """Return the camera's lens, which all flights share."""
    return _lens(*camera.calibration_key)


@lru_cache(maxsize=2)
def _lens(size_px: tuple[int, int], model: str, K: bytes, dist: bytes) -> Lens:
    camera = CameraModel(size_px, np.frombuffer(K).reshape(3, 3), np.frombuffer(dist), model)
    fine, coarse = ray_grid(camera, FINE_PX), ray_grid(camera, COARSE_PX)

    def finer(nodes: NDArray[np.float32]) -> NDArray[np.float32]:
        """Interpolate between the fine nodes, with an error of 1e-4 px."""
        pixels = cv2.resize(nodes, None, fx=FINE_PX, fy=FINE_PX)
        return np.asarray(pixels[FINE_PX:-FINE_PX, FINE_PX:-FINE_PX], np.float32)

    xy = finer(fine.xy)
    down = np.arange(len(xy)) * ((fine.row_share[2] - fine.row_share[1]) / FINE_PX)
    pixels = RayGrid(xy, np.asarray(down, np.float32), fine.boundary_xy)
    r2 = (fine.xy[..., 0] ** 2) + (fine.xy[..., 1] ** 2)
    light = finer((255.0 * (1.0 + r2) ** -VIGNETTING_EXPONENT).astype(np.float32))
    shade = np.asarray(np.rint(light[: size_px[1], : size_px[0]]), np.uint8)
    rows, cols = coarse.xy.shape[:2]
    places = [(rows // 2, cols // 2)] + [
        (r, c) for r in (rows // 5, 4 * rows // 5) for c in (cols // 5, 4 * cols // 5)
    ]
    rays = np.array([[*coarse.xy[place], 1.0] for place in places], np.float64).T
    return Lens(coarse, pixels, shade, rays, float(camera.K[0, 0] + camera.K[1, 1]) / 2.0)
