"""Which board a picture shows: either layout of the named one, or another one, named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.calibration import FoundViews, find_views
from perchctl.calibration.board.detect import BoardView, find_board
from perchctl.calibration.board.recognise import describe_other_board
from perchctl.camera import Grey
from perchctl.errors import InvalidValue
from perchctl.target import Board

SQUARE_PX = 32
EVEN = "charuco:8x6:30mm:22mm:DICT_4X4_50"


def sheet(board: Board, turn_deg: float = 0.0) -> Grey:
    """The board as OpenCV draws it, on a larger grey sheet, turned by that."""
    columns, rows = board.squares
    size = (columns * SQUARE_PX, rows * SQUARE_PX)
    if board.kind == "charuco":
        drawn = board.cv2_board().generateImage(size)
    else:
        dark = np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 0
        drawn = np.where(dark, 0, 255).astype(np.uint8)
        drawn = drawn.repeat(SQUARE_PX, 0).repeat(SQUARE_PX, 1)
    picture = np.pad(drawn, SQUARE_PX, constant_values=255)
    picture = np.pad(picture, SQUARE_PX, constant_values=120)
    h, w = picture.shape
    M = cv2.getRotationMatrix2D((w / 2, h / 2), turn_deg, 0.9)
    turned = cv2.warpAffine(picture, M, (w, h), flags=cv2.INTER_AREA, borderValue=120)
    return np.asarray(cv2.GaussianBlur(turned, (0, 0), 0.8), np.uint8)


def found(pictures: list[Grey], named: str, folder: Path) -> FoundViews:
    for i, picture in enumerate(pictures):
        cv2.imwrite(f"{folder}/{i}.png", picture)
    return find_views(sorted(folder.iterdir()), Board.parse(named))


@pytest.mark.parametrize("shown", [f"{EVEN}:legacy", EVEN])
@pytest.mark.parametrize("named", [f"{EVEN}:legacy", EVEN])
def test_both_layouts_are_found_whichever_is_named(shown: str, named: str) -> None:
    board = Board.parse(shown)
    view = find_board(sheet(board, 5.0), Board.parse(named))
    assert isinstance(view, BoardView)
    assert len(view) == 7 * 5
    assert view.legacy == board.legacy
    assert FoundViews((view,)).layout_of(Board.parse(named)) == board
    # The corners are where the drawing has them, up to the sheet's turn and scale.
    M, _ = cv2.estimateAffinePartial2D(view.corners_m[:, :2] * 1e3, view.corners_px)
    placed = np.column_stack([view.corners_m[:, :2] * 1e3, np.ones(len(view))]) @ M.T
    assert np.abs(placed - view.corners_px).max() < 0.1


def test_a_board_with_an_odd_number_of_rows_has_one_layout() -> None:
    odd = Board.parse("charuco:8x5:30mm:22mm:DICT_4X4_50:legacy")
    assert odd == Board.parse("charuco:8x5:30mm:22mm:DICT_4X4_50")
    assert not Board.parse("chessboard:9x6:25mm").has_two_layouts


def test_views_in_another_layout_than_most_are_left_out(tmp_path: Path) -> None:
    board = Board.parse(EVEN)
    pictures = [sheet(board, turn) for turn in (0.0, 5.0)]
    seen = found([*pictures, sheet(replace(board, legacy=True))], EVEN, tmp_path)
    assert [view.name for view in seen.views] == ["0.png", "1.png"]
    ((name, reason),) = ((r.view, r.reason) for r in seen.without_board)
    assert (name, reason) == (
        "2.png",
        "its markers have a different layout from those in most images",
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("shown", "named", "said"),
    [
        (
            "chessboard:9x6:25mm",
            "chessboard:10x7:25mm",
            "a chessboard of 9x6 inner corners, which are 10x7 squares: "
            "--board chessboard:9x6:25mm",
        ),
        (
            "chessboard:9x6:25mm",
            "chessboard:8x5:25mm",
            "a chessboard of 9x6 inner corners: --board chessboard:9x6:25mm",
        ),
        (
            "chessboard:9x6:25mm",
            "charuco:10x7:25mm:18mm:DICT_5X5_100",
            "a chessboard of 9x6 inner corners: --board chessboard:9x6:25mm",
        ),
        (
            "charuco:10x7:25mm:18mm:DICT_5X5_100",
            "chessboard:9x6:25mm",
            "a ChArUco board of 10x7 squares: --board charuco:10x7:25mm:MARKER:DICT_5X5_50",
        ),
        (
            f"{EVEN}:legacy",
            "charuco:6x8:30mm:22mm:DICT_4X4_50",
            f"a ChArUco board of 8x6 squares: --board {EVEN}",
        ),
        (
            EVEN,
            "charuco:8x6:30mm:22mm:DICT_6X6_50",
            f"a ChArUco board of 8x6 squares: --board {EVEN}",
        ),
    ],
)
def test_another_board_is_named(shown: str, named: str, said: str, tmp_path: Path) -> None:
    seen = found([sheet(Board.parse(shown), 4.0)], named, tmp_path)
    assert not seen.views
    assert seen.other_board == said


def april_grid() -> Grey:
    """Kalibr's target: tags with a border of two cells."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    picture = np.full((420, 420), 255, np.uint8)
    for i in range(9):
        tag = cv2.aruco.generateImageMarker(dictionary, i, 100, borderBits=2)
        y, x = 30 + 130 * (i // 3), 30 + 130 * (i % 3)
        picture[y : y + 100, x : x + 100] = tag
    return picture


@pytest.mark.parametrize(
    ("picture", "named", "said"),
    [
        pytest.param(april_grid(), EVEN, "an AprilGrid", marks=pytest.mark.long),
        (np.full((300, 400), 120, np.uint8), EVEN, ""),
        # A part of the right board is no other board.
        (sheet(Board.parse(EVEN))[64:160, 64:160], EVEN, ""),
        (sheet(Board.parse("chessboard:4x3:25mm"))[:120], "chessboard:4x3:25mm", ""),
    ],
)
def test_what_is_unsure_is_not_named(picture: Grey, named: str, said: str, tmp_path: Path) -> None:
    seen = found([picture], named, tmp_path)
    assert not seen.views
    assert seen.other_board.startswith(said) if said else not seen.other_board


@pytest.mark.parametrize(
    "rows",
    [
        pytest.param(slice(None), marks=pytest.mark.long),
        pytest.param(slice(64, 230), marks=pytest.mark.long),
        slice(56, 104),
    ],
)
def test_the_named_board_is_no_other_one(rows: slice) -> None:
    """Nor is a part of it, or the chessboard that its squares make."""
    board = Board.parse(EVEN)
    assert describe_other_board([sheet(board)[rows]], board) == ""


def test_all_pictures_of_another_size_are_named_before_the_search(tmp_path: Path) -> None:
    """No board is needed for it."""
    sizes = {"a": (48, 64), "b": (49, 65), "c": (48, 64), "d": (64, 48), "e": (48, 64)}
    for name, size in sizes.items():
        cv2.imwrite(f"{tmp_path}/{name}.png", np.full(size, 90, np.uint8))
    (tmp_path / "f.png").write_bytes(b"no picture")
    said = "3 of 5 images are 64x48 px, but b.png is 65x49 px, d.png is 48x64 px: "
    with pytest.raises(InvalidValue, match=said):
        find_views(sorted(tmp_path.iterdir()), Board.parse(EVEN))
