"""The room from above: homes, corridors, targets and order, as text and as SVG.

In both drawings, the room's x axis points to the right and its y axis up. A plan that is refused is
drawn as well, without the order of flight, to show which vehicles are in each other's way.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Mapping
from html import escape

from perchctl.corridor import Corridor, Point
from perchctl.fleet.fleet import Fleet
from perchctl.fleet.schedule import vehicle_corridor

DRAWING_COLUMNS = 80
DRAWING_ROWS = 34
"""Rows of the map. With more rows, the map and its legend do not fit on a screen."""
CELL_ASPECT = 2.0
"""Ratio of height to width of a character in a typical terminal."""
MARGIN_M = 0.2
"""Margin around the corridors, m."""
OVERLAP = "#"
INSIDE = "."

_SVG_WIDTH_PX = 800
_LEGEND_ROW_PX = 22
_PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""The colours of Okabe and Ito, as in perchctl's plots: colour-blind people can tell them apart."""


def draw_text(fleet: Fleet, groups: tuple[tuple[str, ...], ...] = ()) -> str:
    """The room in at most 80 columns: a map, and a line for each vehicle.

    On the map, ``N`` is the home of vehicle number N and ``N*`` its target, or both if its home is
    directly below its target; ``.`` marks a place in one corridor, ``#`` a place in several.
    """
    corridors = _corridors(fleet)
    low, high = _bounds(corridors)
    width_m, height_m = high[0] - low[0], high[1] - low[1]
    cell_m = max(width_m / DRAWING_COLUMNS, height_m / (DRAWING_ROWS * CELL_ASPECT))
    label = len(f"{len(fleet.vehicles)}*")  # the smallest width, for a room that is long and narrow
    columns = min(DRAWING_COLUMNS, max(label, math.ceil(width_m / cell_m)))
    rows = min(DRAWING_ROWS, math.ceil(height_m / (cell_m * CELL_ASPECT)))
    cells = [
        [
            _cell(
                (low[0] + (c + 0.5) * cell_m, high[1] - (r + 0.5) * cell_m * CELL_ASPECT),
                corridors,
            )
            for c in range(columns)
        ]
        for r in range(rows)
    ]

    def cell(place: Point) -> tuple[int, int]:
        row = min(rows - 1, int((high[1] - place[1]) / (cell_m * CELL_ASPECT)))
        return row, min(columns - 1, int((place[0] - low[0]) / cell_m))

    def write(at: tuple[int, int], text: str) -> None:
        """Write the text at the nearest place where it neither covers nor touches another text."""
        (wanted_row, wanted), last = at, columns - len(text)

        def away(place: tuple[int, int]) -> float:
            return math.hypot((place[0] - wanted_row) * CELL_ASPECT, place[1] - wanted)

        free = (
            (row, start)
            for row, start in itertools.product(range(rows), range(last + 1))
            if set(cells[row][max(0, start - 1) : start + len(text) + 1]) <= {" ", INSIDE, OVERLAP}
        )
        row, start = min(free, key=away, default=(wanted_row, min(wanted, last)))
        cells[row][start : start + len(text)] = text

    for number, vehicle in enumerate(fleet.vehicles, 1):
        home, target = cell(vehicle.home_m), cell(vehicle.target_m)
        if home != target:
            write(home, f"{number}")
        write(target, f"{number}*")
    lines = ["".join(row).rstrip() for row in cells]
    lines += [
        f"{width_m:.1f} by {height_m:.1f} m; x to the right, y up",
        "1 home, 1* target (or both, if they are in the same place)",
        f"{INSIDE} in one corridor, {OVERLAP} in several",
        "",
    ]
    for line in _legend(fleet, corridors, groups):
        lines += textwrap.wrap(line, DRAWING_COLUMNS, subsequent_indent="   ", drop_whitespace=True)
    return "\n".join(lines)


def _cell(place: Point, corridors: Mapping[str, Corridor]) -> str:
    inside = sum(corridor.distance_to_m(place) <= 0.0 for corridor in corridors.values())
    return " " if inside == 0 else INSIDE if inside == 1 else OVERLAP


