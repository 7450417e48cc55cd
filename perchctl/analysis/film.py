"""Make a film of a flight that shows the camera image, a side view, the error and the thrust."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from perchctl.analysis.flight import FlightAnalysis
from perchctl.analysis.plot import draw_thrust
from perchctl.errors import InvalidValue
from perchctl.files import atomic_write, write_error
from perchctl.geometry import Array
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
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ARM_M = 0.046
"""Distance from the vehicle's centre to a motor, m."""
BESIDE_M, ABOVE_M = 0.25, 0.12
"""Margins in the side view, to the left and right of the flight and above it, m."""
LEAST_ASIDE_M = 0.05
"""If the take-off point is horizontally closer to the target than this, m, it does not define the
direction of the side view."""
LAST_PICTURE_S = 2.0
"""How long the last image stays on screen, s."""
WIDTH_IN, HEIGHT_IN = 9.6, 5.4
SIZE_STEP_PX = 32
"""Multiple to which the width is rounded, so that width and height are even, as H.264 requires."""
Rgb = NDArray[np.uint8]
Progress = Callable[[int, int | None], object]
"""Called with the number of images done and the total number."""
Recorded = Iterator[tuple[int, float, NDArray[np.uint8]]]
"""Recorded images: number, time of exposure, grey (height, width)."""


def write_film(
    flight: FlightAnalysis,
    pictures: Recorded | None,
    path: Path,
    rate_hz: float = 15.0,
    width_px: int = 960,
    progress: Progress = lambda done, total: None,
) -> int:
    """Write the flight as a real-time film (.mp4 or .gif), and return the number of images in the
    film.

    Args:
        pictures: the recorded images, oldest first; None if there is no recording.
        rate_hz: images per second of flight; the period is rounded to 0.01 s.
        width_px: width of the film; the height is 9/16 of the width.
        progress: called after each image of the film with the number of images done and the total.

    Errors: InvalidValue for a log without ticks, a recording that cannot be read, or a file that
    cannot be written.
    """
    if not flight.log.records:
        raise InvalidValue(f"{flight.log.path}: the log has no ticks, so there is nothing to film")
    period = film_period(rate_hz)
    times_s = np.arange(0.0, flight.log.end_s + LAST_PICTURE_S, float(period))
    drawn = _film_pictures(flight, pictures or iter(()), times_s, width_px, progress)
    write_pictures(drawn, path, period)
    return len(times_s)


def _film_pictures(
    flight: FlightAnalysis,
    recorded: Recorded,
    times_s: Array,
    width_px: int,
    progress: Progress,
) -> Iterator[Rgb]:
    shown = ShownPicture(flight, recorded)
    stage = _Stage(flight, width_px, has_pictures=shown.has_more)
    for number, t_s in enumerate(times_s, start=1):
        index = flight.log.tick_index_at(float(t_s))
        shown.advance(index)
        yield stage.drawn(index, shown)
        progress(number, len(times_s))


class ShownPicture:
    """The recorded image that the flight processed most recently, and its record in the log.

    Attributes:
        image: grey, (height, width); None before the first image.
        record: the log's record of the newest image.
    """

    def __init__(self, flight: FlightAnalysis, recorded: Recorded) -> None:
        self.image: Rgb | None = None
        self.record: dict[str, Any] = flight.log.records[0]
        self._flight, self._recorded = flight, recorded
        self._coming = next(recorded, None)

    @property
    def has_more(self) -> bool:
        """True if there are more images."""
        return self._coming is not None

    def advance(self, index: int) -> None:
        """Advance to the tick with this index, which must not decrease."""
        record = self._flight.log.records[index]
        if record.get("frame") is not None:
            self.record = record
            while self._coming is not None and self._coming[0] <= record["frame"]:
                self.image, self._coming = self._coming[2], next(self._recorded, None)


class CameraView:
    """Axes that show an image and the outlines of the markers. `add` registers each moving
    artist."""

    def __init__(self, ax: Axes, flight: FlightAnalysis, add: Callable[[Any], Any]) -> None:
        ax.set_axis_off()
        camera = flight.log.header.get("camera") or {}
        width, height = camera.get("size_px") or (640, 480)
        self._image = add(ax.imshow(np.zeros((height, width)), cmap="gray", vmin=0.0, vmax=255.0))
        ax.set_xlim(-0.5, width - 0.5)
        ax.set_ylim(height - 0.5, -0.5)
        self._outlines = {
            key: add(ax.plot([], [], solid_capstyle="butt", color=colour, linewidth=1.6)[0])
            for key, colour in (("large_px", SKY), ("small_px", ORANGE))
        }

    def show(self, shown: ShownPicture) -> None:
        """Replace the image that is shown."""
        if shown.image is None:
            return
        self._image.set_data(shown.image)
        for key, line in self._outlines.items():
            corners = np.reshape(shown.record.get(key) or [], (-1, 2))
            line.set_data(*np.vstack([corners, corners[:1]]).T)


