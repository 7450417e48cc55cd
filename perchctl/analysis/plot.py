"""Plot a flight. The plot is written next to the log and shown on the report page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from perchctl.analysis.flight import FlightAnalysis
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.plot import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    GRID,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    figure_bytes,
    new_figure,
    save_figure,
)
from perchctl.record import FlightLog

SHADES = ("#EEF3F8", "#FFFFFF")
TITLE_COLUMNS = 110
BEFORE_LAST_SIGHT_S = 5.0
"""Time before the last frame with the target at which the close-up starts, s. Larger: the end of
the approach is drawn smaller."""
AFTER_LAST_SIGHT_S = 0.5
"""Time after the last frame with the target at which the close-up ends, s."""
LEAST_SPAN_MM = 5.0
"""The close-up's error axis extends at least this far to each side of zero. Smaller: the noise of a
steady approach fills the plot."""
Span = tuple[str, float, float]
"""A phase's name, and its start and end on the time axis."""
NAME_GAP = 0.02
"""Smallest distance between two phase names at which they do not overlap, as a fraction of the time
axis."""
LOST_SHARE = 0.05
"""Height of the marks for lost frames, as a fraction of the panel's height."""
FULL_THRUST_PERCENT = 1 / 655.35
RAW = (
    ("j", "s", GREEN, "both, raw"),
    ("l", "o", SKY, "large, raw"),
    ("s", "^", ORANGE, "small, raw"),
)
"""Letter in the log's keys, marker symbol, colour and label of each raw pose."""
TRACKS = (
    ("x_m", 100.0, "x [cm]"),
    ("y_m", 100.0, "y [cm]"),
    ("z_m", 100.0, "z [cm]"),
    ("yaw_rad", 180.0 / math.pi, "yaw [deg]"),
)


def plot_flight(log: FlightLog | FlightAnalysis, path: Path | str) -> None:
    """Draw the flight as a .png, .pdf or .svg file.

    Raises InvalidValue if the log has no ticks or the file cannot be written.
    """
    flight = log if isinstance(log, FlightAnalysis) else FlightAnalysis(log)
    if not flight.records:
        raise InvalidValue(f"{flight.log.path}: the log has no ticks, so there is nothing to plot")
    save_figure(flight_figure(flight), Path(path))


def flight_png(flight: FlightAnalysis) -> bytes:
    """The plot of a flight as a PNG. The log must have at least one tick."""
    return figure_bytes(flight_figure(flight))


