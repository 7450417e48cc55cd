"""Corners to a hundredth of a pixel: lines fitted to a marker's sides, intersected.

A corner found by its own neighbourhood is pulled inwards (0.15 to 0.55 px), which
makes the target look far. A side is hundreds of gradient samples instead of one
point, and a blur that is equal on both of its flanks does not move it:

1. sample grey profiles across each side, along its image through the lens, so
   that distortion does not bend the side away from the samples;
2. place the edge in each profile by the gradient's windowed centroid, and repeat
   with the window centred on the side's own line (narrow, hence calm in noise);
3. undistort those points, fit each side's line by total least squares in
   normalised coordinates, and intersect neighbours.

All sides of all markers run through the same arrays. Where a residual says that
the sides are not lines (blur, occlusion, false candidates), `cv2.cornerSubPix`
takes over, then the raw corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort, undistort
from perchctl.vision.types import CameraModel

RAW_SIGMA_PX = 0.6
SUBPIX_SIGMA_PX = 0.25
MIN_LINE_SIGMA_PX = 0.015

_NEXT, _BEFORE = [1, 2, 3, 0], [3, 0, 1, 2]
_PROFILES = 32  # across each side
_ALONG: Array = np.linspace(-1.0, 1.0, _PROFILES)  # a side, between its margins
_POWERS: Array = _ALONG[:, None] ** np.arange(3)
_STEPS = 16  # gradient samples in each profile
_MIN_CELL_PX = 1.0  # smaller cells blend into one grey
_MAX_RESIDUAL_PX = 0.6
_MIN_INLIERS = 0.5
_MIN_CONTRAST = 6.0  # grey levels between the flanks


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """corners_px (4, 2), their spread, and whether lines were fitted."""

    corners_px: Array
    sigma_px: float
    refined: bool


def refine(
    image: NDArray[np.uint8],
    corners_px: Array,
    rims: Sequence[Array],
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
        results = _line_refine(image, corners_px, rims, camera)
    return [
        result if result is not None else _fallback(image, raw, rim.shape[1], method)
        for result, raw, rim in zip(results, corners_px, rims, strict=True)
    ]


def rim_of_bits(bits: NDArray[np.uint8]) -> Array:
    """The white cells next to the border, side by side in the order of the corners:
    (4, n + 2) for bits (n, n), the cells at both ends being the border's own.

    At small sizes their blur reaches the border's outer edge and would push it out.
    """
    sides = (bits[0], bits[:, -1], bits[-1, ::-1], bits[::-1, 0])
    return np.pad(np.asarray(sides, dtype=np.float64), ((0, 0), (1, 1)))


def side_lengths_px(corners_px: Array) -> Array:
    """Lengths of the four sides, (..., 4)."""
    d = corners_px[..., _NEXT, :] - corners_px
    return np.asarray(np.hypot(d[..., 0], d[..., 1]), dtype=np.float64)


def _fallback(image: NDArray[np.uint8], raw_px: Array, cells: float, method: str) -> RefinedCorners:
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


def _line_refine(
    image: NDArray[np.uint8], raw_px: Array, rims: Sequence[Array], camera: CameraModel
) -> list[RefinedCorners | None]:
    m = len(raw_px)
    focal_px = 0.5 * (camera.K[0, 0] + camera.K[1, 1])
    sides_px = side_lengths_px(raw_px)  # (m, 4)
    cells = np.array([rim.shape[1] for rim in rims], dtype=np.float64)
    cell_px = sides_px.mean(axis=1) / cells
    # The inner row lies one cell further in, along the neighbouring sides.
    depth_px = (0.5 * (sides_px[:, _BEFORE] + sides_px[:, _NEXT]) / cells[:, None]).ravel()
    origin, normal, along = _profile_lines(raw_px, sides_px, camera)
    inner = np.concatenate(
        [
            np.take_along_axis(rim, (s * rim.shape[1]).astype(np.intp), axis=1)
            for rim, s in zip(rims, along, strict=True)
        ]
    )  # (4m, n): white inside of the border at each profile
    half_px = np.repeat(np.clip(1.5 * cell_px, 1.75, 7.0), 4)  # (4m,)
    near_px = np.repeat(np.clip(0.85 * cell_px, 1.5, 7.0), 4)
    step_px = 2.0 * half_px / _STEPS
    offsets = np.linspace(-1.0, 1.0, _STEPS + 1) * half_px[:, None]  # (4m, steps + 1)
    grey = _sample(image, origin, normal, offsets)
    gradient = np.diff(grey, axis=2)  # dark inside: positive
    gradient /= step_px[:, None, None].astype(np.float32)
    u = 0.5 * (offsets[:, 1:] + offsets[:, :-1])  # (4m, steps)
    edge, weight, blur_px = _edges(gradient, u, near_px, inner, depth_px)
    points = origin + edge[:, :, None] * normal

    lines, residual = _fit_lines(undistort(points.reshape(-1, 2), camera), weight)
    residual_px = residual * focal_px
    corners = distort(_intersect(lines.reshape(m, 4, 3)).reshape(-1, 2), camera).reshape(m, 4, 2)

    inliers = (weight > 0).mean(axis=1)
    contrast = np.median(grey.max(axis=2) - grey.min(axis=2), axis=1)
    good = (
        (residual_px < _MAX_RESIDUAL_PX)
        & (inliers >= _MIN_INLIERS)
        & (contrast > _MIN_CONTRAST)
        & (blur_px < 0.9 * near_px)
    ).reshape(m, 4)
    shift = np.linalg.norm(corners - raw_px, axis=2).max(axis=1)
    allowed_px = np.maximum(1.6, 0.6 * cell_px)
    accepted = (
        good.all(axis=1)
        & np.isfinite(corners).all(axis=(1, 2))
        & (shift < allowed_px)
        & (cell_px > _MIN_CELL_PX)
    )
    # The end of a line fitted to n samples spreads twice as far as its middle.
    samples = np.minimum(weight.sum(axis=1), sides_px.ravel()).clip(4.0)
    sigma = np.sqrt(((residual_px * 2.0) ** 2 / samples).reshape(m, 4).mean(axis=1))
    # Cells of few pixels let the inner pattern's blur reach the border's edge.
    sigma = np.hypot(np.maximum(sigma, MIN_LINE_SIGMA_PX), 0.3 * np.exp(-cell_px / 1.2))
    return [
        RefinedCorners(corners[i], float(sigma[i]), True) if accepted[i] else None for i in range(m)
    ]


def _profile_lines(
    raw_px: Array, sides_px: Array, camera: CameraModel
) -> tuple[Array, Array, Array]:
    """Where the profiles cross the sides, and the outward unit normals there: the
    straight line between undistorted corners, seen through the lens; (4m, n, 2). And
    how far along its side each profile is, 0..1, (m, 4, n)."""
    m = len(raw_px)
    corners = undistort(raw_px.reshape(-1, 2), camera).reshape(m, 4, 2)
    margin = np.clip(2.5 / sides_px, 0.04, 0.25)[:, :, None]  # the other side's blur
    s = margin + (1.0 - 2.0 * margin) * 0.5 * (1.0 + _ALONG)  # (m, 4, n)
    ends = corners[:, _NEXT]
    along = corners[:, :, None] + s[..., None] * (ends - corners)[:, :, None]
    origin = distort(along.reshape(-1, 2), camera).reshape(m, 4, _PROFILES, 2)
    tangent = np.empty_like(origin)
    tangent[:, :, 1:-1] = origin[:, :, 2:] - origin[:, :, :-2]
    tangent[:, :, 0] = origin[:, :, 1] - origin[:, :, 0]
    tangent[:, :, -1] = origin[:, :, -1] - origin[:, :, -2]
    dx, dy = tangent[..., 0], tangent[..., 1]
    length = np.maximum(np.hypot(dx, dy), 1e-12)
    normal = np.stack([dy / length, -dx / length], axis=-1)
    half = _PROFILES // 2
    outward = (normal[:, :, half] * (origin[:, :, half] - raw_px.mean(axis=1)[:, None])).sum(axis=2)
    normal *= np.where(outward < 0.0, -1.0, 1.0)[..., None, None]
    return origin.reshape(4 * m, _PROFILES, 2), normal.reshape(4 * m, _PROFILES, 2), s


def _sample(
    image: NDArray[np.uint8], origin: Array, normal: Array, offsets: Array
) -> NDArray[np.float32]:
    """Grey values at origin + offset * normal, (4m, n, steps + 1): bilinear, the rim
    repeated outside.

    On float pictures OpenCV 5 interpolates at the exact position; on bytes, other
    releases round it to 1/32 px, which is as large as the spread that is aimed at.
    """
    h, w = image.shape
    reach = float(offsets[:, -1].max()) + 2.0
    flat = np.nan_to_num(origin.reshape(-1, 2))
    left, top = np.clip(flat.min(axis=0) - reach, 0, (w - 2, h - 2)).astype(int)
    right, bottom = np.clip(flat.max(axis=0) + reach + 1, (left + 2, top + 2), (w, h)).astype(int)
    patch = image[top:bottom, left:right].astype(np.float32)
    shape = (len(origin), -1)
    x, y = (
        ((origin[:, :, k] - (left, top)[k])[:, :, None] + offsets[:, None] * normal[:, :, k, None])
        .astype(np.float32)
        .reshape(shape)
        for k in (0, 1)
    )
    grey = cv2.remap(patch, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, dtype=np.float32).reshape(*origin.shape[:2], -1)


def _edges(
    gradient: NDArray[np.float32], u: Array, near_px: Array, inner: Array, depth_px: Array
) -> tuple[Array, Array, Array]:
    """The edge's place in each profile, (4m, n) px along the normal; the profiles'
    weights (0 for outliers); and each side's blur as a standard deviation, (4m,)."""
    u32 = u.astype(np.float32)  # sums of some dozen grey values lose nothing by it
    mass = np.maximum(gradient, np.float32(0.0))
    mass *= np.exp(-0.5 * (u / (0.6 * near_px[:, None])) ** 2)[:, None, :].astype(np.float32)
    total = np.einsum("sni->sn", mass).astype(np.float64)
    usable = total > 0.25 * _median(total, None)[:, None]
    edge = np.einsum("sni,si->sn", mass, u32) / np.where(usable, total, 1.0)
    line, weight = _robust_line(edge, usable, 0.3, 2)
    blur = np.ones(len(gradient))
    limit, moved_px = near_px[:, None], np.inf
    for narrow in range(3):
        if narrow == 1 and moved_px < 0.2:
            continue  # the wide window was as good as centred
        relative = u32[:, None, :] - line[:, :, None].astype(np.float32)
        # The second moment under a Gaussian window w gives 1/m2 = 1/blur^2 + 1/w^2.
        w2 = np.minimum(np.maximum(1.5 * blur, 0.9), 0.5 * near_px) ** 2
        squared = relative * relative
        mass = gradient * np.exp(squared * (-0.5 / w2)[:, None, None].astype(np.float32))
        total = np.einsum("sni->sn", mass).astype(np.float64)
        floor = 0.2 * _median(total, None)
        usable = total > np.maximum(floor, 1e-9)[:, None]
        # A white inner cell adds a falling edge of the same height, one cell further in;
        # seen through the window it has this share, at this place, with this spread.
        wide2 = w2 + blur**2
        share = inner * np.exp(-0.5 * depth_px**2 / wide2)[:, None]
        place = -depth_px * w2 / wide2
        total = np.where(usable, total / (1.0 - share), 1.0)
        first = np.einsum("sni,sni->sn", mass, relative) + total * share * place[:, None]
        second = np.einsum("sni,sni->sn", mass, squared)
        second += total * share * (place**2 + w2 * blur**2 / wide2)[:, None]
        centroid = first / total
        mean_of = usable / np.maximum(np.einsum("sn,sn->s", total, usable), 1e-9)[:, None]
        moment = np.einsum("sn,sn->s", second, mean_of)
        moment = np.minimum(np.maximum(moment, 0.01), 0.8 * w2)
        blur = np.sqrt(1.0 / (1.0 / moment - 1.0 / w2))
        # The window pulls the centroid towards its own middle: undo that.
        centroid *= (1.0 + blur**2 / w2)[:, None]
        edge = line + np.minimum(np.maximum(centroid, -limit), limit)
        centre, weight = _robust_line(edge, usable, 0.05, 2 if narrow == 2 else 1)
        moved_px, line = float(np.abs(centre - line).max()), centre
    return edge, weight, blur


