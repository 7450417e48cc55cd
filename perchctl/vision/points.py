"""Corners as a pose is solved from them: where they are, and what each is worth.

Corners that are intersections of fitted lines do not err on their own: a line is off
by an offset and a tilt, and moves the corners at both of its ends. Its two ends have
errors across it of variance s^2 with a correlation of -1/2, so half the line's offset
is known to s/2 and its tilt to s sqrt(3)/2. `whitening` turns corner errors into these
independent ones. A shift of all edges by the same number of pixels (clipped white, ink)
is left out of the fit, where small markers' own faults would feed it, but not out of the
covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array
from perchctl.vision.types import Detection

_EACH = np.eye(8)
_TILT = np.array(1.0 / math.sqrt(3.0))
_BEFORE = np.array([3, 0, 1, 2])
_START = np.arange(4)  # side k runs from corner k ...
_END = np.array([1, 2, 3, 0])  # ... to corner k + 1
_ROWS = np.concatenate([2 * np.tile(_START, 4), 2 * np.tile(_START, 4) + 1])
_COLUMNS = np.concatenate([2 * _START, 2 * _START + 1, 2 * _END, 2 * _END + 1] * 2)
_SIDES = 8 * _ROWS + _COLUMNS  # in an (8, 8) matrix


@dataclass(frozen=True, eq=False)
class Points:
    """object_m (n, 3) and image_px (n, 2) of a pinhole K; sigma_px (n,); whitening
    (2n, 2n) makes errors independent and of unit spread; shift (2n, k): one standard deviation
    each of what moves corners together, whitened: the shift that all edges share, the
    detections' `common_px`, and what shakes the rows of each; lift (2n, 2) of a sheet that
    curls, and whether corners are weighed by it."""

    object_m: Array
    image_px: Array
    sigma_px: Array
    whitening: Array
    shift: Array
    K: Array
    lift: Array | None = None
    curled: bool = False


def make_points(
    detections: Sequence[Detection],
    object_m: Array,
    image_px: Array,
    K: Array,
    lift: Array | None = None,
) -> Points:
    n, m = len(image_px), len(detections)
    W, shift = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 + 2 * m))
    corners_px = image_px.reshape(m, 4, 2)
    normals = _outward_normals(corners_px)
    # A corner moves a pixel along the normals of both of its sides.
    moved = (normals + normals.take(_BEFORE, axis=1)).reshape(m, 8)
    for i, d in enumerate(detections):
        rows, corners = slice(8 * i, 8 * i + 8), corners_px[i]
        shift[rows, 0] = d.shift_sigma_px * moved[i]
        if d.cov_px2 is not None:
            W[rows, rows] = _whitened(d.cov_px2)
        elif d.refined:
            spread_px = d.sigma_px if d.lying_sigma_px == 0.0 else _lying_px(d, corners)
            own = np.zeros(64)
            own[_SIDES] = _of_lines(normals[i], spread_px)
            W[rows, rows] = own.reshape(8, 8)
        else:
            W[rows, rows] = _EACH / d.sigma_px
        if d.common_px is not None:
            shift[rows, 1] = d.common_px.ravel()
        if d.row_sigma_px > 0.0:
            # As of a line: half to all of its rows alike, and a slant.
            down = corners[:, 1] - corners[:, 1].mean()
            down /= max(float(np.abs(down).max()), 1e-9)
            along_x = slice(8 * i, 8 * i + 8, 2)
            shift[along_x, 2 + 2 * i] = 0.5 * d.row_sigma_px
            shift[along_x, 3 + 2 * i] = 0.5 * math.sqrt(3.0) * d.row_sigma_px * down
    sigma_px = np.array([d.sigma_px for d in detections]).repeat(4)
    return Points(object_m, image_px, sigma_px, W, W.dot(shift), K, lift)


def _outward_normals(corners: Array) -> Array:
    """Unit normals (m, 4, 2) of the sides of m squares, whichever way round these are."""
    side = corners.take(_END, axis=1) - corners
    x, y = side[..., 0], side[..., 1]
    length = np.maximum(np.hypot(x, y), 1e-9)
    length = np.copysign(length, (x[:, 0] * y[:, 1] - y[:, 0] * x[:, 1])[:, None])
    normals = np.empty_like(side)
    np.divide(y, length, out=normals[..., 0])
    np.divide(x, -length, out=normals[..., 1])
    return normals


def _whitened(cov_px2: Array) -> Array:
    """(8, 8): what makes errors of that covariance independent and of unit spread."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(cov_px2)), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.diag(1.0 / np.sqrt(np.maximum(np.diagonal(cov_px2), 1e-6)))


def _lying_px(d: Detection, corners: Array) -> Array:
    """Spread of the sides, (4,): the more of a side lies along the rows, the worse. Over
    several rows errors of interpolation cancel out."""
    way = corners.take(_END, axis=0) - corners
    lying = np.abs(way[:, 0]) / np.maximum(np.hypot(way[:, 0], way[:, 1]), 1e-9)
    rows = 0.5 * math.pi * np.abs(way[:, 1])
    return np.asarray(np.hypot(d.sigma_px, d.lying_sigma_px * lying / np.hypot(1.0, rows)))


def _of_lines(normals: Array, sigma_px: float | Array) -> Array:
    """Whitening of the corners of four fitted lines with normals (4, 2), by the offset and the
    tilt of each, at `_SIDES`; `sigma_px` of all or of each, (4,)."""
    across = (normals.T / sigma_px).ravel()
    tilt = across * _TILT
    return np.concatenate([across, across, -tilt, tilt])
