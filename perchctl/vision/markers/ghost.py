"""Double edges: what a converter leaves that averages the two fields of a moving picture.

Both fields are then in every row, and cannot be taken apart again. A side of a marker shows it:
the grey levels across it rise in two equal steps with a plateau between, where blur
of any kind makes one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.square import NEXT, doubled_area, side_lengths_px
from perchctl.vision.types import MARKERS, Detection, Detections

SLOW_PX_S = 80.0
"""Markers that move no faster have fields too near to each other to be told apart."""
FIELDS_APART_S = 0.02
_EVERY = 4
_PLACES: Array = np.linspace(0.12, 0.88, 32)
_STEP_PX = 0.5
_REACH_CELLS, _MOST_REACH_PX = 0.9, 16.0
_LEAST_REACH_PX, _ROOM_PX = 4.0, 8.0
_LEAST_PX = 2.5  # between the steps
_VALLEY = 0.55  # of the lower peak
_ALIKE = 0.55  # the lower peak in terms of the higher
_LEAST_SLOPE = 3.0  # grey levels a pixel
_CELLS = {"large": 6.0, "small": 7.0}  # of a side; with a little less all goes as well


def with_ghosts(
    now: Detections, previous: Detections | None, image: NDArray[np.uint8]
) -> Detections:
    """`now` with `ghost_px`, and the corners' spread widened by it, where a marker that moves,
    or of which that is not known, has double edges. Where the picture before had none, as in
    most streams, it is looked for in every fourth."""
    velocity = now.velocity_px_s
    if velocity is not None and float(np.hypot(*velocity)) < SLOW_PX_S:
        return now
    if velocity is not None and previous is not None and previous.ghost_px == 0.0:
        age = previous.ghost_age + 1
        if age < _EVERY:
            return replace(now, ghost_age=age)
    seen = [d for name in MARKERS if (d := now.get(name)) is not None]
    shows = _shows_best(seen)
    ghost_px = 0.0 if shows is None else double_edge_px(image, shows)
    if ghost_px == 0.0:
        return now
    wider = {d.marker: _wider(d, ghost_px / 4.0) for d in seen}
    return replace(now, large=wider.get("large"), small=wider.get("small"), ghost_px=ghost_px)


def _shows_best(seen: Sequence[Detection]) -> Detection | None:
    """The smallest marker with room enough beside its sides: larger ones bend more, and may
    be outside of the picture, where sides show nothing."""
    whole = [d for d in seen if d.cov_px2 is None]
    small = whole[-1:] if whole and _reach_px(whole[-1]) >= _ROOM_PX else whole[:1]
    return small[0] if small else None


def _reach_px(marker: Detection) -> float:
    """How far from the sides the next edges are not yet seen."""
    cell_px = float(side_lengths_px(marker.corners_px).min()) / _CELLS[marker.marker]
    return min(_REACH_CELLS * cell_px, _MOST_REACH_PX)


def _wider(d: Detection, sigma_px: float) -> Detection:
    """The middle of both steps is where the edge was at the middle moment, but an edge fit may
    hold to one of them."""
    cov_px2 = None if d.cov_px2 is None else d.cov_px2 + sigma_px**2 * np.eye(8)
    return replace(d, sigma_px=float(np.hypot(d.sigma_px, sigma_px)), cov_px2=cov_px2)


def double_edge_px(image: NDArray[np.uint8], marker: Detection) -> float:
    """How far the two steps of a marker's sides are apart, the mean over opposite sides and
    the greater of the two directions; 0 where the sides are single."""
    profiles = _profiles(image, marker)
    if profiles is None:
        return 0.0
    apart = _apart_px(profiles)
    pairs = [(apart[k], apart[k + 2]) for k in (0, 1)]
    both = [(a + b) / 2.0 for a, b in pairs if min(a, b) > 0.6 * max(a, b) > 0.0]
    return max(both, default=0.0)


def _profiles(image: NDArray[np.uint8], marker: Detection) -> Array | None:
    """Mean grey across each side from the inside outwards, `_STEP_PX` apart, (4, n); None of a
    marker that is too small."""
    reach_px = _reach_px(marker)
    if reach_px < _LEAST_REACH_PX:
        return None
    corners = marker.corners_px
    sides_px = side_lengths_px(corners)
    way = corners[NEXT] - corners
    turn = 1.0 if doubled_area(corners[None])[0] > 0.0 else -1.0
    out_x, out_y = turn * way[:, 1] / sides_px, -turn * way[:, 0] / sides_px
    u = np.arange(-reach_px, reach_px + 1e-9, _STEP_PX)
    foot = corners[:, None] + _PLACES[:, None] * way[:, None]
    shape = (4, len(_PLACES), len(u))
    x, y = np.empty(shape, np.float32), np.empty(shape, np.float32)
    np.add(foot[:, :, None, 0], (out_x[:, None] * u)[:, None], out=x, casting="same_kind")
    np.add(foot[:, :, None, 1], (out_y[:, None] * u)[:, None], out=y, casting="same_kind")
    flat = (4 * len(_PLACES), len(u))
    grey = cv2.remap(image, x.reshape(flat), y.reshape(flat), cv2.INTER_LINEAR)
    return np.asarray(grey.reshape(shape).sum(axis=1, dtype=np.int32) / float(len(_PLACES)))


def _apart_px(profiles: Array) -> list[float]:
    """The distance of two equal steps in each of the profiles (m, n), 0 where there is one."""
    rise = np.diff(profiles, axis=1) / _STEP_PX
    slope = 0.25 * rise[:, :-2] + 0.5 * rise[:, 1:-1] + 0.25 * rise[:, 2:]
    middle = slope[:, 1:-1]
    peak = (middle > slope[:, :-2]) & (middle >= slope[:, 2:]) & (middle >= _LEAST_SLOPE)
    return [_between_px(s, np.flatnonzero(p) + 1) for s, p in zip(slope, peak, strict=True)]


def _between_px(slope: Array, peaks: NDArray[np.intp]) -> float:
    """The distance of the two highest peaks, if they are about equal, with a valley between."""
    if len(peaks) < 2:
        return 0.0
    low, high = np.sort(slope[peaks])[-2:]
    if low < _ALIKE * high:
        return 0.0
    a, b = np.sort(peaks[np.argsort(slope[peaks])[-2:]])
    apart_px = float(b - a) * _STEP_PX
    return apart_px if apart_px >= _LEAST_PX and slope[a:b].min() < _VALLEY * low else 0.0
