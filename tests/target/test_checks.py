"""What is refused before it is printed, and lengths and boards as they are written."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.errors import InvalidValue
from perchctl.target import Board, parse_length
from perchctl.target.boards import black_squares, board_rectangles
from perchctl.target.reading import check_target
from perchctl.target.sheets import parse_page
from tests.target.rig import target_of

REFUSED = {
    "magnet too small": (target_of(small=("DICT_ARUCO_ORIGINAL", 5, 36.0)), 0.05,
                         "at most --small 35.3mm"),
    "magnet too large": (target_of(), 0.16, "does not fit behind the large marker"),
    "small too large": (target_of(small=("DICT_ARUCO_ORIGINAL", 5, 35.0)), 0.05,
                        "the large marker cannot be read from this drawing: take a smaller "
                        "--small"),
    "black centre": (target_of(("DICT_4X4_50", 1, 150.0), ("DICT_ARUCO_ORIGINAL", 5, 30.0)), 0.05,
                     "cannot be read .*white in the middle"),
    "centre too fine": (target_of(("DICT_6X6_250", 19, 120.0), ("DICT_5X5_50", 7, 20.0)), 0.05,
                        "cannot be read"),
    "alike": (target_of(("DICT_4X4_1000", 496, 150.0), ("DICT_4X4_50", 5, 25.0)), 0.05,
              "nearly the same pattern"),
    "no heading": (target_of(small=("DICT_ARUCO_ORIGINAL", 1023, 25.0)), 0.05,
                   "looks the same when turned"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_work_is_refused(name: str) -> None:
    check_target(target_of(), 0.05)
    check_target(target_of(large=("DICT_4X4_50", 0, 150.0)), 0.05)
    target, magnet_m, said = REFUSED[name]
    with pytest.raises(InvalidValue, match=said):
        check_target(target, magnet_m)


@pytest.mark.parametrize(
    ("text", "metres"),
    [
        ("150mm", 0.15),
        ("15cm", 0.15),
        ("0.15m", 0.15),
        (" 24.9 mm ", 0.0249),
        (".5cm", 0.005),
        ("149.6", 0.1496),
    ],
)
def test_lengths(text: str, metres: float) -> None:
    assert parse_length(text, "--large", bare_unit="mm") == metres


@pytest.mark.parametrize(
    ("text", "said"),
    [("150", "no unit; write 150mm"), ("15in", "unit 'in'"), ("0mm", "more than zero"),
     ("-3mm", "not a length"), ("wide", "not a length"), ("1e999m", "more than zero")],
)  # fmt: skip
def test_a_length_is_refused_with_what_is_meant(text: str, said: str) -> None:
    with pytest.raises(InvalidValue, match=said):
        parse_length(text, "--large")


def test_pages() -> None:
    assert parse_page("A4") == (210.0, 297.0)
    assert parse_page("220x240mm") == (220.0, 240.0)
    assert parse_page("21 x 29.7 cm") == (210.0, 297.0)
    for text in ("a7", "220x240", "0x10mm", "1.2.3x4mm"):
        with pytest.raises(InvalidValue, match="page"):
            parse_page(text)


boards = st.one_of(
    st.builds(
        Board,
        st.just("chessboard"),
        st.integers(3, 30),
        st.integers(3, 30),
        st.integers(50, 900).map(lambda tenths: tenths / 1e4),
    ),
    st.builds(
        lambda columns, rows, square, share: Board(
            "charuco", columns, rows, square, round(square * share, 5), "DICT_6X6_1000"
        ),
        st.integers(3, 20),
        st.integers(3, 20),
        st.integers(50, 900).map(lambda tenths: tenths / 1e4),
        st.floats(0.4, 0.94),
    ),
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(boards)
def test_a_board_s_notation_reads_back(board: Board) -> None:
    assert Board.parse(board.notation()) == board
    width, height = (round(1e3 * side * 1.003, 3) for side in board.size_m)
    measured, _ = board.with_sides(f"{width}x{height}mm")
    again = Board.parse(measured.notation())
    assert again.scale == pytest.approx(measured.scale, rel=1e-5)
    assert again.notation() == measured.notation()


def test_a_measured_print_moves_the_corners_along_each_side_for_itself() -> None:
    meant = Board.parse("charuco:10x7:25mm:18mm:DICT_5X5_100")
    board, notes = meant.with_sides("246.5x175.7")
    assert board.corners_m() == pytest.approx(
        meant.corners_m() * [246.5 / 250, 175.7 / 175, 1.0], abs=1e-12
    )
    assert notes[0] == "width: 246.5 mm, -1.40 % against 250 mm"
    assert "was the page scaled" in notes[1]
    assert len(notes) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("chessboard:9x6", "COLUMNSxROWS:SQUARE"),
        ("chessboard:9x6:25", "no unit"),
        ("chessboard:2x6:25mm", "3 to 100"),
        ("circles:9x6:25mm", "chessboard:COLUMNSxROWS"),
        ("chessboard:9x6:25mm:measured=25x17cm", "not WIDTHxHEIGHT in mm"),
        ("chessboard:9x6:25mm:measured=25x17.5mm", "-90 % off the 250 mm"),
        ("charuco:10x7:25mm", "MARKER:DICTIONARY"),
        ("charuco:10x7:25mm:25mm:DICT_5X5_100", "needs white around it"),
        ("charuco:10x7:25mm:18mm:DICT_9X9", "is unknown"),
        ("charuco:20x17:25mm:18mm:DICT_5X5_100", "170 markers are needed"),
        ("charuco:10x7:25mm:18mm:DICT_5X5_100:old", "neither"),
        ("", "neither"),
    ],
)
def test_a_wrong_notation_is_one_sentence(text: str, said: str) -> None:
    with pytest.raises(InvalidValue, match=said) as refused:
        Board.parse(text)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "notation", ["charuco:5x6:20mm:15mm:DICT_4X4_50", "charuco:6x5:20mm:15mm:DICT_4X4_50"]
)
def test_charuco_boards_are_drawn_as_opencv_draws_them(notation: str) -> None:
    board = Board.parse(notation)
    px_per_square = 240  # 30 px a cell of the markers
    columns, rows = board.squares
    size = (columns * px_per_square, rows * px_per_square)
    theirs = np.asarray(board.cv2_board().generateImage(size))
    scale = px_per_square / board.square_m
    width, height = board.size_m
    mine = np.full_like(theirs, 255)
    for r in board_rectangles(board):
        across = slice(*(round((x + width / 2) * scale) for x in (r.x0_m, r.x1_m)))
        down = slice(*(round((height / 2 - y) * scale) for y in (r.y1_m, r.y0_m)))
        mine[down, across] = 0
    assert np.array_equal(mine, theirs)
    assert board.corners_m() == pytest.approx(board.cv2_board().getChessboardCorners(), abs=1e-7)


def test_a_chessboard_has_one_more_square_than_corners() -> None:
    board = Board.parse("chessboard:9x6:25mm")
    assert black_squares(board).shape == (7, 10)
    assert board.corners_m().shape == (54, 3)
    assert board.corners_m()[0] == pytest.approx([0.0, 0.0, 0.0])
