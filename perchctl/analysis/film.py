"""A film of a flight: the camera's picture, a side view to scale, error and thrust over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.artist import Artist
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

FULL_THRUST_PERCENT = 1 / 655.35
ARM_M = 0.046
"""From the vehicle's centre to a motor."""
BESIDE_M, ABOVE_M = 0.25, 0.12
"""The side view shows so much more than the flight needs."""
NEAR_M = 0.15
"""Half of what the near view shows."""
LEAST_ASIDE_M = 0.05
"""A start nearer to the target gives the view no direction."""
LAST_S = 2.0
"""The last picture stays for so long."""
WIDTH_IN, HEIGHT_IN = 9.6, 5.4
MOST_GIF_HZ = 50.0
GIF_GREYS, GIF_TINTS = 64, 4
"""The colours of a GIF: greys, and so many mixtures of each line's colour with white."""
_H264 = {"preset": "veryfast", "crf": "23"}
PHASE_WORDS = {
    "APPROACH": "takes off",
    "SEARCH": "looks for the target",
    "ESTIMATE": "waits for a steady pose",
    "ALIGN": "moves under the target",
    "ASCEND": "climbs",
    "PERCH": "presses against the target",
    "COMPLETE": "puts its weight on the magnet",
    "RECOVER": "backs off",
    "LANDING": "lands",
    "PERCHED": "hangs, motors off",
    "LANDED": "has landed",
    "ABORTED": "has stopped",
}
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
        rate_hz: pictures a second of flight; the film runs at the flight's own pace.
        width_px: width of the film; its height is 9/16 of it.

    Errors: InvalidValue for a log without ticks, a recording that cannot be read, or a file that
    cannot be written.
    """
    if not flight.log.records:
        raise InvalidValue(f"{flight.log.path}: the log holds no ticks, there is nothing to film")
    stage = _Stage(flight, width_px)
    shown = _Shown(pictures)
    times = np.arange(0.0, flight.end_s + 1.0 / rate_hz, 1.0 / rate_hz)
    still = max(1, round(LAST_S * rate_hz))
    with _writer(path, rate_hz) as add:
        for t_s in times:
            index = flight.index_at(float(t_s))
            picture = stage.drawn(index, shown.at(flight.log.records[index]))
            add(picture)
        for _ in range(still):
            add(picture)
    return len(times) + still


class _Shown:
    """The recorded picture that belongs to a tick, with the corners found in it."""

    def __init__(self, pictures: Recorded | None) -> None:
        self._coming = pictures
        self._next = None if pictures is None else next(pictures, None)
        self._image = None if self._next is None else np.asarray(self._next[2], dtype=float)
        self._corners: dict[str, Array] = {}

    def at(self, record: dict[str, Any]) -> tuple[Array | None, dict[str, Array]]:
        """Return the newest picture of this tick or before, and its markers' corners (4, 2)."""
        number = record.get("frame")
        while number is not None and self._next is not None and self._next[0] <= number:
            self._image = np.asarray(self._next[2], dtype=float)
            assert self._coming is not None
            self._next = next(self._coming, None)
        if number is not None:
            self._corners = {
                key: np.reshape(record[key], (4, 2))
                for key in ("large_px", "small_px")
                if record.get(key) is not None
            }
        return self._image, self._corners


