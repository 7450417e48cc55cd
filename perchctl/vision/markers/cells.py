"""Which of a drawing's cells the picture contradicts.

The mean over a cell shows a wrong bit as long as blur is smaller than the cell. Beyond that a
wrong bit is spread over its neighbours, and shape, blur and light of the fit take a part of
what it leaves over. So each cell is looked for as it would look: blurred, and without what the
fit's unknowns explain (a matched filter).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array


@dataclass(frozen=True)
class CellsSeen:
    """flip: by how much the cell that is most against it has the other colour, 0 (drawn
    as it is seen) to 1 (the bit is wrong); sigma: the least certain cell's spread."""

    flip: float
    sigma: float


def cells_seen(
    cells: Array, soft: Array, error: Array, J: Array, inverse: Array, noise: float, gain: float
) -> CellsSeen:
    """What a fit leaves over, cell by cell.

    Args:
        cells: the drawing's, (m, m), 1 = white.
        soft: share of each row (and column) of cells in each node, blurred, (n, m).
        error: grey values minus the fit, (n * n,).
        J: changes of the grey values with the fit's unknowns, (k, n * n).
        inverse: of the fit's normal matrix with its priors, (k, k), per unit of noise.
        noise: variance of a node's grey value, of nodes that measure on their own.
        gain: grey levels from black to white.
    """
    n, m = soft.shape
    seen = gain * (soft.T @ error.reshape(n, n) @ soft).ravel()
    shared = gain * (soft.T @ J.reshape(-1, n, n) @ soft).reshape(-1, m * m)
    squared = (soft**2).sum(axis=0)
    energy = gain**2 * np.outer(squared, squared).ravel()
    taken = np.einsum("ij,ij->j", shared, inverse.dot(shared))
    own = np.maximum(energy - taken, 1e-9 * energy + 1e-12)
    flips = np.where(cells.ravel() > 0.5, -1.0, 1.0) * seen / own
    return CellsSeen(float(flips.max()), math.sqrt(noise / float(own.min())))
