"""The report's plots as SVG that takes the page's colours, light and dark.

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
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure, SubFigure

from perchctl.geometry import Array
from perchctl.log import log_frames
from perchctl.report.markup import Markup, tag
from perchctl.report.track import Track

WIDTH_IN, HEIGHT_IN = 5.2, 2.5
MARGINS = {"left": 0.12, "right": 0.89, "bottom": 0.18, "top": 0.88}
LAST_S, AFTER_S = 5.0, 0.5
LEAST_SPAN_MM = 5.0
BINS, LEAST_MS = 24, 0.05
TICKS_MS = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
# Colours that the page replaces: the ink, lines of a grid, and the shade of every other phase.
INK, FAINT, SHADE = "#010203", "#010204", "#010205"
VARIABLES = {INK: "currentColor", FAINT: "var(--line)", SHADE: "var(--shade)"}
# Told apart on white and on black, and with any colour vision: Okabe and Ito's.
RED, TEAL, AMBER, VIOLET, CYAN = "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#3A9BDC"
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


def flight_plots(track: Track) -> list[tuple[str, Markup]]:
    """Titles and figures; each only where the log has something for it."""
    if track.t_s.size < 2:
        return []
    drawn = [
        ("The target relative to the gear", _errors(track)),
        ("The last 5 s with the target, in millimetres", _last_seconds(track)),
        ("Height", _height(track)),
        ("Heading to the target", _heading(track)),
        ("Speed, and how the target moved through the picture", _motion(track)),
    ]
    return [(title, figure) for title, figure in drawn if figure is not None]


def battery_plot(track: Track, rest_v: Array) -> Markup | None:
    """Voltage and thrust; `rest_v` as the model has it, (n,)."""
    volts = np.where(track.log.column("battery_v") > 0, track.log.column("battery_v"), np.nan)
    if not np.isfinite(volts).any() or track.t_s.size < 2:
        return None
    ax = _axes("battery [V]")
    ax.plot(track.t_s, volts, color=INK, linewidth=1.2, label="read")
    if np.isfinite(rest_v).any():
        ax.plot(track.t_s, rest_v, color=TEAL, linewidth=1.2, linestyle="--", label="at rest, est.")
    thrust_ax = _twin(ax)
    thrust = track.log.column("thrust") / 655.35
    thrust_ax.plot(track.t_s, thrust, color=AMBER, linewidth=1.0, label="thrust [%], right")
    thrust_ax.set_ylim(0.0, 105.0)
    return _over_time(track, ax, thrust_ax, "Battery voltage and thrust over time")


def histogram(timings: Mapping[str, Array]) -> Markup | None:
    """How often a turn took how long, on logarithmic scales; None where nothing was late at all."""
    known = {name: 1e3 * v[np.isfinite(v)] for name, v in timings.items()}
    known = {name: v for name, v in known.items() if v.size and float(v.max()) > 0}
    if not known:
        return None
    most_ms = max(float(v.max()) for v in known.values())
    edges = np.concatenate([[0.0], np.geomspace(LEAST_MS, max(most_ms, 2 * LEAST_MS), BINS)])
    ax = _axes("turns")
    for (name, values), colour in zip(known.items(), (INK, CYAN, RED, TEAL, VIOLET), strict=False):
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


def trend(label: str, values: Sequence[float], names: Sequence[str]) -> Markup | None:
    """A figure over the flights of a session, by their numbers; None where none has it."""
    shown = np.array(values, dtype=np.float64)
    if not np.isfinite(shown).any():
        return None
    ax = _axes(label)
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
    return _svg(ax.figure, f"{label} over {len(names)} flights")


# --- over the flight ------------------------------------------------------------------


def _errors(track: Track) -> Markup | None:
    ax, up_ax = _axes("aside [cm]"), None
    drawn = False
    for axis, colour in (("x", CYAN), ("y", AMBER)):
        e_cm = 100.0 * _tracked(track, f"e{axis}_m")
        drawn = drawn or bool(np.isfinite(e_cm).any())
        ax.plot(track.t_s, e_cm, color=colour, linewidth=1.2, label=f"e{axis}")
    if not drawn:
        return None
    ax.axhline(0.0, color=FAINT, linewidth=0.8)
    up_ax = _twin(ax)
    up_ax.plot(track.t_s, _tracked(track, "ez_m"), color=INK, linewidth=1.0, linestyle="--",
               label="ez [m], right")  # fmt: skip
    _mark_unseen(ax, track)
    return _over_time(track, ax, up_ax, "Where the target was, relative to the gear, over time")


def _last_seconds(track: Track) -> Markup | None:
    """What the contact was made with: single frames and the estimate, up to the last sight."""
    frames = log_frames(track.log)
    if not frames.seen_s.size:
        return None
    end_s = float(frames.seen_s[-1])
    low_s, high_s = max(0.0, end_s - LAST_S), min(end_s + AFTER_S, max(track.end_s, 0.1))
    inside = (track.t_s >= low_s) & (track.t_s <= high_s)
    frame_s = track.log.since(track.log.column("frame_t_s"))
    near = (frame_s >= low_s) & (frame_s <= high_s)
    ax = _axes("aside [mm]")
    span_mm = [LEAST_SPAN_MM]
    for axis, colour in (("x", CYAN), ("y", AMBER)):
        for source, marker in (("j", "s"), ("l", "o"), ("s", "^")):
            raw = 1e3 * track.log.column(f"{source}{axis}_m")[near]
            ax.plot(frame_s[near], raw, marker, markersize=2.2, color=colour, fillstyle="none",
                    markeredgewidth=0.6)  # fmt: skip
        e_mm = np.where(inside, 1e3 * _tracked(track, f"e{axis}_m"), np.nan)
        ax.plot(track.t_s[inside], e_mm[inside], color=colour, linewidth=1.4, label=f"e{axis}")
        span_mm.append(_most(np.abs(e_mm)))
    miss_mm = np.where(inside, 1e3 * track.log.column("true_miss_m"), np.nan)
    if np.isfinite(miss_mm).any():
        ax.plot(track.t_s[inside], miss_mm[inside], color=VIOLET, linewidth=1.4, linestyle=":",
                label="true miss")  # fmt: skip
        span_mm.append(_most(miss_mm))
    up_ax = _twin(ax)
    up_mm = np.where(inside, 1e3 * _tracked(track, "ez_m"), np.nan)[inside]
    up_ax.plot(track.t_s[inside], up_mm, color=INK, linewidth=1.0, linestyle="--",
               label="to go, right")  # fmt: skip
    up_ax.set_ylim(min(0.0, -_most(-up_mm)), 1.1 * max(_most(up_mm), LEAST_SPAN_MM))
    ax.axhline(0.0, color=FAINT, linewidth=0.8)
    ax.set_ylim(-1.15 * max(span_mm), 1.15 * max(span_mm))
    return _over_time(track, ax, up_ax, "The last seconds in millimetres", (low_s, high_s))


def _height(track: Track) -> Markup | None:
    z_m = track.log.column("z_m")
    if not np.isfinite(z_m).any():
        return None
    ax = _axes("height [m]")
    ax.plot(track.t_s, z_m, color=CYAN, linewidth=1.4, label="estimate")
    flown = np.array([r.get("cmd") == "position" for r in track.log.records])
    setpoint = np.where(flown, track.log.column("cmd_z_m"), np.nan)
    for values, colour, dashes, name in (
        (setpoint, RED, "--", "setpoint"),
        (track.log.column("pos_z_m"), AMBER, "-", "from outside"),
        (track.log.column("true_z_m"), INK, ":", "truth"),
    ):
        if np.isfinite(values).any():
            ax.plot(track.t_s, values, color=colour, linestyle=dashes, linewidth=1.0, label=name)
    return _over_time(track, ax, None, "Height over time")


def _heading(track: Track) -> Markup | None:
    turn_deg = np.degrees(_tracked(track, "eyaw_rad"))
    if not np.isfinite(turn_deg).any():
        return None
    jumps = np.flatnonzero(np.abs(np.diff(turn_deg)) > 180.0)
    turn_deg[jumps] = np.nan
    ax = _axes("to turn [deg]")
    ax.plot(track.t_s, turn_deg, color=VIOLET, linewidth=1.2, label="heading to the target")
    ax.axhline(0.0, color=FAINT, linewidth=0.8)
    return _over_time(track, ax, None, "Heading to the target over time")


def _motion(track: Track) -> Markup | None:
    if not np.isfinite(track.motion.speed_mps).any():
        return None
    ax, flow_ax = _axes("speed [m/s]"), None
    ax.plot(track.t_s, track.motion.speed_mps, color=CYAN, linewidth=1.0, label="speed")
    tracked = np.array([r.get("tracked") is not False for r in track.log.records])
    blur, flow = track.motion.blur_px, track.motion.flow_pxps
    if np.isfinite(flow).any():
        flow_ax = _twin(ax)
        shown, name = (flow, "px/s") if track.motion.exposure_s is None else (blur, "blur [px]")
        flow_ax.plot(track.t_s, np.where(tracked, shown, np.nan), color=RED, linewidth=1.0,
                     label=f"{name}, right")  # fmt: skip
        flow_ax.set_ylim(bottom=0.0)
    ax.set_ylim(bottom=0.0)
    return _over_time(track, ax, flow_ax, "Speed over time")


# --- what they share ------------------------------------------------------------------


def _axes(label: str) -> Axes:
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN))
        figure.subplots_adjust(**MARGINS)  # a layout that is worked out takes half of the time
        FigureCanvasSVG(figure)
        ax = figure.add_subplot()
        ax.set_ylabel(label)
    return ax


def _twin(ax: Axes) -> Axes:
    with matplotlib.rc_context(STYLE):
        return ax.twinx()


def _over_time(
    track: Track, ax: Axes, right: Axes | None, title: str, shown_s: tuple[float, float] = (0, 0)
) -> Markup:
    low_s, high_s = shown_s if shown_s[1] > shown_s[0] else (0.0, max(track.end_s, 0.1))
    ax.set_xlim(low_s, high_s)
    for i, step in enumerate(track.steps):
        if step.end_s >= low_s and step.start_s <= high_s and step.end_s > step.start_s and i % 2:
            ax.axvspan(max(step.start_s, low_s), min(step.end_s, high_s), facecolor=SHADE,
                       edgecolor="none", zorder=-2)  # fmt: skip
    ax.grid(True, color=FAINT, linewidth=0.5)
    ax.set_axisbelow(True)
    ax.set_xlabel("time [s]")
    lines, words = ax.get_legend_handles_labels()
    if right is not None:
        more, rest = right.get_legend_handles_labels()
        lines, words = lines + more, words + rest
    with matplotlib.rc_context(STYLE):
        ax.figure.legend(lines, words, loc="upper right", ncols=len(words))
    return _svg(ax.figure, title)


def _mark_unseen(ax: Axes, track: Track) -> None:
    """At the bottom: frames without the target, and when no picture came."""
    frames = log_frames(track.log)
    upright = ax.get_xaxis_transform()
    if frames.unseen_s.size:
        ax.vlines(frames.unseen_s, 0.0, 0.05, transform=upright, color=INK, linewidth=0.6,
                  label="no target")  # fmt: skip
    for i, (start_s, end_s) in enumerate(frames.gaps_s):
        ax.axvspan(start_s, end_s, 0.0, 0.05, color=RED, linewidth=0.0,
                   label=None if i else "no picture")  # fmt: skip


def _tracked(track: Track, key: str) -> Array:
    """NaN where the target is only remembered."""
    remembered = [record.get("tracked") is False for record in track.log.records]
    return np.where(remembered, np.nan, track.log.column(key))


def _most(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else 0.0


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
    return tag("svg", Markup(inner), viewBox=box[1] if box else None, role="img", aria_label=title)
