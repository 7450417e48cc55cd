"""The geometry of the nested target: which squares are black, at any resolution.

Drawing axes: origin in the target's centre, x right and y up *as printed and
read from the printed side*, metres. These axes are OpenCV's marker axes. The sheet hangs face down
on the ceiling; the upward-facing camera sees it unmirrored.

Bitmap and PDF come from one raster on a non-uniform grid, whose lines are the
edges of both markers' cells and of the white ring around the small one.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.profile import MarkerConfig, TargetConfig

BORDER_BITS = 1
"""Width of a marker's black border in cells."""


@dataclass(frozen=True)
class Rectangle:
    """A black rectangle in drawing axes, metres; x0 < x1, y0 < y1."""

    x0_m: float
    y0_m: float
    x1_m: float
    y1_m: float


@dataclass(frozen=True, eq=False)
class TargetDrawing:
    """A nested target.

    Attributes:
        edges_m: lines of the grid, ascending, shape (n + 1,); the same for x and y.
        black: shape (n, n); row 0 is the top of the print (largest y).
        sheet_side_m: side of the white sheet, one cell of white around the marker.
        ring_m: width of the white ring around the small marker, cut into the large one.
    """

    edges_m: Array
    black: NDArray[np.bool_]
    large_side_m: float
    small_side_m: float
    sheet_side_m: float
    ring_m: float

    def ink_coverage(self, px_per_m: float, size_px: int, window_px: float = 1.0) -> Array:
        """Return the fraction of black, 0..1, in each pixel's window, (size_px, size_px).
        Parameters as in `pixel_overlap`."""
        w = pixel_overlap(self.edges_m, px_per_m, size_px, window_px)
        # The grid is symmetric about 0, so the same weights are valid for the rows from the top.
        return np.asarray(w @ self.black.astype(np.float64) @ w.T)

    def sheet_coverage(self, px_per_m: float, size_px: int, window_px: float = 1.0) -> Array:
        """Return the fraction, 0..1, of each pixel's window that the sheet covers. Parameters as in
        `pixel_overlap`."""
        half = self.sheet_side_m / 2.0
        w = pixel_overlap(np.array([-half, half]), px_per_m, size_px, window_px)
        return np.asarray(w @ w.T)

    def bitmap(self, px_per_m: float) -> NDArray[np.uint8]:
        """The whole sheet, black 0 on white 255, (n, n); each pixel is the exact mean over its
        area. Row 0 is at the top of the print, and the target's centre is in the middle of the
        image."""
        size = max(1, int(np.ceil(self.sheet_side_m * px_per_m - 1e-9)))
        return np.rint(255.0 * (1.0 - self.ink_coverage(px_per_m, size))).astype(np.uint8)

    def rectangles(self) -> list[Rectangle]:
        """The black area as a small number of large, non-overlapping rectangles (for a PDF)."""
        return merge_black_cells(self.black, self.edges_m, -self.edges_m)


def marker_cells(marker: MarkerConfig) -> NDArray[np.bool_]:
    """A mask (n, n) of the black cells of a marker with its border, row 0 at the top."""
    return np.asarray(np.pad(marker.bits, BORDER_BITS) == 0)


def marker_corners_m(side_m: float) -> Array:
    """A marker's corners in OpenCV's marker axes, TL TR BR BL, shape (4, 3)."""
    h = side_m / 2.0
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def draw_target(target: TargetConfig) -> TargetDrawing:
    """The drawing of both markers; sizes are taken from the configuration.

    If the centre of the large marker is already white (id 997 of DICT_4X4_1000), the white ring
    changes nothing. With a 4x4 dictionary, any two ids stay readable if the small side is at most
    0.18 of the large one.
    """
    large, small = target.large, target.small
    edges, black = _nested(
        marker_cells(large), marker_cells(small), large.side_m, small.side_m, target.ring_m
    )
    sheet = large.side_m + 2.0 * large.side_m / len(marker_cells(large))
    return TargetDrawing(edges, black, large.side_m, small.side_m, sheet, target.ring_m)


def _nested(
    large: NDArray[np.bool_],
    small: NDArray[np.bool_],
    large_side_m: float,
    small_side_m: float,
    ring_m: float,
) -> tuple[Array, NDArray[np.bool_]]:
    hole = small_side_m / 2.0 + ring_m
    large_edges = np.linspace(-large_side_m / 2, large_side_m / 2, len(large) + 1)
    small_edges = np.linspace(-small_side_m / 2, small_side_m / 2, len(small) + 1)
    edges = _merged(np.concatenate([large_edges, small_edges, [-hole, hole]]))
    middle = (edges[:-1] + edges[1:]) / 2.0
    xs, ys = np.meshgrid(middle, -middle)  # rows run from the top of the print down
    black = _lookup(large, large_side_m, xs, ys)
    black &= ~((np.abs(xs) < hole) & (np.abs(ys) < hole))
    black |= _lookup(small, small_side_m, xs, ys)
    return edges, black


def _merged(edges_m: Array) -> Array:
    """Return sorted edges without duplicates that only differ by rounding."""
    edges = np.sort(edges_m)
    keep = np.concatenate([[True], np.diff(edges) > 1e-9])
    return np.asarray(edges[keep])


