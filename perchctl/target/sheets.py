"""The pages to print, true to size: the target's front and back, or a board.

The target's centre is the page's centre, so the cross on the back lies over the front's centre
whichever way the sheet is turned over. Page axes: origin at the top left corner of the paper, x
right, y down, mm.
"""

from __future__ import annotations

import datetime
import itertools
import math
import re
from collections.abc import Sequence
from typing import cast

from fpdf import FPDF
from fpdf.enums import MethodReturnValue, PathPaintRule
from fpdf.prefs import ViewerPreferences

from perchctl.errors import InvalidValue
from perchctl.profile import MarkerConfig, TargetConfig
from perchctl.target.boards import Board, board_rectangles
from perchctl.target.drawing import Rectangle, draw_target, marker_cells, mm_text, parse_length
from perchctl.target.reading import check_target

PAGES_MM: dict[str, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "letter": (215.9, 279.4),
    "a3": (297.0, 420.0),
}
"""Named page sizes, in portrait; if a page is too small, the first of these that fits is
proposed."""
MOST_PAGE = 5000.0
"""Largest side of a page, mm: a page in a PDF can be at most 5.08 m long."""
UNPRINTABLE = 5.0
"""Width of the unprintable margin of many printers, mm."""
MIN_QUIET_CELLS = 0.5
"""Smallest white margin around the large marker, in cells of this marker. One cell is printed if
the page has room for it. Down to half a cell, the detection range stays the same (the marker is
found at 32 px and above; with 0.3 cells, at 36 px and above)."""

_PT_PER_MM = 72.0 / 25.4
RULER = 100.0
_GAP = 1.5  # between the sheet's edge and a ruler
_TICK, _HALF_TICK, _FINE_TICK = 3.5, 2.4, 1.4
_LABEL = 2.5
_RULER_DEPTH = _GAP + _TICK + 0.6 + _LABEL
_RULER_REACH = RULER / 2 + 7.0  # including the label at its end
_MARK_GAP, _MARK = 1.0, 5.0
_TEXT, _LINE = 2.8, 4.0
_ARROW = ((0.0, 10.0), (2.5, 5.5), (0.6, 5.5), (0.6, 0.0), (-0.6, 0.0), (-0.6, 5.5), (-2.5, 5.5))


def target_pdf(
    target: TargetConfig,
    page: str,
    magnet_m: float,
    origin: str = "",
    date: datetime.date | None = None,
) -> bytes:
    """The target's sheet, front and back, as a PDF; the same bytes for the same target.

    The quiet zone is the largest, up to one cell, that leaves room for rulers and caption.

    Args:
        page: ``a4``, ``letter``, ``a3`` or a size such as ``220x240mm``.
        magnet_m: diameter of the magnet, whose outline is drawn on the back.
        origin: where the sizes come from, for the caption.

    Raises InvalidValue if the target cannot be read, or if the page is too small; the message then
    names a page that fits.
    """
    check_target(target, magnet_m)
    size = parse_page(page)
    # Replace characters that Helvetica lacks.
    origin = origin.encode("latin-1", errors="replace").decode("latin-1")
    texts = _caption(target, origin, date)
    place = _layout_on(target, size, texts)
    if place is None:
        raise InvalidValue(
            f"a target of {1e3 * target.large.side_m:g} mm with its margin and rulers does "
            f"not fit on {page}; use --page {_fitting_page(target, texts)}"
        )
    pdf = _Paper(*size, f"perchctl target, {mm_text(target.large.side_m)} mm", 2, date)
    _draw_front(pdf, target, *place)
    _draw_back(pdf, place[0], magnet_m)
    return bytes(pdf.output())