class _Stage:
    """The figure. Static parts are drawn once, moving parts for each image. If no images were
    recorded, the side view takes their place."""

    def __init__(self, flight: FlightAnalysis, width_px: int, *, has_pictures: bool) -> None:
        self._flight = flight
        self._figure = film_figure(width_px)
        grid = self._figure.add_gridspec(2, 2, height_ratios=(2.6, 1.0), width_ratios=(2.0, 1.0))
        self._moving: list[Any] = []
        self._camera: CameraView | None = None
        if has_pictures:
            self._camera = CameraView(self._figure.add_subplot(grid[0, 0]), flight, self._add)
        self._set_side_view(self._figure.add_subplot(grid[0, 1] if has_pictures else grid[0, :]))
        self._set_traces(self._figure.add_subplot(grid[1, :]))
        self._figure.suptitle(" ", fontsize=13)
        self._title = self._add(
            self._figure.text(0.5, 0.985, "", ha="center", va="top", fontsize=13)
        )
        self._still = draw_still(self._figure)

    def drawn(self, index: int, shown: ShownPicture) -> Rgb:
        """The film's image for one tick, (height, width, 3)."""
        record, t_s = self._flight.log.records[index], float(self._flight.log.t_s[index])
        if self._camera is not None:
            self._camera.show(shown)
        x_m, z_m = self._place_m[index]
        self._trail.set_data(*self._place_m[: index + 1].T)
        self._arms.set_data([x_m - ARM_M, x_m + ARM_M], [z_m, z_m])
        self._gear.set_data([x_m, x_m], [z_m, z_m + self._gear_m])
        self._cursor.set_xdata([t_s, t_s])
        self._title.set_text(f"{t_s:.1f} s   {record.get('phase') or ''}")
        return draw_moving(self._figure, self._still, self._moving)

    def _add(self, artist: Any) -> Any:
        artist.set_animated(True)
        self._moving.append(artist)
        return artist

    def _line(self, ax: Axes, **more: Any) -> Any:
        return self._add(ax.plot([], [], solid_capstyle="butt", **more)[0])

    def _set_side_view(self, ax: Axes) -> None:
        self._place_m, target_z_m = side_path_and_target_height(self._flight)
        profile = self._flight.log.flown_profile
        self._gear_m = profile.vehicle.gear_body_m[2]
        half_m = 0.5 * profile.target.large.side_m
        beside_m, height_m = self._place_m.T
        ax.set_aspect("equal", adjustable="box")
        ax.set_xlim(
            min(-half_m, np.nanmin(beside_m)) - BESIDE_M,
            max(half_m, np.nanmax(beside_m)) + BESIDE_M,
        )
        ax.set_ylim(0.0, max(np.nanmax(height_m) + self._gear_m, target_z_m or 0.0) + ABOVE_M)
        ax.set_xticks([0.0])
        ax.set_xlabel("lateral offset [m]")
        ax.set_ylabel("height [m]")
        if target_z_m is not None:
            ax.axhline(target_z_m, color=GREY, linewidth=1.0)
            sheet = ax.plot([-half_m, half_m], [target_z_m] * 2, color=BLACK, linewidth=4.0)
            sheet[0].set_solid_capstyle("butt")
        self._trail = self._line(ax, color=SKY, linewidth=1.0)
        self._arms = self._line(ax, color=BLUE, linewidth=3.0)
        self._gear = self._line(ax, color=VERMILLION, linewidth=1.8)

    def _set_traces(self, ax: Axes) -> None:
        flight = self._flight
        aside_m = np.hypot(flight.tracked_values("ex_m"), flight.tracked_values("ey_m"))
        ax.plot(flight.log.t_s, 100.0 * aside_m, color=PURPLE, linewidth=1.2)
        ax.set_ylabel("off centre [cm]", color=PURPLE)
        ax.set_ylim(bottom=0.0)
        ax.set_xlim(0.0, max(flight.log.end_s, 0.1))
        ax.set_xlabel("time [s]")
        ax.grid(True, color=GRID, linewidth=0.6)
        thrust_ax = draw_thrust(ax, flight)
        thrust_ax.set_ylabel("thrust [%]", color=ORANGE)
        self._cursor = self._add(thrust_ax.axvline(0.0, color=BLACK, linewidth=1.0))