class _Stage:
    """The figure: what stays is drawn once, what moves is drawn for each picture."""

    def __init__(self, flight: FlightAnalysis, width_px: int) -> None:
        self._flight, self._ways = flight, _Ways(flight)
        self._figure: Figure = new_figure(WIDTH_IN, HEIGHT_IN, width_px / WIDTH_IN)
        grid = self._figure.add_gridspec(
            2, 3, height_ratios=(2.6, 1.0), width_ratios=(2.3, 0.8, 1.3)
        )
        self._moving: list[Artist] = []
        self._picture_ax = self._figure.add_subplot(grid[0, 0])
        self._side_ax = self._figure.add_subplot(grid[0, 1])
        self._near_ax = self._figure.add_subplot(grid[0, 2])
        self._time_ax = self._figure.add_subplot(grid[1, :])
        self._set_picture()
        self._set_side_view()
        self._set_near_view()
        self._set_traces()
        self._figure.suptitle(" ", fontsize=13)
        self._title = self._add(
            self._figure.text(0.5, 0.985, "", ha="center", va="top", fontsize=13)
        )
        self._canvas = cast(Any, self._figure.canvas)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self._figure.bbox)

    def drawn(self, index: int, seen: tuple[Array | None, dict[str, Array]]) -> Rgb:
        """Return the picture of a tick, (height, width, 3)."""
        self._move(index, *seen)
        self._canvas.restore_region(self._still)
        for artist in self._moving:
            (artist.axes or self._figure).draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[:, :, :3].copy()

    def _add(self, artist: Any) -> Any:
        artist.set_animated(True)
        self._moving.append(artist)
        return artist

    def _set_picture(self) -> None:
        ax = self._picture_ax
        ax.set_axis_off()
        camera = self._flight.log.header.get("camera") or {}
        width, height = camera.get("size_px") or (640, 480)
        self._image = self._add(
            ax.imshow(np.zeros((height, width)), cmap="gray", vmin=0.0, vmax=255.0)
        )
        ax.set_xlim(-0.5, width - 0.5)
        ax.set_ylim(height - 0.5, -0.5)
        self._outlines = {
            key: self._add(ax.plot([], [], color=colour, linewidth=1.6)[0])
            for key, colour in (("large_px", SKY), ("small_px", ORANGE))
        }
        self._no_picture = self._add(
            ax.text(0.5, 0.5, "no recorded picture", color="white", ha="center", va="center",
                    transform=ax.transAxes)
        )  # fmt: skip

    def _set_side_view(self) -> None:
        ax, ways = self._side_ax, self._ways
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
            ax.plot([-half_m, half_m], [ways.target_z_m] * 2, color=BLACK, linewidth=4.0,
                    solid_capstyle="butt")  # fmt: skip
        self._trail = self._add(ax.plot([], [], color=SKY, linewidth=1.0)[0])
        self._setpoint = self._add(ax.plot([], [], "+", color=VERMILLION, markersize=7)[0])
        self._vehicles = [self._vehicle(ax, 3.0)]

    def _set_near_view(self) -> None:
        """The same, larger, with the vehicle in the middle."""
        ax = self._near_ax
        ax.set_aspect("equal", adjustable="box")
        ax.set_xlim(-NEAR_M, NEAR_M)
        ax.set_ylim(-NEAR_M, NEAR_M)
        ax.set_xticks([])
        ax.set_yticks([])
        ax.set_xlabel(f"the vehicle, {200.0 * NEAR_M:.0f} cm")
        self._ceiling = self._add(ax.plot([], [], color=GREY, linewidth=1.0)[0])
        self._sheet = self._add(
            ax.plot([], [], color=BLACK, linewidth=4.0, solid_capstyle="butt")[0]
        )
        self._vehicles.append(self._vehicle(ax, 6.0))

    def _vehicle(self, ax: Axes, width: float) -> tuple[Any, Any]:
        """Add a vehicle's arms and gear."""
        arms = ax.plot([], [], color=BLUE, linewidth=width, solid_capstyle="butt")[0]
        gear = ax.plot([], [], color=VERMILLION, linewidth=0.6 * width)[0]
        return self._add(arms), self._add(gear)

    def _set_traces(self) -> None:
        ax, flight = self._time_ax, self._flight
        aside_m = np.hypot(flight.tracked("ex_m"), flight.tracked("ey_m"))
        ax.plot(flight.t_s, 100.0 * aside_m, color=PURPLE, linewidth=1.2)
        ax.set_ylabel("off centre [cm]", color=PURPLE)
        ax.set_ylim(bottom=0.0)
        ax.set_xlim(0.0, max(flight.end_s, 0.1))
        ax.set_xlabel("time [s]")
        ax.grid(True, color=GRID, linewidth=0.6)
        thrust_ax: Axes = ax.twinx()
        thrust = flight.log.column("thrust") * FULL_THRUST_PERCENT
        thrust_ax.plot(flight.t_s, thrust, color=ORANGE, linewidth=1.0)
        thrust_ax.set_ylabel("thrust [%]", color=ORANGE)
        thrust_ax.set_ylim(0.0, 105.0)
        self._cursor = self._add(thrust_ax.axvline(0.0, color=BLACK, linewidth=1.0))

    def _move(self, index: int, image: Array | None, corners: dict[str, Array]) -> None:
        flight, ways = self._flight, self._ways
        record, t_s = flight.log.records[index], float(flight.t_s[index])
        self._no_picture.set_visible(image is None)
        if image is not None:
            self._image.set_data(image)
        for key, line in self._outlines.items():
            outline = corners.get(key) if image is not None else None
            closed = np.empty((0, 2)) if outline is None else np.vstack([outline, outline[:1]])
            line.set_data(*closed.T)
        place = ways.place_m[index]
        self._trail.set_data(*ways.place_m[: index + 1].T)
        body = ways.body_m(index)
        for (arms, gear), at in zip(self._vehicles, (place, np.zeros(2)), strict=True):
            arms.set_data(*(at + body[0]).T)
            gear.set_data(*np.array([at, at + body[1]]).T)
        if ways.target_z_m is not None:
            up_m = ways.target_z_m - place[1]
            half_m = 0.5 * ways.large_side_m
            self._ceiling.set_data([-NEAR_M, NEAR_M], [up_m, up_m])
            self._sheet.set_data([-half_m - place[0], half_m - place[0]], [up_m, up_m])
        self._setpoint.set_data(*ways.setpoint_m[index : index + 1].T)
        self._cursor.set_xdata([t_s, t_s])
        phase = str(record.get("phase") or "")
        words = PHASE_WORDS.get(phase, phase)
        if record.get("hold"):
            words += " (held)"
        self._title.set_text(f"{t_s:.1f} s   {phase}: {words}")


