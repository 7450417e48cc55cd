"""Corners to a hundredth of a pixel: lines fitted to a marker's sides, intersected.

A side is hundreds of gradient samples instead of one point, and a blur that is equal on
both of its flanks does not move it. So each side's edge points
(`perchctl.vision.markers.sides`) are undistorted, a line is fitted to them by total least
squares in normalised coordinates, and neighbours are intersected.

White that is clipped, glares or went through a gamma curve does move edges: all of
them, from white towards black, by the same number of pixels. The inner edge of a
marker's border moves the opposite way, so the border's width, known to be one cell,
gives the shift, and it is taken out.

Where a residual shows that the sides are not lines (blur, occlusion, false
candidates), each corner is refined on its own (`perchctl.vision.markers.corners`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, finite
from perchctl.vision.camera_model import distort
from perchctl.vision.markers.corners import RAW_SIGMA_PX, RefinedCorners, refine_each
from perchctl.vision.markers.pattern import Rim
from perchctl.vision.markers.profiles import ALONG, PROFILES, Floats
from perchctl.vision.markers.shift import Border, edge_shift
from perchctl.vision.markers.sides import Markers, Measured, Samples, markers_of, measure
from perchctl.vision.markers.square import BEFORE
from perchctl.vision.types import CameraModel, EdgeShift

MIN_LINE_SIGMA_PX = 0.015

_MIN_CELL_PX = 1.0  # smaller cells blend into one grey
_MAX_RESIDUAL_PX = 0.6
_MIN_INLIERS = 0.5
_TAILS = 1.7  # what robust weights take away from a residual's square, and from the samples
_BEND, _BEND_BLURS = 0.6, 2.0  # what the next edge, a cell away, does to one; in units of blur
_REACH = 0.0022  # px for a cubed pixel of blur: profiles are too short for wide edges
CLIPPED_SIGMA_PX = 0.1  # where white is clipped, edges move, not all alike
CLIPPED_SHARE = 0.05  # of the profiles
_WIDE_BLUR_PX, _CENTRED_PX = 2.2, 0.5  # profiles cut off an edge that is wide and not central
_NEAR_END_PX = 4.0  # of 7: an edge 6 px off, cut off there, was seen up to 0.3 px beside its place
_LEAST_ROWS = 2.0  # times the other sides' variance shows that rows shake
_LEAST_ASPECT = 0.05  # variance of the sides' slants (0 to 1), to tell them apart
_MIN_CONTRAST = 6.0  # grey levels between the flanks
_SHIFT_PRIOR_PX = 0.15  # what glare and gamma do to edges
_CLIPPED_PRIOR_PX = 0.4  # what clipping does
CLIPPED_GREY = 248.0
_ONES: Array = np.ones(PROFILES)
_ONES32: Floats = np.ones(PROFILES, dtype=np.float32)
_QUARTERS: Array = np.full(4, 0.25)
_PARABOLA: Array = ALONG**2 - (ALONG**2).mean()
_BOWED = 3.0  # standard deviations


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines (4m, 3) as (nx, ny, c) with n.x = c and |n| = 1, normalised, and the weighted
    RMS distance of their points, px (4m,)."""

    lines: Array
    residual_px: Array


def refine(
    image: NDArray[np.uint8],
    corners_px: Array,
    rims: Sequence[Rim],
    camera: CameraModel,
    method: str,
) -> list[RefinedCorners]:
    """Refine the corners of m markers.

    Args:
        image: grey picture (h, w).
        corners_px: raw corners (m, 4, 2), in order around each marker.
        rims: for each marker what lies inside of its border.
        method: ``line``, ``subpix`` or ``none`` (the profile's `detector.refinement`).
    """
    corners_px = np.asarray(corners_px, dtype=np.float64).reshape(-1, 4, 2)
    if method == "none":
        return [RefinedCorners(raw, RAW_SIGMA_PX, False) for raw in corners_px]
    by_lines: list[RefinedCorners | None] = [None] * len(corners_px)
    if method == "line" and len(corners_px):
        by_lines = refine_lines(image, corners_px, rims, camera)
    return [
        result if result is not None else refine_each(image, raw, rim.cells)
        for result, raw, rim in zip(by_lines, corners_px, rims, strict=True)
    ]


