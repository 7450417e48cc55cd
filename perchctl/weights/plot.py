"""One picture of a fit of the merge weights: does LMS settle, what is gained, how sure."""

from __future__ import annotations

import math
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

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
from perchctl.weights.evidence import LABELS
from perchctl.weights.result import Result
from perchctl.weights.types import AXES, PAPER_WEIGHTS

SIZE_IN = (14.0, 10.5)
NAMES = ("x", "y", "z", r"$\psi$")
_UNITS = ("mm", "mm", "mm", "deg")
_SCALES = (1e3, 1e3, 1e3, 180.0 / math.pi)
_SHOWN = {
    "large": (SKY, "o"),
    "small": (ORANGE, "^"),
    "paper": (PURPLE, "D"),
    "chosen": (BLACK, "s"),
    "joint": (GREEN, "x"),
}
_BARS = {
    "lms": (BLUE, "LMS"),
    "nlms": (SKY, "norm. LMS"),
    "closed_form": (BLACK, "closed\nform"),
    "inverse_variance": (VERMILLION, "inverse\nvariance"),
}
_TICKS = (
    (0.8, (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)),
    (2.0, (1.0, 2.0, 5.0)),
    (math.inf, (1.0,)),
)
"""Of a decade: those that do not crowd on an axis of up to so many decades."""
MOST_POINTS = 2000
MOST_POSITIONS = 200


def draw_weights(result: Result) -> bytes:
    """A PNG: learning curves, errors by position, weights with intervals; a column an axis."""
    figure = new_figure(*SIZE_IN)
    axes = figure.subplots(3, 4)
    for k in range(len(AXES)):
        _learning(axes[0, k], result, k)
        _by_position(axes[1, k], result, k)
        _weights(axes[2, k], result, k)
        for ax in axes[:, k]:
            ax.grid(True, color=GRID, linewidth=0.6)
            ax.set_axisbelow(True)
    axes[0, 0].set_ylabel("weight of the large marker")
    axes[2, 0].set_ylabel("weight, 95 % over positions")
    axes[0, 0].legend(fontsize=8, loc="best")
    handles = [
        Line2D([], [], linestyle="none", marker=marker, color=colour, label=_label(result, name))
        for name, (colour, marker) in _SHOWN.items()
        if _method(result, name) in result.evidence.methods
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9)
    errors = result.errors
    name = Path(errors.name).name.replace("$", r"\$")
    figure.suptitle(
        f"{name}   |   {len(errors)} rows of {len(errors.positions)} positions   |   "
        + (
            "recommended: " + ", ".join(
                f"{axis} {w:.3f}" for axis, w in zip(AXES, result.recommended, strict=True)
            )
            if any(result.proven)
            else "no weights are recommended"
        ),
        fontsize=12,
    )  # fmt: skip
    content = BytesIO()
    save_png(figure, content)
    return content.getvalue()


def _method(result: Result, name: str) -> str:
    return result.chosen if name == "chosen" else name


def _label(result: Result, name: str) -> str:
    label = LABELS[_method(result, name)]
    return f"{label}, position left out of the fit" if name == "chosen" else label


def _learning(ax: Axes, result: Result, k: int) -> None:
    for name, colour in (("lms", BLUE), ("nlms", ORANGE)):
        run = result.runs[name]
        # Even in the logarithm, as the axis is.
        last = len(run.rows) - 1
        shown = np.unique(
            np.rint(np.geomspace(1, last + 1, min(last + 1, MOST_POINTS))).astype(int) - 1
        )
        ax.plot(
            np.maximum(run.rows[shown], 1.0), run.curve[shown, k], color=colour, linewidth=1.2,
            label=LABELS[name],
        )  # fmt: skip
    closed = float(result.fits["closed_form"].raw[k])
    ax.axhline(closed, color=BLACK, linestyle="--", linewidth=1.0, label="closed form")
    ax.axhline(PAPER_WEIGHTS[k], color=PURPLE, linestyle=":", linewidth=1.2, label="the paper's")
    ax.set_xscale("log")
    _plain_ticks(ax.xaxis, (1, last + 1))
    ax.set_xlabel("rows run through")
    ax.set_title(f"{NAMES[k]}: learning curve", fontsize=10)


def _by_position(ax: Axes, result: Result, k: int) -> None:
    positions = result.errors.positions
    shown = np.unique(
        np.linspace(0, len(positions) - 1, min(len(positions), MOST_POSITIONS)).astype(int)
    )
    for name, (colour, marker) in _SHOWN.items():
        method = result.evidence.methods.get(_method(result, name))
        if method is None:
            continue
        rms = _SCALES[k] * method.by_position[shown, k]
        ax.plot(
            shown + 1, np.where(rms > 0.0, rms, np.nan), linestyle="none", marker=marker,
            color=colour, markersize=5, fillstyle="none" if name == "chosen" else "full",
        )  # fmt: skip
    ax.set_yscale("log")
    _plain_ticks(ax.yaxis, ax.get_ylim())
    ax.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    ax.set_xlabel("position")
    ax.set_ylabel(f"RMS error [{_UNITS[k]}]")
    ax.set_title(f"{NAMES[k]}: error by position", fontsize=10)


def _plain_ticks(axis: Axis, shown: tuple[float, float]) -> None:
    """A few ticks of a logarithmic axis, as plain numbers."""
    decades = math.log10(max(shown) / max(min(shown), 1e-300))
    subs = next(subs for most, subs in _TICKS if decades <= most)
    axis.set_major_locator(LogLocator(subs=subs, numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.10g}"))
    axis.set_minor_locator(NullLocator())


def _weights(ax: Axes, result: Result, k: int) -> None:
    for i, (name, (colour, _)) in enumerate(_BARS.items()):
        fit = result.fits[name]
        low, high = float(fit.low[k]), float(fit.high[k])
        if math.isfinite(low) and math.isfinite(high):
            ax.plot([i, i], [low, high], color=colour, linewidth=2.0)
        ax.plot([i], [fit.raw[k]], marker="o", color=colour, markersize=6)
        ax.annotate(f"{fit.weights[k]:.3f}", (i, fit.raw[k]), xytext=(6, 2), fontsize=8,
                    textcoords="offset points", va="bottom")  # fmt: skip
    ax.axhline(PAPER_WEIGHTS[k], color=PURPLE, linestyle=":", linewidth=1.2)
    for edge in (0.0, 1.0):
        ax.axhline(edge, color=GREY, linewidth=0.8)
    ax.set_xticks(range(len(_BARS)), [label for _, label in _BARS.values()], fontsize=8)
    ax.set_xlim(-0.5, len(_BARS) - 0.2)
    ax.set_title(
        f"{NAMES[k]}: " + ("proven to help" if result.proven[k] else "not proven to help"),
        fontsize=10,
    )
