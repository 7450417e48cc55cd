"""A board in a picture: found, its corners refined, or the reason why not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.camera import Grey
from perchctl.geometry import Array
from perchctl.target import Board
from perchctl.vision import split_fields

MIN_CORNERS = 6
"""Fewer give a pose, but nothing about the lens."""
SEARCH_PX = 1600
"""Larger pictures are scaled down to it for the search; corners are fitted at full size."""
_MOST_MOTION_PX = 12.0
"""Between two fields, for which the mean of both is a picture of the board too."""
_CHESS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_SECTORS = cv2.CALIB_CB_NORMALIZE_IMAGE  # exhaustive would take a second where there is none


@dataclass(frozen=True, eq=False)
class BoardView:
    """One picture of the board.

    Attributes:
        name: of the file, or the frame's number.
        size_px: the picture's width and height.
        ids: number of each corner on the board, (n,).
        object_m: the corners on the board, z = 0, (n, 3).
        corners_px: in the picture, pixel (0, 0) is the centre of the top-left one, (n, 2).
        blur_px: median spread of the edges at the corners (tanh width).
    """

    name: str
    size_px: tuple[int, int]
    ids: NDArray[np.intp]
    object_m: Array
    corners_px: Array
    blur_px: float = 0.0

    def __len__(self) -> int:
        return len(self.ids)

    def keep(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> BoardView:
        """Return the same view with some of its corners."""
        return replace(
            self,
            ids=self.ids[which],
            object_m=self.object_m[which],
            corners_px=self.corners_px[which],
        )


@dataclass(frozen=True)
class Rejection:
    """A view, or corners of a view, left out, and why."""

    view: str
    reason: str
    corners: tuple[int, ...] = ()  # empty: the whole view


def find_board(image: Grey, board: Board, name: str = "") -> BoardView | str:
    """Return the view of a board in a grey picture (h, w), or why there is none.

    Of an interlaced picture, whose fields show a moving board in two places, the view is the
    mean of both fields' corners: where the board was half way between them.
    """
    fields = [_find_in_field(field, board, name) for field in split_fields(image)]
    return _mean_of_fields(*fields) if len(fields) == 2 else fields[0]


def _mean_of_fields(a: BoardView | str, b: BoardView | str) -> BoardView | str:
    """Return the mean of the corners that both fields show, or the better field alone."""
    if isinstance(a, str) or isinstance(b, str):
        return b if isinstance(a, str) else a
    motion_px = np.linalg.norm(a.corners_px.mean(axis=0) - b.corners_px.mean(axis=0))
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    if motion_px > _MOST_MOTION_PX or len(in_a) < MIN_CORNERS:
        return a if len(a) >= len(b) else b
    middle = (a.corners_px[in_a] + b.corners_px[in_b]) / 2.0
    return replace(a.keep(in_a), corners_px=middle)


def _find_in_field(image: Grey, board: Board, name: str) -> BoardView | str:
    """Return the board's view in a picture of one moment, or why there is none."""
    h, w = image.shape
    scale = min(1.0, SEARCH_PX / max(h, w))
    small = image
    if scale < 1.0:
        small = np.asarray(
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
    found = _FINDERS[board.kind](small, board)
    if isinstance(found, str):
        return found
    ids, corners = found
    # cv2.resize keeps the outer rims of the outer pixels, half a pixel before (0, 0).
    corners = (corners + 0.5) / scale - 0.5
    along, down = _local_axes(_cells(board, ids), corners)
    # A ChArUco board's markers begin so far inside of its white squares.
    white = 1.0 if board.marker_m is None else 0.5 * (1.0 - board.marker_m / board.square_m)
    fit = fit_saddles(image, corners, along, down, white)
    if fit.ok.sum() < MIN_CORNERS:
        return f"only {int(fit.ok.sum())} corners are sharp enough to be measured"
    blur_px = float(np.median(fit.width_px[fit.ok]))
    object_m = board.corners_m()[ids]
    return BoardView(name, (w, h), ids, object_m, fit.corners_px, blur_px).keep(fit.ok)


def _charuco(image: Grey, board: Board) -> tuple[NDArray[np.intp], Array] | str:
    # A detector of its own for each call: pictures are searched on several threads.
    detector = cv2.aruco.CharucoDetector(board.cv2_board())
    finding = detector.getDetectorParameters()
    finding.minMarkerPerimeterRate = 0.01
    finding.minDistanceToBorder = 0
    detector.setDetectorParameters(finding)
    # Markers missed at first are looked for where the board has them: far more corners.
    completing = detector.getCharucoParameters()
    completing.tryRefineMarkers = True
    detector.setCharucoParameters(completing)
    corners, ids, _, marker_ids = detector.detectBoard(image)
    seen = 0 if marker_ids is None else len(marker_ids)
    if ids is None or len(ids) < MIN_CORNERS:
        found = 0 if ids is None else len(ids)
        if seen == 0:
            return "no board found"
        return f"{seen} markers but only {found} corners of the board found"
    numbers = np.array(ids, dtype=np.intp).ravel()
    if np.linalg.matrix_rank(np.column_stack([_cells(board, numbers), np.ones(len(ids))])) < 3:
        return "the corners seen lie on one line"
    return numbers, np.asarray(corners, dtype=np.float64).reshape(-1, 2)


def _chessboard(image: Grey, board: Board) -> tuple[NDArray[np.intp], Array] | str:
    size = board.corner_count
    found, corners = cv2.findChessboardCorners(image, size, flags=_CHESS)
    if not found:
        found, corners = cv2.findChessboardCornersSB(image, size, flags=_SECTORS)
    if not found:
        return "no board found"
    return np.arange(size[0] * size[1]), np.asarray(corners, np.float64).reshape(-1, 2)


_FINDERS: dict[str, Callable[[Grey, Board], tuple[NDArray[np.intp], Array] | str]] = {
    "chessboard": _chessboard,
    "charuco": _charuco,
}


def _cells(board: Board, ids: NDArray[np.intp]) -> Array:
    """Return the places of inner corners in squares, (n, 2)."""
    return np.asarray(board.corners_m()[ids, :2] / board.square_m)


def _local_axes(cells: Array, corners: Array) -> tuple[Array, Array]:
    """Return a square's two sides at each corner as the picture shows them, (n, 2) px each: the
    derivative of the homography from board to picture, which smooths over single bad corners."""
    H, _ = cv2.findHomography(cells, corners, cv2.RANSAC, 5.0)
    if H is None:
        H, _ = cv2.findHomography(cells, corners)
    homogeneous = np.column_stack([cells, np.ones(len(cells))]) @ H.T
    at, w = homogeneous[:, :2] / homogeneous[:, 2:], homogeneous[:, 2:]
    along = (H[:2, 0] - at * H[2, 0]) / w
    down = (H[:2, 1] - at * H[2, 1]) / w
    return along, down


# --- The corner where four squares meet, by fitting the picture around it ----------------------
# `cv2.cornerSubPix` with a fixed window takes in the neighbouring corners of small squares
# and wastes most of large ones. Here the window follows the square's own size and slant,
# and the grey levels in it are fitted by what a lens makes of two crossing edges:
#
#     I = a + gx x + gy y + (c + hx x + hy y) tanh(d1 / w1) tanh(d2 / w2)
#
# with d1, d2 the distances from two lines through the corner and w1, w2 the edges' spread,
# one for each line since motion blurs them unequally. Light that falls off over the corner
# scales the contrast too (h); without that term it pulls corners by 0.01 px. Any blur or
# shift of edges (bloom) that is the same on both sides of the corner leaves the fitted place
# where it is.
# All corners of a picture run through the same arrays (Levenberg-Marquardt).


REACH = 0.42
"""Half of the window, in squares; the next corner's edges begin at 1."""
MIN_REACH_PX, MAX_REACH_PX = 2.0, 14.0
GRID = 21  # samples across the largest window
_ITERATIONS = 25
_STILL_PX = 5e-4
_LONGEST: Array = np.array([0.5, 0.5, 0.2, 0.2, 1.0, 1.0])  # step: px, rad, logarithms
_MIN_SLOPE_PX = 5.0
_MIN_WIDTH_PX, _MAX_WIDTH_SHARE = 0.25, 1.2


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """Refined corners: corners_px (n, 2); ok (n,), true where the fit holds; width_px (n,), the
    wider edge's spread."""

    corners_px: Array
    ok: NDArray[np.bool_]
    width_px: Array


def fit_saddles(
    image: NDArray[np.uint8],
    corners_px: Array,
    along_px: Array,
    down_px: Array,
    white: float = 1.0,
) -> RefinedCorners:
    """Return the corners refined to hundredths of a pixel.

    Args:
        image: grey picture (h, w).
        corners_px: first guess, good to a fifth of a square, (n, 2).
        along_px, down_px: the vectors from a corner to its neighbours on the board, as
            the picture shows them, (n, 2) each.
        white: how far the white squares are empty at their rims, in squares.
    """
    start = np.asarray(corners_px, dtype=np.float64)
    axes = np.stack([along_px, down_px], axis=2)  # (n, 2, 2): board units -> px
    size_px = _thickness_px(axes)
    reach = np.clip(
        REACH,
        MIN_REACH_PX / np.maximum(size_px, 1e-6),
        MAX_REACH_PX / np.maximum(size_px, 1e-6),
    )
    uv, offsets = _window(axes, reach)
    grey, inside = _sample(image, start, offsets)
    weight = inside * _unprinted(uv, _white_quadrants(grey, uv), white, size_px)
    return _fit(start, axes, offsets, grey, weight, size_px, reach)


def _thickness_px(axes: Array) -> Array:
    """Return the narrower height of the parallelogram that a square makes, (n,)."""
    area = np.abs(axes[:, 0, 0] * axes[:, 1, 1] - axes[:, 0, 1] * axes[:, 1, 0])
    longer = np.linalg.norm(axes, axis=1).max(axis=1)
    return np.asarray(area / np.maximum(longer, 1e-9))


def _window(axes: Array, reach: Array) -> tuple[Array, Array]:
    """Return the sample places in board units (n, m, 2) and in px from the corner (n, m, 2)."""
    t = np.linspace(-1.0, 1.0, GRID)
    u, v = np.meshgrid(t, t)
    uv = np.stack([u.ravel(), v.ravel()], axis=1)[None] * reach[:, None, None]
    return uv, np.einsum("nij,nmj->nmi", axes, uv)


def _sample(
    image: NDArray[np.uint8], centre: Array, offsets: Array
) -> tuple[Array, NDArray[np.bool_]]:
    places = centre[:, None] + offsets
    h, w = image.shape
    inside = np.asarray(((places >= 0) & (places <= (w - 1, h - 1))).all(axis=2))
    xy = places.astype(np.float32)
    grey = cv2.remap(image.astype(np.float32), xy[..., 0], xy[..., 1], cv2.INTER_LINEAR)
    return np.asarray(grey, dtype=np.float64), inside


def _white_quadrants(grey: Array, uv: Array) -> NDArray[np.bool_]:
    """Return true for corners at which u v > 0 is white, (n,)."""
    product = np.sign(uv[..., 0] * uv[..., 1])
    # Near the corner only: there even a ChArUco board's white is empty.
    near = np.abs(uv).max(axis=2) < 0.5 * np.abs(uv).max(axis=(1, 2))[:, None]
    return np.asarray((grey * product * near).sum(axis=1) > 0)


def _unprinted(uv: Array, positive: NDArray[np.bool_], white: float, size_px: Array) -> Array:
    """Return 0 inside of what is printed in the white squares (those with u v > 0 where
    `positive`), and within its blur, else 1, (n, m)."""
    if white >= REACH:
        return np.ones(uv.shape[:2])
    those = (uv[..., 0] * uv[..., 1] > 0) == positive[:, None]
    clear = np.maximum(white - 1.0 / np.maximum(size_px, 1e-6), 0.5 * white)
    return np.asarray(~(those & (np.abs(uv).min(axis=2) > clear[:, None])), dtype=np.float64)


def _fit(
    start: Array,
    axes: Array,
    offsets: Array,
    grey: Array,
    weight: Array,
    size_px: Array,
    reach: Array,
) -> RefinedCorners:
    n = len(start)
    span_px = reach * size_px
    # Lines: along u (normal to it: 1) and along v. State: x, y, angle 1, 2, ln w1, ln w2.
    state = np.zeros((n, 6))
    state[:, 2] = np.arctan2(axes[:, 0, 0], -axes[:, 1, 0])
    state[:, 3] = np.arctan2(axes[:, 0, 1], -axes[:, 1, 1])
    state[:, 4:] = np.log(np.clip(0.12 * size_px, 0.5, 1.5))[:, None]
    damping = np.full(n, 1e-3)
    linear, residual, J = _model(state, offsets, grey, weight)
    cost = (residual**2).sum(axis=1)
    top = np.log(np.maximum(_MAX_WIDTH_SHARE * span_px, 2 * _MIN_WIDTH_PX))
    on = np.arange(n)  # those that still move
    for _ in range(_ITERATIONS):
        step = _step(J[on], residual[on], damping[on])
        trial = state[on] + step
        trial[:, 4:] = np.clip(trial[:, 4:], np.log(_MIN_WIDTH_PX), top[on, None])
        linear_t, residual_t, J_t = _model(trial, offsets[on], grey[on], weight[on])
        cost_t = (residual_t**2).sum(axis=1)
        better = cost_t < cost[on]
        now = on[better]
        gained = cost[now] - cost_t[better]
        state[now], linear[now] = trial[better], linear_t[better]
        residual[now], J[now], cost[now] = residual_t[better], J_t[better], cost_t[better]
        damping[on] = np.where(better, damping[on] / 5.0, damping[on] * 5.0).clip(1e-7, 1e3)
        settled = np.abs(step[:, :2]).max(axis=1) < _STILL_PX
        settled[better] &= gained < 1e-3 * cost[now] + 1e-9
        on = on[~settled]
        if len(on) == 0:
            break
    return _checked_corners(start, state, linear, cost, J, weight, span_px)


def _step(J: Array, residual: Array, damping: Array) -> Array:
    """Return the damped step of each corner, of bounded length, (n, 6)."""
    A = J.transpose(0, 2, 1) @ J
    b = (J.transpose(0, 2, 1) @ residual[..., None])[..., 0]
    scale = np.einsum("nii->ni", A)
    A[:, range(6), range(6)] += damping[:, None] * scale + 1e-9
    step = np.nan_to_num(np.linalg.solve(A, b[..., None])[..., 0])
    return np.asarray(np.clip(step, -_LONGEST, _LONGEST))


def _model(state: Array, offsets: Array, grey: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Return the best a, gx, gy, c, hx, hy for the state (n, 6), the weighted residuals (n, m),
    and the derivative of the modelled grey (n, m, 6), freed of what those can take up."""
    x = offsets[..., 0] - state[:, 0, None]
    y = offsets[..., 1] - state[:, 1, None]
    parts = []
    for k in (0, 1):
        c, s = np.cos(state[:, 2 + k, None]), np.sin(state[:, 2 + k, None])
        w = np.exp(state[:, 4 + k, None])
        d = c * x + s * y
        t = np.tanh(d / w)
        parts.append((c, s, w, d, t, 1.0 - t * t, -s * x + c * y))
    (c1, s1, w1, d1, t1, g1, e1), (c2, s2, w2, d2, t2, g2, e2) = parts
    u, v, cross = offsets[..., 0], offsets[..., 1], t1 * t2
    # In a window of few pixels the contrast's slope cannot be distinguished from a shift.
    slope = cross * (np.abs(offsets).max(axis=(1, 2)) > _MIN_SLOPE_PX)[:, None]
    base = np.stack([np.ones_like(x), u, v, cross, u * slope, v * slope], axis=2)
    base *= weight[..., None]
    turned = base.transpose(0, 2, 1)
    normal = turned @ base
    normal[:, range(6), range(6)] += 1e-9
    inverse = np.linalg.inv(normal)
    wanted = weight * grey
    linear = (inverse @ (turned @ wanted[..., None]))[..., 0]
    residual = wanted - (base @ linear[..., None])[..., 0]
    q1, q2 = g1 * t2 / w1, g2 * t1 / w2
    gain = linear[:, 3, None] + linear[:, 4, None] * u + linear[:, 5, None] * v
    contrast = (gain * weight)[..., None]
    J = contrast * np.stack(
        [-(c1 * q1 + c2 * q2), -(s1 * q1 + s2 * q2), e1 * q1, e2 * q2, -d1 * q1, -d2 * q2], axis=2
    )
    J -= base @ (inverse @ (turned @ J))
    return linear, residual, J


def _checked_corners(
    start: Array,
    state: Array,
    linear: Array,
    cost: Array,
    J: Array,
    weight: Array,
    span_px: Array,
) -> RefinedCorners:
    samples = weight.sum(axis=1)
    noise2 = cost / np.maximum(samples - 12.0, 1.0)
    # Samples lie closer than pixels do: neighbours share their noise.
    pixels = np.minimum(1.0, (2.0 * span_px / GRID) ** 2)
    A = (J.transpose(0, 2, 1) @ J) * pixels[:, None, None]
    A[:, range(6), range(6)] += 1e-9
    covariance = np.linalg.inv(A) * noise2[:, None, None]
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0] + covariance[:, 1, 1], 0.0) / 2.0)
    contrast = np.abs(linear[:, 3])
    shift = np.linalg.norm(state[:, :2], axis=1)
    crossing = np.abs(np.sin(state[:, 2] - state[:, 3]))
    ok = (
        np.isfinite(state).all(axis=1)
        & (samples > 0.4 * GRID * GRID * 0.5)
        & (contrast > 4.0)
        & (np.sqrt(noise2) < 0.45 * contrast)
        & (shift < np.maximum(1.5, 0.6 * span_px))
        & (crossing > 0.1)
        & (sigma < 0.5)
    )
    corners = np.where(ok[:, None], start + state[:, :2], start)
    return RefinedCorners(corners, ok, np.exp(state[:, 4:]).max(axis=1))