def refine_lines(
    image: NDArray[np.uint8],
    raw_px: Array,
    rims: Sequence[Rim],
    camera: CameraModel,
    known: EdgeShift | None = None,
) -> list[RefinedCorners | None]:
    """The line fit alone, for m markers (m, 4, 2); None where its residual, inliers,
    contrast, blur or movement show that these are not a marker's sides. The shift of all
    edges is measured unless it is known. Wide edges, and those near to the profiles' ends, are
    looked at twice, the second time with the profiles centred on them."""
    found = _refined_once(image, raw_px, rims, camera, known)
    centred = raw_px.copy()
    for i, each in enumerate(found):
        if each is None:
            continue
        off_px = float(np.abs(each.corners_px - raw_px[i]).max())
        if off_px > (_CENTRED_PX if each.blur_px > _WIDE_BLUR_PX else _NEAR_END_PX):
            centred[i] = each.corners_px
    if (centred == raw_px).all():
        return found
    again = _refined_once(image, centred, rims, camera, known)
    return [second or first for first, second in zip(found, again, strict=True)]


def _refined_once(
    image: NDArray[np.uint8],
    raw_px: Array,
    rims: Sequence[Rim],
    camera: CameraModel,
    known: EdgeShift | None,
) -> list[RefinedCorners | None]:
    nothing: list[RefinedCorners | None] = [None] * len(raw_px)
    markers = markers_of(raw_px, rims, camera)
    if markers is None:
        return nothing
    measured = measure(image, markers, camera, with_inner=known is None)
    sides = measured.sides
    clipped = _clipped(sides) > CLIPPED_SHARE
    if known is not None and clipped.any():
        # How far clipping moves edges changes with the light.
        return _refined_once(image, raw_px, rims, camera, None)
    fit = _fit_lines(markers, sides)
    shift = known
    if shift is None:
        corners = _intersect(fit.lines)
        if not finite(corners):
            return nothing
        shift = _measured_shift(markers, measured, fit, corners)
    applied = shift if shift is not None else EdgeShift(0.0, _shift_prior_px(sides))
    corners = _intersect(_moved_outwards(markers, fit, applied.shift_px))
    if not finite(corners):
        return nothing
    corners_px = distort(corners.reshape(-1, 2), camera).reshape(raw_px.shape)
    accepted = _accepted(markers, sides, fit, corners_px)
    ends_px2 = _ends_px2(markers, sides, fit).tolist()
    blurs_px, normals_x = sides.blur_px.tolist(), fit.lines[:, 0].tolist()
    found = nothing
    for i, rim in enumerate(rims):
        if not accepted[i]:
            continue
        four = slice(4 * i, 4 * i + 4)
        ends, blurs = ends_px2[four], blurs_px[four]
        cell_px, blur_px = float(markers.cell_px[i]), sum(blurs) / 4.0
        found[i] = RefinedCorners(
            corners_px=corners_px[i],
            sigma_px=_sigma_px(cell_px, blur_px, sum(ends) / 4.0, bool(clipped[i]), rim.tolerance),
            refined=True,
            shift_sigma_px=applied.sigma_px,
            blur_px=max(blurs),
            edge_shift=shift,
            row_sigma_px=_row_px(normals_x[four], ends),
            least_blur_px=min(blurs),
        )
    return found


