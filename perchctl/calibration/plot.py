"""One picture of a calibration, to see at a glance whether to fly with it."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from perchctl.calibration.lens import PARAMETERS, pixel_derivatives, rays_of
from perchctl.calibration.predict import draws, ray_errors_px
from perchctl.calibration.types import Calibration
from perchctl.calibration.verdict import Level, level, limit_mm, sentence
from perchctl.geometry import Array
from perchctl.plot import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    GRID,
    ORANGE,
    SKY,
    VERMILLION,
    new_figure,
    save_png,
)
from perchctl.vision.camera_model import distort, undistort

BANNER: dict[Level, str] = {"fly": GREEN, "care": "#B36B00", "stop": "#B00020"}
SIZE_IN = (13.0, 11.5)
DPI = 100
_ARROW_SHARE = 0.06  # of the width: the largest residual's arrow
_MOST_NAMES = 45
LIMIT_LOW = 0.5  # mm: the axis reaches down to it


def draw_calibration(calibration: Calibration) -> bytes:
    """The report as a PNG."""
    figure = new_figure(*SIZE_IN, dpi=DPI)
    grid = figure.add_gridspec(4, 2, height_ratios=(0.22, 1.25, 1.0, 1.0))
    _banner(figure.add_subplot(grid[0, :]), calibration)
    _coverage(figure.add_subplot(grid[1, 0]), calibration)
    _residuals(figure.add_subplot(grid[1, 1]), calibration)
    _views(figure.add_subplot(grid[2, 0]), calibration)
    _target(figure.add_subplot(grid[2, 1]), calibration)
    _distortion(figure.add_subplot(grid[3, 0]), calibration)
    _numbers(figure.add_subplot(grid[3, 1]), calibration)
    content = io.BytesIO()
    save_png(figure, content)
    return content.getvalue()


def _banner(ax: Axes, calibration: Calibration) -> None:
    ax.set_axis_off()
    colour = BANNER[level(calibration)]
    ax.add_patch(Rectangle((0, 0), 1, 1, transform=ax.transAxes, color=colour))
    # Outside of the layout: a long sentence must not squeeze the panels.
    style: dict[str, Any] = {"transform": ax.transAxes, "color": "white", "in_layout": False}
    verdict = sentence(calibration)
    size = 15 if len(verdict) < 100 else 11.5
    ax.text(0.012, 0.64, verdict, fontsize=size, weight="bold", va="center", **style)
    lines = _notes(calibration)
    ax.text(0.012, 0.22, _plain("   |   ".join(lines)), fontsize=9.5, va="center", **style)


def _notes(calibration: Calibration) -> list[str]:
    out = [r for r in calibration.rejections if not r.corners]
    notes = [
        f"{len(calibration.views)} views, RMS {calibration.solution.rms_px:.3f} px",
        f"{len(out)} views rejected" if out else "no view rejected",
    ]
    return notes + [_shorter(w, 90) for w in map(str, calibration.lacks[:2])]


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
    *_, each = ray_errors_px(calibration.camera, calibration.solution.covariance)
    error = each.reshape(13, 17)
    if np.isfinite(error).all():
        x, y = np.linspace(0, w - 1, 17), np.linspace(0, h - 1, 13)
        lines = ax.contour(
            x, y, error, levels=(0.1, 0.3, 1, 3, 10), colors=BLACK, linewidths=0.8, alpha=0.7
        )
        ax.clabel(lines, fmt="%g px", fontsize=8)
    covered = 100 * calibration.covered.mean()
    ax.set_title(
        f"Coverage {covered:.0f} %: orange is uncovered; lines: 95 % error of a ray", fontsize=10
    )
    _frame(ax, w, h)


def _residuals(ax: Axes, calibration: Calibration) -> None:
    w, h = calibration.camera.size_px
    points = np.concatenate([v.corners_px for v in calibration.views])
    residuals = np.concatenate(calibration.solution.residuals_px)
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
    rms = dict(
        zip([v.name for v in calibration.views], calibration.solution.view_rms_px(), strict=True)
    )
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
    ax.axhline(calibration.solution.rms_px, color=BLACK, linewidth=0.9, linestyle="--")
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
    ax.plot(z_cm, worst, "o--", color=GREY, markersize=3, linewidth=1, label="worst in the picture")
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


def _distortion(ax: Axes, calibration: Calibration) -> None:
    camera = calibration.camera
    w, h = camera.size_px
    centre = camera.K[:2, 2]
    corners = np.array([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]], dtype=np.float64)
    away = corners - centre
    far = away[np.argmax(np.linalg.norm(away, axis=1))]
    r_px, shift, spread = _radial(calibration, far)
    ax.fill_between(r_px, shift - spread, shift + spread, color=SKY, alpha=0.4, linewidth=0)
    ax.plot(r_px, shift, color=BLUE, linewidth=1.8)
    ax.axhline(0, color=GREY, linewidth=0.8)
    used = np.concatenate(
        [np.linalg.norm(v.corners_px - centre, axis=1) for v in calibration.views]
    )
    ax.axvline(float(used.max()), color=VERMILLION, linewidth=1.2, linestyle=":")
    ax.text(float(used.max()), 0.96, " outermost corner seen", fontsize=8, va="top", ha="right",
            rotation=90, transform=ax.get_xaxis_transform())  # fmt: skip
    low, high = float(shift.min()), float(shift.max())
    margin = 0.25 * (high - low) + 0.5
    ax.set_ylim(low - margin, high + margin)
    ax.set_xlim(0, float(r_px.max()))
    ax.set_xlabel("distance from the image centre [px]")
    ax.set_ylabel("moved by the lens [px]")
    ax.set_title(f"Distortion ({camera.model}) with its 95 % band", fontsize=10)
    ax.grid(True, color=GRID, linewidth=0.6)


def _radial(calibration: Calibration, far_px: Array) -> tuple[Array, Array, Array]:
    """Along a half diagonal: pixels from the centre, the lens's shift and its 95 % line."""
    camera = calibration.camera
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    centre = camera.K[:2, 2]
    edge = undistort((centre + far_px)[None], camera)[0]
    rays = np.linspace(0, 1, 60)[:, None] * edge
    seen = distort(rays, camera) - centre
    outward = far_px / np.linalg.norm(far_px)
    shift = (seen - rays * focal) @ outward
    L = pixel_derivatives(camera, rays_of(rays)).copy()
    L[:, :, :4] = 0.0  # the band is of the distortion alone
    moved = np.einsum("nkp,dp,k->nd", L, draws(calibration.solution.covariance), outward)
    return seen @ outward, shift, 1.96 * moved.std(axis=1)


