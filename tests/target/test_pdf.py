"""The printed page: true to size, centred, the same bytes for the same target."""

from __future__ import annotations

import datetime
import itertools
import re

import cv2
import numpy as np
import pypdfium2  # type: ignore[import-untyped]
import pytest
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.profile import TargetConfig
from perchctl.target import Board, parse_board
from perchctl.target.page import (
    Circle,
    Filled,
    Item,
    Line,
    Page,
    Polygon,
    Text,
    parse_page,
    pdf_bytes,
)
from perchctl.target.page import text_width as width_of
from perchctl.target.reading import PlainReader
from perchctl.target.sheets import board_page, target_pages
from tests.target.rig import sized

DPI = 600
PX_PER_MM = DPI / 25.4
TARGET = TargetConfig()
MAGNET_M = 0.05
TOLERANCE_MM = 0.05
PAGES = ("a4", "letter", "220x240mm")


def page_picture(pdf: bytes, page: int, dpi: int = DPI) -> NDArray[np.uint8]:
    document = pypdfium2.PdfDocument(pdf)
    try:
        bitmap = document[page].render(scale=dpi / 72.0, grayscale=True)
        return np.array(bitmap.to_numpy(), np.uint8).reshape(bitmap.height, bitmap.width)
    finally:
        document.close()


def black_runs_mm(line: NDArray[np.uint8]) -> list[tuple[float, float]]:
    """Start and end of every dark run of a row or column, mm, from the grey at its ends."""
    dark = line < 128
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dark, [False]]).astype(int)))
    ink = 1.0 - line.astype(float) / 255.0
    runs = []
    for start, stop in edges.reshape(-1, 2):
        before = ink[start - 1] if start > 0 else 0.0
        after = ink[stop] if stop < len(line) else 0.0
        low = start + (1.0 - ink[start]) - before
        high = stop - (1.0 - ink[stop - 1]) + after
        runs.append((low * 25.4 / DPI, high * 25.4 / DPI))
    return runs


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
def test_the_back_s_cross_and_circle_are_over_the_front_s_centre(page: str) -> None:
    """That is the middle of the paper, whichever way the sheet is turned."""
    width, height = parse_page(page)
    picture = page_picture(pdf_bytes(pages_of(TARGET, page), "target"), 1)
    radius = 500.0 * MAGNET_M
    off_px = round(0.6 * radius * PX_PER_MM)
    lines = picture[picture.shape[0] // 2 - off_px], picture[:, picture.shape[1] // 2 - off_px]
    chord = 2.0 * np.sqrt(radius**2 - (0.6 * radius) ** 2)
    for line, middle in zip(lines, (width / 2.0, height / 2.0), strict=True):
        marks = sorted(sum(run) / 2.0 - middle for run in black_runs_mm(line))
        near = [mark for mark in marks if abs(mark) < 0.7 * chord]
        assert near == pytest.approx([-chord / 2.0, 0.0, chord / 2.0], abs=0.05)


@pytest.mark.parametrize("page", PAGES)
def test_both_rulers_measure_100_mm(page: str) -> None:
    """Each is the line itself and half a tick at each end."""
    picture = page_picture(pdf_bytes(pages_of(TARGET, page), "target"), 0)
    for lines in (picture, picture.T):
        runs = (
            black_runs_mm(np.ascontiguousarray(line)) for line in lines[:: round(0.1 * PX_PER_MM)]
        )
        lengths = [stop - start for found in runs for start, stop in found]
        assert any(abs(length - 100.2) < TOLERANCE_MM for length in lengths)


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


Box = tuple[float, float, float, float]
"""Left, top, right, bottom."""


def box_of(item: Item) -> list[Box]:
    """What an item covers."""
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
def test_nothing_overlaps_all_is_printable_and_half_a_cell_stays_white(
    large: float, small: float, page: str, side: int
) -> None:
    sheet = pages_of(sized(large, small), page)[side]
    texts = [box for item in sheet.items if isinstance(item, Text) for box in box_of(item)]
    marks = [box for item in sheet.items if not isinstance(item, Text) for box in box_of(item)]

    def apart(a: Box, b: Box) -> bool:
        return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]

    for text in texts:
        assert all(apart(text, other) for other in [*marks, *texts] if other is not text), text
    for left, top, right, bottom in [*texts, *marks]:
        assert min(left, top, sheet.width - right, sheet.height - bottom) >= 4.0
    if side == 0:
        x, y, reach = sheet.width / 2.0, sheet.height / 2.0, large / 2.0 + large / 12.0
        white = (x - reach, y - reach, x + reach, y + reach)
        beside = (item for item in sheet.items if not isinstance(item, Filled))
        assert all(apart(box, white) for item in beside for box in box_of(item))


@pytest.mark.parametrize(
    ("large", "page"),
    [(150.0, "150x150mm"), (150.0, "196x297mm"), (300.0, "a4"), (60.0, "a7mm")],
)
def test_a_page_too_small_is_refused_with_the_one_that_fits(large: float, page: str) -> None:
    """196 mm leave less than half a cell of white around 150 mm and inside of the rulers."""
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
