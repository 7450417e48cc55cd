"""Calibration boards: one notation for printing and for calibrating.

``chessboard:9x6:25mm``
    inner corners (columns x rows) and the side of a square; 10x7 squares are printed.
``charuco:10x7:25mm:18mm:DICT_5X5_100``
    squares (columns x rows), side of a square, side of a marker, dictionary; the suffix ``:legacy``
    selects the layout that OpenCV used before 4.6; many shops still sell such boards.

Columns and rows are counted as in OpenCV's own functions. A suffix such as
``:measured=249.3x174.6mm`` gives the measured size of the print's black area.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.profile import MarkerConfig, dictionary_size
from perchctl.target.drawing import (
    Rectangle,
    marker_cells,
    merge_black_cells,
    mm_text,
    parse_length,
    print_scale,
)

BoardKind = Literal["chessboard", "charuco"]
EXAMPLES = "chessboard:9x6:25mm or charuco:10x7:25mm:18mm:DICT_5X5_100"
MAX_COUNT = 100
_MEASURED = ":measured="
_CHESSBOARD = re.compile(r"chessboard:(?P<columns>\d+)x(?P<rows>\d+):(?P<square>[^:]+)")
_CHARUCO = re.compile(
    r"charuco:(?P<columns>\d+)x(?P<rows>\d+):(?P<square>[^:]+):(?P<marker>[^:]+)"
    r":(?P<dictionary>[^:]+)(?P<legacy>:legacy)?"
)


@dataclass(frozen=True)
class Board:
    """A calibration board.

    Attributes:
        columns, rows: numbers of inner corners (chessboard) or of squares (charuco).
        square_m: side of the squares whose corners meet.
        marker_m, dictionary: the markers' side and dictionary; None on a chessboard.
        scale: measured over nominal size of the print, along width and height.
        legacy: True for a charuco board with an even number of rows whose top left square is white,
            as in OpenCV before 4.6. All other boards have only one layout, and `legacy` is False.
    """

    kind: BoardKind
    columns: int
    rows: int
    square_m: float
    marker_m: float | None = None
    dictionary: str | None = None
    scale: tuple[float, float] = (1.0, 1.0)
    legacy: bool = False

    @property
    def has_two_layouts(self) -> bool:
        """True if the board's layout changed in OpenCV 4.6 (`legacy`)."""
        return self.kind == "charuco" and self.rows % 2 == 0

    @property
    def squares(self) -> tuple[int, int]:
        """Columns and rows of squares."""
        more = 1 if self.kind == "chessboard" else 0
        return self.columns + more, self.rows + more

    @property
    def size_m(self) -> tuple[float, float]:
        """Nominal width and height of the print, without the white margin."""
        columns, rows = self.squares
        return columns * self.square_m, rows * self.square_m

    @property
    def corner_count(self) -> tuple[int, int]:
        """Columns and rows of inner corners."""
        columns, rows = self.squares
        return columns - 1, rows - 1

    def corners_m(self) -> Array:
        """The inner corners (n, 3) in metres, row by row from the top left one; x right, y down.

        The origin is the top left corner of the print, as in
        `cv2.aruco.CharucoBoard.getChessboardCorners`; on a chessboard it is the first corner.
        """
        first = 1 if self.kind == "charuco" else 0
        across, down = (
            (np.arange(count) + first) * self.square_m * scale
            for count, scale in zip(self.corner_count, self.scale, strict=True)
        )
        xs, ys = np.meshgrid(across, down)
        return np.stack([xs.ravel(), ys.ravel(), np.zeros(xs.size)], axis=1)

    def notation(self) -> str:
        """The text that `parse` converts back to the same board, such as
        ``chessboard:9x6:25mm``."""
        text = f"{self.kind}:{self.columns}x{self.rows}:{mm_text(self.square_m)}mm"
        if self.marker_m is not None:
            text += f":{mm_text(self.marker_m)}mm:{self.dictionary}"
        if self.legacy:
            text += ":legacy"
        if self.scale == (1.0, 1.0):
            return text
        width, height = (m * s for m, s in zip(self.size_m, self.scale, strict=True))
        return f"{text}{_MEASURED}{mm_text(width)}x{mm_text(height)}mm"

    @classmethod
    def parse(cls, text: str) -> Board:
        """Return the board for a notation such as ``charuco:10x7:25mm:18mm:DICT_5X5_100``.

        Raises InvalidValue, naming the part that is wrong.
        """
        whole, _, measured = text.strip().partition(_MEASURED)
        found = _CHESSBOARD.fullmatch(whole) or _CHARUCO.fullmatch(whole)
        if found is None:
            raise _wrong(
                text,
                "it must be chessboard:COLUMNSxROWS:SQUARE or "
                "charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY, with :legacy for the layout of "
                "OpenCV before 4.6",
            )
        columns = int(found["columns"])
        rows = int(found["rows"])
        if not (3 <= columns <= MAX_COUNT and 3 <= rows <= MAX_COUNT):
            raise _wrong(text, f"3 to {MAX_COUNT} columns and rows are allowed")
        square_m = parse_length(found["square"], f"board {text}: square")
        board = cls("chessboard", columns, rows, square_m)
        if found.re is _CHARUCO:
            marker_m = parse_length(found["marker"], f"board {text}: marker")
            board = cls("charuco", columns, rows, square_m, marker_m, found["dictionary"])
            _check_markers(board, text)
            board = replace(board, legacy=bool(found["legacy"]) and board.has_two_layouts)
        return board.with_measured_sides(measured)[0] if measured else board

    def with_measured_sides(self, text: str) -> tuple[Board, list[str]]:
        """The same board with the measured sides of its black area, ``249.3x174.6mm``, and
        notes for the user. Raises InvalidValue."""
        sides = re.fullmatch(r"([\d.]+)x([\d.]+)(mm)?", text)
        if sides is None:
            raise InvalidValue(f"{text!r} is not WIDTHxHEIGHT in mm, as in 249.3x174.6mm")
        width_m, height_m = (parse_length(f"{s}mm", "the board's side") for s in sides.groups()[:2])
        given = (("width", width_m), ("height", height_m))
        (across, first), (down, second) = (
            print_scale(name, f"the board's {name}", is_m, spec_m, self.notation())
            for (name, is_m), spec_m in zip(given, self.size_m, strict=True)
        )
        return replace(self, scale=(across, down)), first + second

    def cv2_board(self) -> Any:
        """A `cv2.aruco.CharucoBoard` for a detector. Raises ValueError for a chessboard."""
        if self.kind != "charuco" or self.marker_m is None or self.dictionary is None:
            raise ValueError("only a charuco board has an equivalent in OpenCV")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        size = (self.columns, self.rows)
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, dictionary)
        board.setLegacyPattern(self.legacy)
        return board


