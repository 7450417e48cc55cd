"""The fleet as frozen values: the vehicles in one room, with their homes, targets and profiles."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from perchctl.corridor import Point
from perchctl.link import vehicle_uri
from perchctl.profile import Profile, TargetConfig

Frame = Literal["room", "home"]
OnFailure = Literal["continue", "land-all"]
Assign = Literal["fixed", "nearest"]

ONE_AT_A_TIME = "one-at-a-time"
TOGETHER = "together"
MOST_VEHICLES = 32
"""Largest number of vehicles in a fleet. With more vehicles, computing a plan would take too
long."""


def vehicle_seed(fleet_seed: int, number: int) -> int:
    """Return the seed for the vehicle with this number, counted from 0. No two vehicles get the
    same seed, not even in fleets with different seeds."""
    return MOST_VEHICLES * fleet_seed + number


@dataclass(frozen=True, kw_only=True)
class FleetVehicle:
    """One vehicle of a fleet, with the ordinary `Profile` for its flight.

    The profile already contains the URI, the camera source and, in the axes of this vehicle's state
    estimate, the position of its target (`target.expected_xy_m`, `planner.approach_xy_m`).

    Attributes:
        name: unique in the fleet; consists of letters, digits, ``-``, ``_`` and ``.``, so that it
            can be part of a file name.
        home_m: position before take-off, in room axes.
        target_m: position of its target, in room axes.
        heading_deg: direction in which its nose points at home, counter-clockwise from the room's x
            axis.
        frame: the origin and axes of its state estimate. ``room``: those of the room, as with
            motion capture, Lighthouse or Loco. ``home``: the estimate is zero where the vehicle
            starts, as with a Flow deck or the target alone.
        target_from: the vehicle to which the file gives this target, if ``assign: nearest`` has
            assigned another vehicle's target; otherwise empty.
    """

    name: str
    profile: Profile
    home_m: Point
    target_m: Point
    heading_deg: float = 0.0
    frame: Frame = "home"
    target_from: str = ""

    @property
    def uri(self) -> str:
        """The vehicle's URI. If the file names no dongle (``radio:///80``), a dongle has been
        chosen."""
        return self.profile.link.uri

    @property
    def source(self) -> str:
        """The camera source."""
        return self.profile.camera.source

    @property
    def address(self) -> str:
        """A string that is the same for all URIs of a vehicle: its URI without dongle and options,
        in one letter case."""
        return vehicle_uri(self.uri)

    @property
    def simulated(self) -> bool:
        """True for a vehicle of perchctl's own simulator."""
        return self.uri.startswith("sim://")

    @property
    def as_flown(self) -> FleetVehicle:
        """The vehicle with the axes that its own process uses. The axes of a simulated vehicle have
        their origin where it starts, even if a simulated motion-capture system measures its
        position."""
        if not self.simulated or self.frame == "home":
            return self
        return replace(self, frame="home").with_target(self.target_m)

    def flown_to_room(self, estimate_m: Point) -> Point:
        """Convert a position from the axes of `as_flown` to those of the room."""
        axes = replace(self, frame="home") if self.simulated else self
        return axes.to_room(estimate_m)

    def to_room(self, estimate_m: Point) -> Point:
        """Convert a position from the axes of the vehicle's state estimate to those of the room."""
        if self.frame == "room":
            return estimate_m
        x, y = _rotated(estimate_m, math.radians(self.heading_deg))
        return self.home_m[0] + x, self.home_m[1] + y

    def to_estimate(self, room_m: Point) -> Point:
        """Convert a position from room axes to those of the vehicle's state estimate."""
        if self.frame == "room":
            return room_m
        away = room_m[0] - self.home_m[0], room_m[1] - self.home_m[1]
        return _rotated(away, -math.radians(self.heading_deg))

    def with_target(self, target_m: Point, target: TargetConfig | None = None) -> FleetVehicle:
        """The vehicle with a target at this position in the room. `target`: the target's markers,
        by default those in the vehicle's profile.

        A vehicle that flies with the target alone gets no approach point. Such a vehicle starts
        below its target, and with a heading error of a few degrees it would first fly away from the
        target.
        """
        expected_m = self.to_estimate(target_m)
        planner = self.profile.planner
        alone = self.profile.positioning.source.is_target
        profile = self.profile.model_copy(
            update={
                "target": (target or self.profile.target).model_copy(
                    update={"expected_xy_m": expected_m}
                ),
                "planner": planner.model_copy(
                    update={"approach_xy_m": None if alone else expected_m}
                ),
            }
        )
        return replace(self, target_m=target_m, profile=profile)


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """A fleet file, loaded and checked: no two vehicles share an address, a name, a camera or a
    motion-capture body, and with ``assign: nearest`` each vehicle already has its target.

    Attributes:
        order: ``one-at-a-time``, ``together`` or ``N at a time``; `most_at_once` gives the number.
        on_failure: whether the other vehicles continue or land after one has failed.
        separation_m: minimum distance between two corridors that are flown at the same time; None:
            the default (`perchctl.fleet.schedule`).
        path: the file that the fleet was read from.
    """

    name: str
    vehicles: tuple[FleetVehicle, ...]
    order: str = ONE_AT_A_TIME
    on_failure: OnFailure = "continue"
    assign: Assign = "fixed"
    separation_m: float | None = None
    path: Path | None = None

    @property
    def most_at_once(self) -> int:
        """The largest number of vehicles in the air at the same time."""
        if self.order == ONE_AT_A_TIME:
            return 1
        if self.order == TOGETHER:
            return len(self.vehicles)
        return int(self.order.split()[0])

    def vehicle(self, name: str) -> FleetVehicle:
        """Return the vehicle with this name. Raises KeyError."""
        for vehicle in self.vehicles:
            if vehicle.name == name:
                return vehicle
        raise KeyError(name)


def _rotated(point: Point, angle_rad: float) -> Point:
    (x, y), c, s = point, math.cos(angle_rad), math.sin(angle_rad)
    return c * x - s * y, s * x + c * y
