"""Find a board in an image and refine its corners, or explain why there is none."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.camera import Grey
from perchctl.geometry import Array
from perchctl.profile import TargetConfig, aruco_dictionary
from perchctl.target import Board
from perchctl.vision import deinterlace_image

MIN_CORNERS = 6
"""Minimum number of corners in a view. Fewer corners determine a pose, but nothing about the
lens."""
SEARCH_PX = 1600
"""Size to which larger images are scaled down for the search; corners are fitted at full size."""
_HASH_BYTES = 6
"""Length of an image's hash, bytes. With a shorter hash, the probability that two of a thousand
images have the same hash by chance would exceed 1 in 10^8."""
_CHESS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
# no exhaustive search, which takes a second in an image without a board
_SECTORS = cv2.CALIB_CB_NORMALIZE_IMAGE


@dataclass(frozen=True, eq=False)
class BoardView:
    """Detected board corners of one image.

    Attributes:
        name: the file's name, or the frame's number.
        size_px: the image's width and height.
        ids: index of each corner on the board, (n,).
        corners_m: corner positions on the board, z = 0, (n, 3).
        corners_px: corner positions in the image, (n, 2); the top-left pixel's centre is (0, 0).
        blur_px: median spread of the edges at the corners (tanh width).
        legacy: which layout was detected, as in `perchctl.target.Board`.
        picture_hash: equal for images with the same pixels, whatever their files; empty if unknown.
    """

    name: str
    size_px: tuple[int, int]
    ids: NDArray[np.intp]
    corners_m: Array
    corners_px: Array
    blur_px: float = 0.0
    legacy: bool = False
    picture_hash: str = ""

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> BoardView:
        """Return this view with only the corners of `which`: a mask (n,) or indices."""
        return replace(
            self,
            ids=self.ids[which],
            corners_m=self.corners_m[which],
            corners_px=self.corners_px[which],
        )


@dataclass(frozen=True)
class Rejection:
    """The rejected view with the name `view` or, if `corner_ids` is not empty, its rejected
    corners."""

    view: str
    reason: str
    corner_ids: tuple[int, ...] = ()  # empty: the whole view


@dataclass(frozen=True)
class FrameCounts:
    """How many frames from a video or a camera were examined, and why some of them gave no view.

    Attributes:
        live: True for a camera, whose user can be asked to hold still; False for a recording.
        taken: frames that became views.
        without_board: frames that show no board, or too little of it.
        moved: frames in which the board had moved by more than `still_px` since the previous frame,
            or whose previous frame did not show it.
        blurred: frames too blurred for the corners to be found.
        alike: frames similar to a view that was already taken.
        repeated: frames that the source delivered twice.
    """

    live: bool
    still_px: float
    taken: int = 0
    without_board: int = 0
    moved: int = 0
    blurred: int = 0
    alike: int = 0
    repeated: int = 0

    @property
    def with_board(self) -> int:
        """The number of frames that show the board."""
        return self.taken + self.moved + self.blurred + self.alike

    @property
    def text(self) -> str:
        """The counts in words."""
        reasons = (
            (self.taken, "taken"),
            (self.moved, f"moved by more than {self.still_px:.2g} px since the previous frame"),
            (self.blurred, "too blurred"),
            (self.alike, "similar to a view already taken"),
        )
        counted = ", ".join(f"{count} {reason}" for count, reason in reasons if count)
        text = f"{self.with_board} of {self.with_board + self.without_board} frames show the board"
        return text + (f": {counted}" if counted else "")

    @property
    def advice(self) -> str:
        """Advice on how to get more views; empty if showing the board or moving it elsewhere is
        enough."""
        if self.moved + self.blurred <= self.alike:
            return ""
        if self.live:
            return "hold the board still for a moment at each position, in good light"
        return (
            "record again and hold still for a moment at each position, in good light, or "
            "save sharp frames as images (images:)"
        )


@dataclass(frozen=True, eq=False)
class FoundViews:
    """The detected views of a board.

    Attributes:
        without_board: images without a board, each with the reason.
        frames: the counts of frames from a video or camera; None for image files.
        other_board: if there are no views, the board that the images show instead; empty if there
            is none.
    """

    views: tuple[BoardView, ...]
    without_board: tuple[Rejection, ...] = ()
    frames: FrameCounts | None = None
    other_board: str = ""

    def layout_of(self, board: Board) -> Board:
        """The named board, with the layout that was detected."""
        return replace(board, legacy=self.views[0].legacy) if self.views else board


def find_board(image: Grey, board: Board, name: str = "") -> BoardView | str:
    """Return the view of a board in a grey image (h, w), or the reason why no board was found. In
    an interlaced image, the first field is used, since a moving board appears at a different
    position in each field. Both layouts of a ChArUco board are tried, whatever `board` says."""
    picture_hash = hashlib.blake2b(image.tobytes(), digest_size=_HASH_BYTES).hexdigest()
    image = deinterlace_image(image)[0]
    h, w = image.shape
    scale = min(1.0, SEARCH_PX / max(h, w))
    small = image
    if scale < 1.0:
        small = np.asarray(
            cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
    found = _chessboard(small, board) if board.kind == "chessboard" else _charuco(small, board)
    if isinstance(found, str):
        return found
    ids, corners, legacy = found
    # cv2.resize aligns the images' outer edges, half a pixel outside the centre of pixel (0, 0).
    corners = (corners + 0.5) / scale - 0.5
    # Distance of a ChArUco board's markers from the edge of their white squares.
    white = 1.0 if board.marker_m is None else 0.5 * (1.0 - board.marker_m / board.square_m)
    fit = fit_saddles(image, corners, _local_axes(_cells(board, ids), corners), white)
    if fit.is_valid.sum() < MIN_CORNERS:
        return f"only {int(fit.is_valid.sum())} corners are sharp enough to be measured"
    blur_px = float(np.median(fit.edge_width_px[fit.is_valid]))
    object_m = board.corners_m()[ids]
    view = BoardView(name, (w, h), ids, object_m, fit.corners_px, blur_px, legacy, picture_hash)
    return view.select(fit.is_valid)


_Corners = tuple[NDArray[np.intp], Array, bool]
"""Indices (n,) and positions (n, 2), px, of a board's corners, and True if it has the legacy
layout."""


def _charuco(image: Grey, board: Board) -> _Corners | str:
    """Return the corners of a ChArUco board in either layout, or the reason why there are none.

    The two layouts of a board have the same corners, but their markers are in different squares.
    With the wrong layout no corner is found, since neighbouring markers contradict each other.
    """
    numbers, corners, markers = charuco_corners(image, board)
    # The right layout gives more corners than markers, unless little of the board is visible.
    if board.has_two_layouts and len(numbers) < markers:
        other = replace(board, legacy=not board.legacy)
        more, places, _ = charuco_corners(image, other)
        if len(more) > len(numbers):
            numbers, corners, board = more, places, other
    if markers == 0:
        return _without_board(image)
    plane = np.column_stack([_cells(board, numbers), np.ones(len(numbers))])
    if len(numbers) < MIN_CORNERS or np.linalg.matrix_rank(plane) < 3:
        return (
            f"found {markers} markers, but only {len(numbers)} corners of the board, which may be "
            "too small in the image or partly hidden; move it closer"
        )
    return numbers, corners, board.legacy


def charuco_corners(image: Grey, board: Board) -> tuple[NDArray[np.intp], Array, int]:
    """Return the indices (n,) and positions (n, 2), px, of the corners in the board's layout, and
    the number of markers that were found."""
    # Each call has its own detector, because images are searched on several threads.
    detector = cv2.aruco.CharucoDetector(board.cv2_board())
    finding = detector.getDetectorParameters()
    finding.minMarkerPerimeterRate = 0.01
    finding.minDistanceToBorder = 0
    detector.setDetectorParameters(finding)
    # Search for missed markers where the board must have them, which yields far more corners.
    completing = detector.getCharucoParameters()
    completing.tryRefineMarkers = True
    detector.setCharucoParameters(completing)
    corners, ids, _, marker_ids = detector.detectBoard(image)
    numbers = np.array([] if ids is None else ids, dtype=np.intp).ravel()
    places = np.array([] if ids is None else corners, dtype=np.float64).reshape(-1, 2)
    return numbers, places, 0 if marker_ids is None else len(marker_ids)


def _chessboard(image: Grey, board: Board) -> _Corners | str:
    """Like `_charuco`, but for a chessboard."""
    size = board.corner_count
    found, corners = cv2.findChessboardCorners(image, size, flags=_CHESS)
    if not found:
        found, corners = cv2.findChessboardCornersSB(image, size, flags=_SECTORS)
    if not found:
        return _without_board(image)
    return np.arange(size[0] * size[1]), np.asarray(corners, np.float64).reshape(-1, 2), False


def _without_board(image: Grey) -> str:
    """Return why no board was found in an image. The image may show the perching target instead,
    which is an easy mistake to make."""
    marker = TargetConfig().large
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(marker.dictionary))
    _, ids, _ = detector.detectMarkers(image)
    if ids is not None and marker.id in ids:
        return (
            "the image shows the perching target, not a board; print a board with perchctl "
            "make-target board"
        )
    return "no board found"


def _cells(board: Board, ids: NDArray[np.intp]) -> Array:
    """Return the positions of the inner corners, in squares, (n, 2)."""
    return np.asarray(board.corners_m()[ids, :2] / board.square_m)


def _local_axes(cells: Array, corners: Array) -> Array:
    """Return the two sides of a square at each corner, as the columns of (n, 2, 2), px.

    The sides are computed from the derivative of the homography, which smooths out single bad
    corners.
    """
    H, _ = cv2.findHomography(cells, corners, cv2.RANSAC, 5.0)
    if H is None:
        H, _ = cv2.findHomography(cells, corners)
    homogeneous = np.column_stack([cells, np.ones(len(cells))]) @ H.T
    at = homogeneous[:, :2, None] / homogeneous[:, 2:, None]
    w = homogeneous[:, 2:, None]
    return np.asarray((H[:2, :2] - at * H[2, :2]) / w)


# --- The corner where four squares meet, found by fitting the image around it ---
# `cv2.cornerSubPix` has a fixed window, which includes neighbouring corners of small squares and
# the markers of a ChArUco board. `cv2.cornerSubPix` is off by 0.03 to 0.5 px where this fit is off
# by 0.02 px. In this module, the window follows the size and slant of the square, and a model of
# two crossing blurred edges is fitted to its grey levels:
#
#     I = a + gx x + gy y + (c + hx x + hy y) tanh(d1 / w1) tanh(d2 / w2)
#
# with d1, d2 the distances from two lines through the corner and w1, w2 the edges' spread,
# one for each line since motion blurs them unequally. If the light falls off across the corner, the
# contrast changes too (h); without that term, corners are shifted by 0.01 px.


REACH = 0.42
"""Half the width of the window around a corner, in squares; the next corner is at a distance of
1."""
MIN_REACH_PX, MAX_REACH_PX = 2.0, 14.0
WINDOW_SAMPLES = 21  # number of samples across the largest window
_CORNER_ITERATIONS = 6
_LONGEST: Array = np.array([0.5, 0.5, 0.2, 0.2, 0.5, 0.5])  # largest step: px, rad, logarithms
_MIN_SLOPE_PX = 5.0
_MIN_WIDTH_PX, _MAX_WIDTH_SHARE = 0.25, 1.2


@dataclass(frozen=True, eq=False)
class SaddleFit:
    """Refined corners (n, 2); is_valid (n,), False where the fit failed; edge_width_px (n,), blur
    (tanh width) of the wider edge at each corner."""

    corners_px: Array
    is_valid: NDArray[np.bool_]
    edge_width_px: Array


def fit_saddles(
    image: NDArray[np.uint8], corners_px: Array, axes_px: Array, white_rim: float = 1.0
) -> SaddleFit:
    """The corners refined to hundredths of a pixel.

    Args:
        image: grey image (h, w).
        corners_px: initial corner positions, accurate to a fifth of a square, (n, 2).
        axes_px: the vectors in the image from each corner to its two neighbours on the board, as
            the columns of (n, 2, 2).
        white_rim: width of the blank rim of the white squares, in squares (1: no markers inside).
    """
    start = np.asarray(corners_px, dtype=np.float64)
    area = np.abs(np.linalg.det(axes_px))
    # The smaller of the two heights of the parallelogram that a square forms in the image.
    size_px = np.maximum(area / np.linalg.norm(axes_px, axis=1).max(axis=1), 1e-6)
    reach = np.clip(REACH, MIN_REACH_PX / size_px, MAX_REACH_PX / size_px)
    t = np.linspace(-1.0, 1.0, WINDOW_SAMPLES)
    uv = np.stack(np.meshgrid(t, t), axis=-1).reshape(1, -1, 2) * reach[:, None, None]
    offsets = np.einsum("nij,nmj->nmi", axes_px, uv)
    grey, inside = _sample(image, start[:, None] + offsets)
    weight = inside * _is_blank(uv, grey, white_rim, size_px)
    # Lines: along u and along v, by their normals. State: x, y, angle 1, 2, ln w1, ln w2.
    state = np.zeros((len(start), 6))
    state[:, 2:4] = np.arctan2(axes_px[:, 0], -axes_px[:, 1])
    state[:, 4:] = np.log(np.clip(0.12 * size_px, 0.5, 1.5))[:, None]
    span_px = reach * size_px
    widest = np.log(np.maximum(_MAX_WIDTH_SHARE * span_px, 2 * _MIN_WIDTH_PX))[:, None]
    for _ in range(_CORNER_ITERATIONS):
        _, residual, J = _model(state, offsets, grey, weight)
        normal = J.transpose(0, 2, 1) @ J
        normal += 1e-3 * normal * np.eye(6) + 1e-9 * np.eye(6)
        step = np.linalg.solve(normal, J.transpose(0, 2, 1) @ residual[..., None])[..., 0]
        state += np.clip(np.nan_to_num(step), -_LONGEST, _LONGEST)
        state[:, 4:] = np.clip(state[:, 4:], np.log(_MIN_WIDTH_PX), widest)
    contrast, residual, _ = _model(state, offsets, grey, weight)
    samples = weight.sum(axis=1)
    noise = np.sqrt((residual**2).sum(axis=1) / np.maximum(samples - 12.0, 1.0))
    ok = (
        (samples > 0.2 * WINDOW_SAMPLES * WINDOW_SAMPLES)
        & (np.abs(contrast) > 4.0)
        & (noise < 0.45 * np.abs(contrast))
        & (np.linalg.norm(state[:, :2], axis=1) < np.maximum(1.5, 0.6 * span_px))
        & (np.abs(np.sin(state[:, 2] - state[:, 3])) > 0.1)
    )
    corners = np.where(ok[:, None], start + state[:, :2], start)
    return SaddleFit(corners, ok, np.exp(state[:, 4:]).max(axis=1))


def _sample(image: NDArray[np.uint8], places: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the grey levels (n, m) at positions (n, m, 2), and which of these positions are in the
    image."""
    h, w = image.shape
    inside = np.asarray(((places >= 0) & (places <= (w - 1, h - 1))).all(axis=2))
    xy = places.astype(np.float32)
    grey = cv2.remap(image.astype(np.float32), xy[..., 0], xy[..., 1], cv2.INTER_LINEAR)
    return np.asarray(grey, dtype=np.float64), inside


