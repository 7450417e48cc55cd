"""Corners to a hundredth of a pixel: lines fitted to a marker's sides, intersected.

A corner found by its own neighbourhood is pulled inwards (0.15 to 0.55 px), which
makes the target look far. A side is hundreds of gradient samples instead of one
point, and a blur that is equal on both of its flanks does not move it. So each side's
edge points (`perchctl.vision.markers.edges`) are undistorted, a line is fitted to them by
total least squares in normalised coordinates, and neighbours are intersected.

White that is clipped, glares or went through a gamma curve does move edges: all of
them, from white towards black, by the same number of pixels. The inner edge of a
marker's border moves the opposite way, so the border's width, known to be one cell,
tells the shift, and it is taken out.

Where a residual says that the sides are not lines (blur, occlusion, false
candidates), `cv2.cornerSubPix` takes over, then the raw corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort, undistort
from perchctl.vision.markers.edges import PROFILES, locate, places, sample, side_profiles
from perchctl.vision.markers.shift import edge_shift
from perchctl.vision.types import CameraModel, EdgeShift

RAW_SIGMA_PX = 0.6
SUBPIX_SIGMA_PX = 0.25
MIN_LINE_SIGMA_PX = 0.015

_NEXT, _BEFORE = [1, 2, 3, 0], [3, 0, 1, 2]
_MIN_CELL_PX = 1.0  # smaller cells blend into one grey
_MAX_RESIDUAL_PX = 0.6
_MIN_INLIERS = 0.5
_TAILS = 1.3  # what robust weights take away from a residual's square
_MIN_CONTRAST = 6.0  # grey levels between the flanks
_SHIFT_PRIOR_PX = 0.15  # what glare and gamma do to edges
_CLIPPED_PRIOR_PX = 0.4  # what clipping does
_CLIPPED_GREY = 248.0
_MIN_SHIFT_CELL_PX = 6.0
_UNIT32 = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float32)
_QUARTERS: Array = np.full(4, 0.25)
_SIDES = np.arange(4)[:, None]
_UNIT: Array = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """corners_px (4, 2), their spread, whether lines were fitted, the spread of a shift
    that is common to all sides (outwards), the edges' blur, in px, and the shift that was
    taken out."""

    corners_px: Array
    sigma_px: float
    refined: bool
    shift_sigma_px: float = 0.0
    blur_px: float = 0.0
    edge_shift: EdgeShift | None = None


@dataclass(frozen=True, eq=False)
class Rim:
    """What lies inside of a marker's border, side by side in the order of the corners,
    the cells at both ends being the border's own: (4, n) each.

    white: the row next to the border; open: where a white cell follows behind a
    white one; tolerance: of a printed edge's place, in cells.
    """

    white: Array
    open: Array
    tolerance: float = 0.0

    @property
    def cells(self) -> int:
        return int(self.white.shape[1])


def rim_of_bits(bits: NDArray[np.uint8], tolerance: float = 0.0) -> Rim:
    """The rim of a marker with the inner bits (n, n), 1 = white.

    At small sizes the rim's blur reaches the border's outer edge and would push it out.
    """
    n = len(bits)

    def ring(depth: int) -> Array:
        if 2 * depth >= n:
            return np.ones((4, n))
        last = n - 1 - depth
        return np.asarray(
            (bits[depth], bits[:, last], bits[last, ::-1], bits[::-1, depth]), dtype=np.float64
        )

    white = np.pad(ring(0), ((0, 0), (1, 1)))
    second = np.pad(ring(1), ((0, 0), (1, 1)))
    return Rim(white, white * second, tolerance)


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
        rims: for each marker what lies inside of its border, see `rim_of_bits`.
        method: ``line``, ``subpix`` or ``none`` (the profile's `detector.refinement`).
    """
    corners_px = np.asarray(corners_px, dtype=np.float64).reshape(-1, 4, 2)
    results: list[RefinedCorners | None] = [None] * len(corners_px)
    if method == "line" and len(corners_px):
        results = refine_lines(image, corners_px, rims, camera)
    return [
        result if result is not None else _fallback(image, raw, rim.cells, method)
        for result, raw, rim in zip(results, corners_px, rims, strict=True)
    ]


def side_lengths_px(corners_px: Array) -> Array:
    """Lengths of the four sides, (..., 4)."""
    d = corners_px[..., _NEXT, :] - corners_px
    return np.asarray(np.hypot(d[..., 0], d[..., 1]), dtype=np.float64)


