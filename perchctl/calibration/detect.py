"""A board in a picture: found, its corners refined, or the reason why not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.saddle import Room, fit_saddles
from perchctl.calibration.tags import find_tags
from perchctl.calibration.types import BoardView, Grey
from perchctl.geometry import Array
from perchctl.target import TAG_BORDER_CELLS, Board, BoardKind, tag_cells
from perchctl.vision import field_picture, is_combed

MIN_CORNERS = 6
"""Fewer give a pose, but nothing about the lens."""
SEARCH_PX = 1600
"""Larger pictures are scaled down to it for the search; corners are fitted at full size."""
_MOST_MOTION_PX = 12.0
"""Between two fields, for which the mean of both is a picture of the board too."""
TAG_REACH = 0.6
"""Of the small squares of an aprilgrid; they are a third as large as a chessboard's."""
_RIM_PX = 2.0
"""A tag's corner nearer to the picture's rim is not seen from all sides."""
_WINDOW_PX = {"chessboard": 11, "aprilgrid": 2}
_CHESS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_SECTORS = cv2.CALIB_CB_NORMALIZE_IMAGE  # exhaustive would take a second where there is none


def find_board(image: Grey, board: Board, name: str = "", refine: bool = True) -> BoardView | str:
    """The view of a board, or why there is none.

    Args:
        image: grey, uint8 (h, w).
        refine: fit the corners (`perchctl.calibration.saddle`); otherwise they are
            OpenCV's, with `cv2.cornerSubPix` in the window of OpenCV's own program for
            chessboards, and in Kalibr's for aprilgrids.

    Of an interlaced picture, whose fields show a moving board in two places, the view is the
    mean of both fields' corners: where the board was half way between them.
    """
    if is_combed(image):
        fields = [_whole(field_picture(image, row), board, name, refine) for row in (0, 1)]
        return _half_way(*fields)
    return _whole(image, board, name, refine)


def _half_way(a: BoardView | str, b: BoardView | str) -> BoardView | str:
    """The mean of the corners that both fields show; without a second field, the one."""
    if isinstance(a, str) or isinstance(b, str):
        return b if isinstance(a, str) else a
    if np.linalg.norm(a.corners_px.mean(axis=0) - b.corners_px.mean(axis=0)) > _MOST_MOTION_PX:
        return a if len(a.ids) >= len(b.ids) else b
    _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
    if len(in_a) < MIN_CORNERS:
        return a if len(a.ids) >= len(b.ids) else b
    middle = (a.corners_px[in_a] + b.corners_px[in_b]) / 2.0
    return replace(a, ids=a.ids[in_a], object_m=a.object_m[in_a], corners_px=middle)


def _whole(image: Grey, board: Board, name: str, refine: bool) -> BoardView | str:
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
    object_m = board.corners_m()[ids]
    if not refine:
        if board.kind != "charuco":
            corners = _fixed_window(image, corners, _WINDOW_PX[board.kind])
        return BoardView(name, (w, h), ids, object_m, corners)
    along, down = _local_axes(_cells(board, ids), corners)
    fit = fit_saddles(image, corners, along, down, _room(board))
    if fit.ok.sum() < MIN_CORNERS:
        return f"only {int(fit.ok.sum())} corners are sharp enough to be measured"
    good = BoardView(
        name, (w, h), ids, object_m, fit.corners_px, float(np.median(fit.width_px[fit.ok]))
    )
    return good.keep(fit.ok)


def _room(board: Board) -> Room:
    """How far from a corner nothing but its own four squares is printed."""
    if board.kind == "aprilgrid" and board.marker_m:
        # The squares are small; a tag's cells begin behind its border.
        border = TAG_BORDER_CELLS / len(tag_cells(0)) * board.marker_m / board.square_m
        return Room(reach=TAG_REACH, black=border)
    if board.kind == "charuco" and board.marker_m:
        return Room(white=0.5 * (1.0 - board.marker_m / board.square_m))
    return Room()


def _aprilgrid(image: Grey, board: Board) -> tuple[NDArray[np.intp], Array] | str:
    tags = find_tags(image, board)
    if isinstance(tags, str):
        return tags
    ids = np.array([corner for tag in tags for corner in board.tag_corners(tag)], dtype=np.intp)
    corners = np.concatenate(list(tags.values()))
    h, w = image.shape
    inside = ((corners > _RIM_PX) & (corners < (w - 1 - _RIM_PX, h - 1 - _RIM_PX))).all(axis=1)
    order = np.flatnonzero(inside)[np.argsort(ids[inside])]
    if len(order) < MIN_CORNERS:
        return f"only {len(order)} corners of the board found"
    return ids[order], corners[order]


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


_FINDERS: dict[BoardKind, Callable[[Grey, Board], tuple[NDArray[np.intp], Array] | str]] = {
    "chessboard": _chessboard,
    "charuco": _charuco,
    "aprilgrid": _aprilgrid,
}


def _cells(board: Board, ids: NDArray[np.intp]) -> Array:
    """Places of inner corners in squares, (n, 2)."""
    return np.asarray(board.corners_m()[ids, :2] / board.square_m)


def _fixed_window(image: Grey, corners: Array, half_px: int) -> Array:
    points = np.ascontiguousarray(corners, dtype=np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.001)
    moved = cv2.cornerSubPix(image, points, (half_px, half_px), (-1, -1), criteria)
    return np.asarray(moved, dtype=np.float64).reshape(-1, 2)


def _local_axes(cells: Array, corners: Array) -> tuple[Array, Array]:
    """A square's two sides at each corner, as seen: the derivative of the homography from
    board to picture, which smooths over single bad corners; (n, 2) each."""
    H, _ = cv2.findHomography(cells, corners, cv2.RANSAC, 5.0)
    if H is None:
        H, _ = cv2.findHomography(cells, corners)
    homogeneous = np.column_stack([cells, np.ones(len(cells))]) @ H.T
    at, w = homogeneous[:, :2] / homogeneous[:, 2:], homogeneous[:, 2:]
    along = (H[:2, 0] - at * H[2, 0]) / w
    down = (H[:2, 1] - at * H[2, 1]) / w
    return along, down