def board_pdf(board: Board, page: str) -> bytes:
    """A board in the middle of the page, in portrait or landscape, whichever fits, with rulers, as
    a PDF; `page` as in `target_pdf`. Raises InvalidValue if the board does not fit."""
    width, height = (1e3 * side for side in board.size_m)
    side = UNPRINTABLE + _RULER_DEPTH
    needed = (max(width, 2 * _RULER_REACH) + 2 * side, max(height, 2 * _RULER_REACH) + 2 * side)
    size = parse_page(page)
    held = _holding(needed, size)
    if held is None:
        named = next((name for name, size in PAGES_MM.items() if _holding(needed, size)), None)
        raise InvalidValue(
            f"a board of {width:g} x {height:g} mm with its rulers does not fit on {page}; "
            f"use --page {named or _page_text(*needed)}"
        )
    pdf = _Paper(*held, f"perchctl {board.notation()}", 1, None)
    pdf.start()
    pdf.fill(board_rectangles(board))
    texts = (
        f"perchctl {board.notation()}   Print at 100 %, not scaled: both rulers must "
        "measure 100 mm.",
        f"Then measure the black area ({width:g} x {height:g} mm), and pass its size "
        "to perchctl calibrate: --board "
        f"{board.notation()}:measured=WIDTHxHEIGHTmm.",
    )
    left = max(UNPRINTABLE, pdf.cx - width / 2)
    lines = wrap_texts(texts, _LABEL, held[0] - UNPRINTABLE - left)
    base = pdf.cy - height / 2 - 2.5 - 3.2 * (len(lines) - 1)
    for i, line in enumerate(lines):
        pdf.write_line(left, base + 3.2 * i, line, _LABEL)
    _draw_rulers(pdf, max(width / 2, _RULER_REACH), max(height / 2, _RULER_REACH))
    return bytes(pdf.output())


# --- Pages and their texts ---


def parse_page(text: str) -> tuple[float, float]:
    """Return width and height in mm of ``a4``, ``letter``, ``a3`` or ``220x240mm``.

    Raises InvalidValue.
    """
    named = PAGES_MM.get(text.strip().lower())
    if named is not None:
        return named
    match = re.fullmatch(r"\s*([0-9.]+)\s*x\s*([0-9.]+)\s*([a-zA-Z]*)\s*", text)
    if match is None:
        raise InvalidValue(
            f"page {text!r} is unknown; allowed are {', '.join(PAGES_MM)}, or a size such as "
            f"220x240mm"
        )
    width, height = (
        round(1e3 * parse_length(number + match[3], f"page {text}"), 6)
        for number in match.groups()[:2]
    )
    if max(width, height) > MOST_PAGE:
        raise InvalidValue(f"page {text!r} is too large: at most {MOST_PAGE:g} mm per side")
    return width, height


def _page_text(width: float, height: float) -> str:
    return f"{math.ceil(width)}x{math.ceil(height)}mm"


def _holding(needed: tuple[float, float], page: tuple[float, float]) -> tuple[float, float] | None:
    for width, height in (page, page[::-1]):
        if width >= needed[0] - 1e-9 and height >= needed[1] - 1e-9:
            return width, height
    return None


def _caption(target: TargetConfig, origin: str, date: datetime.date | None) -> tuple[str, ...]:
    def named(marker: MarkerConfig) -> str:
        return f"{mm_text(marker.side_m)} mm {marker.dictionary} id {marker.id}"

    dated = f", {date.isoformat()}" if date else ""
    return (
        f"perchctl target:  large {named(target.large)},  small {named(target.small)}"
        + (f"  ({origin}{dated})" if origin else ""),
        "FRONT: this side faces the floor. Its x axis points right, y down.",
        "Print at 100 %, not scaled: both rulers must measure 100 mm. Cut along the "
        "corner marks, and glue the magnet to the back.",
        "Then measure the black squares, and write their sides to the profile with "
        "perchctl make-target measured.",
    )


def _layout_on(
    target: TargetConfig, page: tuple[float, float], texts: Sequence[str]
) -> tuple[float, list[str]] | None:
    """Return half the cut sheet's side, mm, and caption lines; None if the target does not fit."""
    side, cell = _side_and_cell(target)
    width, height = page
    # On a page that is narrower than its rulers, there may be no room for a word of the caption.
    if min(page) / 2 - UNPRINTABLE < _ruler_half(side / 2):
        return None
    lines, below = _caption_room(texts, width)
    # If a small target's sheet ends inside the rulers, the page has room for a whole cell.
    half = min(width / 2 - _RULER_DEPTH, height / 2 - below) - UNPRINTABLE
    quiet = math.floor(2.0 * min(cell, half - side / 2) + 1e-6) / 2.0
    if quiet < MIN_QUIET_CELLS * cell - 1e-9 or half < _ruler_half(side / 2 + quiet) - 1e-9:
        return None
    return side / 2 + quiet, lines


