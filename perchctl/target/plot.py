"""The designer's picture: where each marker is seen, and how exactly."""

from __future__ import annotations

import math
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from perchctl.plot import BLACK, BLUE, GREY, GRID, ORANGE, new_figure, save_png

if TYPE_CHECKING:
    from perchctl.target.design import TargetDesign

SIZE_IN = (9.0, 7.5)
STYLES = {"large": (BLUE, "-", 1.4), "small": (ORANGE, "-", 1.4), "both": (BLACK, "--", 2.0)}
PANELS = (("x, y [mm]", 1e3), ("z [mm]", 1e3), ("turn [deg]", 180.0 / math.pi))


def draw_design(design: TargetDesign) -> bytes:
    """A PNG: bars from the nearest to the farthest range, and the error bound below them."""
    curve = design.curve
    figure = new_figure(*SIZE_IN)
    axes = figure.subplots(4, 1, sharex=True, height_ratios=(0.8, 1, 1, 1))
    _plot_spans(axes[0], design)
    for i, (label, scale) in enumerate(PANELS):
        ax = axes[i + 1]
        for name, (colour, line, width) in STYLES.items():
            values = scale * curve.bounds[name][:, i]
            if np.isfinite(values).any():
                ax.loglog(
                    100.0 * curve.z_m, values, line, color=colour, linewidth=width, label=name
                )
        ax.set_ylabel(label)
        ax.grid(True, which="both", color=GRID, linewidth=0.5)
        _plain_ticks(ax.yaxis)
    if axes[1].get_legend_handles_labels()[0]:
        axes[1].legend(loc="upper left", ncols=3, fontsize=8)
    axes[0].set_xscale("log")
    axes[-1].set_xlabel("range from camera to target [cm]")
    _plain_ticks(axes[-1].xaxis)
    r, optics = design.ranges, design.optics
    figure.suptitle(
        f"{1e3 * design.target.large.side_m:g} mm around {1e3 * design.target.small.side_m:g} mm, "
        f"f {r.focal_px:.0f} px, blur {optics.blur_px:g} px, noise {optics.noise:g}; "
        f"bound for corners of 0.2 px",
        fontsize=11,
    )
    content = BytesIO()
    save_png(figure, content)
    return content.getvalue()


def _plain_ticks(axis: Axis) -> None:
    """1, 2, 5, 10: as numbers, not as powers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axis.set_minor_formatter(NullFormatter())


def _plot_spans(ax: Axes, design: TargetDesign) -> None:
    r = design.ranges
    rows = (("large", r.z3_m, r.z1_m, ("z3", "z1")), ("small", r.z4_m, r.z2_m, ("z4", "z2")))
    for row, (name, near, far, labels) in enumerate(rows):
        if near is None or far is None or near >= far:
            continue
        ax.barh(-row, 100.0 * (far - near), left=100.0 * near, height=0.5, color=STYLES[name][0])
        for at, label, align in ((near, labels[0], "right"), (far, labels[1], "left")):
            ax.annotate(
                f" {label} {100.0 * at:.3g} ",
                (100.0 * at, -row),
                ha=align,
                va="center",
                fontsize=9,
                annotation_clip=False,
            )
    if design.search_range_m is not None and design.search_range_m > 0.0:
        ax.axvline(100.0 * design.search_range_m, color=GREY, linestyle="--", linewidth=1.0)
        ax.annotate(
            "search height ",
            (100.0 * design.search_range_m, -1.35),
            fontsize=8,
            color=GREY,
            ha="right",
        )
    ax.set_yticks([0, -1], ["large", "small"])
    ax.set_ylim(-1.5, 0.7)
    ends = [v for v in (r.z1_m, r.z2_m, r.z3_m, r.z4_m) if v is not None]
    if ends:
        ax.set_xlim(100.0 * min(ends) / 1.8, 100.0 * max(ends) * 1.8)
