"""Calibration boards: one notation for printing and for calibrating.

``chessboard:9x6:25mm``
    inner corners (columns x rows) and the side of a square; 10x7 squares are printed.
``charuco:10x7:25mm:18mm:DICT_5X5_100[:legacy]``
    squares (columns x rows), side of a square, side of a marker, dictionary. ``legacy``
    is the pattern of OpenCV before 4.6, which differs for an even number of rows.
``aprilgrid:6x6:22mm:0.3``
    tags (columns x rows), side of a tag, and the gap between tags as a share of it; what
    is left out from the end on is as here. The tags are tag36h11 with a border of two cells;
    0 is at the bottom left, 1 at its right, and in the gaps black squares touch the corners.
A path such as ``april_6x6.yaml``
    Kalibr's own file of an aprilgrid or a checkerboard.

Chessboard and charuco count as OpenCV's own calls do, an aprilgrid as Kalibr does. Behind
each ``:measured=249.3x174.6mm`` may say what the print's black area measures.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound
from perchctl.geometry import Array
from perchctl.plain_yaml import parse_yaml
from perchctl.profile import MarkerConfig, aruco_dictionary, dictionary_size
from perchctl.target.drawing import (
    Rectangle,
    marker_cells,
    merged_rectangles,
    mm_text,
    parse_length,
)

_MOST_CHARACTERS = 200  # of a file's faults in a sentence
BoardKind = Literal["chessboard", "charuco", "aprilgrid"]
EXAMPLES = "chessboard:9x6:25mm, charuco:10x7:25mm:18mm:DICT_5X5_100 or aprilgrid:6x6:22mm:0.3"
MAX_COUNT = 100
APRILGRID_DEFAULTS = ("6x6", "22mm", "0.3")
TAG_DICTIONARY, TAG_BORDER_CELLS = "DICT_APRILTAG_36H11", 2
SPACING_LIMITS = (0.1, 1.0)
MAX_SCALE_ERROR = 0.1
"""A print off by more than this was not measured in the unit that was meant."""
_MEASURED = ":measured="


@dataclass(frozen=True)
class Board:
    """A calibration board.

    Attributes:
        columns, rows: of inner corners on a chessboard, of squares on a charuco board, of
            tags on an aprilgrid.
        square_m: side of the squares whose corners meet; an aprilgrid's are those in the gaps.
        marker_m, dictionary: of charuco's markers and an aprilgrid's tags.
        scale: of the print as measured to the print as meant, along width and height.
    """

    kind: BoardKind
    columns: int
    rows: int
    square_m: float
    marker_m: float | None = None
    dictionary: str | None = None
    legacy: bool = False
    scale: tuple[float, float] = (1.0, 1.0)

    @property
    def squares(self) -> tuple[int, int]:
        """Columns and rows of squares; on an aprilgrid of those in the gaps."""
        more = 0 if self.kind == "charuco" else 1
        return self.columns + more, self.rows + more

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the print as meant, without the white around it."""
        tag_m = self.marker_m if self.kind == "aprilgrid" and self.marker_m else 0.0
        width, height = (
            squares * self.square_m + tags * tag_m
            for squares, tags in zip(self.squares, (self.columns, self.rows), strict=True)
        )
        return width, height

    @property
    def corner_count(self) -> tuple[int, int]:
        """Columns and rows of inner corners; an aprilgrid's tags have four each."""
        if self.kind == "aprilgrid":
            return 2 * self.columns, 2 * self.rows
        columns, rows = self.squares
        return columns - 1, rows - 1

    def corners_m(self) -> Array:
        """Inner corners, row by row from the top left one, (n, 3); x right, y down, the
        origin at the top left corner of the print (as
        `cv2.aruco.CharucoBoard.getChessboardCorners`), at the first one on a chessboard."""
        across, down = (
            self._lines_m(count) * s for count, s in zip(self.corner_count, self.scale, strict=True)
        )
        xs, ys = np.meshgrid(across, down)
        return np.stack([xs.ravel(), ys.ravel(), np.zeros(xs.size)], axis=1)

    def _lines_m(self, count: int) -> Array:
        """Where the lines lie in whose crossings the corners are."""
        k = np.arange(count)
        if self.kind != "aprilgrid":
            return np.asarray((k + (self.kind == "charuco")) * self.square_m, dtype=np.float64)
        assert self.marker_m is not None
        return np.asarray((k // 2 + 1) * self.square_m + (k + 1) // 2 * self.marker_m)

    def tag_corners(self, tag: int) -> tuple[int, int, int, int]:
        """Numbers of an aprilgrid tag's corners in `corners_m`, in the order in which
        OpenCV finds them. Kalibr prints its tags upright by AprilTag's own definition, from
        which OpenCV's is turned by half a turn: its first corner is the bottom right one."""
        columns, _ = self.corner_count
        row = self.rows - 1 - tag // self.columns
        left_top = 2 * row * columns + 2 * (tag % self.columns)
        left_bottom = left_top + columns
        return left_bottom + 1, left_bottom, left_top, left_top + 1

    def notation(self) -> str:
        """The text that `parse_board` reads back to this very board."""
        text = f"{self.kind}:{self.columns}x{self.rows}"
        if self.kind == "aprilgrid" and self.marker_m is not None:
            text += f":{mm_text(self.marker_m)}mm:{self.square_m / self.marker_m:.6g}"
        else:
            text += f":{mm_text(self.square_m)}mm"
            if self.marker_m is not None:
                text += f":{mm_text(self.marker_m)}mm:{self.dictionary}"
        text += ":legacy" if self.legacy else ""
        if self.scale == (1.0, 1.0):
            return text
        width, height = (m * s for m, s in zip(self.size_m, self.scale, strict=True))
        return f"{text}{_MEASURED}{mm_text(width)}x{mm_text(height)}mm"

    def measured(self, width_m: float, height_m: float) -> Board:
        """The same board, printed so large. Raises InvalidValue where that cannot be."""
        scale = []
        for name, meant_m, is_m in zip(
            ("width", "height"), self.size_m, (width_m, height_m), strict=True
        ):
            off = is_m / meant_m - 1.0
            if abs(off) > MAX_SCALE_ERROR:
                raise InvalidValue(
                    f"the board's {name} of {mm_text(is_m)} mm is {100 * off:+.0f} % off the "
                    f"{mm_text(meant_m)} mm of {self.notation()}: measure its black area, in mm"
                )
            scale.append(is_m / meant_m)
        return replace(self, scale=(scale[0], scale[1]))

    def cv2_board(self) -> Any:
        """`cv2.aruco.CharucoBoard` for a detector. Raises ValueError on another board."""
        if self.kind != "charuco" or self.marker_m is None or self.dictionary is None:
            raise ValueError("only a charuco board is one of OpenCV's own")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.marker_m, dictionary
        )
        board.setLegacyPattern(self.legacy)
        return board


def parse_board(text: str) -> Board:
    """The board of a notation such as ``charuco:10x7:25mm:18mm:DICT_5X5_100``, or of
    Kalibr's file.

    Raises InvalidValue: what is wrong in which part. NotFound: no such file.
    """
    whole, _, measured = text.strip().partition(_MEASURED)
    if whole.endswith((".yaml", ".yml")):
        whole = kalibr_notation(Path(whole).expanduser())
    board = _parsed(whole)
    if not measured:
        return board
    sides = re.fullmatch(r"([\d.]+)x([\d.]+)mm", measured)
    if sides is None:
        raise _wrong(text, f"{measured!r} is not WIDTHxHEIGHT in mm, as in 249.3x174.6mm")
    width, height = (parse_length(f"{s}mm", f"board {text}: measured") for s in sides.groups())
    return board.measured(width, height)


def _parsed(text: str) -> Board:
    kind, *parts = text.split(":")
    if kind == "aprilgrid":
        return _aprilgrid(text, parts)
    if kind == "chessboard":
        if len(parts) != 2:
            raise _wrong(text, "a chessboard is chessboard:COLUMNSxROWS:SQUARE")
        columns, rows = _counts(text, parts[0])
        return Board("chessboard", columns, rows, parse_length(parts[1], f"board {text}: square"))
    if kind != "charuco":
        raise _wrong(
            text, f"kind {kind!r} is unknown; allowed are chessboard, charuco and aprilgrid"
        )
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
            f"the marker ({mm_text(marker)} mm) needs white around it: at most "
            f"{mm_text(0.95 * square)} mm in a square of {mm_text(square)} mm",
        )
    try:
        held = dictionary_size(parts[3])
    except ValueError as error:
        raise _wrong(text, str(error)) from None
    needed = columns * rows // 2
    if held < needed:
        raise _wrong(text, f"{needed} markers are needed, and {parts[3]} holds {held}")
    return Board("charuco", columns, rows, square, marker, parts[3], len(parts) == 5)


