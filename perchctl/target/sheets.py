"""Where things lie on the printed pages: the target's front and back, a board.

The target's centre is the page's centre, so that the back's cross lies over the
front's centre whichever way the sheet is turned.
"""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass

from perchctl.errors import InvalidValue
from perchctl.profile import MarkerConfig, TargetConfig
from perchctl.target.boards import Board, board_rectangles
from perchctl.target.drawing import draw_target, marker_cells, mm_text
from perchctl.target.page import (
    PAGES_MM,
    UNPRINTABLE,
    Circle,
    Item,
    Line,
    Page,
    Polygon,
    Text,
    filled,
    page_name,
    parse_page,
    pdf_bytes,
    text_width,
    wrapped,
)

MIN_QUIET_CELLS = 0.5
"""White around the large marker, in its cells. One cell is printed where the page has
room; down to half a cell the range stays the same even on a black ceiling (measured: side
found in 11 of 12 pictures, blur sigma 2 px: 32 px at 1.0, 0.68 and 0.5 cells, 36 px at
0.3, 46 px at 0.15)."""

RULER = 100.0
_GAP = 1.5  # between the sheet's edge and a ruler
_TICK, _HALF_TICK, _FINE_TICK = 3.5, 2.4, 1.4
_LABEL = 2.5
_RULER_DEPTH = _GAP + _TICK + 0.6 + _LABEL
_RULER_REACH = RULER / 2 + 7.0  # with the label at its end
_MARK_GAP, _MARK = 1.0, 5.0
_CORNER_TICK = 2.5
_TEXT, _LINE = 2.8, 4.0
_ARROW = 10.0


@dataclass(frozen=True)
class SheetLayout:
    """The sheet that is cut out of the page: its side, and the white in it, mm."""

    width: float
    height: float
    sheet: float
    caption: tuple[str, ...]


def target_pdf(
    target: TargetConfig,
    page: str,
    magnet_m: float,
    origin: str = "",
    date: datetime.date | None = None,
) -> bytes:
    """Return the target's sheet, front and back, as a PDF.

    Args:
        page: ``a4``, ``letter``, ``a3`` or a size such as ``220x240mm``.
        origin: where the sizes come from, for the caption.

    Raises InvalidValue where the page is too small, with the page that fits.
    """
    pages = target_pages(target, parse_page(page), magnet_m, origin, date)
    return pdf_bytes(pages, f"perchctl target, {mm_text(target.large.side_m)} mm", date)


def board_pdf(board: Board, page: str) -> bytes:
    """Return the board as a PDF; `page` as in `target_pdf`. Raises InvalidValue where it does not
    fit."""
    sheet = board_page(board, parse_page(page))
    return pdf_bytes([sheet], f"perchctl {board.notation()}")


def target_pages(
    target: TargetConfig,
    page: tuple[float, float],
    magnet_m: float,
    origin: str = "",
    date: datetime.date | None = None,
) -> tuple[Page, Page]:
    """Return front and back, with the largest quiet zone, up to one cell, that leaves room for
    rulers and caption. Raises InvalidValue where the page is too small."""
    texts = _caption(target, origin, date)
    place = _layout_on(target, page, texts)
    if place is None:
        raise InvalidValue(
            f"a target of {1e3 * target.large.side_m:g} mm with its white and its rulers does not "
            f"fit on {page_name(*page)}; --page {_fitting_page(target, texts)} holds it"
        )
    return _front(target, place), _back(target, place, magnet_m)


def board_page(board: Board, page: tuple[float, float]) -> Page:
    """Return a board in the middle of the page, upright or across as it fits; the caption above,
    rulers left and below. Raises InvalidValue where it does not fit."""
    width, height = (1e3 * side for side in board.size_m)
    side = UNPRINTABLE + _RULER_DEPTH
    needed = (max(width, 2 * _RULER_REACH) + 2 * side, max(height, 2 * _RULER_REACH) + 2 * side)
    for w, h in (page, page[::-1]):
        if w >= needed[0] - 1e-9 and h >= needed[1] - 1e-9:
            break
    else:
        raise InvalidValue(
            f"a board of {width:g} x {height:g} mm with its rulers does not fit on "
            f"{page_name(*page)}; {_page_for(needed)} holds it"
        )
    cx, cy = w / 2, h / 2
    texts = (
        f"perchctl {board.notation()}   print at 100 %, not scaled: both rulers must measure "
        f"100 mm",
        f"Then measure the black area ({width:g} x {height:g} mm) and give its sides to perchctl "
        f"calibrate --measured WIDTHxHEIGHT.",
    )
    left = max(UNPRINTABLE, cx - width / 2)
    lines = wrapped(texts, _LABEL, w - UNPRINTABLE - left)
    base = cy - height / 2 - 2.5 - 3.2 * (len(lines) - 1)
    items: list[Item] = [filled(board_rectangles(board), cx, cy)]
    items += [Text(left, base + 3.2 * i, line, _LABEL) for i, line in enumerate(lines)]
    items += _rulers(cx, cy, max(width / 2, _RULER_REACH), max(height / 2, _RULER_REACH))
    return Page(w, h, tuple(items))


