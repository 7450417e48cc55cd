"""Pictures of flights: one flight, two over each other, a replay beside what was flown.

The panels `draw_...` are also those of the report's page (`perchctl.analysis.figures`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogFormatter
from numpy.typing import NDArray

from perchctl.analysis.compare import Comparison
from perchctl.analysis.decide import Decided
from perchctl.analysis.flight import FlightAnalysis
from perchctl.analysis.replay_text import CAUTION, difference_text
from perchctl.analysis.replayer import Replay
from perchctl.analysis.sight import Frames, Stay
from perchctl.analysis.words import times
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.log import FlightLog
from perchctl.mission import Observation
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
from perchctl.vehicle import Command, PositionSetpoint, RawThrust

SHADES = ("#EEF3F8", "#FFFFFF")
TITLE_COLUMNS = 110
LAST_S, AFTER_S, LEAST_SPAN_MM = 5.0, 0.5, 5.0
Span = tuple[str, float, float]
"""A phase's name, and from when to when on the axis."""
NAME_GAP = 0.02
"""Share of the time axis between the names of two phases, so that they do not overlap."""
FULL_THRUST_PERCENT = 1 / 655.35
SOURCES = (("j", "s"), ("l", "o"), ("s", "^"))
"""Of a raw pose: its letter in the log's keys, and its marker."""
XYZ = (("x", "m", 100.0, "x [cm]"), ("y", "m", 100.0, "y [cm]"), ("z", "m", 100.0, "z [cm]"))
YAW = ("yaw", "rad", 180.0 / math.pi, "yaw [deg]")


@dataclass(frozen=True)
class Look:
    """The colours in which a figure's ground differs from another's."""

    ink: str
    faint: str
    blue: str


ON_PAPER = Look(BLACK, GREY, BLUE)


# --- one flight -------------------------------------------------------------------------


def plot_flight(log: FlightLog, path: Path | str) -> None:
    """Draw the flight into a .png, .pdf or .svg: errors, detections against the filtered track (as
    the paper's figure 6), where frames were lost, height, thrust and battery, over the
    named phases; and the last seconds with the target in millimetres.

    Raises InvalidValue for a log without ticks or a file that cannot be written.
    """
    flight = _with_ticks(FlightAnalysis(log))
    figure = new_figure(11.0, 17.0)
    *axes, last_ax = figure.subplots(9, 1, height_ratios=(1.7, 1, 1, 1, 1, 0.25, 1.1, 1.1, 2.0))
    _add_legend(axes[0], draw_errors(axes[0], flight, ON_PAPER))
    for ax, (name, unit, scale, label) in zip(axes[1:5], (*XYZ, YAW), strict=True):
        _draw_raw_and_filtered(ax, flight, f"{name}_{unit}", scale, label)
    axes[1].legend(handles=_track_legend(), loc="best", ncols=5, fontsize=8)
    _draw_lost(axes[5], flight.frames)
    draw_height(axes[6], flight, ON_PAPER)
    _add_legend(axes[6])
    _add_legend(axes[7], draw_power(axes[7], flight, ON_PAPER))
    twin, shown_s = draw_last_seconds(last_ax, flight, ON_PAPER)
    _add_legend(last_ax, twin)
    mark_lost(last_ax, flight.frames, 0.05, ON_PAPER)
    last_ax.set_xlim(shown_s)
    last_ax.set_ylabel("last 5 s with\nthe target [mm]")
    spans = [(stay.phase, stay.start_s, stay.end_s) for stay in flight.stays]
    whole_s = (float(flight.t_s[0]), float(max(flight.t_s[-1], flight.t_s[0] + 1e-3)))
    for ax in axes:
        ax.set_xlim(whole_s)
        ax.tick_params(labelbottom=ax is axes[-1])
    for ax in (*axes, last_ax):
        _shade_spans(ax, spans)
        _add_grid(ax)
    _name_spans(axes[0], spans, whole_s)
    _name_spans(last_ax, spans, shown_s)
    for ax in (axes[-1], last_ax):
        ax.set_xlabel("time [s]")
    figure.align_ylabels([*axes, last_ax])
    figure.suptitle(fill(title_of(flight), TITLE_COLUMNS), fontsize=12)
    save_figure(figure, Path(path))


