"""Two flights drawn over each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatter

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.log.plot import (
    AXES,
    YAW,
    Span,
    name_spans,
    shade_spans,
    title_of,
    unbroken,
    while_tracked,
)
from perchctl.log.read import FlightLog, PhaseSpan
from perchctl.log.summary import summarise_flight
from perchctl.plot import BLUE, GREY, GRID, VERMILLION, new_figure, save_figure

SIZE_IN = (11.0, 16.0)
ASIDE_MM = (0.5, 2000.0)
_STYLES = ((BLUE, 2.0, "A"), (VERMILLION, 1.1, "B"))
_MOST_OF_A_PATH = 48


def plot_comparison(one: FlightLog, other: FlightLog, path: Path) -> None:
    """Draw errors, height, thrust and battery of both into a .png, .pdf or .svg, each phase
    from the same moment on.

    Raises InvalidValue for a log without ticks or a file that cannot be written.
    """
    logs = (one, other)
    for log in logs:
        if not log.records:
            raise InvalidValue(f"{log.path}: the log holds no ticks, there is nothing to plot")
    common = stretches(one.phases, other.phases)
    spans: list[Span] = [(s.phase, s.start_s, s.end_s) for s in common]
    whole_s = (0.0, max(spans[-1][2], 1e-3))
    figure = new_figure(*SIZE_IN)
    axes: list[Axes] = list(figure.subplots(8, 1, sharex=True))
    for ax, (name, unit, scale, label) in zip(axes, (*AXES, YAW), strict=False):
        _overlay(ax, logs, common, [_error(log, f"e{name}_{unit}", scale) for log in logs])
        ax.axhline(0.0, color=GREY, linewidth=0.8)
        ax.set_ylabel(f"error {label}")
    _overlay(axes[4], logs, common, [_aside_mm(log) for log in logs])
    axes[4].set_yscale("log")
    axes[4].set_ylim(ASIDE_MM)
    axes[4].yaxis.set_major_formatter(LogFormatter())
    axes[4].set_ylabel("aside [mm]")
    for ax, key, scale, label in (
        (axes[5], "z_m", 1.0, "height [m]"),
        (axes[6], "thrust", 1 / 655.35, "thrust [%]"),
        (axes[7], "battery_v", 1.0, "battery [V]"),
    ):
        _overlay(ax, logs, common, [scale * log.column(key) for log in logs])
        ax.set_ylabel(label)
    for ax in axes:
        ax.set_xlim(whole_s)
        shade_spans(ax, spans)
        ax.grid(True, color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
    name_spans(axes[0], spans, whole_s)
    axes[-1].set_xlabel("time, each phase from where it began in both [s]")
    figure.align_ylabels(axes)
    figure.legend(handles=_legend(logs), loc="outside upper center", ncols=1, fontsize=9)
    save_figure(figure, path)


def _error(log: FlightLog, key: str, scale: float) -> Array:
    values = while_tracked(log, log.column(key))
    return scale * (unbroken(values) if key.startswith("eyaw") else values)


def _aside_mm(log: FlightLog) -> Array:
    """Horizontally, from the gear to the target."""
    return np.hypot(_error(log, "ex_m", 1e3), _error(log, "ey_m", 1e3))


def _overlay(
    ax: Axes, logs: Sequence[FlightLog], common: Sequence[Stretch], values: Sequence[Array]
) -> None:
    for which, (log, (colour, width, _)) in enumerate(zip(logs, _STYLES, strict=True)):
        pieces_s, pieces = [], []
        for stretch in common:
            inside, t_s = ticks_of(log, stretch, which)
            # A gap behind each: the next phase begins where the longer stay has ended.
            pieces_s += [t_s, np.array([np.nan])]
            pieces += [values[which][inside], np.array([np.nan])]
        ax.plot(np.concatenate(pieces_s), np.concatenate(pieces), color=colour, linewidth=width)


def _legend(logs: Sequence[FlightLog]) -> list[Line2D]:
    handles = []
    for log, (colour, width, name) in zip(logs, _STYLES, strict=True):
        shown = str(log.path)
        if len(shown) > _MOST_OF_A_PATH:
            shown = f"...{shown[3 - _MOST_OF_A_PATH :]}"
        text = f"{name}: {shown}   |   {title_of(log, summarise_flight(log))}".replace("\n", " ")
        handles.append(Line2D([], [], color=colour, linewidth=width, label=text))
    return handles


# --- Two flights on one time: each phase begins at the same moment in both ---------------------


@dataclass(frozen=True)
class Stretch:
    """One phase on the common time, as long as the longer of the two stays in it.

    `stays`: the two flights' own, in the order of the flights; None where it was not flown.
    """

    phase: str
    start_s: float
    end_s: float
    stays: tuple[PhaseSpan | None, PhaseSpan | None]


def stretches(one: Sequence[PhaseSpan], other: Sequence[PhaseSpan]) -> tuple[Stretch, ...]:
    """The phases of both in an order that is each flight's own.

    What only one of them flew, as a second attempt, stands alone.
    """
    found: list[Stretch] = []

    def add(a: PhaseSpan | None, b: PhaseSpan | None) -> None:
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


def ticks_of(log: FlightLog, stretch: Stretch, which: int) -> tuple[Any, Array]:
    """Which of the flight's ticks (0: the first flight's) lie in the stretch, (n,) bool, and when
    on the common time these are, (k,)."""
    stay = stretch.stays[which]
    t_s = log.column("t_s")
    if stay is None:
        return np.zeros(len(t_s), dtype=bool), np.empty(0)
    inside = (t_s >= stay.start_s) & (t_s <= stay.end_s)
    return inside, t_s[inside] - stay.start_s + stretch.start_s