def fits(target: TargetConfig, page: tuple[float, float]) -> bool:
    """Return true if the page, in mm, holds the target with its white and its rulers."""
    return (
        _layout_on(target, page, _caption(target, "sizes from the command line", None)) is not None
    )


def fitting_page(target: TargetConfig) -> str:
    """Return the page, for --page, that holds the target: a named one, or a size."""
    return _fitting_page(target, _caption(target, "sizes from the command line", None))


def _layout_on(
    target: TargetConfig, page: tuple[float, float], texts: tuple[str, ...]
) -> SheetLayout | None:
    side, cell = _side_and_cell(target)
    width, height = page
    lines, below = _caption_room(texts, width)
    # Where a small target's sheet ends inside of the rulers, the page has room for a cell.
    half = min(width / 2 - _RULER_DEPTH, height / 2 - below) - UNPRINTABLE
    quiet = math.floor(2.0 * min(cell, half - side / 2) + 1e-6) / 2.0
    if quiet < MIN_QUIET_CELLS * cell - 1e-9 or half < _ruler_half(side / 2 + quiet) - 1e-9:
        return None
    return SheetLayout(width, height, side + 2.0 * quiet, tuple(lines))


def _side_and_cell(target: TargetConfig) -> tuple[float, float]:
    side = 1e3 * target.large.side_m
    return side, side / len(marker_cells(target.large))


def _ruler_half(half: float) -> float:
    """Return the distance of the rulers from the centre: at the sheet, or where the sheet is small
    outside of its cut marks and of each other."""
    if half >= _RULER_REACH:
        return half
    return max(half + _MARK_GAP + _MARK, _RULER_REACH)


def _caption_room(texts: tuple[str, ...], width: float) -> tuple[list[str], float]:
    """Return the caption's lines, and the room for rulers and caption below the sheet, mm."""
    lines = wrapped(texts, _TEXT, width - 2 * (UNPRINTABLE + _RULER_DEPTH))
    return lines, _RULER_DEPTH + 2.0 + _LINE * len(lines)


def _fitting_page(target: TargetConfig, texts: tuple[str, ...]) -> str:
    for name, size in PAGES_MM.items():
        if _layout_on(target, size, texts):
            return name
    side, cell = _side_and_cell(target)
    half = _ruler_half(side / 2 + math.ceil(2.0 * MIN_QUIET_CELLS * cell) / 2.0) + UNPRINTABLE
    width = math.ceil(2.0 * (half + _RULER_DEPTH))
    height = math.ceil(2.0 * (half + _caption_room(texts, width)[1]))
    return f"{width}x{height}mm"


def _page_for(needed: tuple[float, float]) -> str:
    for name, (w, h) in PAGES_MM.items():
        if (w >= needed[0] and h >= needed[1]) or (h >= needed[0] and w >= needed[1]):
            return f"--page {name}"
    return f"--page {math.ceil(needed[0])}x{math.ceil(needed[1])}mm"


def _caption(target: TargetConfig, origin: str, date: datetime.date | None) -> tuple[str, ...]:
    def named(marker: MarkerConfig) -> str:
        return f"{mm_text(marker.side_m)} mm {marker.dictionary} id {marker.id}"

    dated = f", {date.isoformat()}" if date else ""
    return (
        f"perchctl target:  large {named(target.large)},  small {named(target.small)}"
        + (f"  ({origin}{dated})" if origin else ""),
        "Print at 100 %, not scaled: both rulers must measure 100 mm. Cut along the corner marks, "
        "glue the magnet to the back.",
        "Then measure the black squares and give their sides to perchctl make-target measured "
        "--measured-large and --measured-small.",
    )


def _front(target: TargetConfig, place: SheetLayout) -> Page:
    cx, cy, half = place.width / 2, place.height / 2, place.sheet / 2
    items: list[Item] = [filled(draw_target(target).rectangles(), cx, cy)]
    items += _cut_marks(cx, cy, half)
    items += _corner_ticks(cx, cy, half, 500.0 * target.large.side_m)
    ruler_half = _ruler_half(half)
    items += _rulers(cx, cy, ruler_half, ruler_half)
    items += _up_arrow(cx, cy - half - 2.0)
    top = cy + ruler_half + _RULER_DEPTH + 2.0 + _TEXT
    longest = max(text_width(line, _TEXT) for line in place.caption)
    left = max(min(cx - ruler_half, place.width - UNPRINTABLE - longest), UNPRINTABLE)
    items += [Text(left, top + _LINE * i, line, _TEXT) for i, line in enumerate(place.caption)]
    return Page(place.width, place.height, tuple(items))


