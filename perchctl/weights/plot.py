"""One picture of a fit of the merge weights: does LMS settle, what is gained, how sure."""

from __future__ import annotations

import math
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, ScalarFormatter

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
from perchctl.weights.data import AXES
from perchctl.weights.fit import LABELS, PAPER_WEIGHTS
from perchctl.weights.result import Result

SIZE_IN = (14.0, 10.5)
_UNITS = (("mm", 1e3), ("mm", 1e3), ("mm", 1e3), ("deg", 180.0 / math.pi))
_COLOURS = {"lms": BLUE, "nlms": SKY, "closed_form": BLACK, "inverse_variance": VERMILLION}
_SHORT = ("LMS", "norm. LMS", "closed\nform", "inverse\nvariance")
_SINGLE = {
    "large": (SKY, "o"),
    "small": (ORANGE, "^"),
    "paper": (PURPLE, "D"),
    "joint": (GREEN, "x"),
}


def draw_weights(result: Result) -> bytes:
    """A PNG: learning curves, errors by position, weights with intervals; a column an axis."""
    figure = new_figure(*SIZE_IN)
    axes = figure.subplots(3, len(AXES))
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
    handles, labels = axes[1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9)
    weights = zip(AXES, result.recommended, strict=True)
    verdict = "recommended: " + ", ".join(f"{axis} {w:.3f}" for axis, w in weights)
    name = Path(result.errors.name).name.replace("$", r"\$")
    figure.suptitle(
        f"{name}   |   {len(result.errors)} rows of {len(result.errors.positions)} positions   |   "
        + (verdict if any(result.proven) else "no weights are recommended"),
        fontsize=12,
    )
    content = BytesIO()
    save_png(figure, content)
    return content.getvalue()


def _learning(ax: Axes, result: Result, k: int) -> None:
    for name in ("lms", "nlms"):
        run = result.runs[name]
        rows = np.maximum(run.rows, 1.0)
        ax.plot(rows, run.curve[:, k], color=_COLOURS[name], linewidth=1.2, label=LABELS[name])
    closed = float(result.fits["closed_form"].raw[k])
    ax.axhline(closed, color=BLACK, linestyle="--", linewidth=1.0, label="closed form")
    ax.axhline(PAPER_WEIGHTS[k], color=PURPLE, linestyle=":", linewidth=1.2, label="the paper's")
    ax.set_xscale("log")
    ax.set_xlabel("rows run through")
    ax.set_title(f"{AXES[k]}: learning curve", fontsize=10)


def _by_position(ax: Axes, result: Result, k: int) -> None:
    unit, scale = _UNITS[k]
    chosen = f"{LABELS[result.chosen]}, position left out of the fit"
    shown = [(name, *style, LABELS[name], "full") for name, style in _SINGLE.items()]
    for name, colour, marker, label, fill in (*shown, (result.chosen, BLACK, "s", chosen, "none")):
        if name in result.evidence.methods:
            rms = scale * result.evidence.methods[name].by_position[:, k]
            ax.plot(
                np.arange(len(rms)) + 1, np.where(rms > 0.0, rms, np.nan), linestyle="none",
                marker=marker, color=colour, markersize=5, fillstyle=fill, label=label,
            )  # fmt: skip
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    ax.set_xlabel("position")
    ax.set_ylabel(f"RMS error [{unit}]")
    ax.set_title(f"{AXES[k]}: error by position", fontsize=10)


def _weights(ax: Axes, result: Result, k: int) -> None:
    for i, (name, colour) in enumerate(_COLOURS.items()):
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
    ax.set_xticks(range(len(_SHORT)), _SHORT, fontsize=8)
    ax.set_xlim(-0.5, len(_SHORT) - 0.2)
    verdict = "proven to help" if result.proven[k] else "not proven to help"
    ax.set_title(f"{AXES[k]}: {verdict}", fontsize=10)
