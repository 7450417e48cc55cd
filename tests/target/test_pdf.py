"""The printed page: true to size, centred, the same bytes for the same target."""

from __future__ import annotations

import datetime
import itertools
import re

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.profile import TargetConfig
from perchctl.target import Board, parse_board
from perchctl.target.page import (
    OVERLAP,
    PAGES_MM,
    UNPRINTABLE,
    Circle,
    Filled,
    Item,
    Line,
    Page,
    Polygon,
    Text,
    parse_page,
    pdf_bytes,
    tile_page,
)
from perchctl.target.page import text_width as width_of
from perchctl.target.reading import PlainReader
from perchctl.target.sheets import board_page, target_pages
from tests.helpers.raster import PX_PER_MM, black_runs_mm, page_picture
from tests.target.rig import sized, target_of

TARGET = TargetConfig()
MAGNET_M = 0.05
TOLERANCE_MM = 0.05
PAGES = ("a4", "letter", "220x240mm")


def pages_of(target: TargetConfig, page: str) -> tuple[Page, Page]:
    return target_pages(target, parse_page(page), MAGNET_M, "profile sim")


def refined(picture: NDArray[np.uint8], corners: NDArray[np.float32]) -> NDArray[np.float64]:
    """Each side as a line through its grey edge, intersected; (4, 2) mm on the page."""
    lines = []
    for a, b in itertools.pairwise([*corners, corners[0]]):
        level = abs(b[0] - a[0]) > abs(b[1] - a[1])
        along, across = (0, 1) if level else (1, 0)
        at = np.linspace(a[along], b[along], 21)[2:-2]
        places = []
        for position in at:
            line = picture[:, round(position)] if level else picture[round(position)]
            ends = np.array(black_runs_mm(line)).ravel()
            places.append(ends[np.abs(ends - (a[across] + 0.5) / PX_PER_MM).argmin()])
        lines.append(float(np.median(places)))
        assert np.ptp(places) < 0.02, "straight and parallel to the paper"
    top, right, bottom, left = lines
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


@pytest.mark.parametrize("page", PAGES)
def test_the_pdf_at_600_dpi_is_read_and_true_to_size(page: str) -> None:
    width, height = parse_page(page)
    pdf = pdf_bytes(pages_of(TARGET, page), "target")
    picture = page_picture(pdf, 0)
    assert picture.shape == pytest.approx((height * PX_PER_MM, width * PX_PER_MM), abs=1.0)
    centre = np.array([width, height]) / 2.0
    found = PlainReader(TARGET).read(picture)
    assert set(found) == {"large", "small"}
    for name, side_mm in (("large", 150.0), ("small", 25.0)):
        rough = found[name]  # type: ignore[index]
        assert rough[0, 0] < rough[1, 0], "upright: the first corner is at the top left"
        assert rough[0, 1] < rough[3, 1]
        corners = refined(picture, rough)
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        assert np.abs(sides - side_mm).max() < TOLERANCE_MM
        assert np.abs(corners.mean(axis=0) - centre).max() < TOLERANCE_MM
        # And as the detector alone has them: its corners sit on whole pixels.
        plain = np.linalg.norm(rough - np.roll(rough, 1, axis=0), axis=1) / PX_PER_MM
        assert np.abs(plain - side_mm).max() < 2.0 / PX_PER_MM