def _robust_line(
    edge: Array, usable: NDArray[np.bool_], floor_px: float, rounds: int
) -> tuple[Array, Array]:
    """Straight lines edge(s) a side with Tukey's weights; returns (line, weight)."""
    error = edge - _median(edge, usable)[:, None]
    line = edge
    for _ in range(rounds):
        size = np.abs(error)
        scale = np.maximum(1.4826 * _median(size, usable), floor_px)
        weight = usable * np.maximum(1.0 - (size / (3.5 * scale[:, None])) ** 2, 0.0) ** 2
        w0, w1, w2 = (weight @ _POWERS).T
        e0, e1 = (weight * edge @ _POWERS[:, :2]).T
        w0 = np.maximum(w0, 1e-9)
        slope = (e1 - e0 * w1 / w0) / np.maximum(w2 - w1 * w1 / w0, 1e-9)
        line = ((e0 - slope * w1) / w0)[:, None] + slope[:, None] * _ALONG
        error = edge - line
    return line, np.asarray(weight, dtype=np.float64)


def _median(values: Array, usable: NDArray[np.bool_] | None) -> Array:
    """Lower median of each row's usable values, (rows,); 0 where there are none."""
    n = values.shape[1]
    if usable is None or usable.all():
        return np.partition(values, (n - 1) // 2, axis=1)[:, (n - 1) // 2]
    count = usable.sum(axis=1)
    ordered = np.sort(np.where(usable, values, np.inf), axis=1)
    middle = ordered[np.arange(len(ordered)), np.maximum(count - 1, 0) // 2]
    return np.where(np.isfinite(middle), middle, 0.0)


def _fit_lines(points: Array, weight: Array) -> tuple[Array, Array]:
    """Total least squares a side: lines (4m, 3) as (nx, ny, c) with n.x = c and |n| = 1,
    and the weighted RMS distance (4m,), both in normalised coordinates."""
    points = np.nan_to_num(points.reshape(*weight.shape, 2))
    w = weight / weight.sum(axis=1, keepdims=True).clip(1e-9)
    centre = (w[:, :, None] * points).sum(axis=1)
    d = points - centre[:, None]
    sxx = (w * d[..., 0] ** 2).sum(axis=1)
    syy = (w * d[..., 1] ** 2).sum(axis=1)
    sxy = (w * d[..., 0] * d[..., 1]).sum(axis=1)
    direction = 0.5 * np.arctan2(2.0 * sxy, sxx - syy)
    nx, ny = -np.sin(direction), np.cos(direction)
    residual2 = nx * nx * sxx + 2.0 * nx * ny * sxy + ny * ny * syy
    lines = np.stack([nx, ny, nx * centre[:, 0] + ny * centre[:, 1]], axis=1)
    return lines, np.sqrt(np.maximum(residual2, 0.0))


def _intersect(lines: Array) -> Array:
    """Corner i of each marker, where side i - 1 meets side i: (m, 4, 2)."""
    a, b = lines[:, _BEFORE], lines
    det = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    det = np.where(np.abs(det) < 1e-9, np.nan, det)
    x = (a[..., 2] * b[..., 1] - a[..., 1] * b[..., 2]) / det
    y = (a[..., 0] * b[..., 2] - a[..., 2] * b[..., 0]) / det
    return np.stack([x, y], axis=-1)
