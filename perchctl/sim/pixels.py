"""Sums, look-ups and shading of whole pictures; pure."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.sim.rays import FINE_PX, RayGrid
from perchctl.sim.surfaces import Picture
from perchctl.sim.tiles import Box, pixels_of

VIGNETTING_EXPONENT = 0.6
"""Relative light is (1 + tan^2(angle))^-exponent; 2 would be the cos^4 law of a
bare lens, real ones correct most of it."""


class Mean:
    """Mean of `count` pictures, rounded once."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._sum: Any = None

    def add(self, picture: Picture) -> None:
        if self._count == 1:
            self._sum = picture
        elif self._sum is None:
            self._sum = picture.astype(np.uint16)
        else:
            self._sum = cv2.add(self._sum, picture, dtype=cv2.CV_16U)

    def result(self) -> Picture:
        assert self._sum is not None
        if self._count == 1:
            return np.asarray(self._sum, np.uint8)
        return np.asarray(cv2.convertScaleAbs(self._sum, alpha=1.0 / self._count), np.uint8)


def sample(texture: Picture, texels: Any, border: int = cv2.BORDER_CONSTANT) -> Picture:
    """Bilinear look-up at `texels` (h, w, 2) float32; 0 outside, or repeating."""
    remap: Any = cv2.remap  # its stub denies that the second map may be None
    return np.asarray(remap(texture, texels, None, cv2.INTER_LINEAR, borderMode=border), np.uint8)


def defocused(picture: Picture, sigma_px: float, box: Box) -> None:
    """Blurs the tiles of `box`, and what is so near to them that it shows a part of their blur."""
    reach = math.ceil(3.0 * sigma_px) + 1
    near, far = pixels_of(box, reach), pixels_of(box, 2 * reach)
    blurred = cv2.GaussianBlur(picture[far], (0, 0), sigma_px)
    top, left = (a.start - b.start for a, b in zip(near, far, strict=True))
    into = picture[near]
    into[:] = blurred[top : top + into.shape[0], left : left + into.shape[1]]


def vignetting(fine: RayGrid, size_px: tuple[int, int]) -> Picture:
    """The lens's relative light, 255 for all of it; (height, width)."""
    r2 = (fine.rays[:2] ** 2).sum(axis=0)
    light = (255.0 * (1.0 + r2) ** -VIGNETTING_EXPONENT).astype(np.float32)
    full = cv2.resize(light, None, fx=FINE_PX, fy=FINE_PX)[FINE_PX:-FINE_PX, FINE_PX:-FINE_PX]
    return np.asarray(np.rint(full[: size_px[1], : size_px[0]]), np.uint8)


def lit(picture: Picture, light: NDArray[np.float64]) -> Picture:
    """The picture with each row's brightness multiplied by `light` (height,)."""
    factor = np.broadcast_to(light.astype(np.float32)[:, None], picture.shape)
    return np.asarray(cv2.multiply(picture, np.ascontiguousarray(factor), dtype=cv2.CV_8U))
