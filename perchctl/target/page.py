"""A printed page as shapes in millimetres, whatever file it becomes.

Page axes: origin at the top left corner of the paper, x right, y down, mm.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

from perchctl.errors import InvalidValue
from perchctl.target.drawing import Rectangle
from perchctl.target.lengths import parse_length

PAGES_MM: dict[str, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "letter": (215.9, 279.4),
    "a3": (297.0, 420.0),
}
"""Named pages, portrait, in the order in which one that fits is proposed."""

MAX_PAGE_MM = 5000.0
Anchor = Literal["start", "middle", "end"]


@dataclass(frozen=True)
class Filled:
    """Black rectangles (x, y, width, height) that are one path: where two of them touch,
    no viewer draws a hair line between them."""

    boxes: tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True)
class Line:
    x0: float
    y0: float
    x1: float
    y1: float
    width: float = 0.2
    dash: float = 0.0  # length of dashes and gaps, 0 is solid


@dataclass(frozen=True)
class Circle:
    x: float
    y: float
    radius: float
    width: float = 0.3


@dataclass(frozen=True)
class Polygon:
    """Filled black."""

    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Text:
    """`y` is the base line, `size` the font's size in mm; `upwards` reads from below."""

    x: float
    y: float
    text: str
    size: float = 2.8
    anchor: Anchor = "start"
    upwards: bool = False


Item = Filled | Line | Circle | Polygon | Text


@dataclass(frozen=True)
class Page:
    width: float
    height: float
    items: tuple[Item, ...]


def parse_page(text: str) -> tuple[float, float]:
    """``a4``, ``letter``, ``a3`` or ``220x240mm`` as width and height in mm.

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
    if max(width, height) > MAX_PAGE_MM:
        raise InvalidValue(f"page {text!r} is larger than {MAX_PAGE_MM:g} mm")
    return width, height


def page_name(width: float, height: float) -> str:
    """``A4`` or ``220 x 240 mm``."""
    for name, size in PAGES_MM.items():
        if size in ((width, height), (height, width)):
            return name.capitalize()
    return f"{width:g} x {height:g} mm"


def filled(rectangles: Sequence[Rectangle], x: float, y: float) -> Filled:
    """Rectangles of a drawing (metres, y up) with its origin at x, y of the page."""
    return Filled(
        tuple(
            (
                x + 1e3 * r.x0_m,
                y - 1e3 * r.y1_m,
                1e3 * (r.x1_m - r.x0_m),
                1e3 * (r.y1_m - r.y0_m),
            )
            for r in rectangles
        )
    )


def mirrored(items: Sequence[Item], width: float) -> tuple[Item, ...]:
    """The items as they lie on the back of the sheet; texts stay readable."""
    return tuple(_mirrored(item, width) for item in items)


def _mirrored(item: Item, width: float) -> Item:
    match item:
        case Filled(boxes):
            return Filled(tuple((width - x - w, y, w, h) for x, y, w, h in boxes))
        case Line(x0=x0, x1=x1):
            return replace(item, x0=width - x0, x1=width - x1)
        case Polygon(points):
            return Polygon(tuple((width - x, y) for x, y in points))
        case Circle(x=x):
            return replace(item, x=width - x)
        case Text(x=x, anchor=anchor):
            other: dict[Anchor, Anchor] = {"start": "end", "end": "start", "middle": "middle"}
            return replace(item, x=width - x, anchor=other[anchor])


@cache
def _widths() -> dict[str, int]:
    from fpdf.fonts import CORE_FONTS_CHARWIDTHS

    return dict(CORE_FONTS_CHARWIDTHS["helvetica"])


def text_width(text: str, size: float) -> float:
    """Width of a line of Helvetica, mm."""
    widths = _widths()
    return sum(widths.get(character, 600) for character in text) * size / 1000.0


def wrapped(texts: Sequence[str], size: float, width: float) -> list[str]:
    """Every text in as many lines as `width` mm needs; words are never cut."""
    lines: list[str] = []
    for text in texts:
        line = ""
        for word in text.split(" "):
            longer = f"{line} {word}" if line else word
            if line and text_width(longer, size) > width:
                lines.append(line)
                line = word
            else:
                line = longer
        lines.append(line)
    return lines
