"""The sides of markers, measured: the edge's place on profiles across each of them.

A row is one side of one marker: rows 4 i to 4 i + 3 belong to marker i. After all of
them the inner edges of one marker's border may follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, finite
from perchctl.vision.camera_model import undistort
from perchctl.vision.markers.edges import Surroundings, locate
from perchctl.vision.markers.pattern import Rim
from perchctl.vision.markers.profiles import PROFILES, Floats, places, sample, side_profiles
from perchctl.vision.markers.square import (
    BEFORE,
    NEXT,
    UNIT,
    doubled_area,
    from_unit,
    mapped,
    side_lengths_px,
)
from perchctl.vision.types import CameraModel

_MIN_SHIFT_CELL_PX = 6.0  # of a border whose inner edge is measured too
_QUARTERS: Array = np.full(4, 0.25)
_SIDES = np.arange(4)[:, None]


@dataclass(frozen=True, eq=False)
class Markers:
    """What is to be measured: raw_px (m, 4, 2), the same normalised, the lengths of their
    sides and the width of the cells behind each of them (m, 4), the number and mean width
    of a marker's cells (m,), +1 or -1 as its corners run (m,), and pixels for a unit of
    normalised coordinates along each side (4m,)."""

    raw_px: Array
    rims: Sequence[Rim]
    corners: Array
    sides_px: Array
    depth_px: Array
    cells: Array
    cell_px: Array
    turn: Array
    px_per_unit: Array


@dataclass(frozen=True, eq=False)
class _Rows:
    """The sides across which profiles are sampled: every marker's, and after them perhaps
    the inner edges of the border of marker number `best`. starts, ends (rows, 2)
    normalised; lengths_px, depth_px (rows,); of: the marker of each; sign: +1 where white
    is to the left of the way from start to end."""

    starts: Array
    ends: Array
    lengths_px: Array
    depth_px: Array
    of: NDArray[np.intp]
    sign: Array
    best: int


@dataclass(frozen=True, eq=False)
class Samples:
    """grey (rows, n, steps + 1), near_px (rows,) the windows' reach in it, the edges' points
    (rows, n, 2), normalised, their weight (rows, n) and their blur (rows,)."""

    grey: Floats
    near_px: Array
    points: Array
    weight: Array
    blur_px: Array


@dataclass(frozen=True, eq=False)
class Measured:
    """All markers' sides, and the inner edges of the border of marker number `inner_of`."""

    sides: Samples
    inner: Samples | None
    inner_of: int


def markers_of(raw_px: Array, rims: Sequence[Rim], camera: CameraModel) -> Markers | None:
    """None where one of the markers is no square at all."""
    sides_px = side_lengths_px(raw_px)
    cells = np.array([rim.cells for rim in rims], dtype=np.float64)
    corners = undistort(raw_px.reshape(-1, 2), camera).reshape(raw_px.shape)
    turn = np.sign(doubled_area(raw_px))
    is_square = turn.all() and sides_px.min() > 1e-6
    if not (is_square and finite(corners)):
        return None
    along = corners.take(NEXT, axis=1) - corners
    across_px = sides_px.take(BEFORE, axis=1) + sides_px.take(NEXT, axis=1)
    return Markers(
        raw_px=raw_px,
        rims=rims,
        corners=corners,
        sides_px=sides_px,
        # The inner row lies one cell further in, along the neighbouring sides.
        depth_px=0.5 * across_px / cells[:, None],
        cells=cells,
        cell_px=sides_px @ _QUARTERS / cells,
        turn=turn,
        px_per_unit=(sides_px / np.hypot(along[..., 0], along[..., 1])).ravel(),
    )


def _rows(markers: Markers, with_inner: bool) -> _Rows:
    """Every marker's sides; then the inner edge of the border with the largest cells,
    which shows best by how much all edges are shifted."""
    starts, lengths_px, depth_px = markers.corners, markers.sides_px, markers.depth_px
    of = np.arange(len(starts)).repeat(4)
    best = int(markers.cell_px.argmax())
    with_inner = with_inner and float(markers.cell_px[best]) > _MIN_SHIFT_CELL_PX
    if with_inner:
        r = 1.0 - 2.0 / float(markers.cells[best])
        inner = mapped(from_unit(markers.corners[best]), r * UNIT)[None]
        starts = np.concatenate([starts, inner])
        lengths_px = np.concatenate([lengths_px, r * lengths_px[best : best + 1]])
        depth_px = np.concatenate([depth_px, depth_px[best : best + 1]])
        of = np.append(of, (best, best, best, best))
    # Normals point out of a marker whose corners run clockwise; dark must come first.
    sign = markers.turn[of]
    if with_inner:
        sign[-4:] *= -1.0
    return _Rows(
        starts=starts.reshape(-1, 2),
        ends=starts.take(NEXT, axis=1).reshape(-1, 2),
        lengths_px=lengths_px.ravel(),
        depth_px=depth_px.ravel(),
        of=of,
        sign=sign,
        best=best,
    )


def measure(
    image: NDArray[np.uint8], markers: Markers, camera: CameraModel, with_inner: bool
) -> Measured:
    """The edges' places on profiles across all sides, and across the inner edges of the
    border with the largest cells, on request and if these are large enough."""
    rows = _rows(markers, with_inner)
    s = places(rows.lengths_px)
    origin, normal = side_profiles(rows.starts, rows.ends, s, camera)
    normal *= rows.sign[:, None, None]
    cell_px = markers.cell_px
    near_px = np.minimum(np.maximum(0.85 * cell_px, 1.5), 7.0)[rows.of]
    half_px = np.minimum(np.maximum(1.5 * cell_px, 1.75), 7.0)[rows.of]
    grey = sample(image, origin, normal, half_px)
    edges = locate(grey, half_px, near_px, _surroundings(s, markers.rims, rows))
    points = undistort((origin + edges.offset_px[..., None] * normal).reshape(-1, 2), camera)
    points = points.reshape(-1, PROFILES, 2)
    if not finite(points):
        points = np.nan_to_num(points)

    def part(chosen: slice) -> Samples:
        return Samples(
            grey=grey[chosen],
            near_px=near_px[chosen],
            points=points[chosen],
            weight=edges.weight[chosen],
            blur_px=edges.blur_px[chosen],
        )

    n = 4 * len(markers.raw_px)
    inner = part(slice(n, None)) if len(rows.of) > n else None
    return Measured(part(slice(0, n)), inner, rows.best)


def _surroundings(s: Array, rims: Sequence[Rim], rows: _Rows) -> Surroundings:
    """Which profiles at places `s` have a neighbouring edge, and which have an edge."""
    inside, outside = np.zeros(s.shape, np.float32), np.zeros(s.shape, np.float32)
    possible = np.ones(s.shape, np.bool_)
    for i, rim in enumerate(rims):
        four = slice(4 * i, 4 * i + 4)
        inside[four] = rim.white[_SIDES, (s[four] * rim.cells).astype(np.intp)]
    if len(s) > 4 * len(rims):
        rim = rims[rows.best]
        at = 1.0 + s[-4:] * (rim.cells - 2)  # in cells from the border's corner
        # Near a black cell of the rim, or with one behind, blur bends the edge.
        free = rim.open[_SIDES, (at - 0.3).astype(np.intp)]
        free = free * rim.open[_SIDES, (at + 0.3).astype(np.intp)]
        possible[-4:] = free > 0.0
        outside[-4:] = 1.0
    return Surroundings(rows.depth_px, inside, outside, possible)
