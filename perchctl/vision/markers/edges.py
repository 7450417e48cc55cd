"""Edges between black and white to a hundredth of a pixel, on grey profiles across them.

1. sample grey profiles across each side, along its image through the lens, so
   that distortion does not bend the side away from the samples;
2. place the edge in each profile by the gradient's windowed centroid, and repeat
   with the window centred on the side's own line (narrow, hence calm in noise).

A blur that is equal on both flanks of an edge does not move its centroid. All rows
(a row is one side of one marker) run through the same arrays.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort
from perchctl.vision.types import CameraModel

PROFILES = 24  # across each side
STEPS = 16  # gradient samples in each profile
Floats = NDArray[np.float32]

ALONG: Array = np.linspace(-1.0, 1.0, PROFILES)  # a side, between its margins
_ALONG32 = ALONG.astype(np.float32)
_POWERS: Floats = (ALONG[:, None] ** np.arange(3)).astype(np.float32)
_OFFSETS: Floats = np.linspace(-1.0, 1.0, STEPS + 1).astype(np.float32)
_MIDDLES: Floats = (_OFFSETS[1:] + _OFFSETS[:-1]) * np.float32(0.5)
# Values and slopes at the profiles from a polynomial through the nodes.
_NODES: Array = np.array([-1.0, -0.7, 0.0, 0.7, 1.0])
_INVERSE: Array = np.linalg.inv(_NODES[:, None] ** np.arange(5.0))
_VALUES: Array = (ALONG[:, None] ** np.arange(5)) @ _INVERSE
_SLOPES: Array = (np.arange(1, 5) * ALONG[:, None] ** np.arange(4)) @ _INVERSE[1:]
_ZERO, _ONE, _TINY = np.float32(0.0), np.float32(1.0), np.float32(1e-9)
_PROFILE_ONES: Floats = np.ones(PROFILES, dtype=np.float32)
_ONES: Floats = np.ones(STEPS, dtype=np.float32)
_SETTLED_PX = 0.06
_FAR = np.float32(1e6)
_HIGH_LOW: Floats = np.where(np.arange(PROFILES) % 2, _FAR, -_FAR).astype(np.float32)


def places(lengths_px: Array) -> Array:
    """How far along its side (rows,) of that length each profile is: (rows, n) in 0..1;
    the ends keep clear of the neighbouring sides' blur."""
    margin = np.minimum(np.maximum(2.5 / lengths_px, 0.04), 0.25)[:, None]
    return np.asarray(margin + (0.5 - margin) * (1.0 + ALONG))


def side_profiles(starts: Array, ends: Array, s: Array, camera: CameraModel) -> tuple[Array, Array]:
    """Where the profiles cross the sides, in the picture, and the unit normals there,
    to the left of the way from start to end as the picture is seen (outwards for a
    marker whose corners run clockwise): each (rows, n, 2).

    A side's image through the lens is smooth: a few nodes tell all of it.

    Args:
        starts, ends: of the sides in normalised coordinates, (rows, 2).
        s: places of the profiles along them, (rows, n), as of `places`.
    """
    first, last = s[:, :1], s[:, -1:]
    at = (0.5 * (first + last) + (0.5 * (last - first)) * _NODES)[..., None]
    points = starts[:, None] + at * (ends - starts)[:, None]
    nodes = distort(points.reshape(-1, 2), camera).reshape(points.shape)
    origin = np.matmul(_VALUES, nodes)
    tangent = np.matmul(_SLOPES, nodes)
    tx, ty = tangent[..., 0], tangent[..., 1]
    length = np.maximum(np.sqrt(tx * tx + ty * ty), 1e-12)
    normal = np.empty_like(tangent)
    np.divide(ty, length, out=normal[..., 0])
    np.divide(tx, -length, out=normal[..., 1])
    return origin, normal


