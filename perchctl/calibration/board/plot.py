"""One picture of a calibration, to see at a glance whether to fly with it."""

from __future__ import annotations

import io
from collections.abc import Sequence
from textwrap import wrap
from warnings import catch_warnings, simplefilter

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from perchctl.calibration.board.adjust import PARAMETERS
from perchctl.calibration.board.predict import limit_mm, ray_errors_px
from perchctl.calibration.board.result import Calibration, Level
from perchctl.plot import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    GRID,
    ORANGE,
    VERMILLION,
    new_figure,
    save_png,
)

BANNER: dict[Level, str] = {"fly": GREEN, "care": "#B36B00", "stop": "#B00020"}
WIDTH_IN, PANELS_IN = 13.0, 10.8
DPI = 100
_HEADLINE_PT, _NOTES_PT = 13.5, 9.5
_HEADLINE_CHARS, _NOTES_CHARS = 104, 150
"""As many fit into the banner's width."""
_LINE_IN = 1.45 / 72.0  # height of a line of one point
_MARGIN_IN = 0.11
_ARROW_SHARE = 0.06  # of the width: the largest residual's arrow
_MOST_NAMES = 45
_MOST_LINES = 22  # of what was left out
LIMIT_LOW = 0.5  # mm: the axis reaches down to it


def draw_calibration(calibration: Calibration) -> bytes:
    """The report as a PNG."""
    content = io.BytesIO()
    save_png(report_figure(calibration), content)
    return content.getvalue()


def report_figure(calibration: Calibration) -> Figure:
    """The verdict in a banner, four panels, and the numbers."""
    headline = wrap(calibration.sentence, _HEADLINE_CHARS)
    notes = [line for note in _notes(calibration) for line in wrap(note, _NOTES_CHARS)]
    banner_in = 2 * _MARGIN_IN + _LINE_IN * (_HEADLINE_PT * len(headline) + _NOTES_PT * len(notes))
    figure = new_figure(WIDTH_IN, banner_in + PANELS_IN, dpi=DPI)
    halves = figure.add_gridspec(2, 1, height_ratios=(banner_in, PANELS_IN))
    banner, panels = figure.add_subfigure(halves[0]), figure.add_subfigure(halves[1])
    banner.set_facecolor(BANNER[calibration.level])
    _write(banner, banner_in, headline, notes)
    grid = panels.add_gridspec(3, 2, height_ratios=(1.25, 1.0, 1.0))
    _coverage(panels.add_subplot(grid[0, 0]), calibration)
    _residuals(panels.add_subplot(grid[0, 1]), calibration)
    _views(panels.add_subplot(grid[1, 0]), calibration)
    _target(panels.add_subplot(grid[1, 1]), calibration)
    _numbers(panels.add_subplot(grid[2, 0]), _number_lines(calibration))
    _numbers(panels.add_subplot(grid[2, 1]), _left_out_lines(calibration))
    return figure


def _write(
    banner: SubFigure, height_in: float, headline: Sequence[str], notes: Sequence[str]
) -> None:
    """Line by line from the top."""
    top_in = _MARGIN_IN
    for lines, size_pt, weight in ((headline, _HEADLINE_PT, "bold"), (notes, _NOTES_PT, "normal")):
        for line in lines:
            top_in += _LINE_IN * size_pt
            banner.text(
                0.012, 1.0 - (top_in - 0.3 * _LINE_IN * size_pt) / height_in, _plain(line),
                fontsize=size_pt, weight=weight, color="white", va="baseline",
            )  # fmt: skip


def _notes(calibration: Calibration) -> list[str]:
    """What it rests on, and whole sentences on what would mend it."""
    out = [r for r in calibration.rejections if not r.corners]
    found = (
        f"{len(calibration.views)} views, RMS {calibration.fit.rms_px:.3f} px, "
        f"{f'{len(out)} views rejected' if out else 'no view rejected'}"
    )
    return [found, *map(str, calibration.lacks)]


def _coverage(ax: Axes, calibration: Calibration) -> None:
    w, h = calibration.camera.size_px
    extent = (-0.5, w - 0.5, h - 0.5, -0.5)
    shade = np.zeros((*calibration.covered.shape, 4))
    shade[~calibration.covered] = (0.84, 0.37, 0.0, 0.28)
    ax.imshow(shade, extent=extent, interpolation="nearest", aspect="equal")
    for view in calibration.views:
        ax.plot(*view.corners_px.T, ".", markersize=3, color=BLUE)
    used = {v.name for v in calibration.views}
    for view in calibration.seen:
        if view.name not in used:
            ax.plot(*view.corners_px.T, "x", markersize=4, color=VERMILLION)
    *_, each = ray_errors_px(calibration.camera, calibration.covariance)
    error = np.ma.masked_invalid(each.reshape(13, 17))
    x, y = np.linspace(0, w - 1, 17), np.linspace(0, h - 1, 13)
    with catch_warnings():
        simplefilter("ignore", UserWarning)  # there may be no line at all
        lines = ax.contour(x, y, error, levels=(0.1, 0.3, 1, 3, 10), colors=BLACK, alpha=0.7)
    ax.clabel(lines, fmt="%g px", fontsize=8)
    covered = 100 * calibration.covered.mean()
    ax.set_title(
        f"Coverage {covered:.0f} %: orange is uncovered; lines: 95 % error of a ray", fontsize=10
    )
    _frame(ax, w, h)