def title_of(flight: FlightAnalysis) -> str:
    """Profile, seed, outcome, and the miss where it is known."""
    end, seed = flight.summary, flight.log.header.get("seed")
    name = f"profile {flight.log.profile_name or '?'}"
    parts = [name + ("" if seed is None else f", seed {seed}"), end.outcome]
    if end.outcome != "perched" and end.reason:
        parts[-1] += f" ({end.reason})"
    if end.miss_m is not None:
        parts.append(f"miss {end.miss_m * 1e3:.1f} mm")
    return "   |   ".join(parts).replace("$", r"\$")


def _with_ticks(flight: FlightAnalysis) -> FlightAnalysis:
    if not flight.log.records:
        raise InvalidValue(f"{flight.log.path}: the log holds no ticks, there is nothing to plot")
    return flight


def _draw_raw_and_filtered(
    ax: Axes, flight: FlightAnalysis, key: str, scale: float, label: str
) -> None:
    # A frame is some 100 ms old when it is measured; the estimate is carried to the present.
    log = flight.log
    frame_s = log.since(log.column("frame_t_s"))
    for (source, marker), colour in zip(SOURCES, (GREEN, SKY, ORANGE), strict=True):
        raw = scale * log.column(f"{source}{key}")
        ax.plot(frame_s, raw, linestyle="none", marker=marker, markersize=3, color=colour)
    filtered = scale * unbroken(flight.tracked(f"e{key}"), key.startswith("yaw"))
    ax.plot(flight.t_s, filtered, color=BLACK, linewidth=1.1)
    coasting = np.array([record.get("measured") is False for record in log.records])
    unseen = np.where(coasting, filtered, np.nan)
    ax.plot(flight.t_s, unseen, color=VERMILLION, linewidth=2.4)
    ax.set_ylabel(label)


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


def _draw_lost(ax: Axes, frames: Frames) -> None:
    """Where the pipeline had nothing to measure: no frame, or none with the target."""
    mark_lost(ax, frames, 1.0, Look(GREY, GREY, GREY))
    ax.set_yticks([])
    ax.set_ylabel("lost", rotation=0, ha="right", va="center")
    gaps = times(len(frames.gaps_s)) if len(frames.gaps_s) else "never"
    handles = [
        Rectangle((0, 0), 1, 1, color=VERMILLION, label=f"no frame ({gaps})"),
        Line2D([], [], color=GREY, label=f"frame without target ({len(frames.unseen_s)})"),
    ]
    ax.legend(handles=handles, loc="lower right", ncols=2, fontsize=8, bbox_to_anchor=(1.0, 0.9))


def _add_legend(ax: Axes, twin: Axes | None = None) -> None:
    lines, words = legend_of(ax, twin)
    ax.legend(lines, words, loc="best", ncols=max(len(words), 1), fontsize=8)


# --- panels, in colours of their figure ---------------------------------------------------


def draw_errors(ax: Axes, flight: FlightAnalysis, look: Look) -> Axes:
    """The target relative to the gear: horizontally, and its height on the axis returned."""
    for axis, colour in (("x", look.blue), ("y", ORANGE)):
        e_cm = 100.0 * flight.tracked(f"e{axis}_m")
        ax.plot(flight.t_s, e_cm, color=colour, linewidth=1.3, label=f"e{axis}")
    ax.axhline(0.0, color=look.faint, linewidth=0.8)
    ax.set_ylabel("aside [cm]")
    up_ax = ax.twinx()
    up_ax.plot(flight.t_s, flight.tracked("ez_m"), color=look.ink, linewidth=1.0,
               linestyle="--", label="ez [m], right")  # fmt: skip
    return up_ax


