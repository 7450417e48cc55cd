"""Edges between black and white to a hundredth of a pixel, on grey profiles across them.

The edge in each profile is the gradient's windowed centroid; this is repeated with the
window centred on the side's own line (narrow, hence calm in noise). A blur that is equal
on both flanks of an edge does not move its centroid.

All that a row (one side of one marker) shares is (rows,), what differs from profile to
profile (rows, n). Single precision suffices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.profiles import ALONG, MIDDLES, PROFILES, STEPS, Floats

_ALONG32 = ALONG.astype(np.float32)
_POWERS: Floats = (ALONG[:, None] ** np.arange(3)).astype(np.float32)
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-9)
_PROFILE_ONES: Floats = np.ones(PROFILES, dtype=np.float32)
_ONES: Floats = np.ones(STEPS, dtype=np.float32)
_LEAST_SHARE = np.float32(0.3)  # of the row's mean gradient, for a profile to count
_WIDE_FLOOR_PX, _FLOOR_PX = 0.3, 0.05  # of the scatter that is taken for noise
_CENTRED_PX = 0.2  # a wide window that is off by less needs only one narrow round
_SETTLED_PX = 0.06
_ROUNDS = 3
_LEAST_WINDOW2 = np.float32(0.81)  # square of its sigma, px^2
_FAR = np.float32(1e6)
_HIGH_LOW: Floats = np.where(np.arange(PROFILES) % 2, _FAR, -_FAR).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What lies beside the edges.

    depth_px: width of a cell, (rows,). inside, outside: 1 where a falling edge of the same
    height lies one cell further in or out, (rows, n). possible: False where there is no
    edge to be found, (rows, n).
    """

    depth_px: Array
    inside: Array
    outside: Array
    possible: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Edges:
    """offset_px: an edge's place along the profile's normal, (rows, n). weight: of the
    profiles, 0 for outliers, (rows, n). blur_px: of each row, a standard deviation, (rows,).
    """

    offset_px: Array
    weight: Array
    blur_px: Array


@dataclass(frozen=True, eq=False)
class _Gradients:
    """The profiles' gradients at places `u` (rows, steps) and what every window over them
    needs: its reach `near`, the squares of the cells' width and of its largest sigma, the
    flanks with a neighbouring edge (`both`, `side`: outside less inside), the
    profiles that `can` show an edge, and `part`, which makes of a row's sum the least
    value that counts."""

    gradient: Floats
    u: Floats
    near: Floats
    depth2: Floats
    most2: Floats
    both: Floats
    side: Floats
    can: Floats
    part: Floats


@dataclass(frozen=True, eq=False)
class _Centroids:
    """Where the window saw the edges, px, which of them count, and the blur's square."""

    edge: Floats
    usable: NDArray[np.bool_]
    blur2: Floats


def locate(grey: Floats, half_px: Array, near_px: Array, around: Surroundings) -> Edges:
    """The place of an edge that rises along the profile.

    Args:
        grey: (rows, n, steps + 1), the profile from -half_px to +half_px.
        half_px, near_px: reach of the profiles and of the windows, (rows,).
    """
    gradients = _gradients(grey, half_px, near_px, around)
    seen = _wide(gradients)
    line, weight = robust_line(seen.edge, seen.usable, _WIDE_FLOOR_PX, 2)
    moved_px = np.inf
    for k in range(_ROUNDS):
        if k == 1 and moved_px < _CENTRED_PX:
            continue
        seen = _narrow(gradients, line, seen.blur2)
        rounds = 2 if k == _ROUNDS - 1 else 1
        centre, weight = robust_line(seen.edge, seen.usable, _FLOOR_PX, rounds)
        moved_px, line = float(np.abs(centre - line).max()), centre
        if moved_px < _SETTLED_PX:
            break
    return Edges(
        offset_px=seen.edge.astype(np.float64),
        weight=weight.astype(np.float64),
        blur_px=np.sqrt(seen.blur2).astype(np.float64),
    )


def _gradients(grey: Floats, half_px: Array, near_px: Array, around: Surroundings) -> _Gradients:
    inside, outside = around.inside.astype(np.float32), around.outside.astype(np.float32)
    near = near_px.astype(np.float32)
    can = around.possible.astype(np.float32)
    return _Gradients(
        gradient=grey[:, :, 1:] - grey[:, :, :-1],
        u=half_px.astype(np.float32)[:, None] * MIDDLES,
        near=near,
        depth2=(around.depth_px * around.depth_px).astype(np.float32),
        most2=(0.25 * near * near).astype(np.float32),
        both=inside + outside,
        side=outside - inside,
        can=can,
        # Multiplies a sum over a row's profiles: a part of the mean over those possible.
        part=_LEAST_SHARE / np.maximum(can @ _PROFILE_ONES, _ONE),
    )


