"""What is refused before it is printed, and lengths and boards as they are written."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.profile import MarkerConfig, TargetConfig
from perchctl.target import Board, draw_target, parse_length
from perchctl.target.drawing import marker_corners_m
from perchctl.target.prints import PrintCheck, size_ratio
from perchctl.target.reading import ArucoReader, check_target
from perchctl.target.sheets import parse_page
from perchctl.vision import CameraModel
from tests.target.rig import target_of

REFUSED = {
    "magnet too small": (target_of(small=("DICT_ARUCO_ORIGINAL", 5, 36.0)), 0.05,
                         "at most 35.3 mm"),
    "magnet too large": (target_of(), 0.16, "does not fit behind the large marker"),
    "small too large": (target_of(small=("DICT_ARUCO_ORIGINAL", 5, 35.0)), 0.05,
                        "the large marker cannot be read from this drawing: make the small "
                        "one smaller"),
    "black centre": (target_of(("DICT_4X4_50", 1, 150.0), ("DICT_ARUCO_ORIGINAL", 5, 30.0)), 0.05,
                     "cannot be read .*white in the middle"),
    "centre too fine": (target_of(("DICT_6X6_250", 19, 120.0), ("DICT_5X5_50", 7, 20.0)), 0.05,
                        "cannot be read"),
    "alike": (target_of(("DICT_4X4_1000", 496, 150.0), ("DICT_4X4_50", 5, 25.0)), 0.05,
              "nearly the same pattern"),
    "no heading": (target_of(small=("DICT_ARUCO_ORIGINAL", 1023, 25.0)), 0.05,
                   "looks the same when rotated"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_work_is_refused(name: str) -> None:
    check_target(target_of(), 0.05)
    check_target(target_of(large=("DICT_4X4_50", 0, 150.0)), 0.05)
    target, magnet_m, said = REFUSED[name]
    with pytest.raises(InvalidValue, match=said):
        check_target(target, magnet_m)


@pytest.mark.parametrize("text", ["150mm", "15cm", "0.15m", " 150.0 mm ", ".15m", "150"])
def test_lengths(text: str) -> None:
    assert parse_length(text, "--large", bare_unit="mm") == 0.15


@pytest.mark.parametrize("text", ["150", "15in", "0mm", "-3mm", "wide", "1e999m"])
def test_a_length_is_refused_with_what_is_meant(text: str) -> None:
    with pytest.raises(InvalidValue, match=r"no unit|unit 'in'|greater than zero|not a length"):
        parse_length(text, "--large")


def test_pages() -> None:
    assert parse_page("A4") == parse_page("21 x 29.7 cm") == (210.0, 297.0)
    assert parse_page("220x240mm") == (220.0, 240.0)
    for text in ("a7", "220x240", "0x10mm", "1.2.3x4mm"):
        with pytest.raises(InvalidValue, match="page"):
            parse_page(text)


boards = st.builds(
    lambda is_charuco, columns, rows, tenths, share, is_legacy: Board(
        "charuco" if is_charuco else "chessboard",
        columns,
        rows,
        tenths / 1e4,
        round(tenths / 1e4 * share, 5) if is_charuco else None,
        "DICT_6X6_1000" if is_charuco else None,
        legacy=is_legacy and is_charuco and rows % 2 == 0,
    ),
    st.booleans(),
    st.integers(3, 20),
    st.integers(3, 20),
    st.integers(50, 900),
    st.floats(0.4, 0.94),
    st.booleans(),
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(boards)
def test_a_board_s_notation_reads_back(board: Board) -> None:
    assert Board.parse(board.notation()) == board
    width, height = (round(1e3 * side * 1.003, 3) for side in board.size_m)
    measured, _ = board.with_measured_sides(f"{width}x{height}mm")
    again = Board.parse(measured.notation())
    assert again.scale == pytest.approx(measured.scale, rel=1e-5)
    assert again.notation() == measured.notation()


def test_a_measured_print_moves_the_corners_along_each_side_for_itself() -> None:
    meant = Board.parse("charuco:10x7:25mm:18mm:DICT_5X5_100")
    board, notes = meant.with_measured_sides("246.5x175.7")
    assert board.corners_m() == pytest.approx(
        meant.corners_m() * [246.5 / 250, 175.7 / 175, 1.0], abs=1e-12
    )
    assert notes[0] == "width: 246.5 mm, -1.40 % against 250 mm"
    assert "the page may have been scaled" in notes[1]
    assert len(notes) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("chessboard:9x6", "COLUMNSxROWS:SQUARE"),
        ("chessboard:9x6:25", "no unit"),
        ("chessboard:2x6:25mm", "3 to 100"),
        ("circles:9x6:25mm", "chessboard:COLUMNSxROWS"),
        ("chessboard:9x6:25mm:measured=25x17cm", "not WIDTHxHEIGHT in mm"),
        ("chessboard:9x6:25mm:measured=25x17.5mm", "90 % smaller than the 250 mm"),
        ("charuco:10x7:25mm:25mm:DICT_5X5_100", "needs a white margin"),
        ("charuco:10x7:25mm:18mm:DICT_9X9", "is unknown"),
        ("charuco:20x17:25mm:18mm:DICT_5X5_100", "170 markers are needed"),
        ("charuco:10x7:25mm:18mm:DICT_5X5_100:old", "must be chessboard"),
    ],
)
def test_a_wrong_notation_is_one_sentence(text: str, said: str) -> None:
    with pytest.raises(InvalidValue, match=said) as refused:
        Board.parse(text)
    assert "\n" not in str(refused.value)


# --- the drawing: cells, rectangles and bitmaps agree --------------------------------------------

targets = st.builds(
    lambda large_id, small_id, large_m, ratio: TargetConfig(
        large=MarkerConfig(dictionary="DICT_4X4_1000", id=large_id, side_m=large_m),
        small=MarkerConfig(
            dictionary="DICT_ARUCO_ORIGINAL", id=small_id, side_m=max(large_m * ratio, 0.004)
        ),
    ),
    st.integers(0, 999),
    st.integers(0, 1023),
    st.floats(0.05, 0.5),
    st.floats(0.1, 0.18),
)


def test_the_papers_target_in_millimetres() -> None:
    """And its rectangles lie where the bitmap is black."""
    drawing = draw_target(TargetConfig())
    assert drawing.sheet_side_m == pytest.approx(0.200)
    assert drawing.ring_m == pytest.approx(0.025 / 7)
    image = drawing.bitmap(1000.0)
    assert image.shape == (200, 200)
    black = image < 128
    assert not black[:25].any()
    assert black[25:175, 25:50].all(), "left border"
    centre = black[75:125, 75:125]
    assert not centre[:12].any(), "12.5 mm of quiet zone above the small marker"
    assert centre[13:37, 13:16].all(), "left border of the small marker"
    image = drawing.bitmap(2800.0)  # whole pixels for both markers' cells
    painted = np.full(image.shape, 255, np.uint8)
    for r in drawing.rectangles():
        across = np.rint(np.array([r.x0_m, r.x1_m]) * 2800.0 + len(image) / 2).astype(int)
        down = np.rint(len(image) / 2 - np.array([r.y1_m, r.y0_m]) * 2800.0).astype(int)
        painted[slice(*down), slice(*across)] = 0
    assert np.array_equal(painted, image)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(targets, st.floats(200.0, 3000.0))
def test_rectangles_are_disjoint_and_the_area_is_the_raster_s_at_any_resolution(
    target: TargetConfig, px_per_m: float
) -> None:
    drawing = draw_target(target)
    rectangles = drawing.rectangles()
    widths = np.diff(drawing.edges_m)
    area = float(widths @ drawing.black @ widths)
    assert sum((r.x1_m - r.x0_m) * (r.y1_m - r.y0_m) for r in rectangles) == pytest.approx(area)
    for i, a in enumerate(rectangles):
        for b in rectangles[:i]:
            apart_x = a.x1_m <= b.x0_m + 1e-12 or b.x1_m <= a.x0_m + 1e-12
            assert apart_x or a.y1_m <= b.y0_m + 1e-12 or b.y1_m <= a.y0_m + 1e-12
    size = int(np.ceil(drawing.sheet_side_m * px_per_m)) + 4
    for window_px in (1.0, 2.0):
        ink = drawing.ink_coverage(px_per_m, size, window_px)
        assert ink.min() >= -1e-12
        assert ink.max() <= 1.0 + 1e-12
        assert ink.sum() / px_per_m**2 == pytest.approx(area)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(targets)
def test_any_two_ids_are_both_read_from_the_bitmap(target: TargetConfig) -> None:
    """The white ring leaves the large marker readable and makes the small one so."""
    image = draw_target(target).bitmap(480.0 / target.large.side_m)
    assert set(ArucoReader(target).read(image)) == {"large", "small"}


# --- the ratio of the two prints, and when it is named an error ----------------------------------

TARGET = TargetConfig()
K = np.array([[380.0, 0.0, 321.5], [0.0, 380.6, 238.2], [0.0, 0.0, 1.0]])
CAMERA = CameraModel((640, 480), K, np.array([-0.17, 0.04, 0.0004, -0.0007, -0.003]))


def corners(
    scale: float, z_m: float, rng: np.random.Generator, sigma_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both markers, the small one printed `scale` times too large, tilted and turned."""
    rvec = np.array([np.pi, 0.0, 0.0]) + rng.normal(0.0, 0.08, 3)
    tvec = np.array([*rng.uniform(-0.02, 0.02, 2), z_m])
    quads = []
    for side in (TARGET.large.side_m, scale * TARGET.small.side_m):
        image, _ = cv2.projectPoints(marker_corners_m(side), rvec, tvec, CAMERA.K, CAMERA.dist)
        quads.append(image.reshape(-1, 2) + rng.normal(0.0, sigma_px, (4, 2)))
    return quads[0], quads[1]


