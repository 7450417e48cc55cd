"""A page that is larger than the printer's paper, cut into sheets of it that overlap."""

from __future__ import annotations

import math
from dataclasses import replace

from perchctl.target.page import Circle, Filled, Item, Line, Page, Polygon, Text
from perchctl.target.sheets import UNPRINTABLE

OVERLAP = 10.0
"""mm: what is cut off, and glued on."""
_MARK = 4.0


def tile_page(page: Page, sheet: tuple[float, float]) -> list[Page]:
    """The page on sheets (width, height, mm), upright or across, whichever are fewer; row by row
    from the top left one. A page that fits is one sheet of its own size.

    Each sheet shows `OVERLAP` of its neighbour's; lines at the page's edges, in the middle of
    the overlap, say where to cut.
    """
    if any(page.width <= w and page.height <= h for w, h in (sheet, sheet[::-1])):
        return [page]
    width, height = min((sheet, sheet[::-1]), key=lambda size: math.prod(_counts(page, size)))
    (columns, rows), steps = _counts(page, (width, height)), _steps((width, height))
    marks = _marks(page, [i * steps[0] + OVERLAP / 2 for i in range(1, columns)],
                   [j * steps[1] + OVERLAP / 2 for j in range(1, rows)])  # fmt: skip
    return [
        Page(
            width,
            height,
            tuple(
                _moved(item, UNPRINTABLE - i * steps[0], UNPRINTABLE - j * steps[1])
                for item in (*page.items, *marks)
            ),
        )
        for j in range(rows)
        for i in range(columns)
    ]


def _steps(sheet: tuple[float, float]) -> tuple[float, float]:
    """From one sheet to the next, mm."""
    across, down = (side - 2.0 * UNPRINTABLE - OVERLAP for side in sheet)
    return across, down


def _counts(page: Page, sheet: tuple[float, float]) -> tuple[int, int]:
    """Columns and rows."""
    columns, rows = (
        max(1, math.ceil((whole - OVERLAP) / step - 1e-9))
        for whole, step in zip((page.width, page.height), _steps(sheet), strict=True)
    )
    return columns, rows


def _marks(page: Page, xs: list[float], ys: list[float]) -> list[Item]:
    """Where to cut, at the page's edges."""
    ends_y = ((0.0, _MARK), (page.height - _MARK, page.height))
    ends_x = ((0.0, _MARK), (page.width - _MARK, page.width))
    return [
        *(Line(x, a, x, b) for x in xs for a, b in ends_y),
        *(Line(a, y, b, y) for y in ys for a, b in ends_x),
    ]


def _moved(item: Item, x: float, y: float) -> Item:
    match item:
        case Filled(boxes):
            return Filled(tuple((left + x, top + y, w, h) for left, top, w, h in boxes))
        case Line():
            return replace(item, x0=item.x0 + x, y0=item.y0 + y, x1=item.x1 + x, y1=item.y1 + y)
        case Polygon(points):
            return Polygon(tuple((px + x, py + y) for px, py in points))
        case Circle() | Text():
            return replace(item, x=item.x + x, y=item.y + y)