def draw_last_seconds(
    ax: Axes, flight: FlightAnalysis, look: Look
) -> tuple[Axes, tuple[float, float]]:
    """The contact's approach in millimetres: single frames and the estimate, up to the last frame
    with the target; the height on the axis returned, and from when to when."""
    log, frames = flight.log, flight.frames
    end_s = float(frames.seen_s[-1]) if frames.seen_s.size else flight.end_s
    low_s, high_s = max(0.0, end_s - LAST_S), min(end_s + AFTER_S, max(flight.end_s, 0.1))
    inside = (flight.t_s >= low_s) & (flight.t_s <= high_s)
    t_s, frame_s = flight.t_s[inside], log.since(log.column("frame_t_s"))
    near = (frame_s >= low_s) & (frame_s <= high_s)
    span_mm = [LEAST_SPAN_MM]
    for axis, colour in (("x", look.blue), ("y", ORANGE)):
        for source, marker in SOURCES:
            raw_mm = 1e3 * log.column(f"{source}{axis}_m")[near]
            ax.plot(frame_s[near], raw_mm, marker, markersize=2.4, color=colour, fillstyle="none",
                    markeredgewidth=0.6)  # fmt: skip
        e_mm = 1e3 * flight.tracked(f"e{axis}_m")[inside]
        ax.plot(t_s, e_mm, color=colour, linewidth=1.4, label=f"e{axis}")
        span_mm.append(_most(np.abs(e_mm)))
    miss_mm = 1e3 * log.column("true_miss_m")[inside]
    if np.isfinite(miss_mm).any():
        ax.plot(t_s, miss_mm, color=PURPLE, linewidth=1.4, linestyle=":", label="true miss")
        span_mm.append(_most(miss_mm))
    up_ax, up_mm = ax.twinx(), 1e3 * flight.tracked("ez_m")[inside]
    up_ax.plot(t_s, up_mm, color=look.ink, linewidth=1.0, linestyle="--", label="to go, right")
    up_ax.set_ylim(min(0.0, -_most(-up_mm)), 1.1 * max(_most(up_mm), LEAST_SPAN_MM))
    ax.axhline(0.0, color=look.faint, linewidth=0.8)
    ax.set_ylim(-1.15 * max(span_mm), 1.15 * max(span_mm))
    ax.set_ylabel("aside [mm]")
    return up_ax, (low_s, high_s)


def draw_height(ax: Axes, flight: FlightAnalysis, look: Look) -> None:
    """The estimated height, the setpoint's, and external and true ones where they are known."""
    log = flight.log
    is_setpoint = np.array([kind == "position" for kind in log.texts("cmd")])
    is_sent = np.array([not note for note in log.texts("pos_note")])
    ax.plot(flight.t_s, log.column("z_m"), color=look.blue, linewidth=1.4, label="estimate")
    for values, colour, dashes, name in (
        (np.where(is_setpoint, log.column("cmd_z_m"), np.nan), VERMILLION, "--", "setpoint"),
        (np.where(is_sent, log.column("pos_z_m"), np.nan), ORANGE, "-", "external"),
        (log.column("true_z_m"), look.ink, ":", "truth"),
    ):
        if np.isfinite(values).any():
            ax.plot(flight.t_s, values, color=colour, linestyle=dashes, linewidth=1.0, label=name)
    ax.set_ylabel("height [m]")


def draw_power(ax: Axes, flight: FlightAnalysis, look: Look) -> Axes:
    """The battery's voltage as it was read and at rest; thrust on the axis returned."""
    volts = flight.log.column("battery_v")
    volts = np.where(volts > 0, volts, np.nan)
    ax.plot(flight.t_s, volts, color=look.ink, linewidth=1.2, label="read")
    ax.plot(flight.t_s, flight.battery.rest_v, color=GREEN, linewidth=1.2, linestyle="--",
            label="at rest, est.")  # fmt: skip
    ax.set_ylabel("battery [V]")
    thrust_ax = ax.twinx()
    thrust = flight.log.column("thrust") * FULL_THRUST_PERCENT
    thrust_ax.plot(flight.t_s, thrust, color=ORANGE, linewidth=1.0, label="thrust [%], right")
    thrust_ax.set_ylim(0.0, 105.0)
    return thrust_ax


