"""A camera that does not move: its picture before noise is made once.

On the floor and under the magnet the vehicle stirs by less than any picture shows. Where the
picture moves by less than `STILL_PX` within the exposure, its pose is rounded; the same rounded
pose has the same picture. That is so whichever of the others are looked at, as their bytes must
not hang on it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from perchctl.geometry import Array
from perchctl.sim.surfaces import Picture

STILL_PX = 0.005
STEP = 2.0**-17
"""Of the directions, and of the place in parts of its distance, to the next power of two: half
a step moves no place of a picture of 400 px focal length by 0.01 px, most by 0.002 px."""


def rounded(T_target_cam: Array) -> Array:
    """The pose (4, 4) of a still camera."""
    steps = np.full((3, 4), STEP)
    steps[:, 3] *= 2.0 ** np.floor(np.log2(max(abs(float(T_target_cam[2, 3])), 1e-3)))
    T = np.eye(4)
    T[:3] = np.rint(T_target_cam[:3] / steps) * steps
    return T


class _Made(NamedTuple):
    pose: bytes
    sigma_px: float
    picture: Picture


class Stills:
    """Keeps the last still picture."""

    def __init__(self) -> None:
        self._last: _Made | None = None

    def forget(self) -> None:
        """What it shows has changed."""
        self._last = None

    def picture(self, pose: Array, sigma_px: float, make: Callable[[], Picture]) -> Picture:
        """Of a `rounded` pose and a blur of the lens: kept, or made. Not to be written into."""
        key = pose.tobytes()
        last = self._last
        if last is None or (last.pose, last.sigma_px) != (key, sigma_px):
            last = self._last = _Made(key, sigma_px, make())
        return last.picture