def _residuals(ax: Axes, calibration: Calibration) -> None:
    w, h = calibration.camera.size_px
    points = np.concatenate([v.corners_px for v in calibration.views])
    residuals = np.concatenate(calibration.fit.residuals)
    length = np.linalg.norm(residuals, axis=1)
    largest = max(float(np.quantile(length, 0.99)), 1e-6)
    scale = _ARROW_SHARE * w / largest
    colours = np.where(length > 3 * np.median(length), VERMILLION, BLUE)
    ax.quiver(
        points[:, 0],
        points[:, 1],
        residuals[:, 0],
        residuals[:, 1],
        color=colours,
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


def _views(ax: Axes, calibration: Calibration) -> None:
    rms = dict(zip([v.name for v in calibration.views], calibration.fit.view_rms_px(), strict=True))
    out = {r.view: r.reason for r in calibration.rejections if not r.corners}
    trimmed = {r.view for r in calibration.rejections if r.corners}
    names = [v.name for v in calibration.seen]
    top = 1.45 * max(rms.values())
    for i, name in enumerate(names):
        if name in out:
            ax.bar(i, top, color="white", edgecolor=VERMILLION, hatch="////", linewidth=1.0)
            ax.text(i, 0.97 * top, "rejected", rotation=90, ha="center", va="top", fontsize=8)
        else:
            ax.bar(i, rms[name], color=ORANGE if name in trimmed else BLUE)
    ax.axhline(calibration.fit.rms_px, color=BLACK, linewidth=0.9, linestyle="--")
    ax.set_ylim(0, top)
    ax.set_xlim(-0.7, len(names) - 0.3)
    if len(names) <= _MOST_NAMES:
        ax.set_xticks(range(len(names)), [_plain(_shorter(n, 14)) for n in names], rotation=60)
        ax.tick_params(axis="x", labelsize=7)
    ax.set_ylabel("RMS [px]")
    more = " (orange: without some corners)" if trimmed else ""
    ax.set_title(f"RMS of each view{more}", fontsize=10)
    ax.grid(True, axis="y", color=GRID, linewidth=0.6)
    ax.set_axisbelow(True)


def _target(ax: Axes, calibration: Calibration) -> None:
    z_cm = 100 * np.array([e.z_m for e in calibration.errors])
    axis = np.array([e.axis_mm95 for e in calibration.errors])
    worst = np.array([e.mm95 for e in calibration.errors])
    fine = np.geomspace(z_cm[0], z_cm[-1], 60)
    limit = np.array([limit_mm(z / 100) for z in fine])
    ax.fill_between(fine, limit, 1e4, color=VERMILLION, alpha=0.13, linewidth=0)
    ax.plot(fine, limit, color=VERMILLION, linewidth=1.2, label="limit for perching")
    ax.plot(
        z_cm,
        worst,
        "o--",
        color=GREY,
        markersize=3,
        linewidth=1,
        label="worst where boards were seen",
    )
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


def _numbers(ax: Axes, lines: Sequence[str]) -> None:
    ax.set_axis_off()
    ax.text(
        0.0, 1.0, _plain("\n".join(lines)), family="monospace", fontsize=7.8, linespacing=1.15,
        va="top", ha="left", transform=ax.transAxes, in_layout=False,
    )  # fmt: skip


def _number_lines(calibration: Calibration) -> list[str]:
    """The lens parameters, and how each model did."""
    fit = calibration.fit
    lines = [f"{'':4}{'value':>12}{'+- 1 sigma':>12}"]
    for name, value, std in zip(
        PARAMETERS[fit.model], fit.parameters, calibration.std, strict=True
    ):
        digits = 2 if name[0] in "fc" else 5
        lines.append(f"{name:4}{value:12.{digits}f}{std:12.{digits}f}")
    lines += ["", f"{'lens model':22}{'RMS':>8}{'held out':>10}"]
    notes = list(dict.fromkeys(s.note for s in calibration.scores if s.note))
    for s in calibration.scores:
        mark = ">" if s.model == fit.model else " "
        rms, held = (
            "-" if value is None else f"{value:.4f}" for value in (s.rms_px, s.held_out_px)
        )
        best = " recommended" if s.model == calibration.recommended else ""
        note = f" ({notes.index(s.note) + 1})" if s.note else ""
        lines.append(f"{mark} {s.model:20}{rms:>8}{held:>10}{best}{note}")
    return lines + [f"({i}) {_shorter(note, 74)}" for i, note in enumerate(notes, start=1)]


def _left_out_lines(calibration: Calibration) -> list[str]:
    out = [f"{r.view}: {r.reason}" for r in (*calibration.rejections, *calibration.missing)]
    if not out:
        return []
    named = out if len(out) <= _MOST_LINES else out[: _MOST_LINES - 1]
    lines = ["left out:"] + [f"  {_shorter(text, 74)}" for text in named]
    if len(out) > len(named):
        lines.append(f"  and {len(out) - len(named)} more (--json names them)")
    return lines


def _frame(ax: Axes, w: int, h: int) -> None:
    ax.set_xlim(-0.5, w - 0.5)
    ax.set_ylim(h - 0.5, -0.5)
    ax.set_aspect("equal")
    ax.tick_params(labelsize=7)


def _shorter(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 3] + "..."


def _plain(text: str) -> str:
    """No mathematics in file names."""
    return text.replace("$", r"\$")
