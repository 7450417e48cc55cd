"""A marker's drawing on a grid: how white each node is, sharp and blurred."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array

_REACH_CELLS = 0.6  # of white around the border
EDGE = 12
"""Nodes more all around, for the blur."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """A marker's cells with its border, 1 = white, (n, n); for the target's large marker
    what lies in its centre, at `ratio` of its size, and `sheet`, half the side of the
    white paper in the marker's own coordinates (None: white without end)."""

    cells: Array
    centre: Array | None = None
    ratio: float = 0.0
    sheet: float | None = None

    @property
    def reach(self) -> float:
        """Half side of the part that is compared."""
        return 1.0 + _REACH_CELLS * 2.0 / len(self.cells)


def drawing_of(bits: NDArray[np.uint8], centre: NDArray[np.uint8] | None = None,
               ratio: float = 0.0) -> Drawing:  # fmt: skip
    """From inner bits, 1 = white; with a centre, the target's large marker: its sheet has
    a cell of white around it."""
    cells = np.pad(bits.astype(np.float64), 1)
    if centre is None:
        return Drawing(cells)
    return Drawing(cells, np.pad(centre.astype(np.float64), 1), ratio, 1.0 + 2.0 / len(cells))


def _coverage(axis: Array, half_node: float, n_cells: int, size: float) -> Array:
    """Share of each cell in each node, (nodes, cells)."""
    edges = size * np.linspace(-1.0, 1.0, n_cells + 1)
    low, high = axis[:, None] - half_node, axis[:, None] + half_node
    overlap = np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1])
    return np.asarray(np.maximum(overlap, 0.0) / (2.0 * half_node))


def _wide(axis: Array, half_node: float) -> Array:
    more = 2.0 * half_node * np.arange(1, EDGE + 1)
    return np.concatenate([axis[0] - more[::-1], axis, axis[-1] + more])


@lru_cache(maxsize=64)
def sheets(drawing: Drawing, n: int) -> tuple[NDArray[np.float32], ...]:
    """The drawing at n by n nodes over its reach, and perhaps what is beyond its sheet."""
    half_node = drawing.reach / n
    axis: Array = half_node * (2.0 * np.arange(n, dtype=np.float64) + 1.0 - n)
    paper = drawn(drawing, axis, half_node)
    outside = beyond_sheet(drawing, axis, half_node)
    return (paper,) if outside is None else (paper, outside)


@lru_cache(maxsize=64)
def square(cells: int, n: int) -> NDArray[np.float32]:
    """A black square of so many cells at n by n nodes over their reach."""
    return sheets(Drawing(np.zeros((cells, cells))), n)[0]


def drawn(drawing: Drawing, axis: Array, half_node: float) -> NDArray[np.float32]:
    """Whiteness of each node and of `EDGE` nodes more all around, exact in area, as if the
    paper had no end."""
    wide = _wide(axis, half_node)
    C = _coverage(wide, half_node, len(drawing.cells), 1.0)
    black = C @ (1.0 - drawing.cells) @ C.T
    if drawing.centre is not None:
        C = _coverage(wide, half_node, len(drawing.centre), drawing.ratio)
        black += C @ (1.0 - drawing.centre) @ C.T
    return (1.0 - black).astype(np.float32)


def soft_cells(drawing: Drawing, axis: Array, half_node: float, sigma: float) -> Array:
    """Share of each row (or column) of cells in each node (n, cells), blurred by sigma nodes:
    a cell's share in the drawing is the product of its row's and its column's."""
    wide = _coverage(_wide(axis, half_node), half_node, len(drawing.cells), 1.0)
    soft = cv2.GaussianBlur(
        wide.astype(np.float32), (1, 0), sigmaX=1e-3, sigmaY=sigma, borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(soft[EDGE : EDGE + len(axis)], dtype=np.float64)


def beyond_sheet(drawing: Drawing, axis: Array, half_node: float) -> NDArray[np.float32] | None:
    """Share of each node that is not on the paper, likewise; None without an end."""
    if drawing.sheet is None:
        return None
    on = _coverage(_wide(axis, half_node), half_node, 1, drawing.sheet)
    return (1.0 - on @ on.T).astype(np.float32)


def softened(sharp: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Nodes, those all around among them, blurred by so many."""
    soft = cv2.GaussianBlur(sharp, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(soft, np.float32)