def _check_markers(board: Board, text: str) -> None:
    """Raise InvalidValue if ChArUco markers are too large, or too many for their dictionary."""
    largest_m = 0.95 * board.square_m
    needed = board.columns * board.rows // 2
    if board.marker_m is not None and board.marker_m > largest_m:
        raise _wrong(
            text,
            f"the marker needs a white margin: its side may be at most {mm_text(largest_m)} mm",
        )
    try:
        held = dictionary_size(str(board.dictionary))
    except ValueError as error:
        raise _wrong(text, str(error)) from None
    if held < needed:
        raise _wrong(text, f"{needed} markers are needed, but {board.dictionary} has only {held}")


def _wrong(text: str, why: str) -> InvalidValue:
    return InvalidValue(f"board {text!r}: {why} (for example {EXAMPLES})")


# --- The black area of a board ---


def board_rectangles(board: Board) -> list[Rectangle]:
    """The black area as rectangles, m; origin in the board's centre, x right, y up."""
    columns, rows = board.squares
    width, height = board.size_m
    found: list[Rectangle] = []
    black = black_squares(board)
    for row in range(rows):
        for column in range(columns):
            if black[row, column]:
                x = column * board.square_m - width / 2
                y = height / 2 - row * board.square_m
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
        found += merge_black_cells(cells, x + at, y - at)
    return found


def black_squares(board: Board) -> NDArray[np.bool_]:
    """A mask (rows, columns) of the black squares, row 0 on top; markers are in the white ones."""
    columns, rows = board.squares
    return np.asarray(np.add.outer(np.arange(rows), np.arange(columns)) % 2 == board.legacy)
