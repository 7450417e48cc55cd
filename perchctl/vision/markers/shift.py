"""By how much white has grown over black in a picture: from the width of a border."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.square import mapped, to_unit
from perchctl.vision.types import EdgeShift

_SHIFT_FLOOR_PX = 0.01
_MAX_SHIFT_PX = 1.0
_MAX_BLUR_CELLS = 0.45  # beyond it the two edges of a border are one
_MIN_PROFILES = 3.0  # in total weight, of a side that counts
_PICTURES = 5  # for which a measured shift holds
_OUT: Array = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])  # of each side


@dataclass(frozen=True, eq=False)
class Border:
    """A marker's border as it was measured, one cell wide.

    corners (4, 2): of its outer edge as fitted, normalised. points (4, n, 2) and weight
    (4, n): of its inner edge. blur_px, depth_px (4,): of the inner edge, and the border's
    width. cells: along a side; cell_px: their mean width. tolerance: of a printed edge's
    place, in cells. bow_px: how far the outer edge's ends lie further out than its middle.
    """

    corners: Array
    points: Array
    weight: Array
    blur_px: Array
    depth_px: Array
    cells: int
    cell_px: float
    tolerance: float
    bow_px: float = 0.0


def edge_shift(border: Border, prior_px: float) -> EdgeShift:
    """How far white has grown over black; `prior_px` is how far edges are shifted before
    anything is measured.

    Outer edges that moved in by d shrink the marker's own scale; the inner edges, at
    the part r of it, moved out by d: they appear d (1 + r) too far out.
    """
    r = 1.0 - 2.0 / border.cells
    own = mapped(to_unit(border.corners), border.points)
    far = np.matmul(own, _OUT[:, :, None])[..., 0] - r
    far_px = far * (border.depth_px / (1.0 - r * r))[:, None]
    w = border.weight * (border.blur_px < _MAX_BLUR_CELLS * border.depth_px)[:, None]
    w *= np.abs(far_px) < _MAX_SHIFT_PX
    mass = w.sum(axis=1)
    some = mass > _MIN_PROFILES
    if not some.any():
        return EdgeShift(0.0, prior_px)
    # A sheet that curls, or a lens that is known badly, moves places by the square of their way
    # from the centre: outer edges farther than inner ones, and their ends farther than middles.
    bent_px = 8.0 * r / (3.0 * border.cells) * border.bow_px
    shift, variance = _mean_of_sides(far_px + bent_px, w, mass, some, bent_px)
    # What no averaging takes away: the neighbours' blur and the print.
    variance += (2.0 * math.exp(-border.cell_px / 2.2)) ** 2 + (
        border.tolerance * border.cell_px
    ) ** 2
    prior = prior_px**2
    return EdgeShift(
        shift_px=shift * prior / (prior + variance),
        sigma_px=(1.0 / variance + 1.0 / prior) ** -0.5,
    )


def known_from(earlier: EdgeShift | None) -> EdgeShift | None:
    """What an earlier picture's shift still gives a picture later, None once it is too old:
    light, lens and ink change slowly."""
    if earlier is None or earlier.age + 1 >= _PICTURES:
        return None
    return EdgeShift(earlier.shift_px, earlier.sigma_px, earlier.age + 1)


def _mean_of_sides(
    far_px: Array, w: Array, mass: Array, some: NDArray[np.bool_], each_px: float
) -> tuple[float, float]:
    """Mean over the sides that count and its variance, px and px^2; `each_px` is by how much
    one may be off beside its noise."""
    share = w / np.maximum(mass, 1e-9)[:, None]
    mean = (share * far_px).sum(axis=1)
    scatter = (share * (far_px - mean[:, None]) ** 2).sum(axis=1)
    least = _SHIFT_FLOOR_PX**2 + each_px**2
    information = some / (2.0 * scatter / np.maximum(mass, 1.0) + least)
    total = float(information.sum())
    shift = float(information @ mean) / total
    # Sides that disagree are worth less.
    chi2 = float(information @ (mean - shift) ** 2) / max(int(np.count_nonzero(some)) - 1, 1)
    return shift, max(chi2, 1.0) / total
