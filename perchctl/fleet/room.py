"""One simulated room: the positions of a fleet's vehicles, the downwash between them, and how close
they come to each other.

Each vehicle is simulated in its own axes, whose origin is the floor below its start. A flight with
an estimate in room axes would differ only in its coordinates, so it is simulated in the vehicle's
own axes as well. The room converts all positions with `FleetVehicle.to_room`.

No vehicle starts exactly where the fleet file says. An estimate that starts at zero does not show
this error; an estimate in room axes does.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from perchctl.fleet.fleet import Fleet, FleetVehicle, vehicle_seed
from perchctl.fleet.schedule import flown_profile
from perchctl.profile import Profile
from perchctl.sim import (
    Neighbour,
    Scenario,
    SimulatedVehicle,
    downwash_mps,
    draw_scenario,
)

START_ERROR_M = 0.03
"""Largest error of a home in the fleet file on each axis, m: the homes are measured with a tape,
and the vehicles are placed by hand. Larger: vehicles start at places that no plan allows for."""
START_TURN_DEG = 2.0
"""Largest error of a vehicle's heading from `heading_deg`. Larger: over a flight of 2 m, the
heading causes a larger error than the drift."""
SEEN_M = 3.0
"""Distance beyond which a neighbour's target is never in the image of a camera below another
target, m. Larger: images take longer to compute."""
COLLISION_RADIUS_M = 0.12
"""Half-width of the ellipsoid that one vehicle needs according to Crazyswarm (IMRCLab/crazyswarm),
m; the centres of two vehicles stay twice as far apart. Larger: vehicles that pass each other count
as collided."""
COLLISION_HALF_HEIGHT_M = 0.3
"""Half-height of the same ellipsoid, m: a vehicle this far below flies in the other one's wake."""
_START_STREAM = 31
_Place = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class PlacedVehicle:
    """A vehicle in the room drawn from one seed.

    Attributes:
        true: the vehicle with its true start as its home, and with an estimate that starts there.
        profile: the profile that it flies with, including its corridor.
    """

    name: str
    true: FleetVehicle
    profile: Profile
    scenario: Scenario


def place_fleet(fleet: Fleet, seed: int) -> tuple[PlacedVehicle, ...]:
    """Place the fleet in the room drawn from a seed: the true starts, one ceiling, and for each
    vehicle a scenario with its target and those of the neighbours that its camera may see."""
    rng = np.random.default_rng([seed, _START_STREAM])
    drawn = []
    for number, vehicle in enumerate(fleet.vehicles):
        x_m, y_m = rng.uniform(-START_ERROR_M, START_ERROR_M, size=2).tolist()
        turn_deg = float(rng.uniform(-START_TURN_DEG, START_TURN_DEG))
        true = replace(
            vehicle,
            home_m=(vehicle.home_m[0] + x_m, vehicle.home_m[1] + y_m),
            heading_deg=vehicle.heading_deg + turn_deg,
            frame="home",
        )
        drawn.append((true, draw_scenario(vehicle.profile, vehicle_seed(seed, number))))
    ceiling_z_m = drawn[0][1].ceiling_z_m
    placed = []
    for vehicle, (true, scenario) in zip(fleet.vehicles, drawn, strict=True):
        knows = vehicle.frame == "room"
        flown = true.with_target(true.target_m, vehicle.profile.target) if knows else vehicle
        placed.append(
            PlacedVehicle(
                name=vehicle.name,
                true=true,
                profile=flown_profile(vehicle, flown),
                scenario=replace(
                    scenario,
                    ceiling_z_m=ceiling_z_m,
                    target_xy_m=true.to_estimate(true.target_m),
                    neighbours=_neighbours(true, scenario, drawn),
                ),
            )
        )
    return tuple(placed)


def _neighbours(
    own: FleetVehicle, scenario: Scenario, drawn: Sequence[tuple[FleetVehicle, Scenario]]
) -> tuple[Neighbour, ...]:
    """Return the other vehicles' targets, in the axes of this vehicle's target. The marker ids of
    the neighbours' targets are set even if they equal the ids of the vehicle's own target, so that
    flying to one of them counts as an error."""
    found = []
    heading_rad = math.radians(own.heading_deg) + scenario.target_yaw_rad
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    for other, theirs in drawn:
        x_m, y_m = (b - a for a, b in zip(own.target_m, other.target_m, strict=True))
        if other is own or other.name == own.name or math.hypot(x_m, y_m) > SEEN_M:
            continue
        target = other.profile.target
        found.append(
            Neighbour(
                (c * x_m + s * y_m, c * y_m - s * x_m),
                math.radians(other.heading_deg) + theirs.target_yaw_rad - heading_rad,
                target.large.id,
                target.small.id,
            )
        )
    return tuple(found)


