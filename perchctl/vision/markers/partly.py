"""A marker of which a part cannot be seen: the picture ends in it, light glares on it, or the
vehicle's own gear is before it.

Four lines need all four sides. Here the whole square is fitted at once, to the edges where they
are seen: its sides, and the inner edges of its border, which stand in for a side that is gone.
What is not seen follows from what is, and the corners' covariance says how well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort, undistort_px
from perchctl.vision.markers.corners import RefinedCorners
from perchctl.vision.markers.mask import hides
from perchctl.vision.markers.pattern import Pattern
from perchctl.vision.markers.profiles import PROFILES
from perchctl.vision.markers.seen_edges import OUT, ROOM_PX, SeenEdges, look
from perchctl.vision.markers.square import (
    UNIT,
    corner_jacobian,
    from_unit,
    mapped,
    mean_side_px,
    side_lengths_px,
    within,
)
from perchctl.vision.markers.visible_cells import (
    KnownBy,
    may_show_enough,
    visible_cells_agree,
)
from perchctl.vision.types import CameraModel, EdgeShift

LEAST_CELL_PX = 4.0  # smaller cells leave no part of a side that would show anything
_ROUNDS, _STILL_PX = 5, 0.05
_MAX_RESIDUAL_PX = 0.6
_MAX_BLUR = 0.9  # of the window
_MAX_SIGMA = 0.02  # of the side: vaguer corners are no measurement
_MIN_SIGMA_PX, _LEAST_SHIFT_SIGMA_PX = 0.015, 0.01
_SHIFT_PRIOR_PX, _CLIPPED_PRIOR_PX, _CLIPPED_GREY = 0.15, 0.4, 248.0
_TAILS = 1.3  # what robust weights take away from a residual's square
_MAX_STEP = 0.5
_MOST_OFF_PX = 20.0  # from its start, three windows on: no edges lead a fit farther


@dataclass(frozen=True, eq=False)
class _Fit:
    """A round's square H (3, 3), unit to pinhole px, how far it moved, the edges that it rests
    on, by how much they are off then, px (rows, n), and the normal matrix (9, 9)."""

    H: Array
    moved_px: float
    seen: SeenEdges
    left_px: Array
    N: Array


def fit_partly(
    image: NDArray[np.uint8],
    start_px: Array,
    pattern: Pattern,
    camera: CameraModel,
    hidden: NDArray[np.bool_] | None = None,
    known: EdgeShift | None = None,
) -> RefinedCorners | None:
    """The marker near to corners `start_px` (4, 2), which may be outside of the picture.

    `hidden` (h, w) is where pixels show something else. None where what is seen does not
    determine the corners. Nothing is said about the marker's cells.
    """
    if not _large_enough(start_px, pattern):
        return None
    start = undistort_px(start_px, camera)
    if not np.isfinite(start).all() or side_lengths_px(start).min() < 1.0:
        return None
    H = from_unit(start)
    fit: _Fit | None = None
    for k in range(_ROUNDS):
        seen = look(image, H, pattern, camera, hidden)
        fit = None if seen is None else _stepped(H, seen, known)
        if fit is None:
            return None
        H = fit.H
        if k > 0 and fit.moved_px < _STILL_PX:
            break
    return None if fit is None else _corners(fit, pattern, camera)


def seen_partly(
    image: NDArray[np.uint8],
    start_px: Array,
    pattern: Pattern,
    camera: CameraModel,
    known_by: KnownBy,
    hidden: NDArray[np.bool_] | None = None,
    known: EdgeShift | None = None,
) -> RefinedCorners | None:
    """`fit_partly`, if the cells that are seen are the marker's."""
    if not _large_enough(start_px, pattern):
        return None
    if not may_show_enough(start_px, image.shape, pattern, camera, known_by, _MOST_OFF_PX):
        return None
    found = fit_partly(image, start_px, pattern, camera, hidden, known)
    if found is None:
        return None
    agree = visible_cells_agree(image, found.corners_px, pattern, camera, hidden, known_by)
    return found if agree else None


def _large_enough(start_px: Array, pattern: Pattern) -> bool:
    return mean_side_px(start_px) / pattern.rim.cells >= LEAST_CELL_PX


def wholly_seen(
    found: RefinedCorners, shape: tuple[int, ...], hidden: NDArray[np.bool_] | None
) -> bool:
    """Whether nothing of the marker is hidden, and the picture's edge too far away to take
    anything from the sides' blur."""
    return within(found.corners_px, shape, ROOM_PX + found.blur_px) and not hides(
        hidden, found.corners_px
    )


def _prior_px(seen: SeenEdges) -> float:
    return _CLIPPED_PRIOR_PX if seen.white > _CLIPPED_GREY else _SHIFT_PRIOR_PX


