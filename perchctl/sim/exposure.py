"""Motion within one exposure: how many poses it needs, and its blur as a kernel; pure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array

SHARP_MOTION_PX = 0.25
"""Motion in one exposure below which one pose is enough (its blur has sigma 0.07 px)."""
SAMPLE_SPACING_PX = 1.3
"""Distance of the poses averaged for motion blur: the ripple this leaves lies above
the pixels' own resolution."""
MAX_SAMPLES = 16
MAX_KERNEL_REACH_PX = 12


def path_length_px(motion_px: Array) -> float:
    """Longest path of any of the places, `motion_px` (places, times, 2)."""
    steps = motion_px[:, 1:] - motion_px[:, :-1]
    return float(np.sqrt((steps * steps).sum(axis=2)).sum(axis=1).max())


def sample_count(length_px: float) -> int:
    """How many poses the blur of a path of that length needs; 1 for a sharp frame."""
    if length_px < SHARP_MOTION_PX:
        return 1
    return min(max(math.ceil(length_px / SAMPLE_SPACING_PX), 2), MAX_SAMPLES)


def spread(poses: Array, count: int) -> Array:
    """`count` poses (count, 4, 4) at the middles of equal parts of the exposure.

    Linear in the matrices of `poses` (n, 4, 4): within an exposure the turn is so small
    (< 0.05 rad) that the loss of orthogonality is below 1e-3 of a pixel.
    """
    if len(poses) == 1:
        return np.broadcast_to(poses, (count, 4, 4))
    last = len(poses) - 1
    places = [(i + 0.5) / count * last for i in range(count)]
    low = [min(int(place), last - 1) for place in places]
    part = np.array([p - i for p, i in zip(places, low, strict=True)])[:, None, None]
    return np.asarray((1.0 - part) * poses[low] + part * poses[[i + 1 for i in low]])


def line_kernel(motion_px: Array) -> NDArray[np.float32] | None:
    """Blur kernel of the path at the image's middle, or None if it is too short to see."""
    path = motion_px[0] - motion_px[0].mean(axis=0)
    reach = float(np.abs(path).max())
    if reach < SHARP_MOTION_PX / 2.0:
        return None
    count = min(2 * math.ceil(reach) + 1, MAX_SAMPLES)
    at = (np.arange(count) + 0.5) / count * (len(path) - 1)
    steps = np.arange(len(path))
    half = min(math.ceil(reach) + 1, 12)
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for x, y in zip(
        np.interp(at, steps, path[:, 0]), np.interp(at, steps, path[:, 1]), strict=True
    ):
        x, y = np.clip(x, -half, half - 1e-6), np.clip(y, -half, half - 1e-6)
        i, j = math.floor(x), math.floor(y)
        fx, fy = x - i, y - j
        weights = np.outer([1.0 - fy, fy], [1.0 - fx, fx])
        kernel[j + half : j + half + 2, i + half : i + half + 2] += weights.astype(np.float32)
    return np.asarray(kernel / kernel.sum(), np.float32)
