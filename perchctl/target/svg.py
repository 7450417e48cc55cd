"""A page as SVG, true to size."""

from __future__ import annotations

from xml.sax.saxutils import escape

from perchctl.target.page import Circle, Filled, Item, Line, Page, Polygon, Text


def svg_bytes(page: Page) -> bytes:
    """One page; a unit of the drawing is a millimetre."""
    w, h = _n(page.width), _n(page.height)
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}mm" height="{h}mm" '
        f'viewBox="0 0 {w} {h}">\n<rect width="{w}" height="{h}" fill="#fff"/>'
    )
    return "\n".join([head, *(_element(item) for item in page.items), "</svg>\n"]).encode()


def _element(item: Item) -> str:
    match item:
        case Filled(boxes):
            path = "".join(f"M{_n(x)} {_n(y)}h{_n(w)}v{_n(h)}h{_n(-w)}z" for x, y, w, h in boxes)
            return f'<path d="{path}"/>'
        case Polygon(points):
            return f'<polygon points="{" ".join(f"{_n(x)},{_n(y)}" for x, y in points)}"/>'
        case Line(x0, y0, x1, y1, width, dash):
            dashes = f' stroke-dasharray="{_n(dash)}"' if dash else ""
            return (
                f'<line x1="{_n(x0)}" y1="{_n(y0)}" x2="{_n(x1)}" y2="{_n(y1)}" stroke="#000" '
                f'stroke-width="{_n(width)}"{dashes}/>'
            )
        case Circle(x, y, radius, width):
            return (
                f'<circle cx="{_n(x)}" cy="{_n(y)}" r="{_n(radius)}" fill="none" stroke="#000" '
                f'stroke-width="{_n(width)}"/>'
            )
        case Text(x, y, text, size, anchor, upwards):
            turn = f' transform="rotate(-90 {_n(x)} {_n(y)})"' if upwards else ""
            return (
                f'<text x="{_n(x)}" y="{_n(y)}" font-family="Helvetica, Arial, sans-serif" '
                f'font-size="{_n(size)}" text-anchor="{anchor}"{turn}>{escape(text)}</text>'
            )


def _n(value: float) -> str:
    return f"{round(value, 5) + 0.0:.10g}"