def side_path_and_target_height(flight: FlightAnalysis) -> tuple[Array, float | None]:
    """The position of the vehicle's centre in each tick, (n, 2) m, and the height of the target
    (None if it was never seen). A position is the horizontal distance from the target and the
    height above ground, in the vertical plane through the target and the take-off point. Errors:
    InvalidValue for a log without positions."""
    log = flight.log
    body_m, targets_m = (
        np.column_stack([log.column(f"{prefix}{axis}_m") for axis in "xyz"]) for prefix in ("", "t")
    )
    known_m = body_m[np.isfinite(body_m).all(axis=1)]
    seen_m = targets_m[np.isfinite(targets_m).all(axis=1)]
    if not known_m.size:
        raise InvalidValue(f"{log.path}: the log has no position, so there is nothing to film")
    start_m = known_m[0]
    target_m = seen_m[-1] if seen_m.size else start_m
    aside_m = start_m[:2] - target_m[:2]
    length_m = float(np.hypot(*aside_m))
    axis = aside_m / length_m if length_m > LEAST_ASIDE_M else np.array([1.0, 0.0])
    place_m = np.column_stack([(body_m - target_m)[:, :2] @ axis, body_m[:, 2] - start_m[2]])
    if not seen_m.size:
        return place_m, None
    target_z_m = float(target_m[2] - start_m[2])
    # The vehicle cannot be above the sheet, but its estimate drifts while it is hanging there.
    highest_m = target_z_m - log.flown_profile.vehicle.gear_body_m[2]
    place_m[:, 1] = np.minimum(place_m[:, 1], highest_m)
    return place_m, target_z_m


# --- Figure and file ---


def film_period(rate_hz: float) -> Fraction:
    """Time between two images, s, rounded to 0.01 s, the unit of time in a GIF."""
    return Fraction(max(2, round(100 / rate_hz)), 100)


def film_figure(width_px: int) -> Figure:
    """An empty figure with the aspect ratio of a film."""
    return new_figure(WIDTH_IN, HEIGHT_IN, width_px // SIZE_STEP_PX * SIZE_STEP_PX / WIDTH_IN)


def draw_still(figure: Figure) -> Any:
    """Draw the static parts, as a background for `draw_moving`."""
    canvas = cast(Any, figure.canvas)
    canvas.draw()
    return canvas.copy_from_bbox(figure.bbox)


def draw_moving(figure: Figure, still: Any, moving: Sequence[Any]) -> Rgb:
    """Draw these artists over the static background, and return the image, (height, width, 3)."""
    canvas = cast(Any, figure.canvas)
    canvas.restore_region(still)
    for artist in moving:
        (artist.axes or figure).draw_artist(artist)
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


def write_pictures(pictures: Iterator[Rgb], path: Path, period: Fraction) -> None:
    """Write a film (.mp4 or .gif). Errors: InvalidValue for a file that cannot be written."""
    write = _write_gif if path.suffix.lower() == ".gif" else _write_video
    try:
        with atomic_write(path) as part:
            write(pictures, part, period)
    except OSError as error:
        raise write_error(path, error) from None


def _write_video(pictures: Iterator[Rgb], path: Path, period: Fraction) -> None:
    """Write H.264, which browsers play."""
    import av

    with av.open(str(path), "w", options={"movflags": "faststart"}) as video:
        options = {"preset": "veryfast", "crf": "23"}
        stream = video.add_stream("libx264", 1 / period, options=options)
        stream.pix_fmt = "yuv420p"
        first = next(pictures)
        stream.height, stream.width = first.shape[:2]
        for picture in chain([first], pictures):
            video.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        video.mux(stream.encode(None))


def _write_gif(pictures: Iterator[Rgb], path: Path, period: Fraction) -> None:
    """Write a GIF with a single palette, so that static parts take no space after the first
    image."""
    from matplotlib.colors import to_rgb
    from PIL import Image

    greys = np.repeat(np.linspace(0.0, 255.0, 64)[:, None], 3, axis=1)
    lines = 255.0 * np.array([to_rgb(c) for c in (SKY, BLUE, ORANGE, PURPLE, VERMILLION, GREEN)])
    tints = [255.0 - share * (255.0 - lines) for share in (1.0, 0.75, 0.5, 0.25)]
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.rint(np.vstack([greys, *tints])).astype(np.uint8).tobytes())
    images = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures
    )
    first = next(images)
    duration_ms = int(1000 * period)
    first.save(path, save_all=True, append_images=images, duration=duration_ms, loop=0)
