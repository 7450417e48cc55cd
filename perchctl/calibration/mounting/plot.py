"""The report of a mounting: how the vehicle was turned, and what is left unexplained."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from perchctl.calibration.mounting.carry import COUNTS_LITTLE, Carried
from perchctl.calibration.mounting.pivot import Pivoted
from perchctl.calibration.mounting.report import MountingReport
from perchctl.calibration.mounting.robust import IN_95
from perchctl.geometry import Array
from perchctl.plot import BLUE, GREEN, GREY, GRID, ORANGE, VERMILLION, new_figure, save_png

WIDTH_IN, ROW_IN, TOP_IN = 12.0, 3.5, 3.4
_AXES = (BLUE, ORANGE, GREEN)
_WIDEST = 99.0  # percentile that still fits on an axis: the outliers lie beyond


def draw_mounting(c: MountingReport) -> bytes:
    """The report as a PNG: the numbers, and a row of panels for each part that was done."""
    rows = [part for part in (c.carried, c.pivoted) if part is not None]
    heights_in = [TOP_IN] + [ROW_IN] * len(rows)
    figure = new_figure(WIDTH_IN, sum(heights_in))
    halves = figure.subfigures(len(heights_in), 1, squeeze=False, height_ratios=heights_in)[:, 0]
    top = halves[0].add_gridspec(1, 2, width_ratios=(1.6, 1.0))
    _numbers(halves[0].add_subplot(top[0, 0]), c.lines())
    _from_above(halves[0].add_subplot(top[0, 1]), c)
    for half, part in zip(halves[1:], rows, strict=True):
        half.suptitle(_title(part), fontsize=11, weight="bold")
        left, right = half.subplots(1, 2)
        if isinstance(part, Carried):
            _rotations(left, part)
            _residuals(right, part)
        else:
            _tip(left, part)
            _tip_in_time(right, part)
    content = io.BytesIO()
    save_png(figure, content)
    return content.getvalue()


def _numbers(axes: Axes, lines: list[str]) -> None:
    axes.axis("off")
    axes.text(
        0.0, 1.0, "The mounting as measured", transform=axes.transAxes, va="top", fontsize=13,
        weight="bold",
    )  # fmt: skip
    axes.text(
        0.0, 0.86, "\n".join(lines), transform=axes.transAxes, va="top", family="monospace",
        fontsize=8.5, linespacing=1.6,
    )  # fmt: skip


def _from_above(axes: Axes, c: MountingReport) -> None:
    """Camera, gear and the picture's right and bottom in the body, forward up: measured, and as
    the profile has it."""
    mount, tip_m = c.profile.camera.mount, np.array(c.profile.vehicle.gear_body_m)
    R, cam_m = mount.T_body_cam[:3, :3], np.array(mount.position_m)
    places = (cam_m, tip_m, c.cam_body_m, c.gear_body_m)
    reach_mm = 1.5 * (25.0 + 1e3 * max(float(np.abs(place[:2]).max()) for place in places))
    told = ("camera, by your profile", "gear's tip, by your profile")
    # Larger, so that it shows around what was measured at the same place.
    _draw_mount(axes, R, cam_m, tip_m, GREY, told, 0.27 * reach_mm, size=11.0)
    tip_label = "gear's tip, as measured" if c.pivoted is not None else ""
    found = (c.R_body_cam, c.cam_body_m, c.gear_body_m)
    named = (c.camera_label, tip_label)
    _draw_mount(axes, *found, BLUE, named, 0.27 * reach_mm, ("right", "bottom"))
    axes.plot(0, 0, "+", color="black", markersize=10, label="middle of the vehicle")
    axes.set(
        xlim=(-reach_mm, reach_mm), ylim=(-reach_mm, reach_mm), aspect="equal",
        xlabel="to the right, mm", ylabel="forward, mm",
        title="From above, with the picture's right and bottom",
    )  # fmt: skip
    axes.title.set_fontsize(10)
    axes.grid(color=GRID)
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.02, 1.0), frameon=False)


def _draw_mount(
    axes: Axes,
    R: Array,
    cam_m: Array,
    tip_m: Array,
    colour: str,
    names: tuple[str, str],
    arrow_mm: float,
    labels: tuple[str, str] = ("", ""),
    size: float = 6.0,
) -> None:
    """`names` of camera and tip; what has none is left out."""
    x, y = _above(cam_m)
    for k, label in enumerate(labels):
        dx, dy = _above(1e-3 * arrow_mm * R[:, k])
        style = {"arrowstyle": "->", "color": colour, "lw": 2.0}
        axes.annotate("", (x + dx, y + dy), (x, y), arrowprops=style)
        at = (x + 1.4 * dx, y + 1.25 * dy)
        axes.text(*at, label, color=colour, ha="center", va="center", fontsize=8)
    camera, tip = names
    if camera:
        axes.plot(x, y, "s", color=colour, markersize=size, label=camera)
    if tip:
        axes.plot(*_above(tip_m), "o", color=colour, markersize=size, mfc="none", label=tip)


def _above(p_m: Array) -> tuple[float, float]:
    """Of a body's x forward, y left, as it is drawn, mm."""
    return -1e3 * float(p_m[1]), 1e3 * float(p_m[0])


