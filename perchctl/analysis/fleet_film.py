"""Make a film of a fleet that shows the room from above, each vehicle's height, and each camera's
image.

Each vehicle's log has its own clock. The logs are aligned on the fleet's clock: each flight has a
start time and a pace on that clock, because simulated time may run slower than the wall clock.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from perchctl.analysis.film import (
    LAST_PICTURE_S,
    CameraView,
    Progress,
    Recorded,
    Rgb,
    ShownPicture,
    draw_moving,
    draw_still,
    film_figure,
    film_period,
    write_pictures,
)
from perchctl.analysis.flight import FlightAnalysis
from perchctl.corridor import Point
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.plot import BLACK, BLUE, GREEN, GRID, ORANGE, PURPLE, SKY, VERMILLION

COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
ROOM_MARGIN_M = 0.2
"""Margin around all corridors in the view from above, m."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmedVehicle:
    """One vehicle in the film of a fleet.

    Attributes:
        pictures: the recorded images, oldest first; None if there is no recording.
        begin_s: time of the first tick, on the fleet's clock.
        pace: seconds on the flight's clock per second on the fleet's clock.
        home_m, target_m, radius_m: the two ends and the radius of its corridor, in room axes.
        heading_rad: direction in which its nose points at home.
        in_room: True if its state estimate is in room axes; otherwise the estimate starts at zero
            at home.
    """

    name: str
    flight: FlightAnalysis
    pictures: Recorded | None
    begin_s: float
    pace: float
    home_m: Point
    target_m: Point
    radius_m: float
    heading_rad: float = 0.0
    in_room: bool = False

    @property
    def end_s(self) -> float:
        """Time of the last tick, on the fleet's clock."""
        return self.begin_s + self.flight.log.end_s / self.pace

    def index_at(self, t_s: float) -> int:
        """Index of the tick at this time on the fleet's clock; before the flight, the first
        tick."""
        return self.flight.log.tick_index_at((t_s - self.begin_s) * self.pace)

    def path_m(self) -> Array:
        """Horizontal position in each tick, in room axes, (n, 2)."""
        log = self.flight.log
        place_m = np.column_stack([log.column("x_m"), log.column("y_m")])
        if self.in_room:
            return place_m
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return np.asarray(place_m @ np.array([[c, s], [-s, c]]) + np.asarray(self.home_m))

    def heights_m(self) -> Array:
        """Height above the take-off point in each tick."""
        z_m = self.flight.log.column("z_m")
        known_m = z_m[np.isfinite(z_m)]
        return np.asarray(z_m - known_m[0] if known_m.size else z_m)


def write_fleet_film(
    vehicles: Sequence[FilmedVehicle],
    path: Path,
    rate_hz: float = 15.0,
    width_px: int = 960,
    progress: Progress = lambda done, total: None,
) -> int:
    """Write the flight of a fleet as a real-time film (.mp4 or .gif), and return the number of
    images in the film. `rate_hz`, `width_px`, `progress` and errors are as in
    `perchctl.analysis.write_film`.
    """
    for vehicle in vehicles:
        if not vehicle.flight.log.records:
            log = vehicle.flight.log.path
            raise InvalidValue(f"{log}: the log has no ticks, so there is nothing to film")
    period = film_period(rate_hz)
    begin_s = min(vehicle.begin_s for vehicle in vehicles)
    end_s = max(vehicle.end_s for vehicle in vehicles)
    times_s = np.arange(begin_s, end_s + LAST_PICTURE_S, float(period))
    write_pictures(_fleet_pictures(vehicles, times_s, width_px, progress), path, period)
    return len(times_s)


def _fleet_pictures(
    vehicles: Sequence[FilmedVehicle], times_s: Array, width_px: int, progress: Progress
) -> Iterator[Rgb]:
    stage = _FleetStage(vehicles, times_s, width_px)
    for number, t_s in enumerate(times_s, start=1):
        yield stage.drawn(float(t_s))
        progress(number, len(times_s))


