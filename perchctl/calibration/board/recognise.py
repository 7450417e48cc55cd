"""Find out which board the images show if they do not show the specified board.

A chessboard is identified by the grid of corners that is found in the most images, and in at least
two. A board with markers is identified by the dictionary that decodes most of the markers, and by
the layout whose corners OpenCV then finds. A board is named only if it is identified with
certainty.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from perchctl.calibration.board.detect import SEARCH_PX, charuco_corners
from perchctl.camera import Grey
from perchctl.profile import aruco_dictionary
from perchctl.target import Board, mm_text

MOST_PICTURES = 5
"""Number of images that are searched for a chessboard; each search takes a few tenths of a
second."""
MARKER_PICTURES = 3
"""Number of these images that are searched for markers; each search takes about a second."""
MIN_MARKERS = 4
"""Minimum number of markers that must be found. Fewer markers may belong to the perching target, or
be patterns that look like markers."""
MIN_MARKER_CORNERS = 12
"""Number of corners that must be found with a ChArUco board's layout before the board is named."""
GRID_START = (5, 4)
"""Grid of corners from which OpenCV grows the board. If the grid is smaller, OpenCV stops growing
it before the edge of the board. A grid that has not grown may be part of a board, or a keyboard."""
_SIZES = (50, 100, 250)
"""Sizes of the dictionaries of one family. Boards have fewer than 250 markers, and searching with
the dictionaries of 1000 would take longer."""
_DICTIONARIES = (
    *(f"DICT_{bits}X{bits}_{_SIZES[-1]}" for bits in (4, 5, 6, 7)),
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_36H11",
    "DICT_ARUCO_MIP_36H12",
)
_APRIL_GRID = "DICT_APRILTAG_36H11"
_GRID_FLAGS = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE


def describe_other_board(pictures: Sequence[Grey], named: Board) -> str:
    """Describe the board in the grey images and give its notation; empty if no board is clearly
    visible, or if it is the specified board."""
    images = [_small(picture) for picture in pictures[:MOST_PICTURES]]
    if not images:
        return ""
    with_markers = _markers_text(images[:MARKER_PICTURES], named)
    # Boards with markers come first, because part of such a board would pass for a chessboard.
    return _grid_text(images, named) if with_markers is None else with_markers


def _small(picture: Grey) -> Grey:
    scale = min(1.0, SEARCH_PX / max(picture.shape))
    resized = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(resized, np.uint8)


# --- Boards with markers ---


def _markers_text(images: Sequence[Grey], named: Board) -> str | None:
    """Like `describe_other_board`, but only for boards with markers; None if there are no
    markers."""
    seen = [_marker_ids(image, _DICTIONARIES) for image in images]
    family, _ = max(
        ((name, sum(len(ids[name]) for ids in seen)) for name in _DICTIONARIES),
        key=lambda each: each[1],
    )
    ids = set().union(*(each[family] for each in seen))
    if len(ids) < MIN_MARKERS:
        tags = (_marker_ids(image, [_APRIL_GRID], border_bits=2)[_APRIL_GRID] for image in images)
        if any(len(each) >= MIN_MARKERS for each in tags):
            return (
                "an AprilGrid, which is not supported: print a board with perchctl make-target "
                "board"
            )
        return None
    dictionary = _smallest(family, max(ids))
    is_named_family = _stem(str(named.dictionary)) == _stem(dictionary)
    image, _ = max(zip(images, seen, strict=True), key=lambda each: len(each[1][family]))
    alike = [named] if is_named_family else []
    board = _charuco_board(
        image, [*alike, *_layouts(replace(named, dictionary=dictionary), max(ids) + 1)]
    )
    if board is None:
        is_part = is_named_family and max(ids) < named.columns * named.rows // 2
        numbers = f"markers of {dictionary} with ids {min(ids)} to {max(ids)}"
        return "" if is_part else numbers
    if is_named_family and (board.columns, board.rows) == (named.columns, named.rows):
        return ""
    square = f"{mm_text(board.square_m)}mm"
    marker = "MARKER" if named.marker_m is None else f"{mm_text(named.marker_m)}mm"
    return (
        f"a ChArUco board of {board.columns}x{board.rows} squares: --board "
        f"charuco:{board.columns}x{board.rows}:{square}:{marker}:{dictionary}"
    )


def _marker_ids(
    image: Grey, dictionaries: Sequence[str], border_bits: int = 1
) -> dict[str, set[int]]:
    """Return the ids of the markers in an image, by dictionary."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.errorCorrectionRate = 0.0  # squares of a chessboard decode with this dictionary
    books = [aruco_dictionary(name) for name in dictionaries]
    detector = cv2.aruco.ArucoDetector(books, parameters)
    _, ids, _, which = detector.detectMarkersMultiDict(image)
    found: dict[str, set[int]] = {name: set() for name in dictionaries}
    if ids is not None:
        for number, k in zip(np.ravel(ids), np.ravel(which), strict=True):
            found[dictionaries[int(k)]].add(int(number))
    return found


def _smallest(family: str, largest_id: int) -> str:
    """Return the smallest dictionary of a family that contains this id; all dictionaries of a
    family begin with the same markers."""
    if not family.endswith(f"_{_SIZES[-1]}"):
        return family
    return next(f"{_stem(family)}_{n}" for n in _SIZES if n > largest_id)


def _stem(dictionary: str) -> str:
    """Return a dictionary's name without its size, as in ``DICT_4X4``."""
    return dictionary.rpartition("_")[0]


def _layouts(named: Board, markers: int) -> list[Board]:
    """Return the ChArUco boards that have this many markers."""
    sizes = [
        (columns, rows)
        for columns in range(3, markers)
        for rows in {2 * markers // columns, (2 * markers + 1) // columns}
        if rows >= 3 and columns * rows // 2 == markers
    ]
    marker_m = named.marker_m or 0.75 * named.square_m
    return [
        replace(named, kind="charuco", columns=columns, rows=rows, marker_m=marker_m, legacy=False)
        for columns, rows in sizes
    ]


def _charuco_board(image: Grey, boards: Sequence[Board]) -> Board | None:
    """Return the board with the most corners in the image in either layout, the first one if
    several have equally many; None if none has enough."""
    best, most = None, MIN_MARKER_CORNERS - 1
    for board in boards:
        for legacy in {board.legacy, board.has_two_layouts}:
            numbers, _, _ = charuco_corners(image, replace(board, legacy=legacy))
            if len(numbers) > most:
                best, most = board, len(numbers)
    return best


# --- Chessboards ---


def _grid_text(images: Sequence[Grey], named: Board) -> str:
    grids: Counter[tuple[int, int]] = Counter()
    for image in images:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(image, GRID_START, _GRID_FLAGS)
        if found:
            rows, columns = meta.shape
            grids[max(columns, rows), min(columns, rows)] += 1
    (grid, count), *_ = [*grids.most_common(1), ((0, 0), 0)]
    if count < min(2, len(images)) or grid[0] * grid[1] <= GRID_START[0] * GRID_START[1]:
        return ""
    columns, rows = grid
    named_grid = max(named.columns, named.rows), min(named.columns, named.rows)
    if named.kind == "chessboard" and named_grid == (columns, rows):
        return ""
    counted = ""
    if named.kind == "chessboard" and named_grid == (columns + 1, rows + 1):
        counted = f", which are {columns + 1}x{rows + 1} squares"
    return (
        f"a chessboard of {columns}x{rows} inner corners{counted}: --board "
        f"chessboard:{columns}x{rows}:{mm_text(named.square_m)}mm"
    )