def _fit_lines(markers: Markers, sides: Samples) -> _Lines:
    """Total least squares on the points of each side."""
    w = sides.weight / np.maximum(sides.weight.dot(_ONES), 1e-9)[:, None]
    x, y = sides.points[..., 0], sides.points[..., 1]
    cx, cy = (w * x).dot(_ONES), (w * y).dot(_ONES)
    dx, dy = x - cx[:, None], y - cy[:, None]
    wx = w * dx
    sxx, sxy, syy = (wx * dx).dot(_ONES), (wx * dy).dot(_ONES), (w * dy * dy).dot(_ONES)
    direction = 0.5 * np.arctan2(2.0 * sxy, sxx - syy)
    nx, ny = -np.sin(direction), np.cos(direction)
    residual2 = nx * nx * sxx + 2.0 * nx * ny * sxy + ny * ny * syy
    lines = np.empty((len(w), 3))
    lines[:, 0], lines[:, 1], lines[:, 2] = nx, ny, nx * cx + ny * cy
    return _Lines(lines, np.sqrt(np.maximum(residual2, 0.0)) * markers.px_per_unit)


def _intersect(lines: Array) -> Array:
    """Corner i of each marker, where side i - 1 meets side i: (m, 4, 2)."""
    sides = lines.reshape(-1, 4, 3)
    before = sides.take(BEFORE, axis=1)
    ax, ay, ac = before[..., 0], before[..., 1], before[..., 2]
    bx, by, bc = sides[..., 0], sides[..., 1], sides[..., 2]
    det = ax * by - ay * bx
    det = np.where(np.abs(det) < 1e-9, np.nan, det)
    corners = np.empty((len(sides), 4, 2))
    corners[..., 0] = (ac * by - ay * bc) / det
    corners[..., 1] = (ax * bc - ac * bx) / det
    return corners


def _shift_prior_px(sides: Samples) -> float:
    """How far edges are shifted before that is measured: by white as the camera sees it
    beyond the sides."""
    clipped = float(sides.grey[:, :, -1].mean()) > CLIPPED_GREY
    return _CLIPPED_PRIOR_PX if clipped else _SHIFT_PRIOR_PX


def _measured_shift(
    markers: Markers, measured: Measured, fit: _Lines, corners: Array
) -> EdgeShift | None:
    """None where no inner edge was sampled."""
    inner, k = measured.inner, measured.inner_of
    if inner is None:
        return None
    border = Border(
        corners=corners[k],
        points=inner.points,
        weight=inner.weight,
        blur_px=inner.blur_px,
        depth_px=markers.depth_px[k],
        cells=markers.rims[k].cells,
        cell_px=float(markers.cell_px[k]),
        tolerance=markers.rims[k].tolerance,
        bow_px=_bow_px(markers, measured.sides, fit, k),
    )
    return edge_shift(border, _shift_prior_px(measured.sides))


def _bow_px(markers: Markers, sides: Samples, fit: _Lines, k: int) -> float:
    """How far the ends of marker k's sides lie further out than their middles, the mean of
    its sides, as far as noise does not explain it."""
    of_k = slice(4 * k, 4 * k + 4)
    lines, points = fit.lines[of_k], sides.points[of_k]
    away = np.matmul(points, lines[:, :2, None])[..., 0] - lines[:, 2:]
    scale = _outwards(markers, fit)[of_k] * markers.px_per_unit[of_k]
    mass = np.maximum(sides.weight[of_k] @ (_PARABOLA * _PARABOLA), 1e-9)
    bow_px = scale * ((sides.weight[of_k] * away) @ _PARABOLA) / mass
    mean_px = float(bow_px @ _QUARTERS)
    noise_px = 0.25 * math.sqrt(float((fit.residual_px[of_k] ** 2 / mass).sum()))
    return mean_px if abs(mean_px) > _BOWED * noise_px else 0.0


def _moved_outwards(markers: Markers, fit: _Lines, shift_px: float) -> Array:
    """The lines (4m, 3) moved out of their markers."""
    if shift_px == 0.0:
        return fit.lines
    lines = fit.lines.copy()
    lines[:, 2] += _outwards(markers, fit) * (shift_px / markers.px_per_unit)
    return lines


def _outwards(markers: Markers, fit: _Lines) -> Array:
    """+1 where a line's normal, which may point either way, points out of its marker, else
    -1, (4m,)."""
    corners = markers.corners
    out = (corners - (_QUARTERS @ corners)[:, None]).reshape(-1, 2)
    return np.asarray(np.sign(fit.lines[:, 0] * out[:, 0] + fit.lines[:, 1] * out[:, 1]))