# --- Track all vehicles as time passes ---


def body_name(name: str) -> str:
    """Return the name of a vehicle's rigid body in the simulated motion-capture system of another
    vehicle. In the vehicle's own system, its body has the name given in its profile."""
    return f"body of {name}"


class Body:
    """One vehicle in the room: simulated, or at rest at a fixed position."""

    def __init__(self, placed: PlacedVehicle) -> None:
        self._true = placed.true
        self._vehicle: SimulatedVehicle | None = None
        self._rest_m: _Place = (*placed.true.home_m, 0.0)

    def follow(self, vehicle: SimulatedVehicle) -> None:
        """Use the position of a simulated vehicle from now on."""
        self._vehicle = vehicle

    def rest(self) -> None:
        """Stay at this position with the motors off."""
        self._rest_m, self._vehicle = self.place_m, None

    @property
    def vehicle(self) -> SimulatedVehicle | None:
        return self._vehicle

    @property
    def place_m(self) -> _Place:
        """The vehicle's true position in the room's axes."""
        if self._vehicle is None:
            return self._rest_m
        world = self._vehicle.world
        return (*self._true.to_room((world.x_m, world.y_m)), world.z_m)

    @property
    def thrust_n(self) -> float:
        """Total thrust of all rotors."""
        return 0.0 if self._vehicle is None else sum(self._vehicle.world.powertrain.forces_n)

    @property
    def turns(self) -> bool:
        """True if the vehicle's motors are turning."""
        return self._vehicle is not None and max(self._vehicle.firmware.motors) > 0.0

    def in_own_axes(self, place_m: _Place) -> _Place:
        """Convert a position in the room to the axes of this vehicle's simulation."""
        return (*self._true.to_estimate(place_m[:2]), place_m[2])


class Room:
    """All vehicles of a fleet, by name.

    Attributes:
        collided: the pairs that touched, with each vehicle modelled as an ellipsoid of
            `COLLISION_RADIUS_M` and `COLLISION_HALF_HEIGHT_M`, even if one fell onto the other with
            its motors off.
        least_m: smallest distance between the centres of two vehicles while the motors of at least
            one are turning; infinite at first. Only the horizontal distance counts, since corridors
            are separated regardless of height.
        least_both_m: the same distance while the motors of both vehicles are turning.
    """

    def __init__(self, placed: Sequence[PlacedVehicle]) -> None:
        self.bodies = {each.name: Body(each) for each in placed}
        self.collided: set[tuple[str, str]] = set()
        self.least_m = self.least_both_m = math.inf

    def others_of(self, name: str) -> tuple[tuple[str, _Place], ...]:
        """Return the other vehicles with their positions, as a motion-capture system reports them,
        in the axes of the vehicle `name`; empty if there are no others, in which case the system
        keeps its own bodies."""
        own = self.bodies[name]
        return tuple(
            (body_name(other), own.in_own_axes(body.place_m))
            for other, body in self.bodies.items()
            if body is not own
        )

    def update(self) -> None:
        """Measure the distances, and update the downwash on each simulated vehicle and the bodies
        that its motion capture sees. Must be called when all vehicles have reached the same
        time."""
        places = {name: body.place_m for name, body in self.bodies.items()}
        turning = {name: body.turns for name, body in self.bodies.items()}
        for pair in itertools.combinations(self.bodies, 2):
            self._measure(pair, places, turning)
        for name, body in self.bodies.items():
            if body.vehicle is None:
                continue
            x_m, y_m, z_m = places[name]
            body.vehicle.world.downwash_mps = sum(
                downwash_mps(other.thrust_n, z - z_m, math.hypot(x - x_m, y - y_m))
                for above, other in self.bodies.items()
                for x, y, z in [places[above]]
                if above != name and turning[above]
            )
            if body.vehicle.capture is not None and len(self.bodies) > 1:
                order = [other for other, _ in body.vehicle.capture.settings.others]
                seen = dict(self.others_of(name))
                body.vehicle.capture.others_m = [seen[other] for other in order]

    def _measure(
        self, pair: tuple[str, str], places: dict[str, _Place], turning: dict[str, bool]
    ) -> None:
        (x, y, z), (u, v, w) = (places[name] for name in pair)
        level_m = math.hypot(x - u, y - v)
        aside, above = level_m / COLLISION_RADIUS_M, (z - w) / COLLISION_HALF_HEIGHT_M
        if math.hypot(aside, above) < 2.0:
            self.collided.add(pair)
        motors = [turning[name] for name in pair]
        if any(motors):
            self.least_m = min(self.least_m, level_m)
        if all(motors):
            self.least_both_m = min(self.least_both_m, level_m)
