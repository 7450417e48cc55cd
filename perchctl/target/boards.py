"""Calibration boards: one notation for printing and for calibrating.

``chessboard:9x6:25mm``
    inner corners (columns x rows) and the side of a square; 10x7 squares are printed.
``charuco:10x7:25mm:18mm:DICT_5X5_100[:legacy]``
    squares (columns x rows), side of a square, side of a marker, dictionary. ``legacy``
    is the pattern of OpenCV before 4.6, which differs for an even number of rows.

Each kind counts as OpenCV's own calls do.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.profile import MarkerConfig
from perchctl.profile.dictionaries import id_count
from perchctl.target.drawing import Rectangle, marker_cells, merged_rectangles
from perchctl.target.lengths import millimetres, parse_length

Kind = Literal["chessboard", "charuco"]
EXAMPLES = "chessboard:9x6:25mm or charuco:10x7:25mm:18mm:DICT_5X5_100"
MAX_COUNT = 100


@dataclass(frozen=True)
class Board:
    """A calibration board; `columns` and `rows` count inner corners on a chessboard and
    squares on a charuco board. `marker_m` and `dictionary` are a charuco board's only."""

    kind: Kind
    columns: int
    rows: int
    square_m: float
    marker_m: float | None = None
    dictionary: str | None = None
    legacy: bool = False

    @property
    def squares(self) -> tuple[int, int]:
        """Columns and rows of squares."""
        more = 1 if self.kind == "chessboard" else 0
        return self.columns + more, self.rows + more

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the print, without the white around it."""
        columns, rows = self.squares
        return columns * self.square_m, rows * self.square_m

    @property
    def corner_count(self) -> tuple[int, int]:
        """Columns and rows of inner corners."""
        columns, rows = self.squares
        return columns - 1, rows - 1

    def corners_m(self) -> Array:
        """Inner corners, row by row from the top left one, (n, 3); x right, y down, the
        origin at the top left corner of the print on a charuco board (as
        `cv2.aruco.CharucoBoard.getChessboardCorners`), at the first one on a chessboard."""
        columns, rows = self.corner_count
        first = 1 if self.kind == "charuco" else 0
        xs, ys = np.meshgrid(np.arange(columns) + first, np.arange(rows) + first)
        flat = np.stack([xs.ravel(), ys.ravel(), np.zeros(xs.size)], axis=1)
        return np.asarray(flat * self.square_m, dtype=np.float64)

    def notation(self) -> str:
        """The text that `parse_board` reads back to this very board."""
        text = f"{self.kind}:{self.columns}x{self.rows}:{millimetres(self.square_m)}mm"
        if self.marker_m is not None:
            text += f":{millimetres(self.marker_m)}mm:{self.dictionary}"
        return text + (":legacy" if self.legacy else "")

    def cv2_board(self) -> Any:
        """`cv2.aruco.CharucoBoard` for a detector. Raises ValueError on a chessboard."""
        if self.kind != "charuco" or self.marker_m is None or self.dictionary is None:
            raise ValueError("only a charuco board has markers")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.marker_m, dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board


def parse_board(text: str) -> Board:
    """The board of a notation such as ``charuco:10x7:25mm:18mm:DICT_5X5_100``.

    Raises InvalidValue: what is wrong in which part.
    """
    kind, *parts = text.strip().split(":")
    if kind == "chessboard":
        if len(parts) != 2:
            raise _wrong(text, "a chessboard is chessboard:COLUMNSxROWS:SQUARE")
        columns, rows = _counts(text, parts[0])
        return Board("chessboard", columns, rows, parse_length(parts[1], f"board {text}: square"))
    if kind != "charuco":
        raise _wrong(text, f"kind {kind!r} is unknown; allowed are chessboard and charuco")
    if len(parts) not in (4, 5):
        raise _wrong(
            text, "a charuco board is charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY[:legacy]"
        )
    if len(parts) == 5 and parts[4] != "legacy":
        raise _wrong(text, f"{parts[4]!r} is unknown; the last part may only be 'legacy'")
    columns, rows = _counts(text, parts[0])
    square = parse_length(parts[1], f"board {text}: square")
    marker = parse_length(parts[2], f"board {text}: marker")
    if marker > 0.95 * square:
        raise _wrong(
            text,
            f"the marker ({millimetres(marker)} mm) needs white around it: at most "
            f"{millimetres(0.95 * square)} mm in a square of {millimetres(square)} mm",
        )
    try:
        held = id_count(parts[3])
    except ValueError as error:
        raise _wrong(text, str(error)) from None
    needed = columns * rows // 2
    if held < needed:
        raise _wrong(text, f"{needed} markers are needed, and {parts[3]} holds {held}")
    return Board("charuco", columns, rows, square, marker, parts[3], len(parts) == 5)


def board_rectangles(board: Board) -> list[Rectangle]:
    """The black area in metres, origin in the board's centre, x right and y up."""
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


def black_squares(board: Board) -> NDArray[np.bool_]:
    """Which squares are black, (rows, columns), row 0 at the top; a charuco board's
    markers fill the others, row by row."""
    columns, rows = board.squares
    # OpenCV's old pattern begins with white where the rows are even in number.
    first = 1 if board.legacy and rows % 2 == 0 else 0
    return np.asarray((np.add.outer(np.arange(rows), np.arange(columns)) + first) % 2 == 0)


def _counts(text: str, part: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", part)
    if match is None:
        raise _wrong(text, f"{part!r} is not COLUMNSxROWS, for example 9x6")
    columns, rows = int(match[1]), int(match[2])
    if not (3 <= columns <= MAX_COUNT and 3 <= rows <= MAX_COUNT):
        raise _wrong(text, f"{part}: 3 to {MAX_COUNT} columns and rows are allowed")
    return columns, rows


def _wrong(text: str, why: str) -> InvalidValue:
    return InvalidValue(f"board {text!r}: {why} (for example {EXAMPLES})")