def _aprilgrid(text: str, parts: list[str]) -> Board:
    if len(parts) > len(APRILGRID_DEFAULTS):
        raise _wrong(text, "an aprilgrid is aprilgrid:COLUMNSxROWS:TAG:SPACING")
    count, side, spacing = (*parts, *APRILGRID_DEFAULTS[len(parts) :])
    columns, rows = _counts(text, count)
    tag = parse_length(side, f"board {text}: tag")
    try:
        share = float(spacing)
    except ValueError:
        share = float("nan")
    low, high = SPACING_LIMITS
    if not low <= share <= high:
        raise _wrong(
            text,
            f"spacing {spacing!r}: the gap is given as a share of the tag's side, {low:g} to "
            f"{high:g}",
        )
    held = dictionary_size(TAG_DICTIONARY)
    if columns * rows > held:
        raise _wrong(text, f"{columns * rows} tags are needed, and tag36h11 holds {held}")
    return Board("aprilgrid", columns, rows, float(f"{share * tag:.12g}"), tag, TAG_DICTIONARY)


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


# --- Kalibr's own description of a board (``target_type: aprilgrid``) in perchctl's notation ---


def kalibr_notation(path: Path) -> str:
    """``aprilgrid:6x6:88mm:0.3`` from the file that is given to Kalibr as --target.

    Raises NotFound, InvalidValue.
    """
    try:
        keys = parse_yaml(path.read_text(encoding="utf-8"))
        if not isinstance(keys, dict):
            raise ValueError("it holds no keys and values")
        if keys["target_type"] == "aprilgrid":
            counts, side_mm = f"{keys['tagCols']}x{keys['tagRows']}", 1e3 * float(keys["tagSize"])
            return f"aprilgrid:{counts}:{side_mm:.9g}mm:{float(keys['tagSpacing']):g}"
        if keys["target_type"] == "checkerboard":
            # It counts inner corners, as perchctl does.
            sides = keys["colSpacingMeters"], keys["rowSpacingMeters"]
            if sides[0] == sides[1]:
                counts = f"{keys['targetCols']}x{keys['targetRows']}"
                return f"chessboard:{counts}:{1e3 * float(sides[0]):.9g}mm"
        why = "it must be an aprilgrid, or a checkerboard with square squares"
    except FileNotFoundError:
        raise NotFound(f"board file {path} does not exist") from None
    except KeyError as error:
        why = f"{error.args[0]} is missing"
    except UnicodeDecodeError:
        why = "not a text file"
    except (OSError, TypeError, ValueError) as error:
        why = str(error)[:_MOST_CHARACTERS]
    raise InvalidValue(f"{path}: cannot be read as Kalibr's board: {why}")


# --- What of a board is black ------------------------------------------------------------------


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