def _accepted(markers: Markers, sides: Samples, fit: _Lines, corners_px: Array) -> list[bool]:
    """Which of the m markers have lines for sides, near to where they were expected."""
    inliers = (sides.weight > 0.0).dot(_ONES32)
    # Half a cell to both sides, but not beyond the samples: dark inside, white outside.
    contrast = np.abs(sides.grey[:, :, -3] - sides.grey[:, :, 2]).dot(_ONES32)
    sharp = sides.blur_px < 0.9 * sides.near_px
    good = [
        residual < _MAX_RESIDUAL_PX
        and count >= _MIN_INLIERS * PROFILES
        and grey > _MIN_CONTRAST * PROFILES
        and is_sharp
        for residual, count, grey, is_sharp in zip(
            fit.residual_px.tolist(), inliers.tolist(), contrast.tolist(), sharp.tolist(),
            strict=True,
        )
    ]  # fmt: skip
    return [
        cell_px > _MIN_CELL_PX
        and all(good[4 * i : 4 * i + 4])
        # False for NaN.
        and all(math.dist(a, b) < max(1.6, 0.6 * cell_px) for a, b in zip(*both, strict=True))
        for i, (cell_px, *both) in enumerate(
            zip(markers.cell_px.tolist(), corners_px.tolist(), markers.raw_px.tolist(), strict=True)
        )
    ]


def _clipped(sides: Samples) -> Array:
    """Share of the profiles of the m markers that end in clipped white, (m,)."""
    ends = sides.grey[:, :, -1]
    if ends.max() <= CLIPPED_GREY:
        return np.zeros(len(ends) // 4)
    glaring = np.count_nonzero(ends > CLIPPED_GREY, axis=1) / PROFILES
    return np.asarray(glaring.reshape(-1, 4) @ _QUARTERS)


def _ends_px2(markers: Markers, sides: Samples, fit: _Lines) -> Array:
    """Variance of the ends of the sides, (4m,): a line fitted to n samples spreads twice as far
    there as in its middle."""
    independent = np.maximum(np.minimum(sides.weight.dot(_ONES), markers.sides_px.ravel()), 4.0)
    residual_px = fit.residual_px
    return np.asarray(4.0 * _TAILS * residual_px * residual_px / independent)


def _sigma_px(
    cell_px: float, blur_px: float, noise_px2: float, clipped: bool, tolerance: float
) -> float:
    """Spread of a marker's corners; `noise_px2` is the variance of its sides' ends, and
    `tolerance` that of the print, in cells."""
    blur_px = max(blur_px, 1e-3)
    # Cells of few pixels let the inner pattern's blur reach the border's edge.
    bend_px = _BEND * blur_px * math.exp(-cell_px / (_BEND_BLURS * blur_px))
    reach_px = _REACH * blur_px**3
    clipped_px = CLIPPED_SIGMA_PX if clipped else 0.0
    # Edges are not where they were meant to be printed.
    print_px = tolerance * cell_px
    noise_px = max(math.sqrt(noise_px2), MIN_LINE_SIGMA_PX)
    return math.hypot(noise_px, bend_px, reach_px, clipped_px, print_px)


def _row_px(normals_x: Sequence[float], ends_px2: Sequence[float]) -> float:
    """Spread of a marker's corners by what shakes a picture's rows, each along itself: it moves
    upright sides, both of a marker's alike, and lying ones not. As the residuals of its four
    sides show it; 0 where the marker stands on a corner and nothing shows."""
    upright = [x * x for x in normals_x]
    mean = sum(upright) / 4.0
    aspect = sum((each - mean) ** 2 for each in upright) / 4.0
    if aspect <= _LEAST_ASPECT:
        return 0.0
    both = zip(ends_px2, upright, strict=True)
    slope = sum(end * (each - mean) for end, each in both) / 4.0 / aspect
    still = sum(ends_px2) / 4.0 - slope * mean
    return math.sqrt(slope) if slope > (_LEAST_ROWS - 1.0) * max(still, 0.0) else 0.0