@pytest.mark.parametrize("page", PAGES)
def test_the_back_s_cross_is_over_the_front_s_centre(page: str) -> None:
    """Turned about either axis of the paper."""
    width, height = parse_page(page)
    picture = page_picture(pdf_bytes(pages_of(TARGET, page), "target"), 1)
    radius = 500.0 * MAGNET_M
    off_px = round(0.6 * radius * PX_PER_MM)
    middle_row, middle_column = picture.shape[0] // 2, picture.shape[1] // 2
    row = black_runs_mm(picture[middle_row - off_px])
    column = black_runs_mm(picture[:, middle_column - off_px])

    def middle(runs: list[tuple[float, float]], near: float) -> float:
        return min((sum(run) / 2.0 for run in runs), key=lambda at: abs(at - near))

    x, y = middle(row, width / 2.0), middle(column, height / 2.0)
    front = page_picture(pdf_bytes(pages_of(TARGET, page), "target"), 0)
    small = refined(front, PlainReader(TARGET).read(front)["small"]).mean(axis=0)
    for turned_x, turned_y in ((width - x, y), (x, height - y)):
        assert turned_x == pytest.approx(small[0], abs=TOLERANCE_MM)
        assert turned_y == pytest.approx(small[1], abs=TOLERANCE_MM)
    # The circle, on a level chord through the upper half.
    chord = 2.0 * np.sqrt(radius**2 - (0.6 * radius) ** 2)
    circle = [sum(run) / 2.0 for run in row if abs(sum(run) / 2.0 - x) > 1.0]
    inner = sorted(circle, key=lambda at: abs(at - x))[:2]
    assert max(inner) - min(inner) == pytest.approx(chord, abs=0.1)


@pytest.mark.parametrize("page", PAGES)
def test_both_rulers_measure_100_mm(page: str) -> None:
    picture = page_picture(pdf_bytes(pages_of(TARGET, page), "target"), 0)
    rulers = {"across": 0, "upright": 0}
    for name, lines in (("across", picture), ("upright", picture.T)):
        for line in lines[:: round(0.1 * PX_PER_MM)]:
            for start, stop in black_runs_mm(np.ascontiguousarray(line)):
                # The line itself and half a tick at each end.
                if abs(stop - start - 100.2) < TOLERANCE_MM:
                    rulers[name] += 1
    assert min(rulers.values()) >= 1, rulers


def test_the_same_bytes_for_the_same_target() -> None:
    first, second = (
        pdf_bytes(pages_of(TARGET, "a4"), "target", datetime.date(2026, 3, 1)) for _ in range(2)
    )
    assert first == second
    assert first != pdf_bytes(pages_of(TARGET, "a4"), "target", datetime.date(2026, 3, 2))
    assert b"D:20260301" in first
    assert b"/PrintScaling /None" in first


def test_the_caption_says_what_is_printed() -> None:
    front, _ = target_pages(
        TARGET, (210.0, 297.0), MAGNET_M, "profile mine", datetime.date(2026, 3, 1)
    )
    text = " ".join(item.text for item in front.items if isinstance(item, Text))
    for part in ("150 mm DICT_4X4_1000 id 997", "25 mm DICT_ARUCO_ORIGINAL id 5", "profile mine",
                 "2026-03-01", "up"):  # fmt: skip
        assert part in text
    assert any(isinstance(item, Polygon) for item in front.items), "the arrow"


def box_of(item: Item) -> list[tuple[float, float, float, float]]:
    """Left, top, right, bottom of what an item covers."""
    match item:
        case Filled(boxes):
            return [(x, y, x + w, y + h) for x, y, w, h in boxes]
        case Line(x0, y0, x1, y1, w):
            return [(min(x0, x1) - w / 2, min(y0, y1) - w / 2, max(x0, x1) + w / 2,
                     max(y0, y1) + w / 2)]  # fmt: skip
        case Circle(x, y, r, w):
            return [(x - r - w / 2, y - r - w / 2, x + r + w / 2, y + r + w / 2)]
        case Polygon(points):
            xs, ys = zip(*points, strict=True)
            return [(min(xs), min(ys), max(xs), max(ys))]
        case Text(x, y, text, size, anchor, upwards):
            w = width_of(text, size)
            start = {"start": 0.0, "middle": w / 2, "end": w}[anchor]
            if upwards:
                return [(x - 0.75 * size, y + start - w, x + 0.22 * size, y + start)]
            return [(x - start, y - 0.75 * size, x - start + w, y + 0.22 * size)]