def _lookup(cells: NDArray[np.bool_], side_m: float, xs: Array, ys: Array) -> NDArray[np.bool_]:
    """Return for each point (shape of xs and ys) whether it is in a black cell of a marker in the
    centre."""
    n = len(cells)
    col = np.floor((xs / side_m + 0.5) * n).astype(int)
    row = np.floor((0.5 - ys / side_m) * n).astype(int)
    inside = (col >= 0) & (col < n) & (row >= 0) & (row < n)
    return np.asarray(inside & cells[np.clip(row, 0, n - 1), np.clip(col, 0, n - 1)])


def pixel_overlap(edges_m: Array, px_per_m: float, size_px: int, window_px: float = 1.0) -> Array:
    """Return the fraction of each pixel's window that lies in each interval of `edges_m`, (size_px,
    n).

    Pixel i is centred at ``(i - (size_px - 1) / 2) / px_per_m``; its window is
    `window_px` wide: 1 is the pixel itself.
    """
    centers = (np.arange(size_px) - (size_px - 1) / 2.0)[:, None]
    e = edges_m[None, :] * px_per_m
    below = np.clip(e, centers - window_px / 2.0, centers + window_px / 2.0)
    return np.diff(below, axis=1) / window_px


def merge_black_cells(black: NDArray[np.bool_], xs_m: Array, ys_m: Array) -> list[Rectangle]:
    """The black cells of a grid as few, large, non-overlapping rectangles.

    `xs_m` are the edges of the columns in ascending order, `ys_m` those of the rows in descending
    order. The rectangles are few and large because viewers draw hairlines between adjacent
    rectangles.
    """
    left = black.copy()
    rows, cols = left.shape
    found = []
    for row in range(rows):
        for col in range(cols):
            if not left[row, col]:
                continue
            right = col
            while right + 1 < cols and left[row, right + 1]:
                right += 1
            bottom = row
            while bottom + 1 < rows and left[bottom + 1, col : right + 1].all():
                bottom += 1
            left[row : bottom + 1, col : right + 1] = False
            found.append(
                Rectangle(
                    float(xs_m[col]),
                    float(ys_m[bottom + 1]),
                    float(xs_m[right + 1]),
                    float(ys_m[row]),
                )
            )
    return found


# --- Lengths with a unit, as people write them ---


MAX_SCALE_ERROR = 0.1
NOTABLE_SCALE_ERROR = 0.01
"""Relative size error above which a viewer must have scaled the page; printers themselves err by
about 0.3 %."""
UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = re.compile(r"\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*([a-zA-Z]*)\s*")


def parse_length(text: str, what: str, *, bare_unit: str | None = None) -> float:
    """Convert a length such as ``150mm``, ``15cm`` or ``0.15m`` to metres.

    `what` names the value in the error; a number without a unit is in `bare_unit`, or is refused if
    that is None. Raises InvalidValue.
    """
    match = _LENGTH.fullmatch(text)
    if match is None:
        raise InvalidValue(f"{what}: {text!r} is not a length; write 150mm, 15cm or 0.15m")
    number, unit = match.groups()
    if not unit:
        if bare_unit is None:
            raise InvalidValue(f"{what}: {text!r} has no unit; write {number}mm, or cm or m")
        unit = bare_unit
    if unit not in UNITS_M:
        raise InvalidValue(f"{what}: unit {unit!r} in {text!r} is unknown; allowed are mm, cm, m")
    value = float(number) * UNITS_M[unit]
    if not (math.isfinite(value) and value > 0.0):
        raise InvalidValue(f"{what}: {text!r} must be greater than zero")
    # People write no more than 12 digits: 0.1 cm is 0.001 m, not 0.0010000000000000002.
    return float(f"{value:.12g}")


def print_scale(
    name: str, option: str, measured_m: float, spec_m: float, source: str
) -> tuple[float, list[str]]:
    """The ratio of a print's measured length to its nominal length, and notes for the user. In the
    notes, `name` and `option` name the length, and `source` says where the nominal value comes
    from.

    Raises InvalidValue for a scale that no printer produces, for example because the length is in
    the wrong unit.
    """
    scale = measured_m / spec_m
    off = scale - 1.0
    if abs(off) > MAX_SCALE_ERROR:
        raise InvalidValue(
            f"{option}: {mm_text(measured_m)} mm is {100 * abs(off):.0f} % "
            f"{'larger' if off > 0.0 else 'smaller'} than the "
            f"{mm_text(spec_m)} mm of {source}: measure the black area, in mm"
        )
    notes = [f"{name}: {mm_text(measured_m)} mm, {100 * off:+.2f} % against {mm_text(spec_m)} mm"]
    if abs(off) > NOTABLE_SCALE_ERROR:
        notes.append(
            f"{name}: more than 1 % off: the page may have been scaled when it was printed"
        )
    return scale, notes


def mm_text(length_m: float) -> str:
    """Return ``150`` or ``149.6``: a length in millimetres, without a unit, to 1 um."""
    return f"{round(length_m * 1e3, 3):g}"
