"""A film of a flight: the camera's picture, a side view to scale, error and thrust over time."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from perchctl.analysis.flight import FlightAnalysis
from perchctl.errors import InvalidValue
from perchctl.files import cannot_be_written, whole_file
from perchctl.geometry import Array, rot_z, rotation_from_rpy
from perchctl.plot import (
    BLACK,
    BLUE,
    GREY,
    GRID,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    new_figure,
)
from perchctl.record import FlightLog

FULL_THRUST_PERCENT = 1 / 655.35
ARM_M = 0.046
"""From the vehicle's centre to a motor."""
BESIDE_M, ABOVE_M = 0.25, 0.12
"""The side view shows so much more than the flight needs."""
LEAST_ASIDE_M = 0.05
"""A start nearer to the target gives the view no direction."""
LAST_S = 2.0
"""The last picture stays for so long."""
WIDTH_IN, HEIGHT_IN = 9.6, 5.4
GIF_GREYS, GIF_TINTS = 64, 4
"""The colours of a GIF: greys, and so many mixtures of each line's colour with white."""
Rgb = NDArray[np.uint8]
Recorded = Iterator[tuple[int, float, NDArray[np.uint8]]]
"""Recorded pictures: number, time of exposure, grey (height, width)."""


def write_film(
    flight: FlightAnalysis,
    pictures: Recorded | None,
    path: Path,
    rate_hz: float = 15.0,
    width_px: int = 960,
) -> int:
    """Write the flight as a film (.mp4 or .gif), and return its number of pictures.

    Args:
        pictures: the recorded pictures, oldest first; None without a recording.
        rate_hz: pictures a second of flight, of a GIF the next that is whole hundredths of a
            second; the film runs at the flight's own pace.
        width_px: width of the film; its height is 9/16 of it.

    Errors: InvalidValue for a log without ticks, a recording that cannot be read, or a file that
    cannot be written.
    """
    if not flight.log.records:
        raise InvalidValue(f"{flight.log.path}: the log holds no ticks, there is nothing to film")
    period = 1 / Fraction(rate_hz).limit_denominator(1001)
    if path.suffix.lower() == ".gif":
        period = Fraction(max(2, round(100 * period)), 100)
    times_s = np.arange(0.0, flight.log.end_s + LAST_S, float(period))
    try:
        with whole_file(path) as part:
            _write_video(_film_pictures(flight, pictures, times_s, width_px), part, 1 / period)
    except OSError as error:
        raise cannot_be_written(path, error) from None
    return len(times_s)


def _film_pictures(
    flight: FlightAnalysis, recorded: Recorded | None, times_s: Array, width_px: int
) -> Iterator[Rgb]:
    stage = _Stage(flight, width_px)
    shown = _Shown(recorded)
    for t_s in times_s:
        index = flight.log.index_at(float(t_s))
        yield stage.drawn(index, *shown.at(flight.log.records[index]))


class _Shown:
    """The recorded picture that belongs to a tick, with the corners found in it."""

    def __init__(self, pictures: Recorded | None) -> None:
        self._coming: Recorded = iter(()) if pictures is None else pictures
        self._next = next(self._coming, None)
        self._image = None if self._next is None else np.asarray(self._next[2], dtype=float)
        self._corners: dict[str, Array] = {}

    def at(self, record: dict[str, Any]) -> tuple[Array | None, dict[str, Array]]:
        """Return the newest picture of this tick or before, and its markers' corners (4, 2)."""
        number = record.get("frame")
        if number is not None:
            while self._next is not None and self._next[0] <= number:
                self._image = np.asarray(self._next[2], dtype=float)
                self._next = next(self._coming, None)
            self._corners = {
                key: np.reshape(record[key], (4, 2))
                for key in ("large_px", "small_px")
                if record.get(key) is not None
            }
        return self._image, self._corners