def _wide(g: _Gradients) -> _Centroids:
    """By one window around the middle of all profiles; the blur is not measured yet."""
    window = np.exp(-0.5 * (g.u / (0.6 * g.near[:, None])) ** 2)
    moments = np.maximum(g.gradient, _ZERO) @ np.stack([window, window * g.u], axis=2)
    total = moments[..., 0] * g.can
    usable = total > ((total @ _PROFILE_ONES) * g.part)[:, None]
    edge = moments[..., 1] / np.where(usable, total, _ONE)
    return _Centroids(edge, usable, np.ones(len(g.near), dtype=np.float32))


def _narrow(g: _Gradients, line: Floats, blur2: Floats) -> _Centroids:
    """By a window around the row's line (rows, n), as wide as its blur so far demands."""
    relative = g.u[:, None, :] - line[:, :, None]
    # The second moment under a Gaussian window w gives 1/m2 = 1/blur^2 + 1/w^2.
    w2 = np.minimum(np.maximum(np.float32(2.25) * blur2, _LEAST_WINDOW2), g.most2)
    squared = relative * relative
    mass = squared * (np.float32(-0.5) / w2)[:, None, None]
    np.exp(mass, out=mass)
    mass *= g.gradient
    total = (mass @ _ONES) * g.can
    usable = total > np.maximum((total @ _PROFILE_ONES) * g.part, _TINY)[:, None]
    # A neighbour seen through the window has this share, at this place, with this
    # spread; the one outside lies at the same distance on the other flank.
    wide2 = w2 + blur2
    lost = np.exp(np.float32(-0.5) * g.depth2 / wide2)
    place = np.sqrt(g.depth2) * w2 / wide2
    share = np.minimum(g.both * lost[:, None], np.float32(0.9))
    total = np.where(usable, total / (_ONE - share), _ONE)
    relative *= mass
    first = relative @ _ONES + total * g.side * (lost * place)[:, None]
    mass *= squared
    second = mass @ _ONES + total * share * (place * place + w2 * blur2 / wide2)[:, None]
    moment = (second * usable) @ _PROFILE_ONES
    moment /= np.maximum((total * usable) @ _PROFILE_ONES, _TINY)
    moment = np.minimum(np.maximum(moment, np.float32(0.01)), np.float32(0.8) * w2)
    found2 = moment * w2 / (w2 - moment)
    # The window pulls the centroid towards its own middle: undo that.
    centroid = first / total * (_ONE + found2 / w2)[:, None]
    limit = g.near[:, None]
    return _Centroids(line + np.minimum(np.maximum(centroid, -limit), limit), usable, found2)


def robust_line(
    edge: Floats, usable: NDArray[np.bool_], floor_px: float, rounds: int
) -> tuple[Floats, Floats]:
    """Straight lines edge(s) a row with Tukey's weights; returns (line, weight)."""
    error = edge - median(edge, usable)[:, None]
    line = weight = edge
    for _ in range(rounds):
        size = np.abs(error)
        scale = np.maximum(np.float32(1.4826) * median(size, usable), np.float32(floor_px))
        size /= (np.float32(3.5) * scale)[:, None]
        size *= size
        weight = np.maximum(_ONE - size, _ZERO)
        weight *= weight
        weight *= usable
        w = weight @ _POWERS
        e = (weight * edge) @ _POWERS
        w0, w1 = np.maximum(w[:, 0], _TINY), w[:, 1]
        mean, middle = e[:, 0] / w0, w1 / w0
        slope = (e[:, 1] - mean * w1) / np.maximum(w[:, 2] - middle * w1, _TINY)
        line = slope[:, None] * (_ALONG32 - middle[:, None])
        line += mean[:, None]
        error = edge - line
    return line, weight


def median(values: Floats, usable: NDArray[np.bool_]) -> Floats:
    """Each row's median over its usable values, to a rank, (rows,); 0 without any.

    The others are set high and low by turns, which keeps the middle where it is.
    """
    values = np.where(usable, values, _HIGH_LOW)
    values.partition(PROFILES // 2, axis=1)
    found = values[:, PROFILES // 2]
    return np.asarray(np.where(np.abs(found) < _FAR, found, _ZERO))
