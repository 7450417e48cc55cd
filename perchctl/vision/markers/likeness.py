"""How much the picture looks like a drawing that was fitted to it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.grid import Grid
from perchctl.vision.markers.light import Light
from perchctl.vision.markers.products import mixed, onto
from perchctl.vision.markers.rendered import GAIN, Rendered


@dataclass(frozen=True)
class PatternSeen:
    """Correlation and height of the inner pattern, beyond what a plain square explains."""

    correlation: float
    strength: float


def pattern_seen(drawing: Rendered, grey: Array, light: Light) -> PatternSeen:
    """In the picture's grey values (n * n,): what no plain square explains of them."""
    plain = drawing.plain
    A = plain.products + 1e-9 * np.eye(len(plain.products))
    both = light.rows[GAIN], grey
    b = np.stack([onto(plain.rows, each) for each in both], axis=1)
    shares = np.asarray(np.linalg.solve(A, b), dtype=np.float64)
    bits, seen = (each - mixed(plain.rows, shares[:, k]) for k, each in enumerate(both))
    energy, product = float((bits * bits).sum()), float((bits * seen).sum())
    scale = math.sqrt(energy * float((seen * seen).sum()))
    if scale < 1e-9:
        return PatternSeen(0.0, 0.0)
    return PatternSeen(product / scale, product / max(energy, 1e-9) / light.gain)


def likeness(grey: Array, error: Array) -> float:
    """Correlation of the picture with the fit that leaves `error` over."""
    spread = grey - grey.mean()
    explained = 1.0 - float((error**2).sum()) / max(float((spread**2).sum()), 1e-9)
    return math.sqrt(max(explained, 0.0))


def repeated(error: Array) -> float:
    """How many neighbouring nodes measure the same: from the correlation along rows and
    columns (n, n) of what is left (nodes closer than a pixel; blur that is not round)."""
    energy = max(float((error * error).mean()), 1e-9)
    factor = 1.0
    for a, b in ((error[1:], error[:-1]), (error[:, 1:], error[:, :-1])):
        r = min(max(float((a * b).mean()) / energy, 0.0), 0.9)
        factor *= (1.0 + r) / (1.0 - r)
    return factor


def worst_cell(error: Array, grid: Grid, n_cells: int) -> float:
    """Largest mean departure over a cell."""
    index, count = _cells_of(grid, n_cells)
    total = np.bincount(index, weights=error, minlength=n_cells**2 + 1)[:-1]
    return float(np.abs(total / count).max())


@lru_cache(maxsize=32)
def _cells_of(grid: Grid, n_cells: int) -> tuple[NDArray[np.intp], Array]:
    """Of each node the cell's number, behind the last one's around the marker, and how many
    nodes each cell has."""
    x, y = ((g + 1.0) * 0.5 * n_cells for g in (grid.u, grid.v))
    inside = (x >= 0) & (x < n_cells) & (y >= 0) & (y < n_cells)
    own = y.astype(np.intp) * n_cells + x.astype(np.intp)
    index = np.where(inside, own, n_cells**2)
    count = np.bincount(index, minlength=n_cells**2 + 1)[:-1]
    return index, np.maximum(count, 1.0)
