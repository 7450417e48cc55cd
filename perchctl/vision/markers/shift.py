"""By how much white has grown over black in a picture: from the width of a border."""

from __future__ import annotations

import math

import cv2
import numpy as np

from perchctl.geometry import Array

_SHIFT_FLOOR_PX = 0.01
_MAX_SHIFT_PX = 1.0
_MAX_BLUR_CELLS = 0.45  # beyond it the two edges of a border are one
_OUT: Array = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])  # of each side
_UNIT32 = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float32)


def edge_shift(
    corners: Array,
    points: Array,
    weight: Array,
    blur_px: Array,
    depth_px: Array,
    cell_px: float,
    cells: int,
    tolerance: float,
    prior_px: float,
) -> tuple[float, float]:
    """How far white has grown over black, px, and the spread of that estimate.

    Outer edges that moved in by d shrink the marker's own scale; the inner edges, at
    the part r of it, moved out by d: they appear d (1 + r) too far out.

    Args:
        corners: (4, 2) as fitted, normalised.
        points, weight: of the border's inner edge, (4, n, 2) and (4, n).
        blur_px, depth_px: of the edge, and the width of the border, (4,).
        tolerance: of a printed edge's place, in cells.
        prior_px: how far edges are shifted before anything is measured.
    """
    r = 1.0 - 2.0 / cells
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), _UNIT32)
    own = cv2.perspectiveTransform(points.reshape(-1, 1, 2), H).reshape(points.shape)
    far = np.matmul(own, _OUT[:, :, None])[..., 0] - r
    far_px = far * (depth_px / (1.0 - r * r))[:, None]
    w = weight * (blur_px < _MAX_BLUR_CELLS * depth_px)[:, None]
    w *= np.abs(far_px) < _MAX_SHIFT_PX
    mass = w.sum(axis=1)
    some = mass > 3.0
    if not some.any():
        return 0.0, prior_px
    share = w / np.maximum(mass, 1e-9)[:, None]
    mean = (share * far_px).sum(axis=1)
    scatter = (share * (far_px - mean[:, None]) ** 2).sum(axis=1)
    information = some / (2.0 * scatter / np.maximum(mass, 1.0) + _SHIFT_FLOOR_PX**2)
    total = float(information.sum())
    shift = float(information @ mean) / total
    # Sides that disagree are worth less.
    chi2 = float(information @ (mean - shift) ** 2) / max(int(np.count_nonzero(some)) - 1, 1)
    variance = max(chi2, 1.0) / total
    # What no averaging takes away: the neighbours' blur and the print.
    variance += (2.0 * math.exp(-cell_px / 2.2)) ** 2 + (tolerance * cell_px) ** 2
    prior = prior_px**2
    return shift * prior / (prior + variance), (1.0 / variance + 1.0 / prior) ** -0.5