def checked(scale: float, sigma_px: float, count: int, wrong: int = 0) -> PrintCheck:
    """A check of so many pictures, of which the last `wrong` show something else."""
    rng, check = np.random.default_rng(1), PrintCheck(CAMERA, TARGET)
    for k in range(count):
        large, small = corners(scale, float(rng.uniform(0.18, 0.26)), rng, sigma_px)
        check.add_corners(large, small + 3.0 * rng.normal(size=2) * (k >= count - wrong))
    return check


@pytest.mark.parametrize("scale", [0.97, 1.0, 1.02])
def test_exact_corners_give_the_exact_ratio(scale: float) -> None:
    large, small = corners(scale, 0.2, np.random.default_rng(4), 0.0)
    ratio = size_ratio(large, small, CAMERA, TARGET)
    assert ratio is not None
    assert ratio[0] == pytest.approx(scale, abs=1e-5)
    assert size_ratio(large, np.full((4, 2), np.nan), CAMERA, TARGET) is None
    assert size_ratio(*np.full((2, 4, 2), 300.0), CAMERA, TARGET) is None


def claimed(text: str) -> tuple[float, float]:
    """The ratio of the sides and its sigma, a share."""
    found = re.search(r"is ([0-9.]+) times as large.*sigma ([0-9.]+) %", text)
    assert found is not None, text
    return float(found[1]), float(found[2]) / 100


@pytest.mark.parametrize(
    ("scale", "wrong"), [(1.0, False), (1.001, False), (0.97, True), (1.02, True)]
)
def test_only_an_error_beyond_the_noise_is_named(scale: float, wrong: bool) -> None:
    verdict = checked(scale, 0.05, 60, wrong=6).verdict()
    assert verdict.is_wrong is wrong
    value, sigma = claimed(verdict.found)
    assert value == pytest.approx(scale / 6.0, abs=3.0 * sigma / 6.0 + 1e-4)
    assert ("--measured-small" in verdict.advice) is wrong


def test_noise_hides_a_small_error_more_frames_are_surer_and_few_say_nothing() -> None:
    few, many = (claimed(checked(1.02, 1.0, n).verdict().found)[1] for n in (10, 200))
    assert many < 0.4 * few
    assert not checked(1.006, 0.6, 6).verdict().is_wrong
    assert not checked(1.05, 0.05, 2).has_enough_frames
    assert "not checked" in checked(1.05, 0.05, 2).verdict().found
