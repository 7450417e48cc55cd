"""What board a picture shows when it is not the one that was named."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np

from perchctl.calibration.tags import detect_tags
from perchctl.calibration.types import Grey
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.profile import aruco_dictionary, dictionary_names, dictionary_size
from perchctl.target import TAG_DICTIONARY, Board

_LARGER = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
_MAX_SIDE = 20
_SEARCH_PX = 1200
_MAX_MISFIT = 0.2  # of a marker's side
_TAGS = dictionary_size(TAG_DICTIONARY)
_LEAST_GRID = 4
"""Smaller grids are seen in many things that are no chessboard."""


def board_seen_instead(images: Sequence[Grey], board: Board) -> str:
    """A half sentence for the error message: what the pictures do show."""
    small = [_shrunk(image) for image in images]
    if board.kind != "aprilgrid" and any(len(detect_tags(s, _TAGS)) >= 4 for s in small):
        return "they show AprilTags with a border of two cells: is it an aprilgrid?"
    if board.kind != "charuco" and any(_markers(s) for s in small):
        return "they show markers: is it a charuco board?"
    looks = {
        "charuco": (_charuco_size, _dictionary),
        "chessboard": (_chessboard_size,),
        "aprilgrid": (_aprilgrid_size,),
    }
    for image in small:
        for look in looks[board.kind]:
            if other := look(image, board):
                return other
    if board.kind != "chessboard" and any(_grid(s) for s in small):
        return "they show a grid without markers: is it a plain chessboard?"
    return ""


def larger_board(images: Sequence[Grey], board: Board) -> str:
    """The board's notation when the pictures show a larger one of which the named
    board is a part, else empty. A part calibrates, but is hardly what was meant."""
    looks = {
        "charuco": _larger_charuco,
        "chessboard": _larger_grid,
        "aprilgrid": _larger_aprilgrid,
    }
    look = looks[board.kind]
    sizes = [size for size in (look(_shrunk(image), board) for image in images) if size]
    if board.marker_m:
        if not sizes:
            return ""
        size = max(sizes)  # numbers are certain, and no picture need show the last row
    else:
        size = max(sizes, key=sizes.count, default=(0, 0))
        if 2 * sizes.count(size) <= len(images):
            return ""
    return dataclasses.replace(board, columns=size[0], rows=size[1]).notation()


def _larger_grid(image: Grey, board: Board) -> tuple[int, int] | None:
    shape = (board.columns, board.rows)
    found, _, meta = cv2.findChessboardCornersSBWithMeta(image, shape, _LARGER)
    if not found or meta is None:
        return None
    size = (max(meta.shape), min(meta.shape))
    return size if size != (max(shape), min(shape)) else None


def _larger_charuco(image: Grey, board: Board) -> tuple[int, int] | None:
    """More rows: numbers go on behind the board's last."""
    assert board.dictionary is not None
    _, ids, _ = cv2.aruco.ArucoDetector(aruco_dictionary(board.dictionary)).detectMarkers(image)
    numbers = np.array([] if ids is None else ids, dtype=np.float64).ravel()
    if len(numbers) < 4 or (numbers >= board.columns * board.rows // 2).sum() < 2:
        return None
    return board.columns, int(np.ceil(2.0 * (numbers.max() + 1) / board.columns))


def _larger_aprilgrid(image: Grey, board: Board) -> tuple[int, int] | None:
    layout = _aprilgrid_layout(image, board)
    if layout is None or layout.columns != board.columns or layout.rows <= board.rows:
        return None
    return layout.columns, layout.rows


def _aprilgrid_size(image: Grey, board: Board) -> str | None:
    layout = _aprilgrid_layout(image, board)
    if layout is None or (layout.columns == board.columns and layout.rows <= board.rows):
        return None
    return (
        f"they show an aprilgrid of {layout.columns} columns and {layout.rows} or more rows: use "
        f"--board {layout.notation()} if so"
    )


def _aprilgrid_layout(image: Grey, board: Board) -> Board | None:
    """The number of columns with which the tags' numbers lie on a plane; the board's own if
    that is one."""
    tags = detect_tags(image, _TAGS)
    if len(tags) < 4:
        return None
    seen = np.concatenate(list(tags.values()))
    best: tuple[float, Board] | None = None
    for columns in (board.columns, *range(3, _MAX_SIDE + 1)):
        rows = max(3, max(tags) // columns + 1)
        layout = dataclasses.replace(board, columns=columns, rows=rows)
        numbers = [corner for tag in tags for corner in layout.tag_corners(tag)]
        misfit = _plane_misfit(layout.corners_m()[numbers, :2], seen)
        if misfit is not None and misfit <= _MAX_MISFIT and columns == board.columns:
            return layout
        if misfit is not None and (best is None or misfit < best[0]):
            best = (misfit, layout)
    return best[1] if best is not None and best[0] <= _MAX_MISFIT else None


def _chessboard_size(image: Grey, board: Board) -> str | None:
    size = _grid(image)
    if size is None or min(size) < _LEAST_GRID:
        return None
    if sorted(size) == sorted((board.columns, board.rows)):
        return None
    return (
        f"they show a chessboard of {max(size)}x{min(size)} inner corners: "
        f"use --board chessboard:{max(size)}x{min(size)}:{board.square_m * 1e3:g}mm if so"
    )


def _grid(image: Grey) -> tuple[int, int] | None:
    """Columns and rows of the largest grid of inner corners, or None."""
    for start in ((5, 4), (4, 3), (3, 3)):
        found, _, meta = cv2.findChessboardCornersSBWithMeta(image, start, _LARGER)
        if found and meta is not None and min(meta.shape) > 2:
            return int(meta.shape[1]), int(meta.shape[0])
    return None


def _charuco_size(image: Grey, board: Board) -> str | None:
    """The layout in which the markers' numbers lie on a plane."""
    assert board.dictionary is not None
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(board.dictionary))
    corners, ids, _ = detector.detectMarkers(image)
    if ids is None or len(ids) < 4:
        return None
    numbers = np.asarray(ids, dtype=np.float64).ravel()
    seen = np.concatenate([np.asarray(c, dtype=np.float64).reshape(4, 2) for c in corners])
    best: tuple[float, Board] | None = None
    for legacy in (board.legacy, not board.legacy):
        for columns in range(3, _MAX_SIDE + 1):
            # Rows as the highest number needs them.
            rows = max(3, int(np.ceil(2.0 * (int(numbers.max()) + 1) / columns)))
            try:
                layout = Board(
                    "charuco",
                    columns,
                    rows,
                    board.square_m,
                    board.marker_m,
                    board.dictionary,
                    legacy,
                )
                misfit = _misfit(layout, numbers, seen)
            except (cv2.error, InvalidValue):
                continue
            if misfit is not None and (best is None or misfit < 0.5 * best[0]):
                best = (misfit, layout)
    if best is None or best[0] > _MAX_MISFIT:
        return None
    own = _misfit(board, numbers, seen)
    if own is not None and own <= _MAX_MISFIT:
        return None  # it is the named board, only not seen well enough
    layout = best[1]
    old = " in the legacy layout" if layout.legacy else ""
    return (
        f"they show a board of {layout.columns}x{layout.rows} squares or more rows{old}: use "
        f"--board {layout.notation()} if so"
    )


def _misfit(layout: Board, ids: Array, seen: Array) -> float | None:
    """Distance of the markers' corners from a plane board, as a part of their side."""
    made = layout.cv2_board()
    numbers = {int(i): k for k, i in enumerate(np.asarray(made.getIds()).ravel())}
    if not all(int(i) in numbers for i in ids):
        return None
    points = made.getObjPoints()
    flat = np.concatenate([np.asarray(points[numbers[int(i)]])[:, :2] for i in ids])
    return _plane_misfit(flat.astype(np.float64), seen)


def _plane_misfit(flat: Array, seen: Array) -> float | None:
    """Of the corners (4n, 2) of markers one after the other, as a part of their side."""
    H, _ = cv2.findHomography(flat, seen)
    if H is None:
        return None
    mapped = np.column_stack([flat, np.ones(len(flat))]) @ H.T
    there = mapped[:, :2] / mapped[:, 2:]
    side = float(np.median(np.linalg.norm(seen[1::4] - seen[0::4], axis=1)))
    return float(np.sqrt(((there - seen) ** 2).sum(axis=1).mean())) / max(side, 1e-9)


def _dictionary(image: Grey, board: Board) -> str | None:
    """Another dictionary whose markers are there."""
    counts = {}
    own = str(board.dictionary).rsplit("_", 1)[0]  # the same markers, more or fewer of them
    for name in dictionary_names():
        if name.rsplit("_", 1)[0] == own or "APRILTAG" in name:
            continue
        _, ids, _ = cv2.aruco.ArucoDetector(aruco_dictionary(name)).detectMarkers(image)
        counts[name] = 0 if ids is None else len(ids)
    best = max(counts.values(), default=0)
    if best < 4:
        return None
    names = [name for name, count in counts.items() if count == best]
    return f"they show markers of {' or '.join(names[:3])}, not of {board.dictionary}"


def _markers(image: Grey) -> bool:
    for name in ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_ARUCO_ORIGINAL"):
        _, ids, _ = cv2.aruco.ArucoDetector(aruco_dictionary(name)).detectMarkers(image)
        if ids is not None and len(ids) >= 4:
            return True
    return False


def _shrunk(image: Grey) -> Grey:
    scale = _SEARCH_PX / max(image.shape)
    if scale >= 1.0:
        return image
    return np.asarray(
        cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
    )
