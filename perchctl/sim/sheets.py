"""The scene of the simulated camera: printed sheets and the ceiling as textures, and the part of an
image that a sheet covers in one exposure.

Textures are kept at several resolutions, each the exact or filtered mean over its texels' areas,
so that sampling at about one texel per pixel is correct at any distance. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, invert_T, make_T, rot_z
from perchctl.profile import TargetConfig
from perchctl.sim.optics import COARSE_PX, Picture, local_px_per_m
from perchctl.sim.scenario import Neighbour
from perchctl.target import TargetDrawing, draw_target

PAPER_GREY, INK_GREY, CEILING_GREY = 225.0, 30.0, 140.0

SHEET_FINEST_PX_PER_M = 8000.0
SHEET_LEVELS = 28  # by a factor of 2^(1/4) per level: 8000 .. 74 px/m
TEXELS_PER_PIXEL = 2.0**0.875
"""Smallest number of texels per image pixel. Between two levels, there are 1.83 to 2.18."""
PIXEL_WINDOW_TEXELS = 2.0
"""Width of the window over which each texel is the exact mean, in texels: one image pixel. With a
smaller window, or one that is not a whole number of texels, edges would alias and be displaced by
up to 0.03 px."""
SAMPLING_SIGMA_PX = 1.0 / (PIXEL_WINDOW_TEXELS * math.sqrt(6.0))
"""Blur that bilinear sampling between texels adds to the pixel's own window."""

TILE_M = 2.0
"""Length after which the ceiling's texture repeats, m."""
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
"""Standard deviation of uniformly distributed bytes."""


class SheetTexture(NamedTuple):
    """The sheet at one resolution: `value` is grey times coverage, `alpha` is the coverage, and
    `uniform_texels` the distance to the next change of grey or coverage, along x or y, up to 255.

    A point (x, y) of the target's plane (target axes) is at column
    ``center_px + x * px_per_m`` and row ``center_px + y * px_per_m``.
    """

    value: Picture
    alpha: Picture
    uniform_texels: Picture
    px_per_m: float
    center_px: float


class Sheet:
    """The printed sheet's textures, built when first needed."""

    def __init__(self, drawing: TargetDrawing) -> None:
        self.drawing = drawing
        self._levels: dict[int, SheetTexture] = {}

    def texture(self, image_px_per_m: float) -> SheetTexture:
        """The texture at the resolution for an image of `image_px_per_m` pixels per metre."""
        ratio = SHEET_FINEST_PX_PER_M / (TEXELS_PER_PIXEL * max(image_px_per_m, 1.0))
        # Level -1 is the finest resolution without averaging, for views from closer than intended.
        level = min(max(math.floor(4.0 * math.log2(ratio)), -1), SHEET_LEVELS - 1)
        if level not in self._levels:
            px_per_m = SHEET_FINEST_PX_PER_M * 2.0 ** (-max(level, 0) / 4.0)
            self._levels[level] = self._build(px_per_m, 1.0 if level < 0 else PIXEL_WINDOW_TEXELS)
        return self._levels[level]

    def _build(self, px_per_m: float, window_px: float) -> SheetTexture:
        size = math.ceil(self.drawing.sheet_side_m * px_per_m) + 4
        # The arrays are computed in place, because a campaign uses the most memory here.
        sheet = self.drawing.sheet_coverage(px_per_m, size, window_px)
        alpha = np.multiply(sheet, 255.0)
        alpha = np.rint(alpha, out=alpha).astype(np.uint8)
        value = self.drawing.ink_coverage(px_per_m, size, window_px)
        value *= INK_GREY - PAPER_GREY
        sheet *= PAPER_GREY
        value += sheet
        grey = np.rint(value, out=value).astype(np.uint8)
        del sheet, value
        square = np.ones((3, 3), np.uint8)
        change = cv2.morphologyEx(grey, cv2.MORPH_GRADIENT, square)
        change = cv2.max(change, cv2.morphologyEx(alpha, cv2.MORPH_GRADIENT, square))
        away = cv2.distanceTransform(np.equal(change, 0).astype(np.uint8), cv2.DIST_C, 3)
        clear = np.minimum(away, 255.0, out=away).astype(np.uint8)
        return SheetTexture(grey, alpha, clear, px_per_m, (size - 1) / 2.0)