def _stepped(H: Array, seen: SeenEdges, known: EdgeShift | None) -> _Fit | None:
    """The square H one round on; None where the fit breaks down."""
    A, N, g = _equations(seen, known or EdgeShift(0.0, _prior_px(seen)))
    try:
        step = np.asarray(np.linalg.solve(N, g), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    p = step[:8]
    if not (np.isfinite(p).all() and np.abs(p).max() < _MAX_STEP):
        return None
    H = H @ np.array([[1 + p[0], p[1], p[2]], [p[3], 1 + p[4], p[5]], [p[6], p[7], 1.0]])
    moved_px = float(np.abs(p[:6]).max() * seen.scale_px.mean())
    return _Fit(H / H[2, 2], moved_px, seen, seen.far_px - (step @ A).reshape(seen.far_px.shape), N)


def _equations(seen: SeenEdges, prior: EdgeShift) -> tuple[Array, Array, Array]:
    """Changes (9, rows * n) of the edges with the square's increment, in the terms of
    `corner_jacobian`, and with the shift of all edges, px; and their normal equations (9, 9),
    (9,), per px^2 of an edge's spread."""
    u, v = seen.own[..., 0], seen.own[..., 1]
    nx, ny = OUT[seen.side].T[..., None] * seen.scale_px[:, None]
    A = np.empty((9, *u.shape))
    A[0], A[1], A[2] = nx * u, nx * v, nx
    A[3], A[4], A[5] = ny * u, ny * v, ny
    across = A[0] + A[4]
    A[6], A[7] = -u * across, -v * across
    # The model's edge moves with the square, the seen one by the shift.
    A[8] = -seen.inwards[:, None]
    A = A.reshape(9, -1)
    weighted = A * (seen.weight * _worth(seen)[:, None]).ravel()
    N, g = weighted.dot(A.T), weighted.dot(seen.far_px.ravel())
    # An edge's spread is about a tenth of a pixel while it is not known.
    certain = (0.1 / prior.sigma_px) ** 2
    N[8, 8] += certain
    g[8] += certain * prior.shift_px
    N[range(8), range(8)] += 1e-6
    return A, N, g


def _worth(seen: SeenEdges) -> Array:
    """Profiles nearer to each other than a pixel measure the same, (rows,)."""
    length_px = 2.0 * seen.scale_px * seen.at
    return np.minimum(1.0, length_px / PROFILES)


def _corners(fit: _Fit, pattern: Pattern, camera: CameraModel) -> RefinedCorners | None:
    """Corners and covariance after the last round; None where they are not determined."""
    seen, N = fit.seen, fit.N
    spread = _spread(seen, fit.left_px)
    if spread is None:
        return None
    residual2, growth = spread
    pinhole = mapped(fit.H, UNIT)
    corners_px = distort(mapped(np.asarray(np.linalg.inv(camera.K)), pinhole), camera)
    side_px = mean_side_px(pinhole)
    cell_px = side_px / pattern.rim.cells
    noise2 = max(_TAILS * residual2 * growth, _MIN_SIGMA_PX**2)
    # Of the square alone; what the shift of all edges leaves open is `shift_sigma_px`.
    J = corner_jacobian(fit.H)
    cov_px2: Array = J @ np.linalg.inv(N[:8, :8]) @ J.T * noise2
    floor2 = _MIN_SIGMA_PX**2 + (pattern.rim.tolerance * cell_px) ** 2
    cov_px2 = cov_px2 + np.eye(8) * (floor2 + 0.25 * np.exp(cell_px * (-2.0 / 1.8)))
    vaguest_px = math.sqrt(float(np.diagonal(cov_px2).max()))
    if not (vaguest_px < _MAX_SIGMA * side_px and np.isfinite(corners_px).all()):
        return None
    shift_sigma_px = math.sqrt(noise2 * float(np.linalg.inv(N)[8, 8]))
    return RefinedCorners(
        corners_px=corners_px,
        sigma_px=math.sqrt(float(np.trace(cov_px2)) / 8.0),
        refined=True,
        shift_sigma_px=min(max(shift_sigma_px, _LEAST_SHIFT_SIGMA_PX), _prior_px(seen)),
        cov_px2=cov_px2,
    )


def _spread(seen: SeenEdges, left: Array) -> tuple[float, float] | None:
    """Mean square of what the fit leaves over within rows, px^2, and by how much rows contradict
    each other beyond it; None where these are no edges of a square."""
    w = seen.weight
    mass = w.sum(axis=1)
    used = mass > 0.0
    if not used.any() or (seen.blur[used] > _MAX_BLUR).any():
        return None
    if float((w * left**2).sum() / w.sum()) > _MAX_RESIDUAL_PX**2:
        return None
    mean = (w * left).sum(axis=1) / np.maximum(mass, 1e-9)
    scatter = float((w * (left - mean[:, None]) ** 2).sum() / w.sum())
    chi2 = float((mean**2 * mass).sum()) / max(scatter, _MIN_SIGMA_PX**2)
    freedom = max(2.0 * np.count_nonzero(used) - 9.0, 1.0)
    return scatter, max(chi2 / freedom, 1.0)
