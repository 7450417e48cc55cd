"""One picture of a flight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.log.frames import Frames, log_frames
from perchctl.log.read import FlightLog
from perchctl.log.summary import FlightSummary, summarise_flight
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
    new_figure,
    save_figure,
)

SHADES = ("#EEF3F8", "#FFFFFF")
SIZE_IN = (11.0, 17.0)
TITLE_COLUMNS = 110
LAST_S, AFTER_S, LEAST_SPAN_MM = 5.0, 0.5, 5.0
Span = tuple[str, float, float]
"""A phase's name, and from when to when on the axis."""
NAME_GAP = 0.02
"""Share of the time axis between the names of two phases, so that they do not overlap."""

AXES = (("x", "m", 100.0, "x [cm]"), ("y", "m", 100.0, "y [cm]"), ("z", "m", 100.0, "z [cm]"))
YAW = ("yaw", "rad", 180.0 / math.pi, "yaw [deg]")


def plot_flight(log: FlightLog, path: Path | str) -> None:
    """Draw the flight into a .png, .pdf or .svg: errors, detections against the filtered track (as
    the paper's figure 6), where frames were lost, height, thrust and battery, over the
    named phases; and the last seconds with the target in millimetres.

    Raises InvalidValue for a log without ticks or a file that cannot be written.
    """
    if not log.records:
        raise InvalidValue(f"{log.path}: the log holds no ticks, there is nothing to plot")
    figure = new_figure(*SIZE_IN)
    *axes, last_ax = figure.subplots(9, 1, height_ratios=(1.7, 1, 1, 1, 1, 0.25, 1.1, 1.1, 2.0))
    t_s = log.since(log.column("t_s"))
    _plot_errors(axes[0], log, t_s)
    for ax, (name, unit, scale, label) in zip(axes[1:5], (*AXES, YAW), strict=True):
        _plot_raw_and_filtered(ax, log, t_s, f"{name}_{unit}", scale, label)
    axes[1].legend(handles=_track_legend(), loc="best", ncols=5, fontsize=8)
    frames = log_frames(log)
    _plot_frames(axes[5], frames)
    _plot_height(axes[6], log, t_s)
    _plot_power(axes[7], log, t_s)
    _plot_last_seconds(last_ax, log, t_s, frames)
    whole_s = (float(t_s[0]), float(max(t_s[-1], t_s[0] + 1e-3)))
    for ax in axes:
        ax.set_xlim(whole_s)
        ax.tick_params(labelbottom=ax is axes[-1])
    for ax in (*axes, last_ax):
        shade_spans(ax, spans_of(log))
        ax.grid(True, color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
    name_spans(axes[0], spans_of(log), whole_s)
    for ax in (axes[-1], last_ax):
        ax.set_xlabel("time [s]")
    figure.align_ylabels([*axes, last_ax])
    figure.suptitle(fill(title_of(log, summarise_flight(log)), TITLE_COLUMNS), fontsize=12)
    save_figure(figure, Path(path))


def title_of(log: FlightLog, summary: FlightSummary) -> str:
    """Profile, seed, outcome, and the miss where it is known."""
    profile: Any = log.header.get("profile")
    name = profile.get("name", "?") if isinstance(profile, dict) else "?"
    seed = log.header.get("seed")
    parts = [f"profile {name}" + ("" if seed is None else f", seed {seed}"), summary.outcome]
    if summary.outcome != "perched" and summary.reason:
        parts[-1] += f" ({summary.reason})"
    if summary.miss_m is not None:
        parts.append(f"miss {summary.miss_m * 1e3:.1f} mm")
    return "   |   ".join(parts).replace("$", r"\$")


def _plot_errors(ax: Axes, log: FlightLog, t_s: Array) -> None:
    """The merged error e = (e_x, e_y, e_z, e_psi) on two scales."""
    lines: list[Line2D] = []
    for (name, unit, scale, _), colour in zip(AXES, (BLUE, VERMILLION, BLACK), strict=True):
        e = scale * while_tracked(log, log.column(f"e{name}_{unit}"))
        lines += ax.plot(t_s, e, color=colour, linewidth=1.4, label=f"$e_{name}$ [cm]")
    yaw_ax = ax.twinx()
    yaw = YAW[2] * unbroken(while_tracked(log, log.column("eyaw_rad")))
    lines += yaw_ax.plot(
        t_s, yaw, color=PURPLE, linewidth=1.4, linestyle="--", label=r"$e_\psi$ [deg], right"
    )
    ax.axhline(0.0, color=GREY, linewidth=0.8)
    ax.set_ylabel("error [cm]")
    yaw_ax.set_ylabel("yaw error [deg]", color=PURPLE)
    _align_zeros(ax, yaw_ax)
    ax.legend(handles=lines, loc="upper right", ncols=4, fontsize=8)


def _plot_raw_and_filtered(
    ax: Axes, log: FlightLog, t_s: Array, key: str, scale: float, label: str
) -> None:
    # A frame is some 100 ms old when it is measured; the estimate is carried to the present.
    frame_s = log.since(log.column("frame_t_s"))
    for source, colour, marker in (("j", GREEN, "s"), ("l", SKY, "o"), ("s", ORANGE, "^")):
        raw = scale * log.column(f"{source}{key}")
        ax.plot(frame_s, raw, linestyle="none", marker=marker, markersize=3, color=colour)
    filtered = while_tracked(log, log.column(f"e{key}"))
    if key.startswith("yaw"):
        filtered = unbroken(filtered)
    ax.plot(t_s, scale * filtered, color=BLACK, linewidth=1.1)
    coasting = np.array([r.get("measured") is False for r in log.records])
    ax.plot(t_s, np.where(coasting, scale * filtered, np.nan), color=VERMILLION, linewidth=2.4)
    ax.set_ylabel(label)


def while_tracked(log: FlightLog, values: Array) -> Array:
    """NaN where the target is only remembered."""
    remembered = [record.get("tracked") is False for record in log.records]
    return np.where(remembered, np.nan, values)


def _track_legend() -> list[Line2D]:
    raw = (("s", GREEN, "both, raw"), ("o", SKY, "large, raw"), ("^", ORANGE, "small, raw"))
    filtered = ((BLACK, 1.4, "filtered"), (VERMILLION, 2.4, "filtered, unseen"))
    return [
        *(
            Line2D([], [], linestyle="none", marker=marker, markersize=4, color=colour, label=text)
            for marker, colour, text in raw
        ),
        *(
            Line2D([], [], color=colour, linewidth=width, label=text)
            for colour, width, text in filtered
        ),
    ]


def _plot_height(ax: Axes, log: FlightLog, t_s: Array) -> None:
    ax.plot(t_s, log.column("z_m"), color=BLUE, linewidth=1.4, label="estimate")
    setpoint = np.where(_commands(log) == "position", log.column("cmd_z_m"), np.nan)
    if np.isfinite(setpoint).any():
        ax.plot(t_s, setpoint, color=VERMILLION, linestyle="--", linewidth=1.2, label="setpoint")
    outside_m = log.column("pos_z_m")
    if np.isfinite(outside_m).any():
        shown_m = np.where(_is_stale(log), np.nan, outside_m)
        ax.plot(t_s, shown_m, color=ORANGE, linewidth=0.9, label="from outside")
    true_m = log.column("true_z_m")
    if np.isfinite(true_m).any():
        ax.plot(t_s, true_m, color=GREY, linestyle=":", linewidth=1.4, label="truth")
    ax.set_ylabel("height [m]")
    ax.legend(loc="best", ncols=3, fontsize=8)


def _is_stale(log: FlightLog) -> Array:
    """Where no position from outside is sent: a gap in its line."""
    return np.array([record.get("pos_note") is not None for record in log.records])


def _plot_power(ax: Axes, log: FlightLog, t_s: Array) -> None:
    thrust = log.column("thrust") / 655.35
    lines = ax.plot(t_s, thrust, color=GREEN, linewidth=1.6, label="thrust [%]")
    battery_ax = ax.twinx()
    lines += battery_ax.plot(
        t_s, log.column("battery_v"), color=BLACK, linewidth=1.4, label="battery [V], right"
    )
    ax.set_ylim(0.0, 105.0)
    ax.set_ylabel("thrust [%]")
    battery_ax.set_ylabel("battery [V]")
    ax.legend(handles=lines, loc="best", ncols=2, fontsize=8)


def _plot_frames(ax: Axes, frames: Frames) -> None:
    """Where the pipeline had nothing to measure: no frame, or none with the target."""
    _mark_lost(ax, frames, 0.0, 1.0)
    ax.set_yticks([])
    ax.set_ylabel("lost", rotation=0, ha="right", va="center")
    handles = [
        Rectangle((0, 0), 1, 1, color=VERMILLION, label=f"no frame ({_times(len(frames.gaps_s))})"),
        Line2D([], [], color=GREY, label=f"frame without target ({len(frames.unseen_s)})"),
    ]
    ax.legend(handles=handles, loc="lower right", ncols=2, fontsize=8, bbox_to_anchor=(1.0, 0.9))


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times" if count else "never"


def _mark_lost(ax: Axes, frames: Frames, low: float, high: float) -> None:
    """Between two shares of the panel's height."""
    upright = ax.get_xaxis_transform()
    ax.vlines(frames.unseen_s, low, high, transform=upright, color=GREY, linewidth=0.8)
    for start_s, end_s in frames.gaps_s:
        ax.axvspan(start_s, end_s, low, high, color=VERMILLION, linewidth=0.0)


def _plot_last_seconds(ax: Axes, log: FlightLog, t_s: Array, frames: Frames) -> None:
    """What the contact was made with: x and y in millimetres up to the moment in which the
    target was seen last, z on a scale of its own."""
    tracked = np.isfinite(while_tracked(log, log.column("ex_m")))
    end_s = float(frames.seen_s[-1]) if frames.seen_s.size else float(t_s[-1])
    shown_s = (end_s - LAST_S, end_s + AFTER_S)
    inside = (t_s >= shown_s[0]) & (t_s <= shown_s[1])
    frame_s = log.since(log.column("frame_t_s"))
    lines: list[Line2D] = []
    span_mm = [LEAST_SPAN_MM]
    for name, colour in (("x", BLUE), ("y", ORANGE)):
        for source, marker in (("j", "s"), ("l", "o"), ("s", "^")):
            raw_mm = 1e3 * log.column(f"{source}{name}_m")
            ax.plot(frame_s, raw_mm, marker, markersize=3, color=colour, fillstyle="none")
        e_mm = 1e3 * while_tracked(log, log.column(f"e{name}_m"))
        lines += ax.plot(t_s, e_mm, color=colour, linewidth=1.4, label=f"$e_{name}$ [mm]")
        span_mm.append(float(np.nanmax(np.abs(e_mm[inside & tracked]), initial=0.0)))
    miss_mm = 1e3 * log.column("true_miss_m")
    if np.isfinite(miss_mm[inside]).any():
        lines += ax.plot(
            t_s, miss_mm, color=GREY, linestyle=":", linewidth=1.6, label="true miss [mm]"
        )
        span_mm.append(float(np.nanmax(miss_mm[inside])))
    z_ax = ax.twinx()
    z_mm = 1e3 * while_tracked(log, log.column("ez_m"))
    lines += z_ax.plot(t_s, z_mm, color=BLACK, linewidth=1.1, linestyle="--",
                       label="$e_z$ [mm], right")  # fmt: skip
    _mark_lost(ax, frames, 0.0, 0.05)
    ax.axhline(0.0, color=GREY, linewidth=0.8)
    ax.set_xlim(shown_s)
    ax.set_ylim(-1.2 * max(span_mm), 1.2 * max(span_mm))
    z_ax.set_ylim(0.0, 1.05 * float(np.nanmax(z_mm[inside & tracked], initial=LEAST_SPAN_MM)))
    _align_zeros(ax, z_ax)
    ax.set_ylabel("last 5 s with\nthe target [mm]")
    z_ax.set_ylabel("height to go [mm]")
    ax.legend(handles=lines, loc="upper right", ncols=4, fontsize=8)
    name_spans(ax, spans_of(log), shown_s)


def spans_of(log: FlightLog) -> list[Span]:
    return [(p.phase, log.since(p.start_s), log.since(p.end_s)) for p in log.phases]


def shade_spans(ax: Axes, spans: Sequence[Span]) -> None:
    """By turns, and a line where one begins."""
    first_s, last_s = ax.get_xlim()
    for i, (_, start_s, end_s) in enumerate(spans):
        if end_s < first_s or start_s > last_s:
            continue
        if end_s > start_s:
            ax.axvspan(start_s, end_s, facecolor=SHADES[i % 2], edgecolor="none", zorder=-2)
        if i:
            ax.axvline(start_s, color=GREY, linewidth=0.6, zorder=-1)


def name_spans(ax: Axes, spans: Sequence[Span], shown_s: tuple[float, float]) -> None:
    """Names above a panel, slanted; where phases crowd, some go unnamed."""
    gap_s = NAME_GAP * (shown_s[1] - shown_s[0])
    named_s = -math.inf
    for i, (name, start_s, end_s) in enumerate(spans):
        start_s, end_s = max(start_s, shown_s[0]), min(end_s, shown_s[1])
        if end_s < start_s:
            continue
        at_s = max((start_s + end_s) / 2, named_s + gap_s)
        if at_s > end_s + 2 * gap_s and i < len(spans) - 1:
            continue
        ax.annotate(
            name,
            xy=(at_s, 1.03),
            xycoords=("data", "axes fraction"),
            rotation=45,
            fontsize=8,
            annotation_clip=False,
        )
        named_s = at_s


def _commands(log: FlightLog) -> Any:
    return np.array([r.get("cmd") or "" for r in log.records])


def unbroken(angle_rad: Array) -> Array:
    """The angle with a gap, not a line across the panel, where it wraps."""
    result = angle_rad.copy()
    jumps = np.flatnonzero(np.abs(np.diff(angle_rad)) > math.pi)
    result[jumps] = np.nan
    return result


def _align_zeros(*axes: Axes) -> None:
    """Zero at the same height on all scales."""
    limits = [(min(ax.get_ylim()[0], 0.0), max(ax.get_ylim()[1], 0.0)) for ax in axes]
    below = max(-low / (high - low) for low, high in limits)
    above = max(high / (high - low) for low, high in limits)
    for ax, (low, high) in zip(axes, limits, strict=True):
        # Both ends in the same proportion, each wide enough for this scale.
        unit = max(-low / below if below > 0 else 0.0, high / above if above > 0 else 0.0)
        ax.set_ylim(-below * unit, above * unit)
