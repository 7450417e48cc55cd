"""The drawing of the whole target: its edges between black and white, and its picture.

Both markers share a centre and a plane, so their cells make one drawing, in the large marker's
own coordinates (see `perchctl.vision.markers.square`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.drawing import Drawing, drawn
from perchctl.vision.markers.grid import make_grid

PAPER = 1.25  # half sides of the large marker that are surely paper
_LARGE_PLACES, _SMALL_PLACES = 24, 6  # along a cell's side
_FROM_END = 0.15  # of a cell's side, where the next cell's corner blurs the edge
_HIDDEN = 1.2  # half sides of the marker in the centre, within which the large one is not seen
_TEXELS = 320


@dataclass(frozen=True, eq=False)
class Outline:
    """Places along the edges: at (n, 2); normal (n, 2) from black to white; the line that each
    lies on (n,), since a line is printed as a whole; the width of the cells beside it (n,); and
    whether it is the small marker's (n,)."""

    at: Array
    normal: Array
    line: NDArray[np.intp]
    cell: Array
    small: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Texture:
    """How white the paper is, float32 (m, m), 0 to 1, and T (3, 3), which maps own coordinates
    to its pixels."""

    white: NDArray[np.float32]
    T: Array


@dataclass(frozen=True, eq=False)
class _Edge:
    """One cell's side, as of an `Outline`; `line` is a name."""

    at: Array
    normal: tuple[float, float]
    line: tuple[float, int, int]
    cell: float


@lru_cache(maxsize=8)
def outline_of(drawing: Drawing) -> Outline:
    """Of a large marker with the small one in its centre."""
    hidden = _HIDDEN * drawing.ratio
    edges = [
        edge
        for edge in _edges(drawing.cells, 1.0, _LARGE_PLACES)
        if np.abs(edge.at).max(axis=1).min() > hidden
    ]
    large = len(edges)
    if drawing.centre is not None:
        edges += _edges(drawing.centre, drawing.ratio, _SMALL_PLACES)
    names = {edge.line: k for k, edge in enumerate(edges)}
    places = np.array([len(edge.at) for edge in edges])
    return Outline(
        at=np.concatenate([edge.at for edge in edges]),
        normal=np.repeat([edge.normal for edge in edges], places, axis=0),
        line=np.repeat([names[edge.line] for edge in edges], places),
        cell=np.repeat([edge.cell for edge in edges], places),
        small=np.repeat(np.arange(len(edges)) >= large, places),
    )


@lru_cache(maxsize=8)
def texture_of(drawing: Drawing) -> Texture:
    """A picture of the drawing up to `PAPER`, beyond which it is white."""
    axis = make_grid(_TEXELS, PAPER).axis
    wide = drawn(drawing, axis, PAPER / _TEXELS)
    more = (len(wide) - _TEXELS) // 2
    scale = _TEXELS / (2.0 * PAPER)
    first = PAPER * scale - 0.5 + more
    T = np.array([[scale, 0.0, first], [0.0, scale, first], [0.0, 0.0, 1.0]])
    return Texture(np.clip(wide, 0.0, 1.0), T)


def _edges(cells: Array, half: float, places: int) -> Iterator[_Edge]:
    """The sides at which a marker's cells (or the paper around it) differ."""
    width = 2.0 * half / len(cells)
    s = _FROM_END + (1.0 - 2.0 * _FROM_END) * (np.arange(places) + 0.5) / places
    for across in (0, 1):
        rows = cells if across == 0 else cells.T
        padded = np.pad(rows, 1, constant_values=1.0)[1:-1]
        step = padded[:, 1:] - padded[:, :-1]
        for i, j in np.argwhere(step != 0.0).tolist():
            at = np.empty((places, 2))
            at[:, across] = width * j - half
            at[:, 1 - across] = width * (i + s) - half
            towards = float(np.sign(step[i, j]))
            normal = (towards, 0.0) if across == 0 else (0.0, towards)
            yield _Edge(at, normal, (half, across, j), width)