class CeilingTexture:
    """A seeded, seamless grey texture with detail from 2 mm to half a metre."""

    def __init__(self, rng: np.random.Generator) -> None:
        # Begin with the coarsest detail, and refine each sum before adding the next.
        tile = np.full((1, 1), CEILING_GREY, np.float32)
        for cells, sigma in CEILING_OCTAVES:
            tile = _finer(tile, cells // len(tile))
            # Same variance as a normal distribution, but ten times faster to draw.
            grey = rng.integers(0, 256, (cells, cells), np.uint8)
            tile += grey * np.float32(sigma / _BYTE_SIGMA) - np.float32(127.5 * sigma / _BYTE_SIGMA)
        self._tiles = [np.clip(tile, 0.0, 255.0)]
        while len(self._tiles[-1]) > 128:
            half = cv2.resize(self._tiles[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            self._tiles.append(np.asarray(half, np.float32))
        self._levels: dict[int, Picture] = {}

    def tile_and_texels_per_m(self, image_px_per_m: float) -> tuple[Picture, float]:
        """A seamless square tile of `CEILING_TEXTURE_PX`, and its texels per metre: 1 to 2
        per image pixel, or the nearest level."""
        finest = TILE_FINEST_PX / TILE_M
        level = math.floor(math.log2(finest / max(image_px_per_m, 1.0)))
        level = min(max(level, 0), len(self._tiles) - 1)
        if level not in self._levels:
            tile = np.rint(self._tiles[level]).astype(np.uint8)
            times = CEILING_TEXTURE_PX // len(tile)
            self._levels[level] = np.tile(tile, (times, times))
        return self._levels[level], finest / 2**level


def _finer(tile: NDArray[np.float32], zoom: int) -> NDArray[np.float32]:
    """Return the same smooth, seamless surface with more cells."""
    padded = np.pad(tile, 2, mode="wrap")
    # Interpolate one axis at a time, and crop the padding after each: at the coarsest detail, this
    # takes a third of the time.
    wide = cv2.resize(padded, None, fx=zoom, fy=1, interpolation=cv2.INTER_CUBIC)
    wide = np.ascontiguousarray(wide[:, 2 * zoom : -2 * zoom])
    big = cv2.resize(wide, None, fx=1, fy=zoom, interpolation=cv2.INTER_CUBIC)
    return np.asarray(big[2 * zoom : -2 * zoom], np.float32)


# --- Sheets on the ceiling, and their position in one exposure ---


Box = tuple[slice, slice]
"""Rows and columns of blocks of `COARSE_PX` pixels."""


# distance from a block's centre, rounded, to the farthest texel of a bilinear look-up
_LOOK_UP_TEXELS = 2.5


class SheetView(NamedTuple):
    """A sheet in one exposure: `box` is its part of the image, `to_texels` (3, 3) maps the plane of
    the vehicle's own target to the texture's columns and rows. `is_uniform` marks those of the
    box's blocks (rows, columns) whose pixels all have the same `value` and `alpha`. `covers_all` is
    True if the sheet covers the whole image."""

    texture: SheetTexture
    box: Box
    to_texels: Array
    covers_all: bool
    is_uniform: NDArray[np.bool_]
    value: Picture
    alpha: Picture


@dataclass(frozen=True, eq=False)
class PlacedSheet:
    """A sheet on the ceiling. `to_sheet` is the homography (3, 3) from the plane of the vehicle's
    own target to that of the sheet; None: the same plane."""

    sheet: Sheet
    to_sheet: Array | None = None

    def view(self, nodes: NDArray[np.float32], length_px: float) -> SheetView | None:
        """The sheet as seen at the coarse nodes' points (rows, columns, 2), m, in the axes of the
        vehicle's own target; None if the sheet is out of view.

        `length_px` is the image's longest motion in the exposure."""
        if self.to_sheet is not None:
            turn, shift = self.to_sheet[:2, :2].T, self.to_sheet[:2, 2]
            nodes = nodes @ turn.astype(np.float32) + shift.astype(np.float32)
        x, y = np.ascontiguousarray(nodes.transpose(2, 0, 1), np.float32)
        # Distance of each block's centre from the sheet's, along the axis with the larger distance,
        # and the distance that the block's pixels extend from there: half a block to each side.
        off_m = cv2.max(np.abs(x[1:-1, 1:-1]), np.abs(y[1:-1, 1:-1]))
        reach_m = cv2.max(_span(x), _span(y)) * np.float32(0.25 + 0.5 * length_px / COARSE_PX)
        half_m = self.sheet.drawing.sheet_side_m / 2.0
        near = off_m - np.minimum(reach_m, 1.0) < half_m
        if not near.any():
            return None
        hits = (np.flatnonzero(near.any(axis=axis)).tolist() for axis in (1, 0))
        rows, cols = (slice(hit[0], hit[-1] + 1) for hit in hits)
        j, i = ((each.start + each.stop - 1) // 2 + 1 for each in (rows, cols))
        texture = self.sheet.texture(local_px_per_m(nodes, j, i, COARSE_PX))
        scale, centre = texture.px_per_m, texture.center_px
        to_texels = np.array([[scale, 0.0, centre], [0.0, scale, centre], [0.0, 0.0, 1.0]])
        if self.to_sheet is not None:
            to_texels = to_texels @ self.to_sheet
        at = nodes[1:-1, 1:-1][rows, cols] * scale + centre
        inside = np.clip(np.rint(at), 0, len(texture.value) - 1).astype(int)
        u, v = inside[..., 0], inside[..., 1]
        clear = np.maximum(np.abs(at - inside).max(axis=-1), texture.uniform_texels[v, u])
        value, alpha = texture.value[v, u], texture.alpha[v, u]
        is_uniform = clear > reach_m[rows, cols] * scale + _LOOK_UP_TEXELS
        covers_all = bool((off_m + reach_m < half_m - 2.0 / scale).all())
        return SheetView(texture, (rows, cols), to_texels, covers_all, is_uniform, value, alpha)


def _span(x: NDArray[np.float32]) -> NDArray[np.float32]:
    level = cv2.absdiff(x[1:-1, 2:], x[1:-1, :-2])
    return np.asarray(cv2.add(level, cv2.absdiff(x[2:, 1:-1], x[:-2, 1:-1])), np.float32)


def union_box(boxes: Sequence[Box]) -> Box:
    """The smallest box around all `boxes`."""
    rows, cols = (
        slice(min(each.start for each in spans), max(each.stop for each in spans))
        for spans in zip(*boxes, strict=True)
    )
    return rows, cols


def pixel_slices(box: Box, margin_px: int = 0) -> tuple[slice, slice]:
    """The rows and columns of pixels in a box with a margin around it."""
    rows, cols = (
        slice(max(COARSE_PX * each.start - margin_px, 0), COARSE_PX * each.stop + margin_px)
        for each in box
    )
    return rows, cols


def neighbour_sheet(neighbour: Neighbour, own: TargetConfig) -> PlacedSheet:
    """Return the sheet of another vehicle's target. An id of None means the corresponding id of the
    vehicle's own target."""
    large = {} if neighbour.large_id is None else {"id": neighbour.large_id}
    small = {} if neighbour.small_id is None else {"id": neighbour.small_id}
    target = TargetConfig(
        large=own.large.model_copy(update=large), small=own.small.model_copy(update=small)
    )
    to_own = make_T(rot_z(neighbour.yaw_rad), (*neighbour.xy_m, 0.0))
    plane = np.delete(np.delete(invert_T(to_own), 2, axis=0), 2, axis=1)
    return PlacedSheet(printed_sheet(target.model_dump_json()), plane)


@lru_cache(maxsize=32)  # enough for the targets of a fleet
def printed_sheet(target_json: str) -> Sheet:
    """Return a target's sheet. Flights share its textures, which take more than a second to
    make."""
    return Sheet(draw_target(TargetConfig.model_validate_json(target_json)))
