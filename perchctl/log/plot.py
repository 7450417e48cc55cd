"""One picture of a flight."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.log.read import FlightLog
from perchctl.log.summary import FlightSummary, summary_of
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
    save_png,
)

SHADES = ("#EEF3F8", "#FFFFFF")
SIZE_IN = (11.0, 13.5)
NAME_GAP = 0.02
"""Share of the flight between the names of two phases, so that they do not overlap."""

AXES = (("x", "m", 100.0, "x [cm]"), ("y", "m", 100.0, "y [cm]"), ("z", "m", 100.0, "z [cm]"))
YAW = ("yaw", "rad", 180.0 / math.pi, "yaw [deg]")


def plot_flight(log: FlightLog, png_path: Path | str) -> None:
    """Draw the flight into a PNG: errors, detections against the filtered track (as
    the paper's figure 6), height, thrust and battery, over the named phases.

    Raises InvalidValue for a log without ticks or a file that cannot be written.
    """
    if not log.records:
        raise InvalidValue(f"{log.path}: the log holds no ticks, there is nothing to plot")
    figure = new_figure(*SIZE_IN)
    axes = figure.subplots(7, 1, sharex=True, height_ratios=(1.7, 1, 1, 1, 1, 1.1, 1.1))
    t_s = log.column("t_s") - log.start_s
    _plot_errors(axes[0], log, t_s)
    for ax, (name, unit, scale, label) in zip(axes[1:5], (*AXES, YAW), strict=True):
        _plot_raw_and_filtered(ax, log, t_s, f"{name}_{unit}", scale, label)
    axes[1].legend(handles=_track_legend(), loc="best", ncols=5, fontsize=8)
    _plot_height(axes[5], log, t_s)
    _plot_power(axes[6], log, t_s)
    for ax in axes:
        _shade_phases(ax, log)
        ax.grid(True, color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
        ax.margins(x=0.0)
    _name_phases(axes[0], log)
    if t_s[-1] > t_s[0]:
        axes[-1].set_xlim(t_s[0], t_s[-1])
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    figure.suptitle(title_of(log, summary_of(log)), fontsize=12)
    save_png(figure, Path(png_path))


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
        e = scale * _while_tracked(log, log.column(f"e{name}_{unit}"))
        lines += ax.plot(t_s, e, color=colour, linewidth=1.4, label=f"$e_{name}$ [cm]")
    yaw_ax = ax.twinx()
    yaw = YAW[2] * _unbroken(_while_tracked(log, log.column("eyaw_rad")))
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
    frame_s = log.column("frame_t_s") - log.start_s
    for source, colour, marker in (("j", GREEN, "s"), ("l", SKY, "o"), ("s", ORANGE, "^")):
        raw = scale * log.column(f"{source}{key}")
        ax.plot(frame_s, raw, linestyle="none", marker=marker, markersize=3, color=colour)
    filtered = _while_tracked(log, log.column(f"e{key}"))
    if key.startswith("yaw"):
        filtered = _unbroken(filtered)
    ax.plot(t_s, scale * filtered, color=BLACK, linewidth=1.1)
    coasting = np.array([r.get("measured") is False for r in log.records])
    ax.plot(t_s, np.where(coasting, scale * filtered, np.nan), color=VERMILLION, linewidth=2.4)
    ax.set_ylabel(label)


def _while_tracked(log: FlightLog, values: Array) -> Array:
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
    true_m = log.column("true_z_m")
    if np.isfinite(true_m).any():
        ax.plot(t_s, true_m, color=GREY, linestyle=":", linewidth=1.4, label="truth")
    ax.set_ylabel("height [m]")
    ax.legend(loc="best", ncols=3, fontsize=8)


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


def _shade_phases(ax: Axes, log: FlightLog) -> None:
    for i, span in enumerate(log.phases):
        start, end = span.start_s - log.start_s, span.end_s - log.start_s
        if end > start:
            ax.axvspan(start, end, facecolor=SHADES[i % 2], edgecolor="none", zorder=-2)
        if i:
            ax.axvline(start, color=GREY, linewidth=0.6, zorder=-1)


def _name_phases(ax: Axes, log: FlightLog) -> None:
    """Names above the top panel, slanted; where phases crowd, some go unnamed."""
    whole_s = max(1e-9, log.phases[-1].end_s - log.start_s)
    gap_s = NAME_GAP * whole_s
    named_s = -math.inf
    for i, span in enumerate(log.phases):
        start_s, end_s = span.start_s - log.start_s, span.end_s - log.start_s
        at_s = max((start_s + end_s) / 2, named_s + gap_s)
        if at_s > end_s + 2 * gap_s and i < len(log.phases) - 1:
            continue
        ax.annotate(
            span.phase,
            xy=(at_s, 1.03),
            xycoords=("data", "axes fraction"),
            rotation=45,
            fontsize=8,
            annotation_clip=False,
        )
        named_s = at_s


def _commands(log: FlightLog) -> Any:
    return np.array([r.get("cmd") or "" for r in log.records])


def _unbroken(angle_rad: Array) -> Array:
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
