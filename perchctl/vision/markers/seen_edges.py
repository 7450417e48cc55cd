"""The edges of a marker where they are seen: on profiles across its sides, and across the inner
edges of its border, that are in the picture, not hidden, and neither glaring nor shaded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.values import replace
from perchctl.vision.camera_model import pinhole_px, undistort
from perchctl.vision.markers.edges import Surroundings, locate
from perchctl.vision.markers.pattern import Pattern
from perchctl.vision.markers.profiles import STEPS, Floats, places, sample, side_profiles
from perchctl.vision.markers.square import (
    BEFORE,
    NEXT,
    UNIT,
    doubled_area,
    mapped,
    side_lengths_px,
)
from perchctl.vision.types import CameraModel

ROOM_PX = 2.0
"""To the picture's edge, where blur would need what is beyond it."""
OUT: Array = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
"""Of each side, in the marker's own coordinates."""
_INNER_CELL_PX = 6.0  # of a border whose inner edge is seen apart from the outer one
_TOO_BRIGHT, _TOO_DARK = 0.2, 0.5  # of the contrast: of black inside, of white outside
_MIN_CONTRAST = 10.0
_MIN_WEIGHT = 3.0  # of a side's profiles
_LEAST_EDGES = 4  # a square has eight unknowns, and an edge fixes two
_FAR_PX = 1e6
_REACH: Array = np.linspace(-1.0, 1.0, STEPS // 2 + 1)[:, None]


@dataclass(frozen=True, eq=False)
class _Rows:
    """The marker's sides and perhaps the inner edges of its border: starts, ends (rows, 2)
    normalised; of each row (rows,) the side that it belongs to, its distance from the centre in
    half sides, its length, pixels for a half side across it, and +1 where white is to the left of
    the way from start to end; the mean width of a cell."""

    starts: Array
    ends: Array
    side: NDArray[np.intp]
    at: Array
    lengths_px: Array
    scale_px: Array
    cell_px: float
    sign: Array

    def only(self, kept: NDArray[np.intp]) -> _Rows:
        """Some of them."""
        return _Rows(
            starts=self.starts[kept],
            ends=self.ends[kept],
            side=self.side[kept],
            at=self.at[kept],
            lengths_px=self.lengths_px[kept],
            scale_px=self.scale_px[kept],
            cell_px=self.cell_px,
            sign=self.sign[kept],
        )


@dataclass(frozen=True, eq=False)
class _Lit:
    """Which profiles (rows, n) show an edge as it should be, and how white the paper is."""

    good: NDArray[np.bool_]
    white: float


@dataclass(frozen=True, eq=False)
class SeenEdges:
    """Edges of one round: of each profile (rows, n) its place in the marker's own coordinates
    (rows, n, 2), how far outwards it is from where the square has it, and its weight; of
    each row (rows,) what `_Rows` has of it, +1 where white grown over black moves it in, and
    its blur in terms of the window; and how white the paper is."""

    own: Array
    far_px: Array
    weight: Array
    side: NDArray[np.intp]
    at: Array
    scale_px: Array
    inwards: Array
    blur: Array
    white: float


def look(
    image: NDArray[np.uint8],
    H: Array,
    pattern: Pattern,
    camera: CameraModel,
    hidden: NDArray[np.bool_] | None,
) -> SeenEdges | None:
    """The edges near to where the square H has them; None where too few are seen. Sides of
    which nothing is seen are left out."""
    rows = _rows(H, pattern, camera)
    if rows is None:
        return None
    s = places(rows.lengths_px)
    origin, normal = side_profiles(rows.starts, rows.ends, s, camera)
    if not (np.abs(origin) < _FAR_PX).all():
        return None  # a lens model throws what is far outside anywhere, to no number too
    normal *= rows.sign[:, None, None]
    near_px = np.full(len(rows.at), min(max(0.85 * rows.cell_px, 1.5), 7.0))
    half_px = np.full(len(rows.at), min(max(1.5 * rows.cell_px, 1.75), 7.0))
    around = _surroundings(s, pattern, 2.0 * rows.scale_px / pattern.rim.cells)
    free = around.possible & _in_view(image.shape, hidden, origin, normal, near_px)
    kept = np.flatnonzero(np.count_nonzero(free, axis=1) >= _MIN_WEIGHT)
    if len(kept) < _LEAST_EDGES:
        return None
    rows, around = rows.only(kept), around.only(kept)
    origin, normal, free = origin[kept], normal[kept], free[kept]
    near_px, half_px = near_px[kept], half_px[kept]
    grey = sample(image, origin, normal, half_px)
    lit = _unspoilt(grey, free, near_px, half_px)
    if lit is None:
        return None
    edges = locate(grey, half_px, near_px, replace(around, possible=lit.good))
    weight = np.where(lit.good, edges.weight, 0.0)
    weight[weight.sum(axis=1) < _MIN_WEIGHT] = 0.0
    found = undistort((origin + edges.offset_px[..., None] * normal).reshape(-1, 2), camera)
    own = mapped(np.asarray(np.linalg.inv(H)), pinhole_px(found, camera)).reshape(origin.shape)
    if not np.isfinite(own).all():
        return None
    far = np.einsum("rni,ri->rn", own, OUT[rows.side]) - rows.at[:, None]
    return SeenEdges(
        own=own,
        far_px=far * rows.scale_px[:, None],
        weight=weight,
        side=rows.side,
        at=rows.at,
        scale_px=rows.scale_px,
        inwards=np.where(rows.at < 1.0, -1.0, 1.0),
        blur=edges.blur_px / near_px,
        white=lit.white,
    )


def _rows(H: Array, pattern: Pattern, camera: CameraModel) -> _Rows | None:
    """Of the square H, unit to pinhole px; None where that is none."""
    corners, cells = mapped(H, UNIT), pattern.rim.cells
    sides_px = side_lengths_px(corners)
    if not (np.isfinite(corners).all() and sides_px.min() > 1.0):
        return None
    cell_px = float(sides_px.mean()) / cells
    rings = (1.0, 1.0 - 2.0 / cells) if cell_px > _INNER_CELL_PX else (1.0,)
    at = np.repeat(rings, 4)
    side = np.arange(len(at)) % 4
    to_rays: Array = np.linalg.inv(camera.K) @ H
    starts = np.stack([mapped(to_rays, r * UNIT) for r in rings])
    across_px = 0.5 * (sides_px[BEFORE] + sides_px[NEXT])
    turn = float(np.sign(doubled_area(corners[None])[0]))
    return _Rows(
        starts=starts.reshape(-1, 2),
        ends=starts[:, NEXT].reshape(-1, 2),
        side=side,
        at=at,
        lengths_px=sides_px[side] * at,
        scale_px=0.5 * across_px[side],
        cell_px=cell_px,
        sign=turn * np.where(at < 1.0, -1.0, 1.0),
    )


def _surroundings(s: Array, pattern: Pattern, depth_px: Array) -> Surroundings:
    """Which profiles at places `s` (rows, n) have a neighbouring edge, and which have one."""
    rim, four = pattern.rim, np.arange(4)[:, None]
    inside, outside = np.zeros(s.shape, np.float32), np.zeros(s.shape, np.float32)
    possible = np.ones(s.shape, np.bool_)
    inside[:4] = rim.white[four, (s[:4] * rim.cells).astype(np.intp)]
    if len(s) > 4:
        along = 1.0 + s[4:] * (rim.cells - 2)  # in cells from the border's corner
        free = rim.open[four, (along - 0.3).astype(np.intp)]
        possible[4:] = free * rim.open[four, (along + 0.3).astype(np.intp)] > 0.0
        outside[4:] = 1.0
    return Surroundings(depth_px, inside, outside, possible)


def _in_view(
    shape: tuple[int, ...],
    hidden: NDArray[np.bool_] | None,
    origin: Array,
    normal: Array,
    near_px: Array,
) -> NDArray[np.bool_]:
    """Which profiles (rows, n) are in the picture, and not hidden, as far as they count."""
    h, w = shape[:2]
    # A profile is as far in the picture as both its ends are.
    reach, last = near_px[:, None, None] * np.abs(normal), (w - 1 - ROOM_PX, h - 1 - ROOM_PX)
    x_and_y = (origin - reach >= ROOM_PX) & (origin + reach <= last)
    seen = x_and_y[..., 0] & x_and_y[..., 1]
    if hidden is not None and seen.any():
        at = origin[:, :, None] + near_px[:, None, None, None] * _REACH * normal[:, :, None]
        pixel = np.rint(np.clip(np.nan_to_num(at), 0.0, (w - 1, h - 1))).astype(np.intp)
        seen &= ~hidden[pixel[..., 1], pixel[..., 0]].any(axis=2)
    return np.asarray(seen)


def _unspoilt(grey: Floats, free: NDArray[np.bool_], near_px: Array, half_px: Array) -> _Lit | None:
    """Which of the free profiles (rows, n) begin black and end white, as most do; None without
    contrast. Light that glares makes black bright; what lies on the paper makes white dark."""
    # At half the window from the edge, blur has ended and no neighbour begins.
    off = max(1, round(0.5 * STEPS * float((0.6 * near_px / half_px)[0])))
    dark, bright = grey[:, :, STEPS // 2 - off], grey[:, :, STEPS // 2 + off]
    black, white = (float(np.median(each[free])) for each in (dark, bright))
    contrast = white - black
    if contrast < _MIN_CONTRAST:
        return None
    good = (dark < black + _TOO_BRIGHT * contrast) & (bright > white - _TOO_DARK * contrast)
    return _Lit(free & good, white)