def mark_lost(ax: Axes, frames: Frames, height: float, look: Look) -> None:
    """Mark frames without the target, and times without any frame, at the panel's bottom, up to
    a share of its height."""
    upright = ax.get_xaxis_transform()
    if frames.unseen_s.size:
        ax.vlines(frames.unseen_s, 0.0, height, transform=upright, color=look.ink, linewidth=0.7,
                  label="no target")  # fmt: skip
    for i, (start_s, end_s) in enumerate(frames.gaps_s):
        ax.axvspan(start_s, end_s, 0.0, height, color=VERMILLION, linewidth=0.0,
                   label=None if i else "no picture")  # fmt: skip


def legend_of(ax: Axes, twin: Axes | None) -> tuple[list[Artist], list[str]]:
    """Lines and words of both axes of a panel."""
    lines, words = ax.get_legend_handles_labels()
    if twin is None:
        return lines, words
    more_lines, more_words = twin.get_legend_handles_labels()
    return lines + more_lines, words + more_words


def unbroken(values: Array, is_angle: bool = True) -> Array:
    """An angle in rad with a gap, not a line across the panel, where it wraps."""
    result = values.copy()
    if is_angle:
        result[np.flatnonzero(np.abs(np.diff(values)) > math.pi)] = np.nan
    return result


