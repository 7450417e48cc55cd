"""The picture in tiles of 8 x 8 pixels: which of them a sheet fills with one grey, and the rays
of the others; pure.

Most of a near sheet is even paper or even ink. A tile whose pixels, on all their way within the
exposure, look up equal texels needs no look-up at each of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.sim.rays import COARSE_PX, FINE_PX, RayGrid
from perchctl.sim.surfaces import FARTHEST_EDGE_TEXELS, Picture, SheetTexture

TILE_PX = COARSE_PX
"""Each tile has a coarse node in its centre."""
_ROOM_TEXELS = 1.5
"""For the neighbours that a bilinear look-up reads, and the centre's rounding."""
_EVERY_BYTE = np.uint64(0x0101010101010101)
_MOST = 0.4
"""Of a picture's tiles, from which on filling goes along its rows."""
Mask = NDArray[np.bool_]
Box = tuple[slice, slice]
"""Rows and columns of tiles."""


@dataclass(frozen=True, eq=False)
class TileRays:
    """Rays of all pixels, tile by tile: xy (tiles, 64, 2), down (tiles, 8)."""

    xy: NDArray[np.float32]
    down: NDArray[np.float32]
    outline: NDArray[np.float32]

    def of(self, tiles: NDArray[np.intp]) -> RayGrid:
        """Eight rows of eight rays for each of these tiles."""
        xy = self.xy.take(tiles, axis=0).reshape(-1, TILE_PX, 2)
        return RayGrid(1, xy, self.down.take(tiles, axis=0).ravel(), self.outline)


def tile_rays(fine: RayGrid) -> TileRays:
    """Of a whole picture's rays; between the nodes they are interpolated (1e-4 px)."""
    xy = cv2.resize(fine.xy, None, fx=FINE_PX, fy=FINE_PX)[FINE_PX:-FINE_PX, FINE_PX:-FINE_PX]
    rows, cols = (n // TILE_PX for n in xy.shape[:2])
    blocks = xy.reshape(rows, TILE_PX, cols, TILE_PX, 2).transpose(0, 2, 1, 3, 4)
    down = np.arange(rows * TILE_PX) * ((fine.down[2] - fine.down[1]) / FINE_PX)
    by_tile = np.repeat(down.reshape(rows, 1, TILE_PX), cols, axis=1)
    return TileRays(
        np.ascontiguousarray(blocks, np.float32).reshape(rows * cols, TILE_PX**2, 2),
        np.asarray(by_tile, np.float32).reshape(rows * cols, TILE_PX),
        fine.outline,
    )


@dataclass(frozen=True, eq=False)
class Reach:
    """Where the tiles lie in a sheet's axes, all (rows, columns): their centres' texture
    coordinates are not yet scaled; `off_m` is how far the centre is from the sheet's, along the
    axis along which it is farther, `reach_m` from there to the farthest that its pixels look."""

    centres_m: NDArray[np.float32]
    off_m: NDArray[np.float32]
    reach_m: NDArray[np.float32]

    def near(self, side_m: float) -> Mask:
        """Tiles that may show a sheet of that side."""
        return np.asarray(self.off_m - np.minimum(self.reach_m, 1.0) < side_m / 2.0)

    def within(self, box: Box) -> Reach:
        """Of these tiles alone."""
        return Reach(self.centres_m[box], self.off_m[box], self.reach_m[box])


def reach_of(nodes: NDArray[np.float32], length_px: float) -> Reach:
    """`nodes` are the coarse ones in the sheet's axes, `length_px` is the longest way of its
    picture within the exposure."""
    x, y = np.ascontiguousarray(nodes.transpose(2, 0, 1), np.float32)
    # Half a tile to each side, by the distance of the nodes at both sides; the outermost pixels'
    # centres lie an eighth less far out.
    reach_m = cv2.max(_span(x), _span(y)) * np.float32(0.25 + 0.5 * length_px / TILE_PX)
    off_m = cv2.max(np.abs(x[1:-1, 1:-1]), np.abs(y[1:-1, 1:-1]))
    return Reach(nodes[1:-1, 1:-1], np.asarray(off_m, np.float32), reach_m)


@dataclass(frozen=True, eq=False)
class Tiles:
    """What a sheet does to each tile; all (rows, columns).

    even: it fills the tile with `grey`; edges, outline: the tile's pixels differ, and all of it
    is on the sheet, or is not; inner: all of it is on the sheet.
    """

    even: Mask
    edges: Mask
    outline: Mask
    inner: Mask
    grey: Picture


def tiles_of(reach: Reach, texture: SheetTexture, side_m: float) -> Tiles:
    """What a sheet of that side does to the tiles."""
    scale, half_m = np.float32(texture.px_per_m), side_m / 2.0
    room_m = _ROOM_TEXELS / texture.px_per_m
    inner = reach.off_m + reach.reach_m < half_m - room_m
    texels = reach.centres_m * scale + np.float32(texture.center_px)
    to_edge = _nearest(texture.to_edge, texels + np.float32(FARTHEST_EDGE_TEXELS))
    plain = to_edge > reach.reach_m * scale + np.float32(_ROOM_TEXELS)
    plain |= reach.off_m - reach.reach_m > half_m + room_m
    grey = _nearest(texture.value, texels)
    return Tiles(plain & (grey > 0), inner & ~plain, ~inner & ~plain, inner, grey)


def box_of(near: Mask) -> Box | None:
    """What holds all tiles that are `near`; None where there are none."""
    rows, cols = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    if not len(rows):
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


def box_around(boxes: Sequence[Box]) -> Box | None:
    """What holds all of them; None where there are none."""
    if not boxes:
        return None
    rows, cols = zip(*boxes, strict=True)
    return _both(rows), _both(cols)


def _both(spans: Sequence[slice]) -> slice:
    return slice(min(each.start for each in spans), max(each.stop for each in spans))


def pixels_of(box: Box, margin_px: int) -> Box:
    """The rows and columns of pixels in a box, and so many around it."""
    rows, cols = (
        slice(max(TILE_PX * each.start - margin_px, 0), TILE_PX * each.stop + margin_px)
        for each in box
    )
    return rows, cols


def by_tile(picture: Picture) -> NDArray[np.uint64]:
    """A view of a picture of whole tiles: (rows, columns, 8), each number a row of 8 pixels."""
    height, width = picture.shape
    words = picture.view(np.uint64).reshape(height // TILE_PX, TILE_PX, width // TILE_PX)
    return words.transpose(0, 2, 1)


def fill(picture: NDArray[np.uint64], which: Mask, grey: Picture) -> None:
    """Tiles of a picture `by_tile` become even."""
    if np.count_nonzero(which) > _MOST * which.size:
        words = (grey * _EVERY_BYTE)[:, None]
        np.copyto(picture.transpose(0, 2, 1), words, where=which[:, None])
    else:
        picture[which] = (grey[which] * _EVERY_BYTE)[:, None]


def _span(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """Between the nodes to the left and right, and above and below, in sum."""
    level = cv2.absdiff(x[1:-1, 2:], x[1:-1, :-2])
    return np.asarray(cv2.add(level, cv2.absdiff(x[2:, 1:-1], x[:-2, 1:-1])), np.float32)


def _nearest(image: Picture, texels: NDArray[np.float32]) -> Picture:
    remap: Any = cv2.remap  # its stub denies that the second map may be None
    return np.asarray(remap(image, texels, None, cv2.INTER_NEAREST), np.uint8)
