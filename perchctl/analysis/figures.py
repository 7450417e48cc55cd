"""The report's figures as SVG that takes the page's colours, light and dark.

Drawn small, so that their words can be read on a narrow page too. Static: a library that zooms
in the page would be ten times as large as all of a flight's plots, and SVG stays sharp when the
browser zooms.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from io import StringIO
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure, SubFigure

from perchctl.analysis.flight import FlightAnalysis
from perchctl.analysis.plot import (
    Look,
    draw_errors,
    draw_height,
    draw_last_seconds,
    draw_power,
    legend_of,
    mark_lost,
    unbroken,
)
from perchctl.geometry import Array
from perchctl.plot import GREEN, PURPLE, VERMILLION

WIDTH_IN, HEIGHT_IN = 5.2, 2.5
MARGINS = {"left": 0.12, "right": 0.89, "bottom": 0.18, "top": 0.88}
BINS, LEAST_MS = 24, 0.05
TICKS_MS = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
# Colours that the page replaces: the ink, lines of a grid, and the shade of every other phase.
INK, FAINT, SHADE = "#010203", "#010204", "#010205"
VARIABLES = {INK: "currentColor", FAINT: "var(--line)", SHADE: "var(--shade)"}
CYAN = "#3A9BDC"
"""A blue that is seen on white and on black."""
ON_PAGE = Look(INK, FAINT, CYAN)
STYLE: Any = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9.5,
    "text.color": INK,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "path.simplify": True,
    "path.simplify_threshold": 0.3,
}


def flight_figures(flight: FlightAnalysis) -> list[tuple[str, Markup]]:
    """Titles and figures; each only where the log has something for it."""
    if flight.t_s.size < 2:
        return []
    drawn = [
        ("The target relative to the gear", _errors(flight)),
        ("The last 5 s with the target, in millimetres", _last_seconds(flight)),
        ("Height", _height(flight)),
        ("Heading to the target", _heading(flight)),
        ("Speed, and how the target moved through the picture", _motion(flight)),
    ]
    return [(title, figure) for title, figure in drawn if figure is not None]


def battery_figure(flight: FlightAnalysis) -> Markup | None:
    """Voltage and thrust; None without a reading."""
    if flight.t_s.size < 2 or not (flight.log.column("battery_v") > 0).any():
        return None
    ax = _axes()
    with matplotlib.rc_context(STYLE):
        twin = draw_power(ax, flight, ON_PAGE)
    return _over_time(flight, ax, twin, "Battery voltage and thrust over time")


def histogram(timings: Mapping[str, Array]) -> Markup | None:
    """How often a turn took how long, on logarithmic scales; None where nothing was late at all."""
    known = {name: 1e3 * v[np.isfinite(v)] for name, v in timings.items()}
    known = {name: v for name, v in known.items() if v.size and float(v.max()) > 0}
    if not known:
        return None
    most_ms = max(float(v.max()) for v in known.values())
    edges = np.concatenate([[0.0], np.geomspace(LEAST_MS, max(most_ms, 2 * LEAST_MS), BINS)])
    ax = _axes()
    ax.set_ylabel("turns")
    for (name, values), colour in zip(
        known.items(), (INK, CYAN, VERMILLION, GREEN, PURPLE), strict=False
    ):
        counts, _ = np.histogram(values, edges)
        ax.stairs(np.maximum(counts, 0.5), edges, color=colour, linewidth=1.4, label=name)
    ax.set_xscale("symlog", linthresh=LEAST_MS)
    ticks = [ms for ms in TICKS_MS if ms <= 1.2 * most_ms]
    ax.set_xticks(ticks, [f"{ms:g}" for ms in ticks])
    ax.set_xticks([], minor=True)
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_xlabel("time [ms]")
    with matplotlib.rc_context(STYLE):
        ax.figure.legend(*ax.get_legend_handles_labels(), loc="upper right", ncols=5)
    ax.grid(True, color=FAINT, linewidth=0.5)
    return _svg(ax.figure, "How often a turn took how long")


def trend(label: str, values: Sequence[float]) -> Markup | None:
    """A number over the flights of a session, in their order; None where none has it."""
    shown = np.array(values, dtype=np.float64)
    if not np.isfinite(shown).any():
        return None
    ax = _axes()
    ax.set_ylabel(label)
    numbers = np.arange(1, shown.size + 1)
    ax.plot(numbers, shown, "o-", color=CYAN, linewidth=1.2, markersize=4)
    ax.set_xticks(numbers[:: max(1, math.ceil(shown.size / 12))])
    ax.set_xlim(0.5, shown.size + 0.5)
    ax.set_ylim(0.0, 1.1 * max(float(np.nanmax(shown)), 1e-9))
    if label.endswith("[V]"):
        low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
        ax.set_ylim(low - 0.1, high + 0.1)
    ax.set_xlabel("flight")
    ax.grid(True, color=FAINT, linewidth=0.5)
    return _svg(ax.figure, f"{label} over {shown.size} flights")


# --- over the flight ------------------------------------------------------------------


def _errors(flight: FlightAnalysis) -> Markup | None:
    if not np.isfinite(flight.tracked("ex_m") + flight.tracked("ey_m")).any():
        return None
    ax = _axes()
    with matplotlib.rc_context(STYLE):
        twin = draw_errors(ax, flight, ON_PAGE)
    mark_lost(ax, flight.frames, 0.05, ON_PAGE)
    return _over_time(flight, ax, twin, "Where the target was, relative to the gear, over time")


def _last_seconds(flight: FlightAnalysis) -> Markup | None:
    if not flight.frames.seen_s.size:
        return None
    ax = _axes()
    with matplotlib.rc_context(STYLE):
        twin, shown_s = draw_last_seconds(ax, flight, ON_PAGE)
    return _over_time(flight, ax, twin, "The last seconds in millimetres", shown_s)


def _height(flight: FlightAnalysis) -> Markup | None:
    if not np.isfinite(flight.log.column("z_m")).any():
        return None
    ax = _axes()
    draw_height(ax, flight, ON_PAGE)
    return _over_time(flight, ax, None, "Height over time")


def _heading(flight: FlightAnalysis) -> Markup | None:
    turn_deg = np.degrees(unbroken(flight.tracked("eyaw_rad")))
    if not np.isfinite(turn_deg).any():
        return None
    ax = _axes()
    ax.set_ylabel("to turn [deg]")
    ax.plot(flight.t_s, turn_deg, color=PURPLE, linewidth=1.2, label="heading to the target")
    ax.axhline(0.0, color=FAINT, linewidth=0.8)
    return _over_time(flight, ax, None, "Heading to the target over time")


def _motion(flight: FlightAnalysis) -> Markup | None:
    motion = flight.motion
    if not np.isfinite(motion.speed_mps).any():
        return None
    ax, flow_ax = _axes(), None
    ax.set_ylabel("speed [m/s]")
    ax.plot(flight.t_s, motion.speed_mps, color=CYAN, linewidth=1.0, label="speed")
    if np.isfinite(motion.flow_pxps).any():
        with matplotlib.rc_context(STYLE):
            flow_ax = ax.twinx()
        tracked = np.array([r.get("tracked") is not False for r in flight.log.records])
        shown, name = (motion.blur_px, "blur [px]")
        if motion.exposure_s is None:
            shown, name = motion.flow_pxps, "px/s"
        flow_ax.plot(flight.t_s, np.where(tracked, shown, np.nan), color=VERMILLION,
                     linewidth=1.0, label=f"{name}, right")  # fmt: skip
        flow_ax.set_ylim(bottom=0.0)
    ax.set_ylim(bottom=0.0)
    return _over_time(flight, ax, flow_ax, "Speed over time")


# --- what they share ------------------------------------------------------------------


def _axes() -> Axes:
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN))
        figure.subplots_adjust(**MARGINS)  # a layout that is worked out takes half of the time
        FigureCanvasSVG(figure)
        return figure.add_subplot()


def _over_time(
    flight: FlightAnalysis,
    ax: Axes,
    twin: Axes | None,
    title: str,
    shown_s: tuple[float, float] = (0, 0),
) -> Markup:
    low_s, high_s = shown_s if shown_s[1] > shown_s[0] else (0.0, max(flight.end_s, 0.1))
    ax.set_xlim(low_s, high_s)
    for i, stay in enumerate(flight.stays):
        if stay.end_s >= low_s and stay.start_s <= high_s and stay.end_s > stay.start_s and i % 2:
            ax.axvspan(max(stay.start_s, low_s), min(stay.end_s, high_s), facecolor=SHADE,
                       edgecolor="none", zorder=-2)  # fmt: skip
    ax.grid(True, color=FAINT, linewidth=0.5)
    ax.set_axisbelow(True)
    ax.set_xlabel("time [s]")
    lines, words = legend_of(ax, twin)
    with matplotlib.rc_context(STYLE):
        ax.figure.legend(lines, words, loc="upper right", ncols=len(words))
    return _svg(ax.figure, title)


def _svg(figure: Figure | SubFigure, title: str) -> Markup:
    """The figure without what only a file of its own needs: no ids, no namespaces, no addresses."""
    stream = StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with matplotlib.rc_context({**STYLE, "svg.hashsalt": title}):
        assert isinstance(figure, Figure)
        figure.savefig(stream, format="svg", metadata=nothing)
    svg = stream.getvalue()
    box = re.search(r'viewBox="([^"]*)"', svg)
    inner = svg[svg.index(">", svg.index("<svg")) + 1 : svg.rindex("</svg>")]
    inner = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", inner, flags=re.DOTALL)
    inner = re.sub(r' id="(?:figure|axes|patch|line2d|text|matplotlib|xtick|ytick|legend|'
                   r'[A-Za-z]*Collection|[A-Za-z]+\.axis)_[\d_]*"', "", inner)  # fmt: skip
    inner = re.sub(r"\n\s*", "\n", inner).replace("xlink:href", "href")
    inner = re.sub(r"font-family: [^;\"]*;? ?", "", inner)
    inner = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", inner)
    for colour, variable in VARIABLES.items():
        inner = inner.replace(colour, variable)
    view = box[1] if box else ""
    start = f'<svg viewBox="{view}" role="img" aria-label="{escape(title)}">'
    return Markup(f"{start}{inner}</svg>")
