"""A marker's drawing at the nodes of a grid, blurred, with all that follows from that alone.

From picture to picture a marker's size and blur hardly change, so blur comes in steps, finer than
anything that a fit can tell, and what belongs to one is kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.drawing import (
    EDGE,
    Drawing,
    sheets,
    soft_cells,
    softened,
    square,
)
from perchctl.vision.markers.grid import Grid, make_grid
from perchctl.vision.markers.products import Basis, make_basis

_STEP = 0.02  # of the blur
# Rows of the light: offset and its slopes, gain and its slopes, bend, what is beyond the sheet.
OFFSET, OFFSET_U, OFFSET_V, GAIN, GAIN_U, GAIN_V, BEND, BEYOND = range(8)


@dataclass(frozen=True, eq=False)
class Rendering:
    """A sheet at the nodes (n * n,) with its changes (9, n * n) with the eight terms of
    a homography's increment and with the blur's square."""

    value: Array
    jacobian: Array


@dataclass(frozen=True, eq=False)
class Rendered:
    """The drawing's sheets, blurred by `sigma` nodes: the paper, and perhaps what is beyond it."""

    drawing: Drawing
    grid: Grid
    sigma: float

    @cached_property
    def sheets(self) -> tuple[Rendering, ...]:
        sharp = sheets(self.drawing, self.grid.n)
        return tuple(_blurred(each, self.sigma, self.grid.axis) for each in sharp)

    @cached_property
    def light(self) -> Basis:
        """What light makes of the drawing: rows (7 or 8, n * n), the last one only with a
        sheet's end."""
        u, v, white = self.grid.u, self.grid.v, self.sheets[0].value
        rows = [np.ones_like(u), u, v, white, white * u, white * v, white * (1.0 - white)]
        return make_basis(np.stack(rows + [sheet.value for sheet in self.sheets[1:]]))

    @cached_property
    def plain(self) -> Basis:
        """What light makes of a black square of the drawing's size, without its slopes and
        bend: rows (4 or 5, n * n)."""
        soft = softened(square(len(self.drawing.cells), self.grid.n), self.sigma)
        black = soft[EDGE:-EDGE, EDGE:-EDGE].reshape(1, -1)
        rows = self.light.rows
        return make_basis(np.concatenate([rows[:GAIN], black, rows[BEYOND:]]))

    @cached_property
    def soft_cells(self) -> Array:
        """Share of each row (or column) of cells in each node, (n, cells)."""
        half_node = self.drawing.reach / self.grid.n
        return soft_cells(self.drawing, self.grid.axis, half_node, self.sigma)


def rendered(drawing: Drawing, n: int, sigma: float) -> Rendered:
    """At n by n nodes over the drawing's reach, blurred by about `sigma` nodes."""
    return _rendered(drawing, n, round(math.log(sigma) / _STEP))


@lru_cache(maxsize=16)
def _rendered(drawing: Drawing, n: int, step: int) -> Rendered:
    return Rendered(drawing, make_grid(n, drawing.reach), math.exp(_STEP * step))


def _blurred(sharp: NDArray[np.float32], sigma: float, axis: Array) -> Rendering:
    """A sheet blurred by sigma nodes, and its changes, per unit of the drawing."""
    soft = softened(sharp, sigma)
    step = float(axis[1] - axis[0])
    e, n = EDGE, len(axis)
    middle = slice(e, e + n)
    left, right = soft[middle, e - 1 : e + n - 1], soft[middle, e + 1 : e + n + 1]
    up, down = soft[e - 1 : e + n - 1, middle], soft[e + 1 : e + n + 1, middle]
    value = soft[middle, middle]
    du, dv = np.float32(0.5 / step) * (right - left), np.float32(0.5 / step) * (down - up)
    laplace = left + right + up + down - 4.0 * value
    u, v = axis.astype(np.float32), axis.astype(np.float32)[:, None]
    along = u * du + v * dv
    changes = np.empty((9, n, n))
    for part, one, other in (
        (0, u, du), (1, v, du), (3, u, dv), (4, v, dv), (6, -u, along), (7, -v, along),
    ):  # fmt: skip
        np.multiply(-one, other, out=changes[part])
    changes[2], changes[5], changes[8] = -du, -dv, 0.5 * laplace
    return Rendering(value.ravel().astype(np.float64), changes.reshape(9, n * n))
