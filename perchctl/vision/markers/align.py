"""A marker's drawing laid over the picture: for what edges and bits no longer tell.

Where blur has run the cells together, or cells are a few pixels wide, the picture of
the whole marker still is its drawing, blurred and lit. Gauss-Newton finds the
homography together with the light (offset, gain, its slope over the marker), the blur,
and the bend of the tone curve (clipped white, gamma): all of them shift edges if left
out. What does not look like the drawing then, cell by cell, is not the marker.

Coordinates: the marker's own, its corners at (-1, -1), (1, -1), (1, 1), (-1, 1) in the
order of `Detection.corners_px`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort, undistort_px
from perchctl.vision.markers.drawing import (
    Drawing,
    Rendering,
    beyond_sheet,
    blurred,
    drawn,
    gram,
    mixed,
    pattern_seen,
)
from perchctl.vision.types import CameraModel

_MAX_GRID, _MIN_GRID = 44, 18
_GRID_PX = 0.8  # picture pixels from node to node
_ROUNDS = 12
_STILL_PX = 0.02
_LENS_PX = 0.3  # what the lens does is computed anew after this way
# How far shape may leave its start, as standard deviations, per unit of the marker's
# half side: turns and scales; then the perspective, which a few pixels hardly tell.
_SHAPE_SIGMA, _VIEW_SIGMA = 0.2, 0.03
_BEND_SIGMA = 0.5  # of the tone curve, in units of the gain
_MIN_BLUR_PX, _MAX_BLUR_CELLS = 0.35, 1.6
_BLUR_STEP = 0.03  # a smaller change of blur draws nothing anew
_MIN_GAIN = 10.0  # grey levels from black to white
_MIN_SIDE_PX, _MAX_SIDE_PX = 4.0, 2000.0
_BLUR, _BEND = 8, 15  # columns of the Jacobian: eight of shape, blur, those of light
_CORNERS: Array = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_PRIOR: Array = (
    np.array(
        [_SHAPE_SIGMA, _SHAPE_SIGMA, 1e3, _SHAPE_SIGMA, _SHAPE_SIGMA, 1e3, _VIEW_SIGMA, _VIEW_SIGMA]
    )
    ** -2.0
)  # of the increment's terms; the place is free


@dataclass(frozen=True, eq=False)
class Alignment:
    """corners_px (4, 2) and their spread; `likeness` is the correlation with the
    drawing, `pattern` that of what a black square of the same size would leave over,
    `strength` the height of the pattern's bits over the border's, `worst_cell` the
    largest mean departure of a cell, in units of the gain."""

    corners_px: Array
    sigma_px: float
    likeness: float
    pattern: float
    strength: float
    worst_cell: float
    blur_px: float
    gain: float
    moved_px: float


class _Field:
    """The part of the picture around a marker, read at the nodes of a grid of its own."""

    def __init__(
        self, image: NDArray[np.uint8], H: Array, n: int, reach: float, camera: CameraModel
    ) -> None:
        self.n, self._camera = n, camera
        self.axis = reach * ((2.0 * np.arange(n) + 1.0) / n - 1.0)
        u, v = np.meshgrid(self.axis, self.axis)
        self.u, self.v = u.ravel(), v.ravel()
        h, w = image.shape
        self._low = np.zeros(2, dtype=np.intp)
        self.look_through_lens(H)
        seen = _project(H, self.u, self.v) + self._lens
        self.inside = bool(seen.min() >= -1.0 and (seen <= (w, h)).all())
        room = 0.15 * float(np.ptp(seen, axis=0).max()) + 3.0
        low = np.clip(seen.min(axis=0) - room, 0, (w - 2, h - 2)).astype(np.intp)
        high = np.clip(seen.max(axis=0) + room + 1.0, low + 2, (w, h)).astype(np.intp)
        self._patch = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
        self._low = low
        self._lens -= low

    def look_through_lens(self, H: Array) -> None:
        """Compute how far the lens moves each node that is seen through H."""
        pin = _project(H, self.u, self.v)
        self._lens = distort(_normalised(pin, self._camera), self._camera) - pin - self._low

    def read(self, H: Array) -> Array:
        """Grey values at the nodes, (n * n,)."""
        at = (_project(H, self.u, self.v) + self._lens).astype(np.float32)
        x, y = (np.ascontiguousarray(at[:, k]).reshape(self.n, self.n) for k in (0, 1))
        grey = cv2.remap(self._patch, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(grey, dtype=np.float64).ravel()


def align(
    image: NDArray[np.uint8],
    start_px: Array,
    drawing: Drawing,
    camera: CameraModel,
    blur_px: float = 1.0,
) -> Alignment | None:
    """Lay the drawing over the picture, starting with corners `start_px` (4, 2) and a blur.

    None where the marker leaves the picture, has no contrast, or the fit breaks down.
    """
    start = undistort_px(start_px, camera)
    if not np.isfinite(start).all():
        return None
    sides = np.hypot(*(start - np.roll(start, 1, axis=0)).T)
    side_px, reach = float(sides.mean()), drawing.reach
    if float(sides.min()) < _MIN_SIDE_PX or side_px > _MAX_SIDE_PX:
        return None
    n = int(np.clip(math.ceil(reach * side_px / _GRID_PX), _MIN_GRID, _MAX_GRID))
    node_px = reach * side_px / n
    H = _homography(start)
    field = _Field(image, H, n, reach, camera)
    if not field.inside:
        return None
    sharp = [drawn(drawing, field.axis, reach / n)]
    outside = beyond_sheet(drawing, field.axis, reach / n)
    if outside is not None:
        sharp.append(outside)
    largest_px = _MAX_BLUR_CELLS * side_px / len(drawing.cells)
    blur_px = min(max(blur_px, _MIN_BLUR_PX), largest_px)
    renderings = [blurred(each, blur_px / node_px, field.axis) for each in sharp]
    total, since_lens_px = np.zeros(8), 0.0
    for _ in range(_ROUNDS):
        if since_lens_px > _LENS_PX:
            field.look_through_lens(H)
            since_lens_px = 0.0
        grey = field.read(H)
        light, coefficients = _lit(renderings, grey, field)
        if coefficients[3] < _MIN_GAIN:
            return None
        error = grey - mixed(light, coefficients)
        N, g = _normal(renderings, light, coefficients, error, field)
        N[range(8), range(8)] += _PRIOR
        g[:8] -= _PRIOR * total
        try:
            step = np.linalg.solve(N, g)
        except np.linalg.LinAlgError:
            return None
        p = step[:8]
        if not np.isfinite(p).all() or np.abs(p).max() > 0.5:
            return None
        total += p
        H = H @ np.array([[1 + p[0], p[1], p[2]], [p[3], 1 + p[4], p[5]], [p[6], p[7], 1.0]])
        H /= H[2, 2]
        moved_px = 0.5 * side_px * float(np.abs(p[:6]).max())
        since_lens_px += moved_px
        squared = (blur_px / node_px) ** 2 + float(np.clip(step[_BLUR], -1.0, 1.0))
        wanted_px = math.sqrt(max(squared, 1e-3)) * node_px
        wanted_px = min(max(wanted_px, _MIN_BLUR_PX), largest_px)
        if abs(wanted_px - blur_px) > _BLUR_STEP * blur_px:
            blur_px = wanted_px
            renderings = [blurred(each, blur_px / node_px, field.axis) for each in sharp]
        elif moved_px < _STILL_PX and since_lens_px <= _LENS_PX:
            break
    corners = distort(_normalised(_project(H, *_CORNERS.T), camera), camera)
    # What the last round left over, its step being next to nothing.
    spread = grey - grey.mean()
    explained = 1.0 - float((error**2).sum()) / max(float((spread**2).sum()), 1e-9)
    pattern, strength = pattern_seen(
        drawing, field.axis, blur_px / node_px, error, light, coefficients
    )
    covariance = np.linalg.inv(N)[:8, :8] * _repeated(error.reshape(n, n))
    J = _corner_jacobian(H)
    return Alignment(
        corners_px=corners,
        sigma_px=math.sqrt(max(float(np.trace(J @ covariance @ J.T)) / 8.0, 0.0)),
        likeness=math.sqrt(max(explained, 0.0)),
        pattern=pattern,
        strength=strength,
        worst_cell=_worst_cell(error / coefficients[3], field, len(drawing.cells)),
        blur_px=blur_px,
        gain=float(coefficients[3]),
        moved_px=float(np.abs(corners - start_px).max()),
    )


def _lit(renderings: list[Rendering], grey: Array, field: _Field) -> tuple[Array, Array]:
    """The light that explains the grey values best: columns (n * n, 7 or 8) for offset,
    gain, their slopes, the bend of the tone curve and what is beyond the sheet, and their
    coefficients."""
    u, v, white = field.u, field.v, renderings[0].value
    columns = [np.ones_like(u), u, v, white, white * u, white * v, white * (1.0 - white)]
    columns += [rendering.value for rendering in renderings[1:]]
    light: Array = np.stack(columns, axis=1)
    A = gram(light, light) + 1e-6 * np.eye(len(columns))
    A[6, 6] += 1e-3 * len(u)  # no bend unless it is seen
    return light, np.asarray(np.linalg.solve(A, gram(light, grey)[:, 0]), dtype=np.float64)


def _normal(
    renderings: list[Rendering], light: Array, coefficients: Array, error: Array, field: _Field
) -> tuple[Array, Array]:
    """Normal equations (16 or 17 unknowns) of shape, blur and light, per unit of noise."""
    gain = float(coefficients[3])
    bend = min(max(float(coefficients[6]) / gain, -0.9), 0.9)
    slope = gain + coefficients[4] * field.u + coefficients[5] * field.v
    slope = slope * (1.0 + bend * (1.0 - 2.0 * renderings[0].value))
    change = renderings[0].jacobian * slope[:, None]
    for rendering, height in zip(renderings[1:], coefficients[7:], strict=True):
        change += rendering.jacobian * height
    J = np.concatenate([change, light], axis=1)
    noise = max(float((error**2).mean()), 1.0)
    N, g = gram(J, J) / noise, gram(J, error)[:, 0] / noise
    N[_BLUR, _BLUR] += 1.0  # about a node's width a round
    N[_BEND, _BEND] += (_BEND_SIGMA * gain) ** -2.0
    g[_BEND] -= coefficients[6] * (_BEND_SIGMA * gain) ** -2.0
    N[range(9, len(g)), range(9, len(g))] += 1e-6
    return N, g


def _homography(corners: Array) -> Array:
    H = cv2.getPerspectiveTransform(_CORNERS.astype(np.float32), corners.astype(np.float32))
    return np.asarray(H, dtype=np.float64)


def _project(H: Array, u: Array, v: Array) -> Array:
    d = H[2, 0] * u + H[2, 1] * v + H[2, 2]
    x = (H[0, 0] * u + H[0, 1] * v + H[0, 2]) / d
    y = (H[1, 0] * u + H[1, 1] * v + H[1, 2]) / d
    return np.stack([x, y], axis=1)


def _normalised(pin: Array, camera: CameraModel) -> Array:
    K = camera.K
    y = (pin[:, 1] - K[1, 2]) / K[1, 1]
    x = (pin[:, 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x, y], axis=1)


def _repeated(error: Array) -> float:
    """How many neighbouring nodes tell the same: from the correlation along rows and
    columns of what is left (nodes closer than a pixel; blur that is not round)."""
    energy = max(float((error * error).mean()), 1e-9)
    factor = 1.0
    for a, b in ((error[1:], error[:-1]), (error[:, 1:], error[:, :-1])):
        r = min(max(float((a * b).mean()) / energy, 0.0), 0.9)
        factor *= (1.0 + r) / (1.0 - r)
    return factor


def _worst_cell(error: Array, field: _Field, n_cells: int) -> float:
    """Largest mean departure over a cell's inner part."""
    x, y = ((g + 1.0) * 0.5 * n_cells for g in (field.u, field.v))
    inside = (x >= 0) & (x < n_cells) & (y >= 0) & (y < n_cells)
    index = (y[inside].astype(np.intp)) * n_cells + x[inside].astype(np.intp)
    total = np.bincount(index, weights=error[inside], minlength=n_cells**2)
    count = np.bincount(index, minlength=n_cells**2)
    return float(np.abs(total / np.maximum(count, 1)).max())


def _corner_jacobian(H: Array) -> Array:
    """Change of the four pinhole corners with the increment's terms, (8, 8)."""
    rows = []
    for u, v in _CORNERS:
        d = H[2] @ (u, v, 1.0)
        x, y = H[0] @ (u, v, 1.0) / d, H[1] @ (u, v, 1.0) / d
        A = np.array([(H[0, :2] - x * H[2, :2]) / d, (H[1, :2] - y * H[2, :2]) / d])
        du = np.array([u, v, 1, 0, 0, 0, -u * u, -u * v])
        dv = np.array([0, 0, 0, u, v, 1, -u * v, -v * v])
        rows.append(A @ np.stack([du, dv]))
    return np.concatenate(rows)