def _side_and_cell(target: TargetConfig) -> tuple[float, float]:
    side = 1e3 * target.large.side_m
    return side, side / len(marker_cells(target.large))


def _ruler_half(half: float) -> float:
    if half >= _RULER_REACH:
        return half
    return max(half + _MARK_GAP + _MARK, _RULER_REACH)


def _caption_room(texts: Sequence[str], width: float) -> tuple[list[str], float]:
    """The caption's lines, and the room for rulers and caption below the sheet, mm."""
    lines = wrap_texts(texts, _TEXT, width - 2 * (UNPRINTABLE + _RULER_DEPTH))
    return lines, _RULER_DEPTH + 2.0 + _LINE * len(lines)


def _fitting_page(target: TargetConfig, texts: Sequence[str]) -> str:
    for name, size in PAGES_MM.items():
        if _layout_on(target, size, texts):
            return name
    side, cell = _side_and_cell(target)
    half = _ruler_half(side / 2 + math.ceil(2.0 * MIN_QUIET_CELLS * cell) / 2.0) + UNPRINTABLE
    width = math.ceil(2.0 * (half + _RULER_DEPTH))
    return _page_text(width, 2.0 * (half + _caption_room(texts, width)[1]))


# --- Drawing ---


class _Paper(FPDF):
    """Pages of one size, drawn in mm; print scaling is switched off in the viewer's preferences."""

    def __init__(
        self, width: float, height: float, title: str, pages: int, date: datetime.date | None
    ) -> None:
        super().__init__(unit="mm", format=(width, height))
        self.cx = width / 2.0
        self.cy = height / 2.0
        self._format = (width, height)
        self.set_auto_page_break(False)
        self.set_margin(0.0)
        self.set_title(title)
        self.set_producer("perchctl")
        # Not the current time, so that the same target always gives the same bytes.
        day = date or datetime.date(2000, 1, 1)
        self.set_creation_date(datetime.datetime.combine(day, datetime.time(), datetime.UTC))
        # Portrait pages are flipped on their long edge, which is the vertical one.
        duplex = "DuplexFlipLongEdge" if height >= width else "DuplexFlipShortEdge"
        self.viewer_preferences = ViewerPreferences(
            print_scaling="None", duplex=duplex if pages == 2 else None
        )

    def start(self) -> None:
        self.add_page(orientation="portrait", format=self._format)

    def fill(self, rectangles: Sequence[Rectangle]) -> None:
        """Draw black rectangles (m, y up, from the page's centre) as one path, so that viewers draw
        no hairlines between them."""
        with self.new_path(paint_rule=PathPaintRule.FILL_NONZERO) as path:
            path.style.fill_color = "#000000"
            path.style.stroke_color = None
            for r in rectangles:
                x = self.cx + 1e3 * r.x0_m
                y = self.cy - 1e3 * r.y1_m
                path.rectangle(x, y, 1e3 * (r.x1_m - r.x0_m), 1e3 * (r.y1_m - r.y0_m))

    def stroke(
        self, x0: float, y0: float, x1: float, y1: float, width: float = 0.2, dash: float = 0.0
    ) -> None:
        self.set_line_width(width)
        self.set_dash_pattern(dash=dash, gap=dash)
        self.line(x0, y0, x1, y1)

    def write_line(
        self,
        x: float,
        y: float,
        text: str,
        size: float = _TEXT,
        back: float = 0.0,
        turn_deg: float = 0.0,
    ) -> None:
        self.set_font("helvetica", size=size * _PT_PER_MM)
        with self.rotation(turn_deg, x, y):
            self.text(x - back * self.get_string_width(text), y, text)


