"""How a marker looks: its cells, its drawing on a grid, and the edges of that."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.corners import increments

LEAST_SIDE_PX = 7.0  # below it a marker is a spot
_COVERED = 1.25  # half sides of a marker in the centre that may hide cells
_SPOTS: Array = np.array([[-0.22, -0.22], [0.22, -0.22], [0.22, 0.22], [-0.22, 0.22]])


@dataclass(frozen=True, eq=False)
class Pattern:
    """How one marker looks.

    drawing: all of it. outline: the edges between its cells. spots (n, 2): points in its own
    coordinates (see `perchctl.vision.markers.corners`) at which its cells are read; owner
    (n,): the cell of each; white (cells,): what they must be; soft (4, n):
    what blur of half a cell makes of them at the spots, without mean and of unit length,
    for a marker whose corners are numbered on by 0 to 3; inner (cells,): those within its
    border.
    """

    drawing: Drawing
    outline: Outline
    spots: Array
    owner: NDArray[np.intp]
    spots_per_cell: Array
    soft: Array
    white: NDArray[np.bool_]
    inner: NDArray[np.bool_]

    @property
    def cells(self) -> int:
        """Along a side, with the border's."""
        return len(self.drawing.cells)


def pattern_of(drawing: Drawing) -> Pattern:
    """Spots in every cell, but for those that another marker in the centre covers."""
    n = len(drawing.cells)
    middle = (2.0 * np.arange(n) + 1.0) / n - 1.0
    x, y = np.meshgrid(middle, middle)
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    spots = (centres[:, None] + _SPOTS * 2.0 / n).reshape(-1, 2)
    owner = np.repeat(np.arange(n * n), len(_SPOTS))
    free = np.abs(spots).max(axis=1) > _COVERED * drawing.ratio
    kept = np.unique(owner[free])
    turns, at = [], spots[free]
    for _ in range(4):
        soft = _softened(drawing, at)
        soft -= soft.mean()
        turns.append(soft / math.sqrt(float(soft @ soft)))
        at = np.stack([-at[:, 1], at[:, 0]], axis=1)
    own = np.searchsorted(kept, owner[free]).astype(np.intp)
    return Pattern(
        drawing=drawing,
        outline=outline_of(drawing),
        spots=np.ascontiguousarray(spots[free]),
        owner=own,
        spots_per_cell=np.bincount(own).astype(np.float64),
        soft=np.stack(turns),
        white=drawing.cells.ravel()[kept] > 0.5,
        inner=np.abs(centres).max(axis=1)[kept] < 1.0 - 2.0 / n,
    )


def _softened(drawing: Drawing, spots: Array) -> Array:
    """Whiteness at the spots with a blur of half a cell."""
    n, fine = len(drawing.cells), 8
    sharp = np.kron(np.pad(drawing.cells, 2, constant_values=1.0), np.ones((fine, fine)))
    white = np.asarray(cv2.GaussianBlur(sharp, (0, 0), 0.5 * fine), dtype=np.float64)
    at = (((spots + 1.0) * 0.5 * n + 2.0) * fine).astype(np.intp)
    return np.asarray(white[at[:, 1], at[:, 0]])


# --- A marker's drawing on a grid: how white each node is, sharp and blurred -------------------


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


# --- The edges of a drawing between black and white --------------------------------------------


_LARGE_PLACES, _SMALL_PLACES = 6, 4  # along a cell's side
_FROM_END = 0.2  # of a cell's side, where the next cell's corner blurs the edge
_HIDDEN = 1.2  # half sides of the marker in the centre, within which the large one is not seen


@dataclass(frozen=True, eq=False)
class Outline:
    """Places along the edges between black and white, in the drawing's own coordinates.

    Attributes:
        at: (n, 2).
        normal: (n, 2), from black to white.
        line: the line that each lies on (n,).
        cell: the width of the cells beside it (n,).
        spacing: from place to place (n,).
        border: whether it is the outer edge of the border (n,).
        small: whether it is that of the small marker in the centre of a large one (n,).
    """

    at: Array
    normal: Array
    line: NDArray[np.intp]
    cell: Array
    spacing: Array
    border: NDArray[np.bool_]
    small: NDArray[np.bool_]

    @cached_property
    def J(self) -> Array:
        """Changes (n, 8) across the edges with the terms of an increment (see
        `perchctl.vision.markers.corners`)."""
        return np.asarray(np.einsum("ni,nij->nj", self.normal, increments(self.at)))


def outline_of(drawing: Drawing) -> Outline:
    """Of one marker. What another one in its centre hides is left out."""
    places = _SMALL_PLACES if drawing.centre is None else _LARGE_PLACES
    whole = _outline(drawing.cells, 1.0, places)
    return _only(whole, np.abs(whole.at).max(axis=1) > _HIDDEN * drawing.ratio)


@lru_cache(maxsize=8)
def outline_of_both(drawing: Drawing) -> Outline:
    """Of a large marker and of the small one in its centre, in the large one's coordinates."""
    large = outline_of(drawing)
    if drawing.centre is None:
        return large
    small = _outline(drawing.centre, drawing.ratio, _SMALL_PLACES)
    return Outline(
        at=np.concatenate([large.at, small.at]),
        normal=np.concatenate([large.normal, small.normal]),
        line=np.concatenate([large.line, small.line + large.line.max() + 1]),
        cell=np.concatenate([large.cell, small.cell]),
        spacing=np.concatenate([large.spacing, small.spacing]),
        border=np.concatenate([large.border, small.border]),
        small=np.repeat([False, True], [len(large.at), len(small.at)]),
    )


def _only(outline: Outline, kept: NDArray[np.bool_]) -> Outline:
    return Outline(*(getattr(outline, each.name)[kept] for each in fields(outline)))


def _outline(cells: Array, half: float, places: int) -> Outline:
    """The sides at which a marker's cells (or the paper around it) differ."""
    n = len(cells)
    width = 2.0 * half / n
    s = _FROM_END + (1.0 - 2.0 * _FROM_END) * (np.arange(places) + 0.5) / places
    at, normal, line, border = [], [], [], []
    for across in (0, 1):
        rows = cells if across == 0 else cells.T
        step = np.diff(np.pad(rows, 1, constant_values=1.0)[1:-1], axis=1)
        for i, j in np.argwhere(step != 0.0).tolist():
            edge = np.empty((places, 2))
            edge[:, across] = width * j - half
            edge[:, 1 - across] = width * (i + s) - half
            way = np.zeros(2)
            way[across] = np.sign(step[i, j])
            at.append(edge)
            normal.append(np.tile(way, (places, 1)))
            line.append(np.full(places, (n + 1) * across + j))
            border.append(np.full(places, j in (0, n)))
    count = places * len(at)
    return Outline(
        at=np.concatenate(at),
        normal=np.concatenate(normal),
        line=np.concatenate(line),
        cell=np.full(count, width),
        spacing=np.full(count, width * float(s[1] - s[0])),
        border=np.concatenate(border),
        small=np.zeros(count, np.bool_),
    )