class _Stage:
    """The figure: what stays is drawn once, what moves is drawn for each picture."""

    def __init__(self, flight: FlightAnalysis, width_px: int) -> None:
        self._flight, self._ways = flight, Ways(flight)
        self._figure: Figure = new_figure(WIDTH_IN, HEIGHT_IN, width_px / WIDTH_IN)
        grid = self._figure.add_gridspec(2, 2, height_ratios=(2.6, 1.0), width_ratios=(2.0, 1.0))
        self._moving: list[Any] = []
        self._set_picture(self._figure.add_subplot(grid[0, 0]))
        self._set_side_view(self._figure.add_subplot(grid[0, 1]))
        self._set_traces(self._figure.add_subplot(grid[1, :]))
        self._figure.suptitle(" ", fontsize=13)
        self._title = self._add(
            self._figure.text(0.5, 0.985, "", ha="center", va="top", fontsize=13)
        )
        self._canvas = cast(Any, self._figure.canvas)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self._figure.bbox)

    def drawn(self, index: int, image: Array | None, corners: dict[str, Array]) -> Rgb:
        """Return the picture of a tick, (height, width, 3)."""
        self._draw_frame(index, image, corners)
        self._canvas.restore_region(self._still)
        for artist in self._moving:
            (artist.axes or self._figure).draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[:, :, :3].copy()

    def _add(self, artist: Any) -> Any:
        artist.set_animated(True)
        self._moving.append(artist)
        return artist

    def _line(self, ax: Axes, style: str = "-", **more: Any) -> Any:
        return self._add(ax.plot([], [], style, solid_capstyle="butt", **more)[0])

    def _set_picture(self, ax: Axes) -> None:
        ax.set_axis_off()
        camera = self._flight.log.header.get("camera") or {}
        width, height = camera.get("size_px") or (640, 480)
        self._image = self._add(
            ax.imshow(np.zeros((height, width)), cmap="gray", vmin=0.0, vmax=255.0)
        )
        ax.set_xlim(-0.5, width - 0.5)
        ax.set_ylim(height - 0.5, -0.5)
        self._outlines = {
            key: self._line(ax, color=colour, linewidth=1.6)
            for key, colour in (("large_px", SKY), ("small_px", ORANGE))
        }

    def _set_side_view(self, ax: Axes) -> None:
        ways = self._ways
        ax.set_aspect("equal", adjustable="box")
        low_m, high_m = ways.span_m
        ax.set_xlim(low_m - BESIDE_M, high_m + BESIDE_M)
        ax.set_ylim(0.0, ways.top_m + ABOVE_M)
        ax.set_xticks([0.0])
        ax.set_xlabel("beside the target [m]")
        ax.set_ylabel("height [m]")
        if ways.target_z_m is not None:
            ax.axhline(ways.target_z_m, color=GREY, linewidth=1.0)
            half_m = 0.5 * ways.large_side_m
            ax.plot(
                [-half_m, half_m],
                [ways.target_z_m] * 2,
                color=BLACK,
                linewidth=4.0,
                solid_capstyle="butt",
            )
        self._trail = self._line(ax, color=SKY, linewidth=1.0)
        self._setpoint = self._line(ax, "+", color=VERMILLION, markersize=7)
        self._arms = self._line(ax, color=BLUE, linewidth=3.0)
        self._gear = self._line(ax, color=VERMILLION, linewidth=1.8)

    def _set_traces(self, ax: Axes) -> None:
        flight = self._flight
        aside_m = np.hypot(flight.tracked("ex_m"), flight.tracked("ey_m"))
        ax.plot(flight.log.t_s, 100.0 * aside_m, color=PURPLE, linewidth=1.2)
        ax.set_ylabel("off centre [cm]", color=PURPLE)
        ax.set_ylim(bottom=0.0)
        ax.set_xlim(0.0, max(flight.log.end_s, 0.1))
        ax.set_xlabel("time [s]")
        ax.grid(True, color=GRID, linewidth=0.6)
        thrust_ax: Axes = ax.twinx()
        thrust = flight.log.column("thrust") * FULL_THRUST_PERCENT
        thrust_ax.plot(flight.log.t_s, thrust, color=ORANGE, linewidth=1.0)
        thrust_ax.set_ylabel("thrust [%]", color=ORANGE)
        thrust_ax.set_ylim(0.0, 105.0)
        self._cursor = self._add(thrust_ax.axvline(0.0, color=BLACK, linewidth=1.0))

    def _draw_frame(self, index: int, image: Array | None, corners: dict[str, Array]) -> None:
        flight, ways = self._flight, self._ways
        record, t_s = flight.log.records[index], float(flight.log.t_s[index])
        if image is not None:
            self._image.set_data(image)
            for key, line in self._outlines.items():
                outline = corners.get(key, np.empty((0, 2)))
                line.set_data(*np.vstack([outline, outline[:1]]).T)
        place = ways.place_m[index]
        arms, gear = ways.body_m(index)
        self._trail.set_data(*ways.place_m[: index + 1].T)
        self._arms.set_data(*(place + arms).T)
        self._gear.set_data(*np.array([place, place + gear]).T)
        self._setpoint.set_data(*ways.setpoint_m[index : index + 1].T)
        self._cursor.set_xdata([t_s, t_s])
        text = f"{t_s:.1f} s   {record.get('phase') or ''}"
        if record.get("hold"):
            text += " (held)"
        if image is None:
            text += "   (no recorded picture)"
        self._title.set_text(text)


