"""Pages as a vector PDF, true to size, the same bytes for the same pages."""

from __future__ import annotations

import datetime
from collections.abc import Sequence

from fpdf import FPDF
from fpdf.enums import PathPaintRule
from fpdf.prefs import ViewerPreferences

from perchctl.target.page import Circle, Filled, Item, Line, Page, Polygon, Text, text_width

_PT_PER_MM = 72.0 / 25.4
_EPOCH = datetime.datetime(2000, 1, 1, tzinfo=datetime.UTC)
"""The date in the file where the profile names none: never the clock's."""


def pdf_bytes(pages: Sequence[Page], title: str, date: datetime.date | None = None) -> bytes:
    """A PDF of all pages; print scaling is switched off in the viewer's preferences."""
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
        case Filled(boxes):
            with pdf.new_path(paint_rule=PathPaintRule.FILL_NONZERO) as path:
                path.style.fill_color = "#000000"
                path.style.stroke_color = None
                for x, y, w, h in boxes:
                    path.rectangle(x, y, w, h)
        case Polygon(points):
            with pdf.new_path(paint_rule=PathPaintRule.FILL_NONZERO) as path:
                path.style.fill_color = "#000000"
                path.style.stroke_color = None
                path.move_to(*points[0])
                for point in points[1:]:
                    path.line_to(*point)
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