class _FleetStage:
    """The figure. Static parts are drawn once, moving parts for each image."""

    def __init__(self, vehicles: Sequence[FilmedVehicle], times_s: Array, width_px: int) -> None:
        self._begin_s = float(times_s[0])
        self._moving: list[Any] = []
        self._figure = film_figure(width_px)
        grid = self._figure.add_gridspec(2, 2, height_ratios=(2.6, 1.0), width_ratios=(1.0, 1.35))
        room, heights = (self._figure.add_subplot(grid[row, 0]) for row in (0, 1))
        columns = math.ceil(math.sqrt(len(vehicles)))
        cameras = grid[:, 1].subgridspec(math.ceil(len(vehicles) / columns), columns)
        self._set_room(room, vehicles)
        self._set_heights(heights, vehicles, float(times_s[-1]))
        self._shown = [
            _ShownVehicle(
                vehicle,
                COLOURS[number % len(COLOURS)],
                self._figure.add_subplot(cameras[divmod(number, columns)]),
                room,
                self._add,
            )
            for number, vehicle in enumerate(vehicles)
        ]
        self._figure.suptitle(" ", fontsize=13)
        self._title = self._add(
            self._figure.text(0.5, 0.985, "", ha="center", va="top", fontsize=13)
        )
        self._still = draw_still(self._figure)

    def drawn(self, t_s: float) -> Rgb:
        """The film's image at this time on the fleet's clock, (height, width, 3)."""
        for each in self._shown:
            each.show(t_s)
        hanging = sum(each.hangs for each in self._shown)
        since_s = t_s - self._begin_s
        self._title.set_text(f"{since_s:.1f} s   {hanging} of {len(self._shown)} hang")
        self._cursor.set_xdata([since_s, since_s])
        return draw_moving(self._figure, self._still, self._moving)

    def _add(self, artist: Any) -> Any:
        artist.set_animated(True)
        self._moving.append(artist)
        return artist

    def _set_room(self, ax: Axes, vehicles: Sequence[FilmedVehicle]) -> None:
        ax.set_aspect("equal", adjustable="box")
        for number, vehicle in enumerate(vehicles):
            colour = COLOURS[number % len(COLOURS)]
            for end_m in (vehicle.home_m, vehicle.target_m):
                ax.add_patch(Circle(end_m, vehicle.radius_m, color=colour, alpha=0.12, lw=0.0))
            ax.plot(*vehicle.home_m, marker="o", color=colour, fillstyle="none")
            ax.plot(*vehicle.target_m, marker="s", color=colour)
        low, high = (
            [
                pick(
                    end[axis] + sign * (v.radius_m + ROOM_MARGIN_M)
                    for v in vehicles
                    for end in (v.home_m, v.target_m)
                )
                for axis in (0, 1)
            ]
            for pick, sign in ((min, -1.0), (max, 1.0))
        )
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_xlabel("x [m]")
        ax.set_ylabel("y [m]")

    def _set_heights(self, ax: Axes, vehicles: Sequence[FilmedVehicle], end_s: float) -> None:
        for number, vehicle in enumerate(vehicles):
            t_s = vehicle.begin_s + vehicle.flight.log.t_s / vehicle.pace - self._begin_s
            ax.plot(t_s, vehicle.heights_m(), color=COLOURS[number % len(COLOURS)], linewidth=1.2)
        ax.set_xlim(0.0, max(end_s - self._begin_s, 0.1))
        ax.set_ylim(bottom=0.0)
        ax.set_xlabel("time [s]")
        ax.set_ylabel("height [m]")
        ax.grid(True, color=GRID, linewidth=0.6)
        self._cursor = self._add(ax.axvline(0.0, color=BLACK, linewidth=1.0))


class _ShownVehicle:
    """The moving parts for one vehicle: its camera image, its text, and its position in the
    room."""

    def __init__(
        self, vehicle: FilmedVehicle, colour: str, camera: Axes, room: Axes, add: Any
    ) -> None:
        self.hangs = False
        self._vehicle = vehicle
        self._picture = ShownPicture(vehicle.flight, vehicle.pictures or iter(()))
        self._view = CameraView(camera, vehicle.flight, add)
        camera.set_title(" ", fontsize=9)
        self._words = add(
            camera.text(
                0.0, 1.02, "", transform=camera.transAxes, color=colour, fontsize=9, va="bottom"
            )
        )
        self._path_m = vehicle.path_m()
        self._trail = add(room.plot([], [], color=colour, linewidth=1.0)[0])
        self._place = add(room.plot([], [], color=colour, marker="P", markersize=9.0)[0])

    def show(self, t_s: float) -> None:
        """Update the parts to this time on the fleet's clock."""
        index = self._vehicle.index_at(t_s)
        phase = "waits"
        if t_s >= self._vehicle.begin_s:
            self._picture.advance(index)
            phase = self._vehicle.flight.log.records[index].get("phase") or ""
        self.hangs = phase == "PERCHED"
        self._view.show(self._picture)
        self._words.set_text(f"{self._vehicle.name}: {phase}")
        self._trail.set_data(*self._path_m[: index + 1].T)
        self._place.set_data(*self._path_m[index : index + 1].T)