class _Ways:
    """Where everything is in the side view: metres beside the target, and above the floor.

    The view's plane is vertical and holds the target and the place of take-off. Everything is shown
    relative to the target as it was estimated then.
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
        relative_m = _by_truth(body_m - origin_m, _columns(log, "true_{}_m"), log)
        start = relative_m[0, :2]
        length_m = float(np.hypot(*start))
        self._axis = start / length_m if length_m > LEAST_ASIDE_M else np.array([1.0, 0.0])
        self.place_m = self._seen(relative_m, above_m)
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


def _columns(log: Any, name: str) -> Array:
    return np.column_stack([log.column(name.format(axis)) for axis in "xyz"])


def _by_truth(relative_m: Array, truth_m: Array, log: Any) -> Array:
    """Return the places relative to the target, (n, 3). Where no frame shows the target, they go on
    from the last one by the true motion, if it is known, since the estimate drifts."""
    measured = np.array([record.get("measured") is True for record in log.records])
    if not (measured.any() and np.isfinite(truth_m).all()):
        return relative_m
    last = np.maximum.accumulate(np.where(measured, np.arange(len(measured)), 0))
    last = np.maximum(last, np.argmax(measured))
    carried: Array = relative_m[last] + truth_m - truth_m[last]
    return carried


def _filled(points_m: Array) -> Array:
    """Return the points, (n, 3), with each unknown one as the last known, or the first known."""
    known = np.isfinite(points_m.sum(axis=1))
    if not known.any():
        return points_m
    last = np.maximum.accumulate(np.where(known, np.arange(len(known)), -1))
    filled: Array = points_m[np.where(last < 0, np.argmax(known), last)]
    return filled


# --- The file ----------------------------------------------------------------------------------


@contextmanager
def _writer(path: Path, rate_hz: float) -> Iterator[Callable[[Rgb], None]]:
    """Yield the function that adds a picture; the file is there whole or not at all.

    Errors: InvalidValue if it cannot be written, or is to be faster than its kind can.
    """
    form = _gif if path.suffix.lower() == ".gif" else _mp4
    if form is _gif and rate_hz > MOST_GIF_HZ:
        raise InvalidValue(f"a .gif shows at most {MOST_GIF_HZ:g} pictures a second: make an .mp4")
    try:
        with whole_file(path) as part, form(part, rate_hz) as add:
            yield add
    except OSError as error:
        raise cannot_be_written(path, error) from None


@contextmanager
def _mp4(path: Path, rate_hz: float) -> Iterator[Callable[[Rgb], None]]:
    """H.264, which browsers play."""
    import av

    with av.open(str(path), "w", options={"movflags": "faststart"}) as video:
        rate = Fraction(rate_hz).limit_denominator(1001)
        stream = video.add_stream("libx264", rate, options=dict(_H264))
        stream.pix_fmt = "yuv420p"
        has_size = False

        def add(picture: Rgb) -> None:
            nonlocal has_size
            even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
            if not has_size:
                stream.height, stream.width = even.shape[:2]
                has_size = True
            video.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))

        yield add
        video.mux(stream.encode(None))


@contextmanager
def _gif(path: Path, rate_hz: float) -> Iterator[Callable[[Rgb], None]]:
    """An animated GIF with one palette, so that what stands still costs nothing."""
    from PIL import Image

    palette = Image.new("P", (1, 1))
    palette.putpalette(_gif_palette())
    pictures: list[Any] = []

    def add(picture: Rgb) -> None:
        image = Image.fromarray(picture)
        pictures.append(image.quantize(palette=palette, dither=Image.Dither.NONE))

    yield add
    first, *rest = pictures
    # A GIF counts in hundredths of a second.
    ends = [round(100.0 * k / rate_hz) for k in range(len(pictures) + 1)]
    first.save(
        path, format="GIF", save_all=True, append_images=rest, loop=0,
        duration=[10 * (end - start) for start, end in pairwise(ends)],
    )  # fmt: skip


def _gif_palette() -> list[int]:
    """Return the colours of a GIF, red, green and blue in turn."""
    greys = np.repeat(np.linspace(0.0, 255.0, GIF_GREYS)[:, None], 3, axis=1)
    shares = np.linspace(1.0, 0.25, GIF_TINTS)[:, None]
    lines = [255.0 * np.array(to_rgb(c)) for c in (SKY, BLUE, ORANGE, PURPLE, VERMILLION)]
    tints = [shares * line + 255.0 * (1.0 - shares) for line in lines]
    return [int(value) for value in np.rint(np.vstack([greys, *tints])).ravel()]