def wrap_texts(texts: Sequence[str], font_mm: float, width_mm: float) -> list[str]:
    """Return the lines of all texts, broken between words to `width_mm` at font size `font_mm`."""
    pdf = FPDF(unit="mm")
    pdf.add_page()
    pdf.set_font("helvetica", size=font_mm * _PT_PER_MM)
    pdf.c_margin = 0.0
    lines: list[str] = []
    for text in texts:
        broken = pdf.multi_cell(width_mm, text=text, dry_run=True, output=MethodReturnValue.LINES)
        lines += cast(list[str], broken)
    return lines


def _draw_front(pdf: _Paper, target: TargetConfig, half: float, caption: list[str]) -> None:
    pdf.start()
    pdf.fill(draw_target(target).rectangles())
    _draw_cut_marks(pdf, half)
    ruler_half = _ruler_half(half)
    _draw_rulers(pdf, ruler_half, ruler_half)
    _draw_up_arrow(pdf, half)
    top = pdf.cy + ruler_half + _RULER_DEPTH + 2.0 + _TEXT
    for i, line in enumerate(caption):
        pdf.write_line(UNPRINTABLE + _RULER_DEPTH, top + _LINE * i, line)


def _draw_back(pdf: _Paper, half: float, magnet_m: float) -> None:
    pdf.start()
    cx, cy = pdf.cx, pdf.cy
    _draw_cut_marks(pdf, half)
    _draw_up_arrow(pdf, half)
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
    for (ax, ay), (bx, by) in itertools.pairwise(corners):
        pdf.stroke(cx + ax * half, cy + ay * half, cx + bx * half, cy + by * half, 0.15, 2.0)
    radius = 500.0 * magnet_m
    reach = radius + 6.0
    pdf.stroke(cx - reach, cy, cx + reach, cy)
    pdf.stroke(cx, cy - reach, cx, cy + reach)
    pdf.set_line_width(0.3)
    pdf.circle(cx, cy, radius)
    texts = (
        "BACK: this side faces the ceiling. Its x axis points left, y down.",
        f"Glue the magnet ({mm_text(magnet_m)} mm across) into the circle. The cross "
        "marks the centre of both markers.",
    )
    base = cy + half + _MARK_GAP + _MARK + 2.0 + _TEXT
    for i, line in enumerate(wrap_texts(texts, _TEXT, pdf.w - 2 * UNPRINTABLE)):
        pdf.write_line(cx, base + _LINE * i, line, back=0.5)


def _draw_rulers(pdf: _Paper, half_x: float, half_y: float) -> None:
    y = pdf.cy + half_y + _GAP
    x = pdf.cx - half_x - _GAP
    left = pdf.cx - RULER / 2
    low = pdf.cy + RULER / 2
    pdf.stroke(left, y, left + RULER, y)
    pdf.stroke(x, low, x, low - RULER)
    for mm in range(int(RULER) + 1):
        tick = _TICK if mm % 10 == 0 else _HALF_TICK if mm % 5 == 0 else _FINE_TICK
        thick = 0.2 if mm % 5 == 0 else 0.12
        pdf.stroke(left + mm, y, left + mm, y + tick, thick)
        pdf.stroke(x, low - mm, x - tick, low - mm, thick)
        if mm % 10 == 0:
            label = f"{mm} mm" if mm == RULER else str(mm)
            pdf.write_line(left + mm, y + _TICK + 0.4 + 0.75 * _LABEL, label, _LABEL, 0.5)
            pdf.write_line(x - _TICK - 0.8, low - mm, label, _LABEL, 0.5, 90.0)


def _draw_cut_marks(pdf: _Paper, half: float) -> None:
    near = half + _MARK_GAP
    far = half + _MARK_GAP + _MARK
    for sx, sy in itertools.product((-1, 1), repeat=2):
        x = pdf.cx + sx * half
        y = pdf.cy + sy * half
        pdf.stroke(pdf.cx + sx * near, y, pdf.cx + sx * far, y)
        pdf.stroke(x, pdf.cy + sy * near, x, pdf.cy + sy * far)


def _draw_up_arrow(pdf: _Paper, half: float) -> None:
    tail = pdf.cy - half - 2.0
    pdf.set_fill_color(0)
    pdf.polygon([(pdf.cx + x, tail - y) for x, y in _ARROW], style="F")
    pdf.write_line(pdf.cx + 4.0, tail - 2.0, "up", 4.0)
