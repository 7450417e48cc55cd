"""Who may take off, who lands, and why: all decisions of the parent, as pure functions.

    nothing is permitted until all are ready at the same time and the operator has confirmed
    groups fly in the order of the schedule, each after all flights of the previous one have ended
    no vehicle takes off if another one's flight has ended in its corridor or at an unknown place
    a failure before the first take-off ends all flights; later, only with ``on_failure: land-all``
    two vehicles in the air that are known to be too close to each other land
    no vehicle begins to climb while another one is, or may be, near the column in which it climbs

A vehicle's reported position is used only if it is measured in room axes (``frame: room``). For all
other vehicles, the positions in the plan are used.

If a position is old or cannot be trusted, the distances to it are unknown. An unknown distance does
not make a vehicle land; otherwise a lost link to one vehicle would end its neighbours' flights. An
unknown distance does not count as safe either: `find_unwatched` lists such vehicles for the
operator. These vehicles are kept apart by their corridors, which each vehicle enforces by itself,
without any message.

As long as all vehicles keep to their corridors, every vehicle may climb: in the plan, the place
below a target has the required separation from all corridors that are flown at the same time. The
permission to climb guards against a neighbour that has left its corridor, or may have left it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from perchctl.corridor import Point
from perchctl.errors import Interrupted
from perchctl.fleet.fleet import FleetVehicle
from perchctl.fleet.messages import Order, Result, Stage, Status, VehicleOutcome
from perchctl.fleet.plan import FleetPlan
from perchctl.fleet.schedule import OBSTACLE_M, ROOM_ERROR_M, TARGET_ALONE_M, gap_text
from perchctl.mission import OperatorRequest, Phase

FRESH_STATUS_S = 1.0
"""Time without a message after which a vehicle is not ready, s. Longer: a process that hangs counts
as ready. Shorter: a busy computer delays the start."""

NEAR_MARGIN_M = 2.0 * ROOM_ERROR_M
"""Two vehicles land if their distance is smaller than the plan's separation by more than this
margin, m; the positions of both may be wrong by `ROOM_ERROR_M`. Larger: two vehicles that approach
each other are noticed later. Smaller: position errors make vehicles land that are far enough
apart."""
FRESH_PLACE_S = 0.5
"""Age above which a position counts as unknown, s. Longer: two vehicles that fly at 0.4 m/s towards
each other may come 0.4 m closer unnoticed. Shorter: with slow telemetry, and a status ten times a
second, distances are unknown all the time."""
HUNG_S = 10.0
"""Time without a message after which a process is killed, s. The vehicle of such a process is
already down, since the firmware stops the motors 2 s after the last packet. Longer: the fleet waits
needlessly. Shorter: flights are lost when a computer pauses, and a neighbour climbs while a vehicle
that nobody controls may still be in the air."""
ROUNDING_M = 1e-6
"""Rounding error by which a vehicle at the very edge of its corridor may seem too near a climb, m.
Larger: a climb begins although another vehicle is too near."""


@dataclass(frozen=True, kw_only=True)
class VehicleView:
    """What the parent knows about one vehicle.

    Attributes:
        status: its newest status; None before the first one.
        silent_s: time since its last message.
        result: how its flight ended; None until then.
    """

    name: str
    status: Status | None = None
    silent_s: float = 0.0
    result: Result | None = None

    @property
    def stage(self) -> Stage:
        return Stage.STARTING if self.status is None else self.status.stage

    @property
    def is_in_air(self) -> bool:
        """True from the vehicle's first setpoint to the end of its mission, according to its
        status."""
        return self.result is None and self.stage is Stage.FLYING

    @property
    def may_be_in_air(self) -> bool:
        """True if the vehicle is in the air, or if its flight has ended without a known landing and
        the vehicle may not have come down by itself yet."""
        result = self.result
        lost = (
            result is not None
            and result.has_flown
            and result.outcome in (VehicleOutcome.FAILED, VehicleOutcome.ABORTED)
            and self.silent_s <= HUNG_S
        )
        return self.is_in_air or lost

    @property
    def place_age_s(self) -> float:
        """Age of the position in the newest status: the sum of the ages of telemetry, loop
        iteration and message, each of which may stop being renewed. The age is infinite if one of
        these is unknown."""
        status = self.status
        if status is None or status.telemetry_age_s is None or status.loop_age_s is None:
            return math.inf
        return status.telemetry_age_s + status.loop_age_s + self.silent_s

    @property
    def is_silent(self) -> bool:
        """True if its status is too old to be used."""
        return self.silent_s >= FRESH_STATUS_S

    @property
    def is_ready(self) -> bool:
        """True if only the permission to take off is missing."""
        return self.result is None and self.stage is Stage.READY and not self.is_silent


@dataclass(frozen=True, kw_only=True)
class Decision:
    """An order for each vehicle, and the reason for each order that the operator did not give."""

    orders: Mapping[str, Order]
    reasons: Mapping[str, str]


def are_all_ready(views: Sequence[VehicleView]) -> bool:
    """True if all vehicles are currently ready."""
    return all(view.is_ready for view in views)


def decide(
    plan: FleetPlan,
    views: Sequence[VehicleView],
    *,
    started: bool,
    word: OperatorRequest = OperatorRequest.NONE,
    landed: Collection[str] = (),
) -> Decision:
    """Return the orders to send now.

    Args:
        started: all vehicles have been ready, and the operator has confirmed; never becomes False
            again.
        word: the operator's command for all vehicles.
        landed: vehicles that the operator has landed individually.
    """
    ended = {view.name: view.result for view in views if view.result is not None}
    # Once the fleet is flying, a vehicle that the operator has landed individually does not count
    # as failed.
    by_key = {
        name
        for name, result in ended.items()
        if started and name in landed and result.exit_code == Interrupted.exit_code
    }
    failed = next((n for n, r in ended.items() if r.exit_code != 0 and n not in by_key), None)
    group = next((g for g in plan.schedule.groups if not ended.keys() >= set(g)), ())
    orders, reasons = {}, {}
    for view in views:
        name, own = view.name, word
        if own is OperatorRequest.NONE and name in landed:
            own = OperatorRequest.LAND
        if own is OperatorRequest.NONE and failed is not None:
            if not started:
                own, reasons[name] = OperatorRequest.LAND, f"{failed} is not ready"
            elif plan.fleet.on_failure == "land-all":
                own, reasons[name] = OperatorRequest.LAND, f"{failed} has failed"
        if own is OperatorRequest.NONE and view.stage.is_before_takeoff:
            obstacle = find_obstacle(plan, name, ended)
            if obstacle is not None:
                own, reasons[name] = OperatorRequest.LAND, obstacle
        permitted = started and own is OperatorRequest.NONE and name in group
        flies = started and own is OperatorRequest.NONE and view.is_in_air
        barred = find_climb_obstacle(plan, name, views) if flies else None
        orders[name] = Order(
            may_take_off=permitted,
            may_climb=flies and barred is None,
            why_not_climb=barred or "",
            word=own,
        )
    return Decision(orders=orders, reasons=reasons)


@dataclass(frozen=True, kw_only=True)
class NearPair:
    """Two vehicles in the air that are closer to each other than the plan allows."""

    first: str
    second: str
    distance_m: float

    def __str__(self) -> str:
        return f"{self.first} and {self.second} were {self.distance_m:.2f} m apart in the air"

    def why(self, name: str) -> str:
        """Return the reason why the vehicle called `name`, one of the two, lands."""
        other = self.second if name == self.first else self.first
        return f"{self.distance_m:.2f} m from {other} in the air"


def find_near_pairs(plan: FleetPlan, views: Sequence[VehicleView]) -> tuple[NearPair, ...]:
    """Return all pairs in the air whose known horizontal distance is below the plan's separation
    minus `NEAR_MARGIN_M`."""
    least_m = plan.separation_m - NEAR_MARGIN_M
    known = [(name, place) for name, place in air_places(plan, views).items() if place is not None]
    return tuple(
        NearPair(first=first, second=second, distance_m=math.dist(here, there))
        for (first, here), (second, there) in itertools.combinations(known, 2)
        if math.dist(here, there) < least_m
    )


def find_unwatched(plan: FleetPlan, views: Sequence[VehicleView]) -> tuple[str, ...]:
    """Return the vehicles in the air whose distance to another one should be known but is not."""
    places = air_places(plan, views)
    return tuple(name for name, place in places.items() if place is None and len(places) > 1)


def air_places(plan: FleetPlan, views: Sequence[VehicleView]) -> dict[str, Point | None]:
    """Return the position, in the room's axes, of each vehicle in the air that measures its
    position in these axes; None for a vehicle whose position is currently unknown."""
    places: dict[str, Point | None] = {}
    for view in views:
        if view.is_in_air and plan.fleet.vehicle(view.name).frame == "room":
            is_fresh = view.place_age_s <= FRESH_PLACE_S
            places[view.name] = last_place_m(plan, view) if is_fresh else None
    return places


def last_place_m(plan: FleetPlan, view: VehicleView) -> Point | None:
    """Return the newest position that this vehicle has reported in the room's axes, however old it
    is; None if its newest status contains none."""
    vehicle = plan.fleet.vehicle(view.name)
    place_m = None if view.status is None else view.status.place_m
    is_known = vehicle.frame == "room" and place_m is not None and all(map(math.isfinite, place_m))
    return vehicle.flown_to_room(place_m) if place_m is not None and is_known else None


def find_climb_obstacle(plan: FleetPlan, name: str, views: Sequence[VehicleView]) -> str | None:
    """Return why this vehicle must not begin to climb to its target now: another vehicle in the air
    is, or may be, within the plan's separation from its climb, a column as wide as its corridor.

    A vehicle without a known position is assumed to be in its corridor only if it has no position
    in room axes to report, is still flying, answers, and is not landing. Otherwise the vehicle may
    be up to `TARGET_ALONE_M` away from its path, and from the position that it reported last. The
    same applies to a vehicle whose flight has ended without a known landing, until it is down.
    """
    target_m, radius_m = plan.fleet.vehicle(name).target_m, plan.corridors[name].radius_m
    least_m = radius_m + plan.separation_m - ROUNDING_M
    places = air_places(plan, views)
    for view in views:
        other = view.name
        if other == name or not view.may_be_in_air:
            continue
        place_m = places.get(other)
        if place_m is not None:
            if math.dist(place_m, target_m) < least_m:
                return f"{other} is too close to this vehicle's climb path"
            continue
        lands = view.status is not None and view.status.phase is Phase.LANDING
        if other in places or lands or view.is_silent or not view.is_in_air:
            corridor = plan.corridors[other]
            lost = replace(corridor, radius_m=max(corridor.radius_m, TARGET_ALONE_M))
            last_m = last_place_m(plan, view)
            strayed = last_m is not None and math.dist(last_m, target_m) - TARGET_ALONE_M < least_m
            if strayed or lost.distance_to_m(target_m) < least_m:
                return f"the distance of {other} from this vehicle's climb path is unknown"
    return None


def find_obstacle(plan: FleetPlan, name: str, ended: Mapping[str, Result]) -> str | None:
    """Return why this vehicle may no longer take off: another vehicle's flight has ended in its
    corridor. A vehicle whose flight has ended does not move again, so this reason is permanent."""
    corridor = plan.corridors[name]
    for other, result in ended.items():
        vehicle = plan.fleet.vehicle(other)
        if other == name:
            continue
        if result.hangs:
            place, where = vehicle.target_m, "is hanging"
        elif is_at_home(vehicle, result):
            place, where = vehicle.home_m, "is on the floor"
        elif not plan.schedule.may_fly_together(name, other):
            return f"{other} may be in this vehicle's corridor: its flight ended away from its home"
        else:
            continue
        away_m = corridor.distance_to_m(place)
        if away_m < OBSTACLE_M:
            return f"{other} {where} {gap_text(away_m)} this vehicle's corridor"
    return None


def is_at_home(vehicle: FleetVehicle, result: Result) -> bool:
    """True if a vehicle whose flight has ended is known to be on the floor where it took off. An
    estimate that starts at zero drifts, so it cannot show where the vehicle is."""
    if not result.has_flown:
        return True
    if result.hangs or vehicle.frame != "room" or result.place_m is None:
        return False
    away_m = math.dist(vehicle.flown_to_room(result.place_m), vehicle.home_m)
    return result.outcome is VehicleOutcome.LANDED and away_m <= OBSTACLE_M