def _back(target: TargetConfig, place: SheetLayout, magnet_m: float) -> Page:
    """Return the page as seen from the back, the sheet turned about its upright axis: all of it is
    symmetric."""
    cx, cy, half = place.width / 2, place.height / 2, place.sheet / 2
    radius = 500.0 * magnet_m
    items: list[Item] = [*_cut_marks(cx, cy, half), *_up_arrow(cx, cy - half - 2.0)]
    for a, b in (((-1, -1), (1, -1)), ((1, -1), (1, 1)), ((1, 1), (-1, 1)), ((-1, 1), (-1, -1))):
        items.append(
            Line(cx + a[0] * half, cy + a[1] * half, cx + b[0] * half, cy + b[1] * half, 0.15, 2.0)
        )
    reach = radius + 6.0
    items += [
        Circle(cx, cy, radius),
        Line(cx - reach, cy, cx + reach, cy, 0.2),
        Line(cx, cy - reach, cx, cy + reach, 0.2),
    ]
    texts = (
        f"BACK: glue the magnet ({mm_text(magnet_m)} mm across) into the circle.",
        "The cross lies over the centre of both markers.",
    )
    base = cy + half + _MARK_GAP + _MARK + 2.0 + _TEXT
    for i, line in enumerate(wrapped(texts, _TEXT, place.width - 2 * UNPRINTABLE)):
        items.append(Text(cx, base + _LINE * i, line, _TEXT, "middle"))
    return Page(place.width, place.height, tuple(items))


def _rulers(cx: float, cy: float, half_x: float, half_y: float) -> list[Item]:
    """Return two rulers of 100 mm: below, from left to right, and at the left, upwards."""
    y, x = cy + half_y + _GAP, cx - half_x - _GAP
    start = RULER / 2
    items: list[Item] = [
        Line(cx - start, y, cx + start, y, 0.2),
        Line(x, cy - start, x, cy + start, 0.2),
    ]
    for mm in range(int(RULER) + 1):
        tick = _TICK if mm % 10 == 0 else _HALF_TICK if mm % 5 == 0 else _FINE_TICK
        thick = 0.2 if mm % 5 == 0 else 0.12
        items.append(Line(cx - start + mm, y, cx - start + mm, y + tick, thick))
        items.append(Line(x, cy + start - mm, x - tick, cy + start - mm, thick))
        if mm % 10 == 0:
            label = f"{mm} mm" if mm == RULER else str(mm)
            items.append(
                Text(cx - start + mm, y + _TICK + 0.4 + 0.75 * _LABEL, label, _LABEL, "middle")
            )
            items.append(Text(x - _TICK - 0.8, cy + start - mm, label, _LABEL, "middle", True))
    return items


def _cut_marks(cx: float, cy: float, half: float) -> list[Item]:
    items: list[Item] = []
    near, far = half + _MARK_GAP, half + _MARK_GAP + _MARK
    for sx in (-1, 1):
        for sy in (-1, 1):
            x, y = cx + sx * half, cy + sy * half
            items.append(Line(cx + sx * near, y, cx + sx * far, y, 0.2))
            items.append(Line(x, cy + sy * near, x, cy + sy * far, 0.2))
    return items


def _corner_ticks(cx: float, cy: float, half: float, side_half: float) -> list[Item]:
    """Return short ticks in line with the large marker's sides (and its centre, at the right),
    where no ruler is."""
    near, far = half + _MARK_GAP, half + _MARK_GAP + _CORNER_TICK
    items: list[Item] = [Line(cx + near, cy, cx + far, cy, 0.2)]
    for s in (-side_half, side_half):
        for sign, has_ruler in ((1, False), (-1, True)):
            if not has_ruler or side_half > _RULER_REACH:
                items.append(Line(cx + sign * near, cy + s, cx + sign * far, cy + s, 0.2))
                items.append(Line(cx + s, cy - sign * near, cx + s, cy - sign * far, 0.2))
    return items


def _up_arrow(x: float, tail_y: float) -> list[Item]:
    tip = tail_y - _ARROW
    points = [(0.0, 0.0), (2.5, 4.5), (0.6, 4.5), (0.6, _ARROW), (-0.6, _ARROW), (-0.6, 4.5)]
    shape = tuple((x + dx, tip + dy) for dx, dy in [*points, (-2.5, 4.5)])
    return [Polygon(shape), Text(x + 4.0, tail_y - 2.0, "up", 4.0)]