def flight_figure(flight: FlightAnalysis) -> Figure:
    """Draw detections and the filtered track (as in figure 6 of the paper), height, thrust and
    battery over time, with phase names, and a close-up (in mm) of the last seconds in which the
    target was seen. Frames without a detection are marked at the bottom."""
    figure = new_figure(11.0, 14.0)
    *axes, last_ax = figure.subplots(7, 1, height_ratios=(1, 1, 1, 1, 1.1, 1.1, 2.0))
    for ax, (key, scale, label) in zip(axes[:4], TRACKS, strict=True):
        _draw_raw_and_filtered(ax, flight, key, scale, label)
        _mark_lost(ax, flight)
    _add_legend(axes[0])
    _draw_height(axes[4], flight)
    _draw_power(axes[5], flight)
    shown_s = _draw_last_seconds(last_ax, flight)
    spans = [(stay.phase, stay.start_s, stay.end_s) for stay in flight.log.phases]
    whole_s = (float(flight.log.t_s[0]), float(max(flight.log.t_s[-1], flight.log.t_s[0] + 1e-3)))
    for ax in axes:
        ax.set_xlim(whole_s)
        ax.tick_params(labelbottom=ax is axes[-1])
    for ax in (*axes, last_ax):
        _shade_spans(ax, spans)
        ax.grid(True, color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
    _name_spans(axes[0], spans, whole_s)
    _name_spans(last_ax, spans, shown_s)
    for ax in (axes[-1], last_ax):
        ax.set_xlabel("time [s]")
    figure.align_ylabels([*axes, last_ax])
    figure.suptitle(fill(figure_title(flight), TITLE_COLUMNS), fontsize=12)
    return figure


def figure_title(flight: FlightAnalysis) -> str:
    """Return the profile, seed, outcome and, if known, the miss distance as a single line."""
    end = flight.summary
    parts = [flight.log.setup_text, end.outcome]
    if end.outcome != "perched" and end.reason:
        parts[-1] += f" ({end.reason})"
    if end.miss_m is not None:
        parts.append(f"miss {end.miss_m * 1e3:.1f} mm")
    return "   |   ".join(parts).replace("$", r"\$")


# --- panels ---


def _draw_raw_and_filtered(
    ax: Axes, flight: FlightAnalysis, key: str, scale: float, label: str
) -> None:
    # A frame is about 100 ms old when its target pose is measured, whereas the estimate is
    # extrapolated to the present.
    log = flight.log
    frame_s = log.to_flight_s(log.column("frame_t_s"))
    for source, marker, colour, text in RAW:
        raw = scale * log.column(f"{source}{key}")
        ax.plot(frame_s, raw, marker, markersize=3, color=colour, label=text)
    filtered = flight.tracked_values(f"e{key}")
    if key == "yaw_rad":  # leave a gap in the line where the angle wraps
        filtered[np.flatnonzero(np.abs(np.diff(filtered)) > math.pi)] = np.nan
    filtered = scale * filtered
    ax.plot(log.t_s, filtered, color=BLACK, linewidth=1.1, label="filtered")
    coasting = np.array([record.get("measured") is False for record in log.records])
    unseen = np.where(coasting, filtered, np.nan)
    ax.plot(log.t_s, unseen, color=VERMILLION, linewidth=2.4, label="not seen, or no frame")
    ax.set_ylabel(label)


def _draw_height(ax: Axes, flight: FlightAnalysis) -> None:
    log = flight.log
    is_setpoint = np.array([kind == "position" for kind in log.texts("cmd")])
    is_sent = np.array([not note for note in log.texts("pos_note")])
    ax.plot(flight.log.t_s, log.column("z_m"), color=BLUE, linewidth=1.4, label="estimate")
    for values, colour, dashes, name in (
        (np.where(is_setpoint, log.column("cmd_z_m"), np.nan), VERMILLION, "--", "setpoint"),
        (np.where(is_sent, log.column("pos_z_m"), np.nan), ORANGE, "-", "external"),
        (log.column("true_z_m"), BLACK, ":", "truth"),
    ):
        if np.isfinite(values).any():
            ax.plot(log.t_s, values, color=colour, linestyle=dashes, linewidth=1.0, label=name)
    ax.set_ylabel("height [m]")
    _add_legend(ax)


def _draw_power(ax: Axes, flight: FlightAnalysis) -> None:
    volts = flight.log.column("battery_v")
    volts = np.where(volts > 0, volts, np.nan)
    ax.plot(flight.log.t_s, volts, color=BLACK, linewidth=1.2, label="battery")
    ax.set_ylabel("battery [V]")
    _add_legend(ax, draw_thrust(ax, flight))


def draw_thrust(ax: Axes, flight: FlightAnalysis) -> Axes:
    """Draw the commanded thrust in percent on a second y axis on the right; return that axis."""
    thrust_ax: Axes = ax.twinx()
    thrust = flight.log.column("thrust") * FULL_THRUST_PERCENT
    thrust_ax.plot(
        flight.log.t_s, thrust, color=ORANGE, linewidth=1.0, label="thrust [%], right axis"
    )
    thrust_ax.set_ylim(0.0, 105.0)
    return thrust_ax


def _draw_last_seconds(ax: Axes, flight: FlightAnalysis) -> tuple[float, float]:
    """Draw the approach in mm up to the last frame that shows the target. Return the start and end
    of the period drawn."""
    log, frames = flight.log, flight.frames
    end_s = (
        float(frames.times_with_target_s[-1])
        if frames.times_with_target_s.size
        else flight.log.end_s
    )
    low_s, high_s = (
        max(0.0, end_s - BEFORE_LAST_SIGHT_S),
        min(end_s + AFTER_LAST_SIGHT_S, max(flight.log.end_s, 0.1)),
    )
    inside = (flight.log.t_s >= low_s) & (flight.log.t_s <= high_s)
    t_s, frame_s = flight.log.t_s[inside], log.to_flight_s(log.column("frame_t_s"))
    near = (frame_s >= low_s) & (frame_s <= high_s)
    span_mm = [LEAST_SPAN_MM]
    for axis, colour in (("x", BLUE), ("y", ORANGE)):
        for source, marker, _, _ in RAW:
            raw_mm = 1e3 * log.column(f"{source}{axis}_m")[near]
            ax.plot(frame_s[near], raw_mm, marker, markersize=2.4, color=colour, fillstyle="none")
        e_mm = 1e3 * flight.tracked_values(f"e{axis}_m")[inside]
        ax.plot(t_s, e_mm, color=colour, linewidth=1.4, label=f"e{axis}")
        span_mm.append(_most(np.abs(e_mm)))
    miss_mm = 1e3 * log.column("true_miss_m")[inside]
    if np.isfinite(miss_mm).any():
        ax.plot(t_s, miss_mm, color=PURPLE, linewidth=1.4, linestyle=":", label="true miss")
        span_mm.append(_most(miss_mm))
    ax.axhline(0.0, color=GREY, linewidth=0.8)
    ax.set_ylim(-1.15 * max(span_mm), 1.15 * max(span_mm))
    ax.set_ylabel("last 5 s with\nthe target [mm]")
    _add_legend(ax)
    _mark_lost(ax, flight)
    ax.set_xlim(low_s, high_s)
    return low_s, high_s


def _mark_lost(ax: Axes, flight: FlightAnalysis) -> None:
    unseen_s, bottom = flight.frames.times_without_target_s, ax.get_xaxis_transform()
    ax.vlines(unseen_s, 0.0, LOST_SHARE, transform=bottom, color=BLACK, linewidth=0.7)
    for start_s, end_s in flight.frames.gaps_s:
        ax.axvspan(start_s, end_s, 0.0, LOST_SHARE, color=VERMILLION, linewidth=0.0)


def _add_legend(ax: Axes, twin: Axes | None = None) -> None:
    lines, words = ax.get_legend_handles_labels()
    if twin is not None:
        more_lines, more_words = twin.get_legend_handles_labels()
        lines, words = lines + more_lines, words + more_words
    ax.legend(lines, words, loc="best", ncols=max(len(words), 1), fontsize=8)


def _most(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else 0.0


# --- phases ---


def _shade_spans(ax: Axes, spans: Sequence[Span]) -> None:
    for i, (_, start_s, end_s) in enumerate(spans):
        ax.axvspan(start_s, end_s, facecolor=SHADES[i % 2], edgecolor="none", zorder=-2)
        if i:
            ax.axvline(start_s, color=GREY, linewidth=0.6, zorder=-1)


def _name_spans(ax: Axes, spans: Sequence[Span], shown_s: tuple[float, float]) -> None:
    """Draw the phase names slanted above a panel. If phases are too close together, some names are
    left out."""
    gap_s = NAME_GAP * (shown_s[1] - shown_s[0])
    named_s = -math.inf
    for name, start_s, end_s in spans:
        start_s, end_s = max(start_s, shown_s[0]), min(end_s, shown_s[1])
        at_s = (start_s + end_s) / 2
        if start_s <= end_s and at_s >= named_s + gap_s:
            above = ax.get_xaxis_transform()
            ax.text(at_s, 1.03, name, transform=above, rotation=45, fontsize=8)
            named_s = at_s
