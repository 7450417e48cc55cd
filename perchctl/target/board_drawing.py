"""What of a calibration board is black."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perchctl.profile import MarkerConfig, aruco_dictionary
from perchctl.target.boards import TAG_DICTIONARY, Board
from perchctl.target.drawing import Rectangle, marker_cells, merged_rectangles

TAG_BORDER_CELLS = 2


def board_rectangles(board: Board) -> list[Rectangle]:
    """The black area in metres, origin in the board's centre, x right and y up."""
    if board.kind == "aprilgrid":
        return _aprilgrid_rectangles(board)
    columns, rows = board.squares
    width, height = board.size_m
    found: list[Rectangle] = []
    black = black_squares(board)
    for row in range(rows):
        for column in range(columns):
            if black[row, column]:
                x, y = column * board.square_m - width / 2, height / 2 - row * board.square_m
                found.append(Rectangle(x, y - board.square_m, x + board.square_m, y))
    if board.marker_m is None or board.dictionary is None:
        return found
    for marker_id, (row, column) in enumerate(np.argwhere(~black)):
        cells = marker_cells(
            MarkerConfig(dictionary=board.dictionary, id=marker_id, side_m=board.marker_m)
        )
        at = np.linspace(-board.marker_m / 2, board.marker_m / 2, len(cells) + 1)
        x = (column + 0.5) * board.square_m - width / 2
        y = height / 2 - (row + 0.5) * board.square_m
        found += merged_rectangles(cells, x + at, y - at)
    return found


def _aprilgrid_rectangles(board: Board) -> list[Rectangle]:
    assert board.marker_m is not None
    (columns, rows), (width, height) = board.squares, board.size_m
    pitch, side = board.square_m + board.marker_m, board.square_m
    found = []
    for x in np.arange(columns) * pitch - width / 2:
        for y in height / 2 - np.arange(rows) * pitch:
            found.append(Rectangle(float(x), float(y - side), float(x + side), float(y)))
    corners = board.corners_m()
    for tag in range(board.columns * board.rows):
        cells = tag_cells(tag)
        at = np.linspace(0.0, board.marker_m, len(cells) + 1)
        x, y, _ = corners[board.tag_corners(tag)[2]]  # the top left one
        found += merged_rectangles(cells, x - width / 2 + at, height / 2 - y - at)
    return found


def tag_cells(tag: int) -> NDArray[np.bool_]:
    """Black cells of an aprilgrid's tag as Kalibr prints it, (10, 10), row 0 at the top."""
    dictionary = aruco_dictionary(TAG_DICTIONARY)
    n = int(dictionary.markerSize) + 2 * TAG_BORDER_CELLS
    picture = dictionary.generateImageMarker(tag, n, borderBits=TAG_BORDER_CELLS)
    return np.asarray(picture)[::-1, ::-1] < 128  # half a turn: see `Board.tag_corners`


def black_squares(board: Board) -> NDArray[np.bool_]:
    """Which squares are black, (rows, columns), row 0 at the top; a charuco board's
    markers fill the others, row by row."""
    columns, rows = board.squares
    # OpenCV's old pattern begins with white where the rows are even in number.
    first = 1 if board.legacy and rows % 2 == 0 else 0
    return np.asarray((np.add.outer(np.arange(rows), np.arange(columns)) + first) % 2 == 0)