def _fallback(image: NDArray[np.uint8], raw_px: Array, cells: int, method: str) -> RefinedCorners:
    if method == "none":
        return RefinedCorners(raw_px, RAW_SIGMA_PX, False)
    side_px = float(side_lengths_px(raw_px).min())
    half = int(np.clip(round(0.5 * side_px / cells), 1, 5))
    points = np.ascontiguousarray(raw_px, dtype=np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
    cv2.cornerSubPix(image, points, (half, half), (-1, -1), criteria)
    moved = points.reshape(4, 2).astype(np.float64)
    shift = np.linalg.norm(moved - raw_px, axis=1).max()
    if not np.isfinite(shift) or shift > half + 1.0:
        return RefinedCorners(raw_px, RAW_SIGMA_PX, False)
    return RefinedCorners(moved, SUBPIX_SIGMA_PX, False)


def refine_lines(
    image: NDArray[np.uint8],
    raw_px: Array,
    rims: Sequence[Rim],
    camera: CameraModel,
    known: EdgeShift | None = None,
) -> list[RefinedCorners | None]:
    """The line fit alone, for m markers (m, 4, 2); None where its residual, inliers,
    contrast, blur or movement say that these are not a marker's sides. The shift of all
    edges is measured unless it is known."""
    m = len(raw_px)
    sides_px = side_lengths_px(raw_px)  # (m, 4)
    cells = np.array([rim.cells for rim in rims], dtype=np.float64)
    cell_px = sides_px @ _QUARTERS / cells
    corners = undistort(raw_px.reshape(-1, 2), camera).reshape(m, 4, 2)
    turn = np.sign(doubled_area(raw_px))
    if not (np.isfinite(corners).all() and turn.all() and sides_px.min() > 1e-6):
        return [None] * m
    # The inner row lies one cell further in, along the neighbouring sides.
    depth_px = 0.5 * (sides_px[:, _BEFORE] + sides_px[:, _NEXT]) / cells[:, None]
    # Rows: every marker's sides; then the inner edge of the border with the largest
    # cells, which tells best by how much all edges are shifted.
    best = int(cell_px.argmax())
    tells = known is None and float(cell_px[best]) > _MIN_SHIFT_CELL_PX
    starts, ends, lengths, depth = corners, corners[:, _NEXT], sides_px, depth_px
    of = np.arange(m).repeat(4)
    if tells:
        r = 1.0 - 2.0 / float(cells[best])
        H = cv2.getPerspectiveTransform(_UNIT32, corners[best].astype(np.float32))
        inner = cv2.perspectiveTransform((r * _UNIT)[:, None], H).reshape(1, 4, 2)
        starts = np.concatenate([corners, inner])
        ends = starts[:, _NEXT]
        lengths = np.concatenate([sides_px, r * sides_px[best : best + 1]])
        depth = np.concatenate([depth_px, depth_px[best : best + 1]])
        of = np.append(of, (best, best, best, best))
    s = places(lengths.ravel())
    origin, normal = side_profiles(starts.reshape(-1, 2), ends.reshape(-1, 2), s, camera)
    # Normals point out of a marker whose corners run clockwise; dark must come first.
    sign = turn[of]
    if tells:
        sign[-4:] *= -1.0
    normal *= sign[:, None, None]
    inside, outside, possible = _neighbours(s, rims, best if tells else None)
    near_px = np.minimum(np.maximum(0.85 * cell_px, 1.5), 7.0)[of]
    half_px = np.minimum(np.maximum(1.5 * cell_px, 1.75), 7.0)[of]
    grey = sample(image, origin, normal, half_px)
    edge, weight, blur_px = locate(grey, half_px, near_px, depth.ravel(), inside, outside, possible)
    points = undistort((origin + edge[..., None] * normal).reshape(-1, 2), camera)
    points = points.reshape(-1, PROFILES, 2)
    if not np.isfinite(points).all():
        points = np.nan_to_num(points)

    n = 4 * m
    fitted, residual = _fit_lines(points[:n], weight[:n])
    along = corners[:, _NEXT] - corners
    px_per_unit = (sides_px / np.hypot(along[..., 0], along[..., 1])).ravel()
    residual_px = residual * px_per_unit
    found = _intersect(fitted.reshape(m, 4, 3))
    if not np.isfinite(found).all():
        return [None] * m
    # White as the camera sees it beyond the sides.
    clipped = float(grey[:n, :, -1].mean()) > _CLIPPED_GREY
    prior_px = _CLIPPED_PRIOR_PX if clipped else _SHIFT_PRIOR_PX
    shift_px, shift_sigma_px = 0.0, prior_px
    if tells:
        shift_px, shift_sigma_px = edge_shift(
            found[best],
            points[n:],
            weight[n:],
            blur_px[n:],
            depth_px[best],
            float(cell_px[best]),
            rims[best].cells,
            rims[best].tolerance,
            prior_px,
        )
        known = EdgeShift(shift_px, shift_sigma_px)
    elif known is not None:
        shift_px, shift_sigma_px = known.shift_px, known.sigma_px
    if shift_px != 0.0:
        # The line's normal may point either way.
        out = (corners - corners.mean(axis=1)[:, None]).reshape(-1, 2)
        outwards = np.sign(fitted[:, 0] * out[:, 0] + fitted[:, 1] * out[:, 1])
        fitted[:, 2] += outwards * (shift_px / px_per_unit)
        found = _intersect(fitted.reshape(m, 4, 3))
    result = distort(found.reshape(-1, 2), camera).reshape(m, 4, 2)

    inliers = np.count_nonzero(weight[:n], axis=1)
    # Half a cell to both sides, but not beyond the samples: dark inside, white outside.
    contrast = np.abs(grey[:n, :, -3] - grey[:n, :, 2]).mean(axis=1)
    good = (
        (residual_px < _MAX_RESIDUAL_PX)
        & (inliers >= _MIN_INLIERS * PROFILES)
        & (contrast > _MIN_CONTRAST)
        & (blur_px[:n] < 0.9 * near_px[:n])
    ).reshape(m, 4)
    moved = result - raw_px
    moved_px = np.sqrt((moved * moved).sum(axis=2).max(axis=1))
    accepted = (
        good.all(axis=1)
        & (moved_px < np.maximum(1.6, 0.6 * cell_px))  # False for NaN
        & (cell_px > _MIN_CELL_PX)
    )
    # The end of a line fitted to n samples spreads twice as far as its middle.
    samples = np.maximum(np.minimum(weight[:n].sum(axis=1), sides_px.ravel()), 4.0)
    sigma2 = (_TAILS * 4.0 * residual_px * residual_px / samples).reshape(m, 4) @ _QUARTERS
    # Cells of few pixels let the inner pattern's blur reach the border's edge; and edges
    # are not where they were meant to be printed.
    print_px = np.array([rim.tolerance for rim in rims]) * cell_px
    sigma = np.sqrt(
        np.maximum(sigma2, MIN_LINE_SIGMA_PX**2)
        + 0.25 * np.exp(cell_px * (-2.0 / 1.8))
        + print_px * print_px
    )
    return [
        RefinedCorners(
            result[i],
            float(sigma[i]),
            True,
            shift_sigma_px,
            float(blur_px[4 * i : 4 * i + 4].max()),
            known,
        )
        if accepted[i]
        else None
        for i in range(m)
    ]


def _neighbours(
    s: Array, rims: Sequence[Rim], best: int | None
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """For `locate`: which profiles have a neighbouring edge, and which have an edge."""
    inside, outside = np.zeros_like(s), np.zeros_like(s)
    possible = np.ones(s.shape, dtype=np.bool_)
    for i, rim in enumerate(rims):
        rows = slice(4 * i, 4 * i + 4)
        inside[rows] = rim.white[_SIDES, (s[rows] * rim.cells).astype(np.intp)]
    if best is not None:
        rim = rims[best]
        at = 1.0 + s[-4:] * (rim.cells - 2)  # in cells from the border's corner
        # Near a black cell of the rim, or with one behind, blur bends the edge.
        free = rim.open[_SIDES, (at - 0.3).astype(np.intp)]
        free = free * rim.open[_SIDES, (at + 0.3).astype(np.intp)]
        possible[-4:] = free > 0.0
        outside[-4:] = 1.0
    return inside, outside, possible


def doubled_area(corners: Array) -> Array:
    """Positive for corners that run clockwise as the picture is seen, (m,)."""
    a, b = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _fit_lines(points: Array, weight: Array) -> tuple[Array, Array]:
    """Total least squares a side: lines (4m, 3) as (nx, ny, c) with n.x = c and |n| = 1,
    and the weighted RMS distance (4m,), both in normalised coordinates."""
    w = weight / np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    x, y = points[..., 0], points[..., 1]
    cx, cy = (w * x).sum(axis=1), (w * y).sum(axis=1)
    dx, dy = x - cx[:, None], y - cy[:, None]
    wx = w * dx
    sxx, sxy, syy = (wx * dx).sum(axis=1), (wx * dy).sum(axis=1), (w * dy * dy).sum(axis=1)
    direction = 0.5 * np.arctan2(2.0 * sxy, sxx - syy)
    nx, ny = -np.sin(direction), np.cos(direction)
    residual2 = nx * nx * sxx + 2.0 * nx * ny * sxy + ny * ny * syy
    lines = np.empty((len(w), 3))
    lines[:, 0], lines[:, 1], lines[:, 2] = nx, ny, nx * cx + ny * cy
    return lines, np.sqrt(np.maximum(residual2, 0.0))


def _intersect(lines: Array) -> Array:
    """Corner i of each marker, where side i - 1 meets side i: (m, 4, 2)."""
    before = lines[:, _BEFORE]
    ax, ay, ac = before[..., 0], before[..., 1], before[..., 2]
    bx, by, bc = lines[..., 0], lines[..., 1], lines[..., 2]
    det = ax * by - ay * bx
    det = np.where(np.abs(det) < 1e-9, np.nan, det)
    corners = np.empty((len(lines), 4, 2))
    corners[..., 0] = (ac * by - ay * bc) / det
    corners[..., 1] = (ax * bc - ac * bx) / det
    return corners
