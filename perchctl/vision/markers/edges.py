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


def _single(value: float) -> Floats:
    """A number as arrays meet it soonest: beside one of numpy's scalars they take twice as long."""
    return np.array(value, dtype=np.float32)


_ALONG32 = ALONG.astype(np.float32)
_ZERO, _ONE, _TINY = _single(0.0), _single(1.0), _single(1e-9)
_QUARTER_OF, _MINUS_HALF = _single(0.25), _single(-0.5)
_WINDOW2, _MOST_SHARE = _single(2.25), _single(0.9)
_LEAST_MOMENT2, _MOST_MOMENT = _single(0.01), _single(0.8)
_PER_NEAR = _single(1.0 / 0.6)  # of the wide window's spread
_TUKEY = _single(3.5 * 1.4826)
_POWERS: Floats = (ALONG[:, None] ** np.arange(3)).astype(np.float32)
_PROFILE_ONES: Floats = np.ones(PROFILES, dtype=np.float32)
_ONES: Floats = np.ones(STEPS, dtype=np.float32)
_LEAST_SHARE = _single(0.3)  # of the row's mean gradient, for a profile to count
_TUKEY_FLOOR_PX = _single(3.5 * 0.05)  # of the scatter that is taken for noise
_CENTRED_PX = 0.2  # a wide window that is off by less needs only one narrow round
_SETTLED_PX = 0.06
_ROUNDS = 3
_LEAST_WINDOW2 = _single(0.81)  # square of its sigma, px^2
_FAR = _single(1e6)
_QUARTER = PROFILES // 4
_QUARTER_ONES: Floats = np.ones(_QUARTER, dtype=np.float32)
# The line through values in the middles of both halves of the profiles, (2, n).
_SLOPE: Floats = _ALONG32 * _single(0.5 / float(ALONG[PROFILES // 2 :].mean()))
_THROUGH_HALVES: Floats = np.stack([_single(0.5) - _SLOPE, _single(0.5) + _SLOPE])
_HIGH_LOW: Floats = np.where(np.arange(PROFILES) % 2, _FAR, -_FAR).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What lies beside the edges.

    depth_px: width of a cell, (rows,). inside, outside: 1 where a falling edge of the same
    height lies one cell further in or out, (rows, n). possible: False where there is no
    edge to be found, (rows, n).
    """

    depth_px: Array
    inside: Floats
    outside: Floats
    possible: NDArray[np.bool_]

    def only(self, kept: NDArray[np.intp]) -> Surroundings:
        """Of some of the rows."""
        return Surroundings(
            self.depth_px[kept], self.inside[kept], self.outside[kept], self.possible[kept]
        )


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
    needs: its reach `near`, the cells' width, the square of its largest sigma, the
    flanks with a neighbouring edge (`both`, `side`: outside less inside), the
    profiles that `can` show an edge, and `part`, which makes of a row's sum the least
    value that counts."""

    gradient: Floats
    u: Floats
    near: Floats
    depth: Floats
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
    line = weight = _halves_line(seen.edge, seen.usable)
    moved_px = np.inf
    for k in range(_ROUNDS):
        if k == 1 and moved_px < _CENTRED_PX:
            continue
        seen = _narrow(gradients, line, seen.blur2)
        rounds = 2 if k == _ROUNDS - 1 else 1
        centre, weight = _robust_line(seen.edge, seen.usable, rounds)
        moved_px, line = float(np.abs(centre - line).max()), centre
        if moved_px < _SETTLED_PX:
            break
    return Edges(
        offset_px=seen.edge.astype(np.float64),
        weight=weight.astype(np.float64),
        blur_px=np.sqrt(seen.blur2).astype(np.float64),
    )


def _gradients(grey: Floats, half_px: Array, near_px: Array, around: Surroundings) -> _Gradients:
    inside, outside, can = around.inside, around.outside, around.possible.astype(np.float32)
    near, depth = near_px.astype(np.float32), around.depth_px.astype(np.float32)
    return _Gradients(
        gradient=grey[:, :, 1:] - grey[:, :, :-1],
        u=half_px.astype(np.float32)[:, None] * MIDDLES,
        near=near,
        depth=depth,
        most2=_QUARTER_OF * near * near,
        both=inside + outside,
        side=outside - inside,
        can=can,
        # Multiplies a sum over a row's profiles: a part of the mean over those possible.
        part=_LEAST_SHARE / np.maximum(can.dot(_PROFILE_ONES), _ONE),
    )


def _wide(g: _Gradients) -> _Centroids:
    """By one window around the middle of all profiles; the blur is not measured yet."""
    spread = g.u * (_PER_NEAR / g.near)[:, None]
    spread *= spread
    window = np.empty((*g.u.shape, 2), dtype=np.float32)
    np.exp(_MINUS_HALF * spread, out=window[..., 0])
    np.multiply(window[..., 0], g.u, out=window[..., 1])
    moments: Floats = np.maximum(g.gradient, _ZERO) @ window
    total = moments[..., 0] * g.can
    usable = total > (total.dot(_PROFILE_ONES) * g.part)[:, None]
    edge = np.divide(moments[..., 1], np.where(usable, total, _ONE))
    return _Centroids(edge, usable, np.ones(len(g.near), dtype=np.float32))


def _narrow(g: _Gradients, line: Floats, blur2: Floats) -> _Centroids:
    """By a window around the row's line (rows, n), as wide as its blur so far demands."""
    relative = g.u[:, None, :] - line[:, :, None]
    # The second moment under a Gaussian window w gives 1/m2 = 1/blur^2 + 1/w^2.
    w2 = np.minimum(np.maximum(_WINDOW2 * blur2, _LEAST_WINDOW2), g.most2)
    squared = relative * relative
    mass = squared * (_MINUS_HALF / w2)[:, None, None]
    np.exp(mass, out=mass)
    mass *= g.gradient
    total = (mass @ _ONES) * g.can
    usable = total > np.maximum(total.dot(_PROFILE_ONES) * g.part, _TINY)[:, None]
    # A neighbour seen through the window has this share, at this place, with this
    # spread; the one outside lies at the same distance on the other flank.
    wide2 = w2 + blur2
    place = g.depth * w2 / wide2
    lost = np.exp(_MINUS_HALF * g.depth * g.depth / wide2)
    share = np.minimum(g.both * lost[:, None], _MOST_SHARE)
    total = np.where(usable, total / (_ONE - share), _ONE)
    relative *= mass
    first = relative @ _ONES + total * g.side * (lost * place)[:, None]
    mass *= squared
    second = mass @ _ONES + total * share * (place * place + w2 * blur2 / wide2)[:, None]
    moment = (second * usable).dot(_PROFILE_ONES)
    moment /= np.maximum((total * usable).dot(_PROFILE_ONES), _TINY)
    moment = np.minimum(np.maximum(moment, _LEAST_MOMENT2), _MOST_MOMENT * w2)
    found2 = moment * w2 / (w2 - moment)
    # The window pulls the centroid towards its own middle: undo that.
    centroid = first / total * (_ONE + found2 / w2)[:, None]
    limit = g.near[:, None]
    return _Centroids(line + np.minimum(np.maximum(centroid, -limit), limit), usable, found2)


def _halves_line(edge: Floats, usable: NDArray[np.bool_]) -> Floats:
    """Straight lines (rows, n) through the middles of the two halves of each row: where a
    window is put, whatever a quarter of either half shows. A half that shows nothing is
    taken to lie where the other does."""
    halves = np.where(usable, edge, _HIGH_LOW).reshape(-1, 2, 2 * _QUARTER)
    halves.sort(axis=2)
    first = _QUARTER // 2
    middle = halves[:, :, first : first + _QUARTER]
    # Left out before the sum: beside the others' size an edge's place is rounded away.
    shown = np.abs(middle) < _FAR
    count = shown @ _QUARTER_ONES
    mean = (middle * shown) @ _QUARTER_ONES / np.maximum(count, _ONE)
    return np.asarray(np.where(count, mean, mean[:, ::-1]) @ _THROUGH_HALVES)


def _robust_line(edge: Floats, usable: NDArray[np.bool_], rounds: int) -> tuple[Floats, Floats]:
    """Straight lines edge(s) a row with Tukey's weights; returns (line, weight)."""
    line = median(edge, usable)[:, None]
    for _ in range(rounds):
        size = np.abs(edge - line)
        size /= np.maximum(_TUKEY * median(size, usable), _TUKEY_FLOOR_PX)[:, None]
        size *= size
        weight = np.maximum(_ONE - size, _ZERO)
        weight *= weight
        weight *= usable
        w = weight.dot(_POWERS)
        e = (weight * edge).dot(_POWERS)
        w0, w1 = np.maximum(w[:, 0], _TINY), w[:, 1]
        mean, middle = e[:, 0] / w0, w1 / w0
        slope = (e[:, 1] - mean * w1) / np.maximum(w[:, 2] - middle * w1, _TINY)
        line = slope[:, None] * (_ALONG32 - middle[:, None])
        line += mean[:, None]
    return line, weight


def median(values: Floats, usable: NDArray[np.bool_]) -> Floats:
    """Each row's median over its usable values, to a rank, (rows,); 0 without any.

    The others are set high and low by turns, which keeps the middle where it is.
    """
    values = np.where(usable, values, _HIGH_LOW)
    values.partition(PROFILES // 2, axis=1)
    found = values[:, PROFILES // 2]
    return np.asarray(np.where(np.abs(found) < _FAR, found, _ZERO))