def _is_blank(uv: Array, grey: Array, white: float, size_px: Array) -> Array:
    """Return 0 where there is print inside the white squares, including its blur, and 1 elsewhere,
    (n, m)."""
    if white >= REACH:
        return np.ones(grey.shape)
    positive = uv[..., 0] * uv[..., 1] > 0.0
    # Near the corner, the white squares of a ChArUco board contain no print either, so the brighter
    # squares there are the white ones.
    near = np.abs(uv).max(axis=2) < 0.5 * np.abs(uv).max(axis=(1, 2))[:, None]
    brighter = (grey * np.where(positive, 1.0, -1.0) * near).sum(axis=1) > 0.0
    clear = np.maximum(white - 1.0 / size_px, 0.5 * white)[:, None]
    printed = (positive == brighter[:, None]) & (np.abs(uv).min(axis=2) > clear)
    return np.asarray(~printed, dtype=np.float64)


def _model(state: Array, offsets: Array, grey: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Return the best contrast c (n,) for the state (n, 6), the weighted residuals (n, m), and the
    derivative of the modelled grey (n, m, 6), without the part that a, gx, gy, c, hx and hy can
    absorb."""
    x = offsets[..., 0] - state[:, 0, None]
    y = offsets[..., 1] - state[:, 1, None]
    parts = []
    for k in (0, 1):
        c = np.cos(state[:, 2 + k, None])
        s = np.sin(state[:, 2 + k, None])
        w = np.exp(state[:, 4 + k, None])
        d = c * x + s * y
        parts.append((c, s, w, d, np.tanh(d / w), -s * x + c * y))
    (c1, s1, w1, d1, t1, e1), (c2, s2, w2, d2, t2, e2) = parts
    u = offsets[..., 0]
    v = offsets[..., 1]
    cross = t1 * t2
    # In a window of few pixels, the slope of the contrast cannot be distinguished from a shift.
    slope = cross * (np.abs(offsets).max(axis=(1, 2)) > _MIN_SLOPE_PX)[:, None]
    base = np.stack([np.ones_like(x), u, v, cross, u * slope, v * slope], axis=2)
    base *= weight[..., None]
    turned = base.transpose(0, 2, 1)
    project = np.linalg.solve(turned @ base + 1e-9 * np.eye(6), turned)
    wanted = (weight * grey)[..., None]
    linear = project @ wanted
    q1 = (1.0 - t1 * t1) * t2 / w1
    q2 = (1.0 - t2 * t2) * t1 / w2
    gain = linear[:, 3] + linear[:, 4] * u + linear[:, 5] * v
    J = (gain * weight)[..., None] * np.stack(
        [-(c1 * q1 + c2 * q2), -(s1 * q1 + s2 * q2), e1 * q1, e2 * q2, -d1 * q1, -d2 * q2], axis=2
    )
    J -= base @ (project @ J)
    return linear[:, 3, 0], (wanted - base @ linear)[..., 0], J