def sample(image: NDArray[np.uint8], origin: Array, normal: Array, half_px: Array) -> Floats:
    """Grey values along the profiles, (rows, n, steps + 1): bilinear, the picture's rim
    repeated outside.

    On float pictures OpenCV 5 interpolates at the exact position; on bytes, other
    releases round it to 1/32 px, which is as large as the spread that is aimed at.
    """
    h, w = image.shape
    reach = float(half_px.max()) + 2.0
    flat = origin.reshape(-1, 2)
    (x0, y0), (x1, y1) = flat.min(axis=0).tolist(), flat.max(axis=0).tolist()
    left, top = min(max(int(x0 - reach), 0), w - 2), min(max(int(y0 - reach), 0), h - 2)
    right, bottom = min(int(x1 + reach) + 1, w), min(int(y1 + reach) + 1, h)
    right, bottom = max(right, left + 2), max(bottom, top + 2)
    patch = image[top:bottom, left:right].astype(np.float32)
    at = (origin - (left, top)).astype(np.float32)
    way = (normal * half_px[:, None, None]).astype(np.float32)
    rows, n = origin.shape[:2]
    x = way[:, :, 0, None] * _OFFSETS
    x += at[:, :, 0, None]
    y = way[:, :, 1, None] * _OFFSETS
    y += at[:, :, 1, None]
    shape = (rows, n * (STEPS + 1))
    grey = cv2.remap(patch, x.reshape(shape), y.reshape(shape), cv2.INTER_LINEAR,
                     borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    return np.asarray(grey, dtype=np.float32).reshape(rows, n, STEPS + 1)


def locate(
    grey: Floats,
    half_px: Array,
    near_px: Array,
    depth_px: Array,
    inside: Array,
    outside: Array,
    possible: NDArray[np.bool_],
) -> tuple[Array, Array, Array]:
    """The place of an edge that rises along the profile.

    Args:
        grey: (rows, n, steps + 1), the profile from -half_px to +half_px.
        near_px: reach of the windows, (rows,).
        depth_px: width of a cell, (rows,).
        inside, outside: 1 where a falling edge of the same height lies one cell further
            in or out, (rows, n).
        possible: False where there is no edge to be found, (rows, n).

    Returns the edge's place in px along the normal (rows, n), the profiles' weights (0
    for outliers), and each row's blur as a standard deviation, px (rows,).
    """
    half = half_px.astype(np.float32)
    near = near_px.astype(np.float32)
    depth2 = (depth_px * depth_px).astype(np.float32)
    inside32, outside32 = inside.astype(np.float32), outside.astype(np.float32)
    both, side = inside32 + outside32, outside32 - inside32
    can = possible.astype(np.float32)
    # Multiplies a sum over a row's profiles: a part of the mean over those possible.
    part = np.float32(0.3) / np.maximum(can @ _PROFILE_ONES, np.float32(1.0))
    gradient = grey[:, :, 1:] - grey[:, :, :-1]
    u = half[:, None] * _MIDDLES  # (rows, steps)
    window = np.exp(-0.5 * (u / (0.6 * near[:, None])) ** 2)
    moments = np.maximum(gradient, _ZERO) @ np.stack([window, window * u], axis=2)
    total = moments[..., 0] * can
    usable = total > ((total @ _PROFILE_ONES) * part)[:, None]
    edge = moments[..., 1] / np.where(usable, total, _ONE)
    line, weight = robust_line(edge, usable, 0.3, 2)
    blur2 = np.ones(len(grey), dtype=np.float32)
    least, most = np.float32(0.81), (0.25 * near * near).astype(np.float32)
    limit, moved_px = near[:, None], np.inf
    for narrow in range(3):
        if narrow == 1 and moved_px < 0.2:
            continue  # the wide window was as good as centred
        relative = u[:, None, :] - line[:, :, None]
        # The second moment under a Gaussian window w gives 1/m2 = 1/blur^2 + 1/w^2.
        w2 = np.minimum(np.maximum(np.float32(2.25) * blur2, least), most)
        squared = relative * relative
        mass = squared * (np.float32(-0.5) / w2)[:, None, None]
        np.exp(mass, out=mass)
        mass *= gradient
        total = (mass @ _ONES) * can
        usable = total > np.maximum((total @ _PROFILE_ONES) * part, _TINY)[:, None]
        # A neighbour seen through the window has this share, at this place, with this
        # spread; the one outside lies at the same distance on the other flank.
        wide2 = w2 + blur2
        lost = np.exp(np.float32(-0.5) * depth2 / wide2)
        place = np.sqrt(depth2) * w2 / wide2
        share = np.minimum(both * lost[:, None], np.float32(0.9))
        total = np.where(usable, total / (_ONE - share), _ONE)
        relative *= mass
        first = relative @ _ONES + total * side * (lost * place)[:, None]
        mass *= squared
        second = mass @ _ONES + total * share * (place * place + w2 * blur2 / wide2)[:, None]
        moment = (second * usable) @ _PROFILE_ONES
        moment /= np.maximum((total * usable) @ _PROFILE_ONES, _TINY)
        moment = np.minimum(np.maximum(moment, np.float32(0.01)), np.float32(0.8) * w2)
        blur2 = moment * w2 / (w2 - moment)
        # The window pulls the centroid towards its own middle: undo that.
        centroid = first / total * (_ONE + blur2 / w2)[:, None]
        edge = line + np.minimum(np.maximum(centroid, -limit), limit)
        centre, weight = robust_line(edge, usable, 0.05, 2 if narrow == 2 else 1)
        moved_px, line = float(np.abs(centre - line).max()), centre
        if moved_px < _SETTLED_PX:
            break
    return edge.astype(np.float64), weight.astype(np.float64), np.sqrt(blur2).astype(np.float64)


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
