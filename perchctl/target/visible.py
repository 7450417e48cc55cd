"""What of the ceiling a camera has in its picture."""

from __future__ import annotations

import math

import numpy as np

from perchctl.geometry import Array
from perchctl.vision import CameraModel, undistort

MARGIN_PX = 3.0
"""cv2.aruco drops markers nearer than this to the picture's edge."""
_EDGE_POINTS = 200
NEAREST_M, FARTHEST_M = 1e-3, 50.0


class FieldOfView:
    """The picture's edge in view rays, as a distance from the axis in every direction."""

    def __init__(self, camera: CameraModel, margin_px: float = MARGIN_PX) -> None:
        width, height = camera.size_px
        low, right, bottom = margin_px - 0.5, width - 0.5 - margin_px, height - 0.5 - margin_px
        s = np.linspace(0.0, 1.0, _EDGE_POINTS, endpoint=False)
        x, y = low + s * (right - low), low + s * (bottom - low)
        edge_px = np.concatenate(
            [
                np.stack([x, np.full_like(s, low)], axis=1),
                np.stack([np.full_like(s, right), y], axis=1),
                np.stack([right + low - x, np.full_like(s, bottom)], axis=1),
                np.stack([np.full_like(s, low), bottom + low - y], axis=1),
            ]
        )
        rays = undistort(edge_px, camera)
        rays = rays[np.isfinite(rays).all(axis=1)]
        angle = np.arctan2(rays[:, 1], rays[:, 0])
        order = np.argsort(angle)
        self._angle, self._reach = angle[order], np.hypot(*rays.T)[order]

    def holds(self, points_cam_m: Array) -> bool:
        """Whether all points (n, 3) of the camera frame are in the picture."""
        x, y, z = points_cam_m.T
        if (z <= 0.0).any():
            return False
        reach = np.interp(np.arctan2(y, x), self._angle, self._reach, period=2.0 * math.pi)
        return bool((np.hypot(x, y) <= reach * z).all())

    def nearest_m(self, outline_m: Array, R: Array, offset_m: Array) -> float | None:
        """The shortest distance d at which ``R (x, y, d) + offset`` is in the picture for
        all points (x, y) of `outline_m` (n, 2) and from there on; None if for no distance."""

        def seen(d: float) -> bool:
            points = np.column_stack([outline_m, np.full(len(outline_m), d)])
            return self.holds(points @ R.T + offset_m)

        low, high = NEAREST_M, FARTHEST_M
        if not seen(high):
            return None
        if seen(low):
            return low
        while high / low > 1.0005:
            middle = math.sqrt(low * high)
            low, high = (low, middle) if seen(middle) else (middle, high)
        return high


def square_outline(side_m: float) -> Array:
    """Points along an upright square, (n, 2)."""
    s = np.linspace(-0.5, 0.5, 21) * side_m
    h = np.full_like(s, side_m / 2.0)
    return np.concatenate([np.column_stack(pair) for pair in ((s, h), (s, -h), (h, s), (-h, s))])


def turned_outline(side_m: float) -> Array:
    """The circle through the corners: the square at any turn, (n, 2)."""
    a = np.linspace(0.0, 2.0 * math.pi, 180, endpoint=False)
    return np.asarray(side_m / math.sqrt(2.0) * np.column_stack([np.cos(a), np.sin(a)]))