def _numbers(ax: Axes, calibration: Calibration) -> None:
    ax.set_axis_off()
    solution = calibration.solution
    names = PARAMETERS[calibration.camera.model]
    lines = [f"{'':4}{'value':>12}{'+- 1 sigma':>12}"]
    for name, value, std in zip(names, solution.parameters, solution.std, strict=True):
        digits = 2 if name[0] in "fc" else 5
        lines.append(f"{name:4}{value:12.{digits}f}{std:12.{digits}f}")
    lines += ["", f"{'lens model':22}{'RMS':>8}{'held out':>10}"]
    for s in calibration.scores:
        mark = ">" if s.model == calibration.camera.model else " "
        rms = "-" if s.rms_px is None else f"{s.rms_px:.4f}"
        held = "-" if s.held_out_px is None else f"{s.held_out_px:.4f}"
        best = " recommended" if s.model == calibration.recommended else ""
        note = f" ({s.note})" if s.note else ""
        lines.append(f"{mark} {s.model:20}{rms:>8}{held:>10}{best}{_shorter(note, 40)}")
    out = [f"{r.view}: {r.reason}" for r in calibration.rejections]
    out += [f"{r.view}: {r.reason}" for r in calibration.missing]
    if out:
        lines += ["", "left out:"] + [f"  {_shorter(text, 74)}" for text in out[:4]]
        if len(out) > 4:
            lines.append(f"  and {len(out) - 4} more (--json names them)")
    ax.text(
        0.0, 1.0, _plain("\n".join(lines)), family="monospace", fontsize=8.2, va="top", ha="left",
        transform=ax.transAxes, in_layout=False,
    )  # fmt: skip


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
