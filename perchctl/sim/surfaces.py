"""What the simulated camera looks at: the printed sheet and the ceiling, as textures.

Both are kept at several resolutions, each the exact or filtered mean over its
texels' areas, so that sampling near one texel a pixel is correct near and far.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.target import TargetDrawing

Picture = NDArray[np.uint8]

PAPER_GREY, INK_GREY, CEILING_GREY = 225.0, 30.0, 140.0

SHEET_FINEST_PX_PER_M = 8000.0
SHEET_LEVELS = 28  # a factor 2^(1/4) between levels: 8000 .. 74 px/m
TEXELS_PER_PIXEL = 2.0**0.875
"""Texels per image pixel, at least: 1.83 to 2.18 from one level to the next."""
PIXEL_WINDOW_TEXELS = 2.0
"""Each texel is the exact mean over a window of one image pixel's size. A smaller
window, or one that is no whole number of texels, aliases: edges would be out of
place by up to 0.03 px."""
SAMPLING_SIGMA_PX = 1.0 / (PIXEL_WINDOW_TEXELS * math.sqrt(6.0))
"""Blur that bilinear sampling between texels adds to the pixel's own window."""
FARTHEST_EDGE_TEXELS = 128
"""Edges farther away than that are not told apart."""

TILE_M = 2.0
"""The ceiling's texture repeats after this length."""
TILE_FINEST_PX = 1024
CEILING_TEXTURE_PX = 2048
CEILING_OCTAVES: tuple[tuple[int, float], ...] = (
    # (cells along the tile, standard deviation in grey levels)
    (4, 5.0),
    (16, 4.0),
    (64, 3.0),
    (256, 3.0),
    (1024, 3.0),
)


_BYTE_SIGMA = math.sqrt((256.0**2 - 1.0) / 12.0)
"""Spread of bytes that are all as likely."""


@dataclass(frozen=True, eq=False)
class SheetTexture:
    """The sheet at one resolution: `value` is grey times coverage, `alpha` coverage.

    A point (x, y) of the target's plane (target axes) is at column
    ``center_px + x * px_per_m`` and row ``center_px + y * px_per_m``. `to_edge` is how many
    texels, along rows or columns, it is to the next that differs from its neighbours; it has
    `FARTHEST_EDGE_TEXELS` more at each side, and says no more than these.
    """

    value: Picture
    alpha: Picture
    px_per_m: float
    center_px: float
    to_edge: Picture


class Sheet:
    """The printed sheet's textures, built when first needed."""

    def __init__(self, drawing: TargetDrawing) -> None:
        self.drawing = drawing
        self._levels: dict[int, SheetTexture] = {}

    def texture(self, image_px_per_m: float) -> SheetTexture:
        """The level that suits an image in which one metre spans that many pixels."""
        ratio = SHEET_FINEST_PX_PER_M / (TEXELS_PER_PIXEL * max(image_px_per_m, 1.0))
        # Level -1 is the finest resolution with single texels, for views nearer than it suits.
        level = min(max(math.floor(4.0 * math.log2(ratio)), -1), SHEET_LEVELS - 1)
        if level not in self._levels:
            px_per_m = SHEET_FINEST_PX_PER_M * 2.0 ** (-max(level, 0) / 4.0)
            self._levels[level] = self._build(px_per_m, 1.0 if level < 0 else PIXEL_WINDOW_TEXELS)
        return self._levels[level]

    def _build(self, px_per_m: float, window_px: float) -> SheetTexture:
        size = math.ceil(self.drawing.sheet_side_m * px_per_m) + 4
        # In place: at the finest level each array of these has 20 MB, and a campaign's peak of
        # memory is here.
        sheet = self.drawing.sheet_coverage(px_per_m, size, window_px)
        alpha = np.multiply(sheet, 255.0)
        alpha = np.rint(alpha, out=alpha).astype(np.uint8)
        value = self.drawing.ink_coverage(px_per_m, size, window_px)
        value *= INK_GREY - PAPER_GREY
        sheet *= PAPER_GREY
        value += sheet
        grey = np.rint(value, out=value).astype(np.uint8)
        del sheet, value
        return SheetTexture(grey, alpha, px_per_m, (size - 1) / 2.0, _to_edge(grey, alpha))


def _to_edge(value: Picture, alpha: Picture) -> Picture:
    even = np.ones(np.add(value.shape, 2 * FARTHEST_EDGE_TEXELS), np.bool_)
    inside = slice(FARTHEST_EDGE_TEXELS, -FARTHEST_EDGE_TEXELS)
    near = np.ones((3, 3), np.uint8)
    for each in (value, alpha):
        even[inside, inside] &= cv2.dilate(each, near) == cv2.erode(each, near)
    distance = cv2.distanceTransform(even.astype(np.uint8), cv2.DIST_C, 3)
    return np.minimum(distance, FARTHEST_EDGE_TEXELS - 1).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class CeilingTexture:
    """A piece of ceiling, `CEILING_TEXTURE_PX` square, that repeats without a seam."""

    image: Picture
    px_per_m: float


class Ceiling:
    """A seeded, seamless grey texture with detail from 2 mm to half a metre."""

    def __init__(self, rng: np.random.Generator) -> None:
        # The coarsest first, each sum made finer before the next is added.
        tile = np.full((1, 1), CEILING_GREY, np.float32)
        for cells, sigma in CEILING_OCTAVES:
            tile = _finer(tile, cells // len(tile))
            # As wide as a normal distribution, at a tenth of the price.
            grey = rng.integers(0, 256, (cells, cells), np.uint8)
            tile += grey * np.float32(sigma / _BYTE_SIGMA) - np.float32(127.5 * sigma / _BYTE_SIGMA)
        self._tiles = [np.clip(tile, 0.0, 255.0)]
        while len(self._tiles[-1]) > 128:
            half = cv2.resize(self._tiles[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            self._tiles.append(np.asarray(half, np.float32))
        self._levels: dict[int, CeilingTexture] = {}

    def texture(self, image_px_per_m: float) -> CeilingTexture:
        """The level with 1 to 2 texels a pixel, or the nearest there is."""
        finest = TILE_FINEST_PX / TILE_M
        level = math.floor(math.log2(finest / max(image_px_per_m, 1.0)))
        level = min(max(level, 0), len(self._tiles) - 1)
        if level not in self._levels:
            tile = np.rint(self._tiles[level]).astype(np.uint8)
            times = CEILING_TEXTURE_PX // len(tile)
            self._levels[level] = CeilingTexture(np.tile(tile, (times, times)), finest / 2**level)
        return self._levels[level]


def _finer(tile: NDArray[np.float32], zoom: int) -> NDArray[np.float32]:
    """The same smooth surface with more cells; left and right, top and bottom fit together."""
    padded = np.pad(tile, 2, mode="wrap")
    # One axis after the other, without what lies around the tile: at the coarsest a third.
    wide = cv2.resize(padded, None, fx=zoom, fy=1, interpolation=cv2.INTER_CUBIC)
    wide = np.ascontiguousarray(wide[:, 2 * zoom : -2 * zoom])
    big = cv2.resize(wide, None, fx=1, fy=zoom, interpolation=cv2.INTER_CUBIC)
    return np.asarray(big[2 * zoom : -2 * zoom], np.float32)
