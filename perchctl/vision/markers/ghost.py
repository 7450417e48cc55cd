"""Double edges: what a converter leaves that averages the two fields of a moving picture.

Both fields are then in every row, and cannot be taken apart again. A side of a marker shows it:
the grey levels across it rise in two equal steps with a plateau between, where blur
of any kind makes one.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.types import MARKERS, Detection, Detections

SLOW_PX_S = 80.0
"""Markers that move no faster have fields too near to each other to be told apart."""
FIELDS_APART_S = 0.02
_PLACES: Array = np.linspace(0.12, 0.88, 48)
_STEP_PX = 0.5
_REACH_CELLS, _MOST_REACH_PX = 0.9, 16.0
_LEAST_REACH_PX = 4.0
_LEAST_PX = 2.5  # between the steps
_VALLEY = 0.55  # of the lower peak
_ALIKE = 0.55  # the lower peak in terms of the higher
_LEAST_SLOPE = 3.0  # grey levels a pixel
_CELLS = {"large": 6.0, "small": 7.0}  # of a side; with a little less all goes as well


def with_ghosts(now: Detections, image: NDArray[np.uint8]) -> Detections:
    """`now` with `ghost_px`, and the corners' spread widened by it, where a marker that moves,
    or of which that is not known, has double edges."""
    velocity = now.velocity_px_s
    if velocity is not None and float(np.hypot(*velocity)) < SLOW_PX_S:
        return now
    seen = [d for name in MARKERS if (d := now.get(name)) is not None]
    # Sides that are outside of the picture show nothing.
    ghost_px = max((double_edge_px(image, d) for d in seen if d.cov_px2 is None), default=0.0)
    if ghost_px == 0.0:
        return now
    wider = {d.marker: _wider(d, ghost_px / 4.0) for d in seen}
    return replace(now, large=wider.get("large"), small=wider.get("small"), ghost_px=ghost_px)


def _wider(d: Detection, sigma_px: float) -> Detection:
    """The middle of both steps is where the edge was at the middle moment, but an edge fit may
    hold to one of them."""
    cov_px2 = None if d.cov_px2 is None else d.cov_px2 + sigma_px**2 * np.eye(8)
    return replace(d, sigma_px=float(np.hypot(d.sigma_px, sigma_px)), cov_px2=cov_px2)


def double_edge_px(image: NDArray[np.uint8], marker: Detection) -> float:
    """How far the two steps of a marker's sides are apart, the mean over opposite sides and
    the greater of the two directions; 0 where the sides are single."""
    apart = [_apart_px(profile) for profile in _profiles(image, marker)]
    if len(apart) < 4:
        return 0.0
    pairs = [(apart[k], apart[k + 2]) for k in (0, 1)]
    both = [(a + b) / 2.0 for a, b in pairs if min(a, b) > 0.6 * max(a, b) > 0.0]
    return max(both, default=0.0)


def _profiles(image: NDArray[np.uint8], marker: Detection) -> list[Array]:
    """Mean grey across each side from the inside outwards, `_STEP_PX` apart."""
    corners = marker.corners_px
    ends = np.roll(corners, -1, axis=0)
    sides_px = np.linalg.norm(ends - corners, axis=1)
    reach_px = min(_REACH_CELLS * float(sides_px.min()) / _CELLS[marker.marker], _MOST_REACH_PX)
    if reach_px < _LEAST_REACH_PX:
        return []
    along = (ends - corners) / sides_px[:, None]
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    inside = ((corners + ends) / 2.0 - corners.mean(axis=0)) * normal
    normal *= np.sign(inside.sum(axis=1))[:, None]
    u = np.arange(-reach_px, reach_px + 1e-9, _STEP_PX)
    foot = corners[:, None] + _PLACES[None, :, None] * (ends - corners)[:, None]
    at = (foot[:, :, None] + u[None, None, :, None] * normal[:, None, None]).astype(np.float32)
    flat = at.reshape(4 * len(_PLACES), len(u), 2)
    grey = cv2.remap(image, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR)
    return list(grey.reshape(4, len(_PLACES), len(u)).mean(axis=1, dtype=np.float64))


def _apart_px(profile: Array) -> float:
    """The distance of two equal steps in a profile, 0 where there is one."""
    slope = np.convolve(np.diff(profile), (0.25, 0.5, 0.25), mode="same") / _STEP_PX
    peaks = np.flatnonzero((slope[1:-1] > slope[:-2]) & (slope[1:-1] >= slope[2:])) + 1
    if len(peaks) < 2:
        return 0.0
    highest = peaks[np.argsort(slope[peaks])[-2:]]
    a, b = int(highest.min()), int(highest.max())
    low, high = sorted((float(slope[a]), float(slope[b])))
    apart_px = (b - a) * _STEP_PX
    double = (
        apart_px >= _LEAST_PX
        and low >= _ALIKE * high
        and low >= _LEAST_SLOPE
        and float(slope[a:b].min()) < _VALLEY * low
    )
    return apart_px if double else 0.0
