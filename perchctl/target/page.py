"""A printed page as shapes in millimetres, and its PDF.

Page axes: origin at the top left corner of the paper, x right, y down, mm.
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

from fpdf import FPDF
from fpdf.enums import PathPaintRule
from fpdf.fonts import CORE_FONTS_CHARWIDTHS
from fpdf.prefs import ViewerPreferences

from perchctl.errors import InvalidValue
from perchctl.target.drawing import Rectangle, parse_length

PAGES_MM: dict[str, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "letter": (215.9, 279.4),
    "a3": (297.0, 420.0),
}
"""Named pages, portrait, in the order in which one that fits is proposed."""

MAX_PAGE_MM = 5000.0
UNPRINTABLE = 5.0
"""mm at the paper's edges that many printers leave white."""
_PT_PER_MM = 72.0 / 25.4
_EPOCH = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)
"""The date in the file where the profile names none: never the clock's."""
Anchor = Literal["start", "middle", "end"]


@dataclass(frozen=True)
class Filled:
    """Black rectangles (x, y, width, height) that are one path: where two of them touch,
    no viewer draws a hair line between them."""

    boxes: tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True)
class Line:
    """A straight line. `dash` is the length of dashes and gaps; 0 is solid."""

    x0: float
    y0: float
    x1: float
    y1: float
    width: float = 0.2
    dash: float = 0.0


@dataclass(frozen=True)
class Circle:
    """A circle that is not filled."""

    x: float
    y: float
    radius: float
    width: float = 0.3


@dataclass(frozen=True)
class Polygon:
    """A polygon, filled black."""

    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Text:
    """A line of text. `y` is the base line, `size` the font's size in mm; `upwards` reads from
    below."""

    x: float
    y: float
    text: str
    size: float = 2.8
    anchor: Anchor = "start"
    upwards: bool = False


Item = Filled | Line | Circle | Polygon | Text


@dataclass(frozen=True)
class Page:
    """Width and height of the paper, mm, and what is printed on it."""

    width: float
    height: float
    items: tuple[Item, ...]


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
    if max(width, height) > MAX_PAGE_MM:
        raise InvalidValue(f"page {text!r} is larger than {MAX_PAGE_MM:g} mm")
    return width, height


def page_name(width: float, height: float) -> str:
    """Return a page's name, ``A4`` or ``220 x 240 mm``."""
    for name, size in PAGES_MM.items():
        if size in ((width, height), (height, width)):
            return name.capitalize()
    return f"{width:g} x {height:g} mm"


def filled(rectangles: Sequence[Rectangle], x: float, y: float) -> Filled:
    """Return rectangles of a drawing (metres, y up) with its origin at x, y of the page."""
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


@cache
def _widths() -> dict[str, int]:
    return dict(CORE_FONTS_CHARWIDTHS["helvetica"])


def text_width(text: str, size: float) -> float:
    """Return the width of a line of Helvetica, mm."""
    return sum(_widths().get(character, 600) for character in text) * size / 1000.0


def wrapped(texts: Sequence[str], size: float, width: float) -> list[str]:
    """Return every text in as many lines as `width` mm needs; words are never cut."""
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


# --- The PDF ------------------------------------------------------------------------------------


def pdf_bytes(pages: Sequence[Page], title: str, date: datetime.date | None = None) -> bytes:
    """Return a PDF of all pages, true to size, the same bytes for the same pages; print scaling is
    switched off in the viewer's preferences."""
    first = pages[0]
    pdf = FPDF(unit="mm", format=(first.width, first.height))
    pdf.set_auto_page_break(False)
    pdf.set_margin(0.0)
    pdf.set_title(title)
    pdf.set_producer("perchctl")
    pdf.set_creation_date(
        datetime.datetime.combine(date, datetime.time(), datetime.UTC) if date else _EPOCH
    )
    # Portrait pages turn about their long edge, which is the upright one.
    duplex = "DuplexFlipLongEdge" if first.height >= first.width else "DuplexFlipShortEdge"
    pdf.viewer_preferences = ViewerPreferences(
        print_scaling="None", duplex=duplex if len(pages) == 2 else None
    )
    for page in pages:
        pdf.add_page(orientation="portrait", format=(page.width, page.height))
        for item in page.items:
            _draw(pdf, item)
    return bytes(pdf.output())


def _draw(pdf: FPDF, item: Item) -> None:
    match item:
        case Filled() | Polygon():
            with pdf.new_path(paint_rule=PathPaintRule.FILL_NONZERO) as path:
                path.style.fill_color = "#000000"
                path.style.stroke_color = None
                if isinstance(item, Filled):
                    for x, y, w, h in item.boxes:
                        path.rectangle(x, y, w, h)
                else:
                    (x, y), *others = item.points
                    path.move_to(x, y)
                    for x, y in others:
                        path.line_to(x, y)
                    path.close()
        case Line(x0, y0, x1, y1, width, dash):
            pdf.set_line_width(width)
            pdf.set_dash_pattern(dash=dash, gap=dash)
            pdf.line(x0, y0, x1, y1)
        case Circle(x, y, radius, width):
            pdf.set_line_width(width)
            pdf.set_dash_pattern()
            pdf.circle(x, y, radius)
        case Text(x, y, text, size, anchor, upwards):
            pdf.set_font("helvetica", size=size * _PT_PER_MM)
            back = {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor] * text_width(text, size)
            if upwards:
                with pdf.rotation(90.0, x, y):
                    pdf.text(x - back, y, text)
            else:
                pdf.text(x - back, y, text)