def _title(part: Carried | Pivoted) -> str:
    if isinstance(part, Pivoted):
        return f"Pivot: {len(part.t_s)} pictures"
    jitter_ms = 1e3 * IN_95 * part.jitter_s
    return f"Carry: {len(part.t_s)} pictures, single ones {jitter_ms:.0f} ms later or earlier"


def _rotations(axes: Axes, c: Carried) -> None:
    roll, pitch, yaw = np.degrees(c.body_rpy_rad).T
    shown = axes.scatter(roll, pitch, c=yaw - yaw.min(), s=7, cmap="viridis")
    axes.figure.colorbar(shown, ax=axes, label="heading from its least (deg)")
    _labelled(axes, "How the vehicle was turned", "roll (deg)", "pitch (deg, nose down)")


def _residuals(axes: Axes, c: Carried) -> None:
    size = np.degrees(np.linalg.norm(c.residual_rad, axis=1))
    good = _points(axes, c.t_s - c.t_s[0], size, c.counted)
    axes.set_ylim(0.0, 1.2 * _widest(size[good]))
    _labelled(axes, "Misfit", "time (s)", "felt against seen (deg)")


def _tip(axes: Axes, p: Pivoted) -> None:
    """Seen along the target's normal."""
    way_mm = 1e3 * p.residual_m
    good = _points(axes, way_mm[:, 0], way_mm[:, 1], p.counted)
    reach = 1.3 * _widest(way_mm[good])
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    _labelled(axes, "The tip, from where it stands", "target x (mm)", "target y (mm)")


def _tip_in_time(axes: Axes, p: Pivoted) -> None:
    """A tip that slips steps here."""
    for k, (name, colour) in enumerate(zip("xyz", _AXES, strict=True)):
        axes.plot(
            p.t_s - p.t_s[0], 1e3 * p.residual_m[:, k], ".", markersize=3, color=colour, label=name
        )
    reach = 1.5e3 * _widest(p.residual_m[p.counted > COUNTS_LITTLE])
    axes.set_ylim(-reach, reach)
    axes.legend(fontsize=8, loc="upper right", ncols=3)
    _labelled(axes, "The tip over time", "time (s)", "from its point (mm)")


def _points(axes: Axes, x: Array, y: Array, counted: Array) -> NDArray[np.bool_]:
    """Draws what counts, and what is left out; True where a pose counts, (n,)."""
    good = counted > COUNTS_LITTLE
    axes.plot(x[good], y[good], ".", markersize=3, color=BLUE, label="counts")
    if not good.all():
        left = f"left out: {(~good).sum()}"
        axes.plot(x[~good], y[~good], "x", markersize=4, color=VERMILLION, label=left)
    axes.legend(fontsize=8, loc="upper right")
    return good


def _widest(values: Array) -> float:
    """But for outliers, and never nothing: an axis needs some width."""
    return float(np.percentile(np.abs(values), _WIDEST)) + 1e-6 if values.size else 1.0


def _labelled(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