LAYOUTS = [
    (150.0, 25.0, "a4"), (150.0, 25.0, "letter"), (150.0, 25.0, "a3"), (150.0, 25.0, "220x240mm"),
    (120.0, 20.0, "a4"), (100.0, 15.0, "letter"), (60.0, 10.0, "a4"), (60.0, 10.0, "160x220mm"),
    (200.0, 30.0, "a3"),
]  # fmt: skip


@pytest.mark.parametrize(("large", "small", "page"), LAYOUTS)
@pytest.mark.parametrize("side", [0, 1])
def test_nothing_overlaps_and_all_is_printable(
    large: float, small: float, page: str, side: int
) -> None:
    sheet = pages_of(sized(large, small), page)[side]
    texts = [box for item in sheet.items if isinstance(item, Text) for box in box_of(item)]
    marks = [box for item in sheet.items if not isinstance(item, Text) for box in box_of(item)]
    for text in texts:
        for other in [*marks, *(t for t in texts if t is not text)]:
            apart = (text[2] <= other[0] or other[2] <= text[0] or text[3] <= other[1]
                     or other[3] <= text[1])  # fmt: skip
            assert apart, (text, other)
    for left, top, right, bottom in [*texts, *marks]:
        assert left >= 4.0
        assert top >= 4.0
        assert right <= sheet.width - 4.0
        assert bottom <= sheet.height - 4.0


@pytest.mark.parametrize(("large", "small", "page"), LAYOUTS)
def test_marks_lie_outside_of_the_quiet_zone(large: float, small: float, page: str) -> None:
    """At least half a cell of white on every side of the large marker."""
    front, _ = pages_of(sized(large, small), page)
    reach = large / 2.0 + large / 12.0
    for item in front.items:
        if isinstance(item, Filled):
            continue
        for left, top, right, bottom in box_of(item):
            x, y = front.width / 2.0, front.height / 2.0
            assert (right <= x - reach or left >= x + reach or bottom <= y - reach
                    or top >= y + reach), item  # fmt: skip


@pytest.mark.parametrize(("large", "page"), [(150.0, "150x150mm"), (300.0, "a4"), (60.0, "a7mm")])
def test_a_page_too_small_is_refused_with_the_one_that_fits(large: float, page: str) -> None:
    target = sized(large, 25.0)
    with pytest.raises(InvalidValue) as refused:
        pages_of(target, page)
    named = re.search(r"--page (\S+) holds it", str(refused.value))
    if named is not None:
        assert pages_of(target, named[1])[0].width > large
    else:
        assert "allowed are a4, letter, a3" in str(refused.value)


@pytest.mark.parametrize("notation", ["charuco:10x7:25mm:18mm:DICT_5X5_100", "chessboard:9x6:25mm"])
def test_a_printed_board_is_found_and_true_to_size(notation: str) -> None:
    board = parse_board(notation)
    page = board_page(board, parse_page("a4"))
    assert (page.width, page.height) == (297.0, 210.0), "turned, as it fits"
    picture = page_picture(pdf_bytes([page], "board"), 0, 200)
    corners = board_corners(board, picture)
    expected = board.corners_m()[:, :2] * 1e3
    shift = np.median(corners - expected, axis=0)
    assert np.abs(corners - expected - shift).max() < TOLERANCE_MM


