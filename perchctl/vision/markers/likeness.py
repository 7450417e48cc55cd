"""How much the picture looks like a drawing that was fitted to it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array
from perchctl.vision.markers.drawing import EDGE, Drawing, softened, square
from perchctl.vision.markers.grid import Grid
from perchctl.vision.markers.light import BEYOND, GAIN, Light
from perchctl.vision.markers.products import gram, mixed


@dataclass(frozen=True)
class PatternSeen:
    """Correlation and height of the inner pattern, beyond what a plain square explains."""

    correlation: float
    strength: float


def pattern_seen(
    drawing: Drawing, grid: Grid, sigma: float, light: Light, error: Array
) -> PatternSeen:
    """With the drawing blurred by `sigma` nodes; `error` (n * n,) is what the fit left over."""
    plain = softened(square(len(drawing.cells), grid.n), sigma)[EDGE:-EDGE, EDGE:-EDGE]
    columns = light.columns
    known: Array = np.column_stack([columns[:, :GAIN], plain.ravel(), columns[:, BEYOND:]])
    left: Array = np.stack([columns[:, GAIN], light.grey + error], axis=1)
    both = np.concatenate([known, left], axis=1)
    count = known.shape[1]
    products = gram(both, both)[:count]
    A = products[:, :count] + 1e-9 * np.eye(count)
    mix = np.asarray(np.linalg.solve(A, products[:, count:]), dtype=np.float64)
    bits, seen = (left[:, k] - mixed(known, mix[:, k]) for k in (0, 1))
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
    x, y = ((g + 1.0) * 0.5 * n_cells for g in (grid.u, grid.v))
    inside = (x >= 0) & (x < n_cells) & (y >= 0) & (y < n_cells)
    index = (y[inside].astype(np.intp)) * n_cells + x[inside].astype(np.intp)
    total = np.bincount(index, weights=error[inside], minlength=n_cells**2)
    count = np.bincount(index, minlength=n_cells**2)
    return float(np.abs(total / np.maximum(count, 1)).max())
