"""`perchctl fleet check --identify`: check, one vehicle after another, that address, body, camera
and home belong together."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from perchctl.check import CheckScope, Row, Stand, identity_rows
from perchctl.corridor import Point
from perchctl.fleet.fleet import Fleet, FleetVehicle
from perchctl.fleet.plan import FleetPlan
from perchctl.fleet.prepare import flight_options
from perchctl.fleet.schedule import have_common_marker


def identify_fleet(
    plan: FleetPlan, scope: CheckScope, ask: Callable[[str], bool]
) -> Iterator[tuple[str, Row]]:
    """Yield the name and a row for each vehicle as soon as the row is known. Connects to one
    vehicle at a time, so vehicles that share a dongle need no radio hub.

    Raises the errors of `flight_options` and of `perchctl.check.check`.
    """
    options = flight_options(plan, Path(plan.fleet.name), 0, False)
    for vehicle in plan.fleet.vehicles:
        stand = make_stand(plan.fleet, vehicle)
        for row in identity_rows(options[vehicle.name], stand, scope, ask):
            yield vehicle.name, row


def make_stand(fleet: Fleet, vehicle: FleetVehicle) -> Stand:
    """Return this vehicle's home, and what the other vehicles would observe from there."""
    flown = vehicle.as_flown
    others = [other for other in fleet.vehicles if other.name != vehicle.name]
    own_m, within_m = _seen_m(vehicle, vehicle.target_m), vehicle.profile.target.expected_within_m
    lookalikes = dict.fromkeys(
        other.name
        for other in others
        for each in fleet.vehicles
        if have_common_marker(each, vehicle)
        and math.dist(_seen_m(other, each.target_m), own_m) <= within_m
    )
    x_m, y_m = vehicle.home_m
    return Stand(
        name=vehicle.name,
        home_m=flown.to_estimate(vehicle.home_m),
        home_text=f"{x_m:.2f} {y_m:.2f} m",
        heading_rad=math.radians(vehicle.heading_deg) if flown.frame == "room" else 0.0,
        homes={other.name: flown.to_estimate(other.home_m) for other in others},
        views={
            other.name: flown.to_estimate(_from_home(vehicle, _seen_m(other, other.target_m)))
            for other in others
            if have_common_marker(other, vehicle)
        },
        lookalikes=tuple(lookalikes),
    )


def _seen_m(vehicle: FleetVehicle, place_m: Point) -> Point:
    """Convert a position in the room to (forward, left) as seen from the vehicle at its home."""
    return replace(vehicle, frame="home").to_estimate(place_m)


def _from_home(vehicle: FleetVehicle, seen_m: Point) -> Point:
    """The inverse of `_seen_m`."""
    return replace(vehicle, frame="home").to_room(seen_m)