def _legend(
    fleet: Fleet, corridors: Mapping[str, Corridor], groups: tuple[tuple[str, ...], ...]
) -> list[str]:
    lines = []
    for number, vehicle in enumerate(fleet.vehicles, 1):
        turn = next((n for n, group in enumerate(groups, 1) if vehicle.name in group), None)
        order = f", flies {_ordinal(turn)}" if turn is not None else ""
        lines.append(
            f"{number:>2} {vehicle.name}: home {_place(vehicle.home_m)}, {number}* target "
            f"{_place(vehicle.target_m)}, radius {corridors[vehicle.name].radius_m:.2f} m{order}"
        )
    return lines


def _place(place: Point) -> str:
    return f"{place[0]:.2f} {place[1]:.2f}"


def _ordinal(number: int) -> str:
    teens = 10 <= number % 100 < 20
    return f"{number}{'th' if teens else {1: 'st', 2: 'nd', 3: 'rd'}.get(number % 10, 'th')}"


def draw_svg(fleet: Fleet, groups: tuple[tuple[str, ...], ...] = ()) -> str:
    """Return the room as an SVG picture: corridors as wide lines with round ends, homes as circles,
    and targets as squares, as in the film."""
    corridors = _corridors(fleet)
    low, high = _bounds(corridors)
    scale = _SVG_WIDTH_PX / (high[0] - low[0])
    map_px = (high[1] - low[1]) * scale
    symbols = "circle: home; square: target; wide line: corridor"
    legend = [symbols, *_legend(fleet, corridors, groups)]
    height_px = map_px + _LEGEND_ROW_PX * (len(legend) + 1)

    def at(place: Point) -> Point:
        return (place[0] - low[0]) * scale, (high[1] - place[1]) * scale

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_SVG_WIDTH_PX} {height_px:.0f}" '
        f'font-family="sans-serif" font-size="15">',
        f"<title>{escape(fleet.name)}: the room from above, x to the right, y up</title>",
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for number, vehicle in enumerate(fleet.vehicles):
        corridor, colour = corridors[vehicle.name], _PALETTE[number % len(_PALETTE)]
        (x, y), (u, v) = at(vehicle.home_m), at(vehicle.target_m)
        line = f'x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}" stroke="{colour}"'
        parts += [
            f'<line {line} stroke-opacity="0.2" stroke-linecap="round" '
            f'stroke-width="{2 * corridor.radius_m * scale:.1f}"/>',
            f'<line {line} stroke-width="1.5" stroke-dasharray="5 4"/>',
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{colour}"/>',
            f'<rect x="{u - 6:.1f}" y="{v - 6:.1f}" width="12" height="12" fill="none" '
            f'stroke="{colour}" stroke-width="2.5"/>',
            f'<text x="{x + 9:.1f}" y="{y + 5:.1f}">{number + 1} {escape(vehicle.name)}</text>',
        ]
    metre_y = map_px - 12
    parts.append(
        f'<path d="M12 {metre_y:.1f}h{scale:.1f}" stroke="black" stroke-width="2"/>'
        f'<text x="12" y="{metre_y - 6:.1f}">1 m</text>'
    )
    colours = ["black", *(_PALETTE[n % len(_PALETTE)] for n in range(len(fleet.vehicles)))]
    parts += [
        f'<text x="12" y="{map_px + _LEGEND_ROW_PX * (row + 1):.1f}" '
        f'fill="{colour}">{escape(text.strip())}</text>'
        for row, (text, colour) in enumerate(zip(legend, colours, strict=True))
    ]
    return "\n".join([*parts, "</svg>", ""])


def _corridors(fleet: Fleet) -> dict[str, Corridor]:
    return {vehicle.name: vehicle_corridor(vehicle) for vehicle in fleet.vehicles}


def _bounds(corridors: Mapping[str, Corridor]) -> tuple[Point, Point]:
    """Return the lower left and the upper right corner of the drawing."""
    edges = [
        (place[0] + sign * reach, place[1] + sign * reach)
        for corridor in corridors.values()
        for reach in [corridor.radius_m + MARGIN_M]
        for place in (corridor.home_m, corridor.target_m)
        for sign in (-1.0, 1.0)
    ]
    xs, ys = [x for x, _ in edges], [y for _, y in edges]
    return (min(xs), min(ys)), (max(xs), max(ys))
