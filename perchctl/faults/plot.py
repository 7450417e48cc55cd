"""The heat map of a fault campaign: faults against phases, the worst of each cell."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.patches import Patch, Rectangle

from perchctl.faults.catalogue import FAULTS
from perchctl.faults.oracle import Flag
from perchctl.faults.result import FaultResult
from perchctl.faults.summary import PHASES
from perchctl.plot import BLACK, GREY, new_figure, save_png

KINDS: tuple[tuple[str, str], ...] = (
    ("perched", "#C9E4D4"),
    ("landed", "#E8F1FA"),
    ("ended otherwise", "#F3E9C0"),
    ("unavoidable", "#B9B9B9"),
    ("wrong", "#E8A33D"),
    ("fell, flies on, stop ignored", "#C8372D"),
)
"""From good to bad; a cell has the colour of its worst flight."""
GRAVE: frozenset[Flag] = frozenset({"crashed", "fell", "flies_on", "endless", "stop_not_obeyed"})
"""Somebody or something may get hurt."""


def plot_heat_map(results: Sequence[FaultResult], png_path: Path) -> None:
    """Draw it into a PNG. Raises InvalidValue for a file that cannot be written."""
    flown = {r.fault for r in results}
    faults = [fault.name for fault in FAULTS if fault.name in flown]
    figure = new_figure(9.0, 1.8 + 0.24 * len(faults))
    axes = figure.subplots()
    for row, fault in enumerate(faults):
        for column, phase in enumerate(PHASES):
            here = [r for r in results if r.fault == fault and r.phase == phase]
            if not here:
                continue
            worst = max(map(kind_of, here))
            axes.add_patch(_square(column, row, KINDS[worst][1]))
            wrong = sum(bool(r.counted) for r in here)
            text = f"{wrong} of {len(here)}" if wrong else str(len(here))
            axes.text(column, row, text, ha="center", va="center", fontsize=7, color=BLACK)
    axes.set_xlim(-0.5, len(PHASES) - 0.5)
    axes.set_ylim(len(faults) - 0.5, -0.5)
    axes.set_xticks(range(len(PHASES)), PHASES, fontsize=7)
    axes.set_yticks(range(len(faults)), faults, fontsize=8)
    axes.tick_params(length=0)
    axes.xaxis.tick_top()
    for side in axes.spines.values():
        side.set_visible(False)
    legend = [Patch(facecolor=colour, edgecolor=GREY, label=name) for name, colour in KINDS]
    axes.legend(
        handles=legend, loc="upper center", bbox_to_anchor=(0.4, 0.0), ncols=len(KINDS),
        fontsize=7, frameon=False,
    )  # fmt: skip
    save_png(figure, png_path)


def kind_of(result: FaultResult) -> int:
    """Which of `KINDS` a flight is."""
    if GRAVE & set(result.counted):
        return 5
    if result.counted:
        return 4
    if result.flags:
        return 3
    return {"perched": 0, "landed": 1}.get(result.end, 2)


def _square(column: int, row: int, colour: str) -> Rectangle:
    corner = (column - 0.5, row - 0.5)
    return Rectangle(corner, 1.0, 1.0, facecolor=colour, edgecolor="white", linewidth=1.0)