class Ways:
    """Where everything is in the side view: metres beside the target, and above the floor.

    The view's plane is vertical and holds the target and the place of take-off. Everything is shown
    relative to the target as it was estimated then.

    Attributes:
        place_m: the vehicle's centre in each tick, (n, 2); `setpoint_m`: its setpoint.
        target_z_m: the target's height; None where it was never seen.
        span_m: from where to where the view has to show; `top_m`: and up to where.
    """

    def __init__(self, flight: FlightAnalysis) -> None:
        log = flight.log
        profile = log.flown_profile
        body_m = _columns(log, "{}_m")
        if not np.isfinite(body_m.sum(axis=1)).any():
            raise InvalidValue(f"{log.path}: the log knows no position, there is nothing to film")
        self.large_side_m = profile.target.large.side_m
        self._gear_body_m = np.array(profile.vehicle.gear_body_m)
        self._angles_rad = np.column_stack(
            [log.column(f"{name}_rad") for name in ("roll", "pitch", "yaw")]
        )
        targets_m = _filled(_columns(log, "t{}_m"))
        is_setpoint = np.array([kind == "position" for kind in log.texts("cmd")])
        setpoints_m = np.where(is_setpoint[:, None], _columns(log, "cmd_{}_m"), np.nan)
        ground_m = float(_filled(body_m)[0, 2])
        known = np.isfinite(targets_m).all()
        self.target_z_m = float(np.median(targets_m[:, 2])) - ground_m if known else None
        origin_m = targets_m if known else np.array([*_filled(body_m)[0, :2], ground_m])
        above_m = self.target_z_m or 0.0
        start = (body_m - origin_m)[0, :2]
        length_m = float(np.hypot(*start))
        self._axis = start / length_m if length_m > LEAST_ASIDE_M else np.array([1.0, 0.0])
        self.place_m = self._seen(body_m - origin_m, above_m)
        if known:  # nothing is above the sheet; an estimate of a vehicle that hangs drifts
            highest_m = above_m - float(self._gear_body_m[2])
            self.place_m[:, 1] = np.minimum(self.place_m[:, 1], highest_m)
        self.setpoint_m = self._seen(setpoints_m - origin_m, above_m)
        half_m = 0.5 * self.large_side_m
        beside_m, height_m = self.place_m.T
        self.span_m = min(-half_m, np.nanmin(beside_m)), max(half_m, np.nanmax(beside_m))
        self.top_m = max(float(np.nanmax(height_m)) + float(self._gear_body_m[2]), above_m)

    def body_m(self, index: int) -> tuple[Array, Array]:
        """Return both arms' ends (2, 2) and the gear's tip (2,) from the vehicle's centre."""
        roll, pitch, yaw = np.nan_to_num(self._angles_rad[index])
        R_world_body = rotation_from_rpy(roll, pitch, yaw)
        axis = np.append(self._axis, 0.0)
        arm = R_world_body @ rot_z(yaw).T @ (ARM_M * axis)
        end = np.array([arm @ axis, arm[2]])
        gear = R_world_body @ self._gear_body_m
        return np.array([-end, end]), np.array([gear @ axis, gear[2]])

    def _seen(self, points_m: Array, above_m: float) -> Array:
        return np.column_stack([points_m[:, :2] @ self._axis, points_m[:, 2] + above_m])


def _columns(log: FlightLog, name: str) -> Array:
    return np.column_stack([log.column(name.format(axis)) for axis in "xyz"])


def _filled(points_m: Array) -> Array:
    """Return the points, (n, 3), with each unknown one as the last known, or the first known."""
    known = np.isfinite(points_m.sum(axis=1))
    if not known.any():
        return points_m
    last = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    filled: Array = points_m[np.where(last < 0, np.argmax(known), last)]
    return filled


# --- The file ---------------------------------------------------------


def _write_video(pictures: Iterator[Rgb], path: Path, rate: Fraction) -> None:
    """Write the pictures one by one: H.264, which browsers play, or an animated GIF."""
    import av

    is_gif = path.suffix.lower() == ".gif"
    first = next(pictures)
    height, width = (size // 2 * 2 for size in first.shape[:2])  # H.264 needs even ones
    with av.open(str(path), "w", options={} if is_gif else {"movflags": "faststart"}) as video:
        if is_gif:
            stream = video.add_stream("gif", rate)
        else:
            stream = video.add_stream("libx264", rate, options={"preset": "veryfast", "crf": "23"})
        stream.pix_fmt = "pal8" if is_gif else "yuv420p"
        stream.height, stream.width = height, width
        for picture in chain([first], pictures):
            even = picture[:height, :width]
            frame = _gif_frame(even) if is_gif else av.VideoFrame.from_ndarray(even, "rgb24")
            video.mux(stream.encode(frame))
        video.mux(stream.encode(None))


def _gif_frame(picture: Rgb) -> Any:
    """Return a picture in the one palette of a GIF, so that what stands still costs nothing."""
    import av
    from PIL import Image

    greys = np.repeat(np.linspace(0.0, 255.0, GIF_GREYS)[:, None], 3, axis=1)
    shares = np.linspace(1.0, 0.25, GIF_TINTS)[:, None]
    lines = [255.0 * np.array(to_rgb(c)) for c in (SKY, BLUE, ORANGE, PURPLE, VERMILLION)]
    tints = [shares * line + 255.0 * (1.0 - shares) for line in lines]
    rgb = np.rint(np.vstack([greys, *tints])).astype(np.uint8)
    palette = Image.new("P", (1, 1))
    palette.putpalette(rgb.tobytes())
    indices = Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
    argb = np.zeros((256, 4), np.uint8)
    argb[:, 0] = 255
    argb[: len(rgb), 1:] = rgb
    return av.VideoFrame.from_ndarray((np.array(indices), argb), format="pal8")  # type: ignore[arg-type]