def board_corners(board: Board, picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """All inner corners in the board's order, mm on the page."""
    if board.kind == "charuco":
        found, ids, _, _ = cv2.aruco.CharucoDetector(board.cv2_board()).detectBoard(picture)
        order = np.argsort(np.asarray(ids).ravel())
        corners = np.asarray(found, np.float32).reshape(-1, 2)[order]
    else:
        ok, found = cv2.findChessboardCorners(picture, board.corner_count)
        assert ok
        corners = np.asarray(found, np.float32).reshape(-1, 2)
        if corners[0, 0] > corners[-1, 0]:
            corners = corners[::-1]
    columns, rows = board.corner_count
    assert len(corners) == columns * rows
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    fine = cv2.cornerSubPix(
        picture, np.ascontiguousarray(corners).reshape(-1, 1, 2), (9, 9), (-1, -1), criteria
    )
    return np.asarray(fine, np.float64).reshape(-1, 2) * 25.4 / 200


def test_a_board_too_large_for_the_page_is_refused_with_one_that_holds_it() -> None:
    board = parse_board("charuco:10x7:30mm:22mm:DICT_5X5_100")
    with pytest.raises(InvalidValue, match="--page a3 holds it"):
        board_page(board, parse_page("a4"))
    assert board_page(board, parse_page("a3")).width == 420.0


def test_markers_of_other_dictionaries_are_printed_too() -> None:
    target = target_of(("DICT_4X4_50", 16, 120.0), ("DICT_5X5_50", 7, 20.0))
    picture = page_picture(pdf_bytes(pages_of(target, "a4"), "target"), 0, 200)
    assert set(PlainReader(target).read(picture)) == {"large", "small"}


# --- A page on several sheets: together they show all of it, and each seam twice ---------------


sizes = st.floats(60.0, 1500.0)


def shown_on(sheets: list[Page], size: tuple[float, float]) -> list[Circle]:
    """The circles in what a printer prints."""
    width, height = size
    assert all({page.width, page.height} == {width, height} for page in sheets)
    return [
        item
        for page in sheets
        for item in page.items
        if isinstance(item, Circle)
        and UNPRINTABLE - 1e-6 <= item.x + page.origin[0] <= page.width - UNPRINTABLE + 1e-6
        and UNPRINTABLE - 1e-6 <= item.y + page.origin[1] <= page.height - UNPRINTABLE + 1e-6
    ]


@given(sizes, sizes, st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.sampled_from(["a4", "a3"]))
def test_whatever_is_on_the_page_is_on_a_sheet(
    width: float, height: float, across: float, down: float, name: str
) -> None:
    """`radius` marks the spot: it is in view of one to four sheets."""
    spot = Circle(across * width, down * height, 1.0)
    whole = Page(width, height, (spot,))
    sheets = tile_page(whole, PAGES_MM[name])
    if sheets == [whole]:
        assert min(width, height) <= min(PAGES_MM[name])
        return
    assert 1 <= len(shown_on(sheets, PAGES_MM[name])) <= 4


def test_a_page_that_fits_stays_as_it_is() -> None:
    page = Page(297.0, 210.0, ())
    assert tile_page(page, PAGES_MM["a4"]) == [page]


def test_neighbours_share_the_seam_and_its_mark() -> None:
    page = Page(500.0, 250.0, (Text(250.0, 120.0, "x"),))
    left, right = tile_page(page, PAGES_MM["a3"])
    assert left.items == right.items
    (mark, _) = (item for item in left.items if isinstance(item, Line))
    assert mark.x0 + left.origin[0] - (left.width - UNPRINTABLE) == -OVERLAP / 2
    assert mark.x0 + right.origin[0] - UNPRINTABLE == OVERLAP / 2


def test_a_tiled_page_s_sheets_show_it_in_its_place_and_true_to_size() -> None:
    sheets = tile_page(pages_of(sized(150.0, 25.0), "450x460mm")[0], PAGES_MM["a3"])
    pdf = pdf_bytes(sheets, "target")
    found = 0
    for number, sheet in enumerate(sheets):
        quad = PlainReader(TARGET).read(page_picture(pdf, number, 200)).get("small")
        if quad is not None:
            found += 1
            corners = (quad + 0.5) * 25.4 / 200
            sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
            assert np.abs(sides - 25.0).max() < 2 * 25.4 / 200
            middle = np.array([225.0, 230.0]) + sheet.origin
            assert np.abs(corners.mean(axis=0) - middle).max() < 2 * 25.4 / 200
    assert 1 <= found < len(sheets)
