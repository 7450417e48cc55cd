"""One picture of a calibration, to see at a glance whether to fly with it."""

from __future__ import annotations

from textwrap import wrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from perchctl.calibration.board.predict import limit_mm
from perchctl.calibration.board.solve import Calibration, Level
from perchctl.plot import BLACK, BLUE, GREEN, GREY, GRID, VERMILLION, figure_bytes, new_figure

BANNER: dict[Level, str] = {"fly": GREEN, "care": "#B36B00", "stop": "#B00020"}
WIDTH_IN, PANELS_IN, LINE_IN = 13.0, 8.6, 0.26
DPI = 100
_LINE_CHARS = 104
"""As many fit into the banner's width."""
_ARROW_SHARE = 0.06  # of the width: the largest residual's arrow
LIMIT_LOW = 0.5  # mm: the axis reaches down to it


def draw_calibration(calibration: Calibration) -> bytes:
    """Return the report as a PNG."""
    return figure_bytes(report_figure(calibration))


def report_figure(calibration: Calibration) -> Figure:
    """Return the verdict in a banner, coverage, residuals, and the error at the target."""
    sentences = [calibration.sentence, *calibration.lacks]
    lines = [line for sentence in sentences for line in wrap(sentence, _LINE_CHARS)]
    banner_in = LINE_IN * (len(lines) + 1)
    figure = new_figure(WIDTH_IN, banner_in + PANELS_IN, dpi=DPI)
    halves = figure.add_gridspec(2, 1, height_ratios=(banner_in, PANELS_IN))
    banner = figure.add_subfigure(halves[0])
    panels = figure.add_subfigure(halves[1])
    banner.set_facecolor(BANNER[calibration.level])
    banner.text(
        0.012,
        0.5,
        _plain("\n".join(lines)),
        fontsize=13,
        color="white",
        weight="bold",
        va="center",
        linespacing=1.3,
    )
    axes = panels.subplot_mosaic("ab;cc")
    _draw_coverage(axes["a"], calibration)
    _draw_residuals(axes["b"], calibration)
    _draw_target_error(axes["c"], calibration)
    return figure


def _draw_coverage(ax: Axes, calibration: Calibration) -> None:
    w, h = calibration.camera.size_px
    shade = np.zeros((*calibration.covered.shape, 4))
    shade[~calibration.covered] = (0.84, 0.37, 0.0, 0.28)
    ax.imshow(shade, extent=(-0.5, w - 0.5, h - 0.5, -0.5), interpolation="nearest")
    for view in calibration.views:
        ax.plot(*view.corners_px.T, ".", markersize=3, color=BLUE)
    covered = 100 * calibration.covered.mean()
    ax.set_title(f"Coverage {covered:.0f} %: orange is uncovered", fontsize=10)
    _frame(ax, w, h)


def _draw_residuals(ax: Axes, calibration: Calibration) -> None:
    w, h = calibration.camera.size_px
    points = np.concatenate([v.corners_px for v in calibration.views])
    residuals = np.concatenate(calibration.fit.residuals)
    length = np.linalg.norm(residuals, axis=1)
    largest = max(float(np.quantile(length, 0.99)), 1e-6)
    scale = _ARROW_SHARE * w / largest
    ax.quiver(
        *points.T,
        *residuals.T,
        color=np.where(length > 3 * np.median(length), VERMILLION, BLUE),
        angles="xy",
        scale_units="xy",
        scale=1.0 / scale,
        width=0.0018,
    )
    key = float(f"{largest / 2:.1g}")
    ax.plot([12, 12 + key * scale], [h - 14, h - 14], color=BLACK, linewidth=2)
    ax.text(16 + key * scale, h - 14, f"{key:g} px", fontsize=8, va="center")
    ax.set_title("Residuals: random is good, a pattern is a wrong lens model", fontsize=10)
    _frame(ax, w, h)


def _draw_target_error(ax: Axes, calibration: Calibration) -> None:
    z_cm = 100 * np.array([e.z_m for e in calibration.errors])
    axis = np.array([e.axis_mm95 for e in calibration.errors])
    worst = np.array([e.mm95 for e in calibration.errors])
    limit = np.array([limit_mm(z / 100) for z in z_cm])
    ax.fill_between(z_cm, limit, 1e4, color=VERMILLION, alpha=0.13, linewidth=0)
    ax.plot(z_cm, limit, color=VERMILLION, linewidth=1.2, label="limit for perching")
    aside = "worst where boards were seen"
    ax.plot(z_cm, worst, "o--", color=GREY, markersize=3, linewidth=1, label=aside)
    ax.plot(z_cm, axis, "o-", color=BLUE, markersize=4, linewidth=2, label="straight ahead")
    ax.set_xscale("log")
    ax.set_yscale("log")
    low = 0.5 * min(axis.min(), LIMIT_LOW)
    ax.set_ylim(low, 3 * max(worst.max(), limit.max()))
    ax.set_xlim(z_cm[0], z_cm[-1])
    ticks = (5, 10, 20, 50, 100, 150)
    ax.set_xticks(ticks, [str(t) for t in ticks])
    ax.minorticks_off()
    yticks = [t for t in (0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 100) if t >= low]
    ax.set_yticks(yticks, [f"{t:g}" for t in yticks])
    ax.set_xlabel("distance to the target [cm]")
    ax.set_ylabel("error, 95 % [mm]")
    ax.set_title("Error at the target's centre", fontsize=10)
    ax.grid(True, color=GRID, linewidth=0.6)
    ax.legend(fontsize=8, loc="upper left")


def _frame(ax: Axes, w: int, h: int) -> None:
    ax.set_xlim(-0.5, w - 0.5)
    ax.set_ylim(h - 0.5, -0.5)
    ax.set_aspect("equal")
    ax.tick_params(labelsize=7)


def _plain(text: str) -> str:
    """Return the text with its dollars escaped: no mathematics."""
    return text.replace("$", r"\$")