def _most(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else 0.0


def _add_grid(ax: Axes) -> None:
    ax.grid(True, color=GRID, linewidth=0.6)
    ax.set_axisbelow(True)


def _shade_spans(ax: Axes, spans: Sequence[Span]) -> None:
    """Alternate shades, and a line where a phase begins."""
    first_s, last_s = ax.get_xlim()
    for i, (_, start_s, end_s) in enumerate(spans):
        if end_s < first_s or start_s > last_s:
            continue
        if end_s > start_s:
            ax.axvspan(start_s, end_s, facecolor=SHADES[i % 2], edgecolor="none", zorder=-2)
        if i:
            ax.axvline(start_s, color=GREY, linewidth=0.6, zorder=-1)


def _name_spans(ax: Axes, spans: Sequence[Span], shown_s: tuple[float, float]) -> None:
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


# --- two flights over each other --------------------------------------------------------

ASIDE_MM = (0.5, 2000.0)
_STYLES = ((BLUE, 2.0, "A"), (VERMILLION, 1.1, "B"))
_MOST_OF_A_PATH = 48


def plot_comparison(found: Comparison, path: Path) -> None:
    """Draw errors, height, thrust and battery of both into a .png, .pdf or .svg, each phase
    from the same moment on.

    Raises InvalidValue for a log without ticks or a file that cannot be written.
    """
    flights = [_with_ticks(flight) for flight in found.flights]
    common = stretches(flights[0].stays, flights[1].stays)
    figure = new_figure(11.0, 16.0)
    axes: list[Axes] = list(figure.subplots(8, 1, sharex=True))
    for ax, (name, unit, scale, label) in zip(axes, (*XYZ, YAW), strict=False):
        errors = [unbroken(f.tracked(f"e{name}_{unit}"), name == "yaw") for f in flights]
        _overlay(ax, flights, common, [scale * error for error in errors])
        ax.axhline(0.0, color=GREY, linewidth=0.8)
        ax.set_ylabel(f"error {label}")
    aside_mm = [1e3 * np.hypot(f.tracked("ex_m"), f.tracked("ey_m")) for f in flights]
    _overlay(axes[4], flights, common, aside_mm)
    axes[4].set_yscale("log")
    axes[4].set_ylim(ASIDE_MM)
    axes[4].yaxis.set_major_formatter(LogFormatter())
    axes[4].set_ylabel("aside [mm]")
    for ax, key, scale, label in (
        (axes[5], "z_m", 1.0, "height [m]"),
        (axes[6], "thrust", FULL_THRUST_PERCENT, "thrust [%]"),
        (axes[7], "battery_v", 1.0, "battery [V]"),
    ):
        _overlay(ax, flights, common, [scale * flight.log.column(key) for flight in flights])
        ax.set_ylabel(label)
    spans: list[Span] = [(s.phase, s.start_s, s.end_s) for s in common]
    whole_s = (0.0, max(spans[-1][2], 1e-3))
    for ax in axes:
        ax.set_xlim(whole_s)
        _shade_spans(ax, spans)
        _add_grid(ax)
    _name_spans(axes[0], spans, whole_s)
    axes[-1].set_xlabel("time, each phase from where it began in both [s]")
    figure.align_ylabels(axes)
    figure.legend(handles=_flight_legend(flights), loc="outside upper center", fontsize=9)
    save_figure(figure, path)


def _overlay(
    ax: Axes, flights: Sequence[FlightAnalysis], common: Sequence[Stretch], values: Sequence[Array]
) -> None:
    for which, (flight, (colour, width, _)) in enumerate(zip(flights, _STYLES, strict=True)):
        pieces_s, pieces = [], []
        for stretch in common:
            inside, t_s = ticks_of(flight, stretch, which)
            # A gap behind each: the next phase begins where the longer stay has ended.
            pieces_s += [t_s, np.array([np.nan])]
            pieces += [values[which][inside], np.array([np.nan])]
        ax.plot(np.concatenate(pieces_s), np.concatenate(pieces), color=colour, linewidth=width)


def _flight_legend(flights: Sequence[FlightAnalysis]) -> list[Line2D]:
    handles = []
    for flight, (colour, width, name) in zip(flights, _STYLES, strict=True):
        shown = str(flight.log.path)
        if len(shown) > _MOST_OF_A_PATH:
            shown = f"...{shown[3 - _MOST_OF_A_PATH :]}"
        text = f"{name}: {shown}   |   {title_of(flight)}".replace("\n", " ")
        handles.append(Line2D([], [], color=colour, linewidth=width, label=text))
    return handles


@dataclass(frozen=True)
class Stretch:
    """One phase on the common time, as long as the longer of the two stays in it.

    `stays`: the two flights' own, in the order of the flights; None where it was not flown.
    """

    phase: str
    start_s: float
    end_s: float
    stays: tuple[Stay | None, Stay | None]


def stretches(one: Sequence[Stay], other: Sequence[Stay]) -> tuple[Stretch, ...]:
    """The phases of both in an order that is each flight's own.

    What only one of them flew, as a second attempt, stands alone.
    """
    found: list[Stretch] = []

    def add(a: Stay | None, b: Stay | None) -> None:
        stays = [stay for stay in (a, b) if stay is not None]
        start_s = found[-1].end_s if found else 0.0
        end_s = start_s + max(stay.duration_s for stay in stays)
        found.append(Stretch(stays[0].phase, start_s, end_s, (a, b)))

    names = ([stay.phase for stay in one], [stay.phase for stay in other])
    for tag, i0, i1, j0, j1 in SequenceMatcher(None, *names, autojunk=False).get_opcodes():
        if tag == "equal":
            for a, b in zip(one[i0:i1], other[j0:j1], strict=True):
                add(a, b)
            continue
        for a in one[i0:i1]:
            add(a, None)
        for b in other[j0:j1]:
            add(None, b)
    return tuple(found)


def ticks_of(
    flight: FlightAnalysis, stretch: Stretch, which: int
) -> tuple[NDArray[np.bool_], Array]:
    """Which of the flight's ticks (0: the first flight's) lie in the stretch, (n,) bool, and when
    on the common time these are, (k,)."""
    stay, t_s = stretch.stays[which], flight.t_s
    if stay is None:
        return np.zeros(len(t_s), dtype=bool), np.empty(0)
    inside = (t_s >= stay.start_s) & (t_s <= stay.end_s)
    return inside, t_s[inside] - stay.start_s + stretch.start_s


# --- a replay beside what was flown --------------------------------------------------------


def plot_replay(replay: Replay, path: Path) -> None:
    """Setpoints, the target's error and the phases, as flown and as replayed, with the first
    difference marked. Errors: InvalidValue (a file that cannot be written)."""
    figure = new_figure(11.0, 11.0)
    axes = figure.subplots(8, 1, sharex=True, height_ratios=(1, 1, 1, 0.7, 1, 1, 1, 0.8))
    flown = [each for each in replay.decided if each.turn.role == "flown"]
    t_s = np.array([each.turn.t_s - replay.log.start_s for each in flown])
    for k, axis in enumerate("xyz"):
        was = [_setpoint(each.turn.command, k) for each in flown]
        then = [_setpoint(each.command, k) for each in flown]
        _draw_both(axes[k], t_s, was, then, f"setpoint {axis} [m]")
    was = [_thrust(each.turn.command) for each in flown]
    _draw_both(axes[3], t_s, was, [_thrust(each.command) for each in flown], "raw thrust")
    for k, axis in enumerate("xyz"):
        was = [_error_cm(each.turn.observation, k) for each in flown]
        then = [_error_cm(each.observation, k) for each in flown]
        _draw_both(axes[4 + k], t_s, was, then, f"$e_{axis}$ [cm]")
    _draw_phases(axes[7], t_s, flown)
    for ax in axes:
        _add_grid(ax)
        if replay.first is not None:
            ax.axvline(replay.first.t_s, color=BLACK, linewidth=1.0, linestyle=":")
    axes[0].legend(loc="upper right", ncols=2, fontsize=8)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    figure.suptitle(fill(_replay_title(replay), TITLE_COLUMNS), fontsize=10)
    save_figure(figure, path)


def _replay_title(replay: Replay) -> str:
    head = ", ".join(replay.changed) if replay.changed else "as it was flown"
    if replay.first is None:
        return f"{head}: no command differs"
    text = difference_text(replay.first, bool(replay.changed))
    return f"{head}: {text} (dotted); {CAUTION}".replace("$", r"\$")


def _draw_both(ax: Axes, t_s: Array, was: list[float], then: list[float], label: str) -> None:
    ax.plot(t_s, was, color=BLUE, linewidth=1.6, label="as flown")
    ax.plot(t_s, then, color=VERMILLION, linewidth=1.0, linestyle="--", label="replayed")
    ax.set_ylabel(label, fontsize=8)


def _draw_phases(ax: Axes, t_s: Array, flown: Sequence[Decided]) -> None:
    """Two strips, as flown and as replayed."""
    was = ["" if each.turn.phase is None else each.turn.phase.value for each in flown]
    then = ["" if each.state is None else each.state.phase.value for each in flown]
    for level, names in ((1.0, was), (0.0, then)):
        starts = [k for k in range(len(names)) if k == 0 or names[k] != names[k - 1]]
        for number, k in enumerate(starts):
            end = starts[number + 1] if number + 1 < len(starts) else len(names) - 1
            shade = GRID if number % 2 else "#FFFFFF"
            ax.barh(level, t_s[end] - t_s[k], left=t_s[k], color=shade, edgecolor=GREY, height=0.9)
            middle_s = (t_s[k] + t_s[end]) / 2
            ax.text(middle_s, level, names[k][:3], ha="center", va="center", fontsize=6)
    ax.set_yticks([1.0, 0.0], ["as flown", "replayed"], fontsize=8)


def _setpoint(command: Command | None, axis: int) -> float:
    if not isinstance(command, PositionSetpoint):
        return float("nan")
    return (command.x_m, command.y_m, command.z_m)[axis]


def _thrust(command: Command | None) -> float:
    return float(command.thrust) if isinstance(command, RawThrust) else float("nan")


def _error_cm(obs: Observation | None, axis: int) -> float:
    if obs is None or obs.target is None or not obs.target.tracked:
        return float("nan")
    return 100.0 * float(obs.target.e_m[axis])
