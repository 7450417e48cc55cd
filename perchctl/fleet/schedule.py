"""Keep vehicles apart: compute each vehicle's corridor, and the order in which they fly.

The corridor's radius depends on the positioning:

    room axes (motion capture, Lighthouse, Loco)   WANDER_M + ROOM_ERROR_M
    Flow deck                                      WANDER_M + FLOW_DRIFT_MPS * time without target
    target alone                                   TARGET_ALONE_M

Two vehicles are in the air together only if their corridors keep the separation and neither takes
off near the other's corridor. A vehicle that is waiting on the floor, or that is already hanging,
is an obstacle for the others:

    i waits in j's corridor  ->  i flies before j
    i hangs in j's corridor  ->  j flies before i

An order that satisfies all of these constraints is found by topological sorting. If there is no
such order, the error names the vehicles whose constraints form a circle, and the remedies with
which a plan would succeed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from graphlib import CycleError, TopologicalSorter

from perchctl.corridor import Corridor
from perchctl.errors import InvalidValue
from perchctl.fleet.assignment import assign_nearest
from perchctl.fleet.fleet import Fleet, FleetVehicle
from perchctl.profile import CorridorConfig, Profile

WANDER_M = 0.3
"""Horizontal distance by which a draught may move a healthy vehicle from its setpoint, m. It is
also the smallest fence radius that a profile allows (`0.3 <= safety.fence_radius_m`). Smaller:
gusts end flights. Larger: fewer vehicles fit into a room."""
ROOM_ERROR_M = 0.05
"""Error of a position in the room's axes, m. perchctl takes off only if estimate and motion capture
agree to within this distance (docs/positioning.md), and the Lighthouse geometries of two vehicles
can differ by centimetres (bitcraze/cfcli). Smaller: two vehicles with different estimates may
meet."""
FLOW_DRIFT_MPS = 0.01
"""Drift of a Flow deck's estimate, m/s, as in the simulation (`simulation.drift_mps`). Smaller: a
long search ends outside the corridor. Larger: Flow decks need more room."""
TARGET_ALONE_M = 1.0
"""Radius for the target alone, m: a vehicle that loses sight of it may drift by up to 1 m until it
is down (observed in simulated flights). Smaller: a blind vehicle leaves the corridor. Larger:
targets must hang farther apart."""
HEIGHT_MARGIN_M = 0.3
"""Height of the corridor above the highest search, m: a climb overshoots by 0.1 m
(docs/firmware.md, "Position take-off"), and the height drifts. Smaller: an overshoot ends a
flight."""

SEPARATION_M = 0.4
"""Distance between the edges of two corridors that are flown at the same time, m. A jet 2 m below
its vehicle still blows at 0.24 m/s at 0.4 m from its axis (jet of Bauersfeld and others, 2024),
less than the draughts in which perchctl perches. Distances between axes used elsewhere: 0.2 m in
Bitcraze's demos, 0.24 m by Crazyswarm, 0.6 m in the firmware's avoidance. Smaller: neighbours
disturb each other. Larger: fewer vehicles fit into a room."""
START_SEPARATION_M = 0.5
"""Minimum distance between a vehicle that takes off and the corridor of another one that is flying,
m, as in Bitcraze's demos. Smaller: a vehicle starts in another one's jet. Larger: homes must be
farther apart."""
OBSTACLE_M = 0.24
"""Minimum distance between a vehicle that is waiting or hanging and a corridor that is being flown,
m: twice the radius of 0.12 m that Crazyswarm assumes for a vehicle. Smaller: propellers may touch.
Larger: fewer targets fit."""
FAR_M = 10.0
"""Distance from home to target above which a wrong number in the fleet file is a more likely reason
than a fence that is too small, m. Larger: more errors are answered with a larger fence."""


# --- Corridors ---


def corridor_radius_m(vehicle: FleetVehicle) -> float:
    """Return the radius of the vehicle's corridor, which depends on its positioning."""
    profile = vehicle.profile
    if profile.positioning.source.is_target:
        return TARGET_ALONE_M
    if vehicle.frame == "room":
        return WANDER_M + ROOM_ERROR_M
    drift_mps = FLOW_DRIFT_MPS
    if vehicle.simulated:
        drift_mps = max(drift_mps, profile.simulation.drift_mps)
    return WANDER_M + drift_mps * _unseen_s(profile)


def _unseen_s(profile: Profile) -> float:
    """Return the longest time for which the vehicle's position is known only from its estimate:
    take-off and flight to the target, the whole search, and the descent from the height limit.
    Under its target, the vehicle steers by the camera."""
    planner = profile.planner
    search_s = planner.search.attempts * planner.search.wait_s
    descent_s = profile.safety.max_height_m / planner.landing.speed_mps
    return planner.approach_timeout_s + search_s + descent_s


def vehicle_corridor(vehicle: FleetVehicle) -> Corridor:
    """Return the vehicle's corridor in room axes."""
    profile = vehicle.profile
    return Corridor(
        home_m=vehicle.home_m,
        target_m=vehicle.target_m,
        radius_m=corridor_radius_m(vehicle),
        way_top_m=profile.planner.search.max_height_m + HEIGHT_MARGIN_M,
        target_top_m=profile.safety.max_height_m,
    )


def estimate_corridor(vehicle: FleetVehicle, estimate: FleetVehicle | None = None) -> Corridor:
    """Return the same corridor in the axes of the vehicle's own state estimate, in which it is
    enforced. `estimate`: the same vehicle with an estimate in other axes, which are used instead.

    The radius is the same: while a vehicle follows setpoints, its estimate stays on the path and
    its true position drifts; under its target, its true position stays and its estimate drifts.
    """
    corridor, axes = vehicle_corridor(vehicle), estimate or vehicle
    return replace(
        corridor,
        home_m=axes.to_estimate(corridor.home_m),
        target_m=axes.to_estimate(corridor.target_m),
    )


def flown_profile(vehicle: FleetVehicle, estimate: FleetVehicle | None = None) -> Profile:
    """Return the profile with which a vehicle of a fleet flies: its own profile, with its corridor
    as a safety limit (`safety.corridor`). If the vehicle leaves its corridor, it lands.

    `estimate`: the same vehicle with an estimate in other axes, whose profile is used instead.
    """
    section = CorridorConfig(**asdict(estimate_corridor(vehicle, estimate)))
    profile = (estimate or vehicle).profile
    safety = profile.safety.model_copy(update={"corridor": section})
    return profile.model_copy(update={"safety": safety})


# --- Which vehicles may fly together ---


@dataclass(frozen=True)
class Conflict:
    """Two vehicles that must not be in the air at the same time, with the reason `why` and the
    distance."""

    first: str
    second: str
    why: str


@dataclass(frozen=True)
class Precedence:
    """`first` must have flown before `then` takes off, with the reason `why` and the distance."""

    first: str
    then: str
    why: str


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Groups of vehicles that fly together, in order, and the constraints that lead to them."""

    groups: tuple[tuple[str, ...], ...]
    conflicts: tuple[Conflict, ...]
    precedences: tuple[Precedence, ...]

    def may_fly_together(self, first: str, second: str) -> bool:
        """True if the corridors of the two vehicles keep all required separations.

        Two vehicles that must not fly together are also in each other's way on the floor: if one
        has landed away from its home, the other one must not take off.
        """
        return {first, second} not in ({c.first, c.second} for c in self.conflicts)


def make_schedule(fleet: Fleet) -> Schedule:
    """Decide who flies with whom, and in which order: as many at a time as `fleet.order` allows, in
    the order of the file unless a vehicle is in the way of another.

    Raises InvalidValue, naming the vehicles, the distances and what to do, if no order exists, or
    if a target cannot be reached.
    """
    corridors = _corridors(fleet)
    for problem_text in _problems(fleet, corridors):
        raise InvalidValue(problem_text())
    separation_m = SEPARATION_M if fleet.separation_m is None else fleet.separation_m
    conflicts = find_conflicts(corridors, separation_m)
    precedences = find_precedences(corridors)
    groups = _groups(list(corridors), fleet.most_at_once, conflicts, precedences)
    return Schedule(groups=groups, conflicts=conflicts, precedences=precedences)


def _corridors(fleet: Fleet) -> dict[str, Corridor]:
    return {vehicle.name: vehicle_corridor(vehicle) for vehicle in fleet.vehicles}


def find_conflicts(
    corridors: dict[str, Corridor], separation_m: float = SEPARATION_M
) -> tuple[Conflict, ...]:
    """Return the pairs whose corridors or homes are too close to each other."""
    found = []
    for (a, ours), (b, theirs) in itertools.combinations(corridors.items(), 2):
        if (gap_m := ours.distance_m(theirs)) < separation_m:
            found.append(Conflict(a, b, f"their corridors {_apart(gap_m)}"))
            continue
        for name, home_m, other, corridor in (
            (a, ours.home_m, b, theirs),
            (b, theirs.home_m, a, ours),
        ):
            if (gap_m := corridor.distance_to_m(home_m)) < START_SEPARATION_M:
                why = f"{name} takes off {_from(gap_m, other)}"
                found.append(Conflict(a, b, why))
                break
    return tuple(found)


def find_precedences(corridors: dict[str, Corridor]) -> tuple[Precedence, ...]:
    """Return which of two vehicles must fly first, for each pair in which one would be waiting or
    hanging in the other's corridor."""
    found = []
    for (name, own), (other, corridor) in itertools.permutations(corridors.items(), 2):
        waits_m, hangs_m = (corridor.distance_to_m(p) for p in (own.home_m, own.target_m))
        if waits_m < OBSTACLE_M:
            why = f"{name} waits on the floor {_from(waits_m, other)}"
            found.append(Precedence(name, other, why))
        if hangs_m < OBSTACLE_M:
            found.append(Precedence(other, name, f"{name} hangs {_from(hangs_m, other)}"))
    return tuple(found)


def _apart(gap_m: float) -> str:
    if abs(gap_m) < 0.005:
        return "touch"
    return f"overlap by {-gap_m:.2f} m" if gap_m < 0.0 else f"are {gap_m:.2f} m apart"


def _from(gap_m: float, other: str) -> str:
    return f"{gap_text(gap_m)} the corridor of {other}"


def gap_text(gap_m: float) -> str:
    """Return text such as "0.10 m from", "0.10 m inside" or "at the edge of" for a position whose
    distance from a corridor's edge is `gap_m` (negative inside)."""
    if abs(gap_m) < 0.005:
        return "at the edge of"
    return f"{-gap_m:.2f} m inside" if gap_m < 0.0 else f"{gap_m:.2f} m from"


def _groups(
    names: Sequence[str],
    most: int,
    conflicts: Sequence[Conflict],
    precedences: Sequence[Precedence],
) -> tuple[tuple[str, ...], ...]:
    """Return the groups, each filled in the order of the names with vehicles that are free to
    fly."""
    apart = {frozenset((c.first, c.second)) for c in conflicts}
    flown: set[str] = set()
    groups = []
    while len(flown) < len(names):
        group: list[str] = []
        for name in names:
            waits = any(p.then == name and p.first not in flown for p in precedences)
            meets = any(frozenset((name, other)) in apart for other in group)
            if name not in flown and not waits and not meets and len(group) < most:
                group.append(name)
        groups.append(tuple(group))
        flown.update(group)
    return tuple(groups)


# --- Refusals ---


def _problems(fleet: Fleet, corridors: dict[str, Corridor]) -> Iterator[Callable[[], str]]:
    """Yield a function for each reason why the fleet cannot be flown, which returns the reason and
    what to do in one sentence. Finding out what to do may require further plans."""
    for vehicle in fleet.vehicles:
        away_m = math.dist(vehicle.home_m, vehicle.target_m)
        if away_m + WANDER_M > vehicle.profile.safety.fence_radius_m:
            yield partial(_beyond_fence, vehicle, away_m, fleet)
    for first, second in itertools.combinations(fleet.vehicles, 2):
        apart_m = math.dist(first.target_m, second.target_m)
        within_m = max(v.profile.target.expected_within_m for v in (first, second))
        if have_common_marker(first, second) and apart_m <= within_m:
            yield partial(_like_targets, first, second, apart_m, within_m)
    if circle := _find_circle(find_precedences(corridors), list(corridors)):
        yield partial(_without_order, circle, fleet, corridors)


def _can_be_flown(fleet: Fleet) -> bool:
    return not any(_problems(fleet, _corridors(fleet)))


def _find_circle(precedences: Sequence[Precedence], names: Sequence[str]) -> list[Precedence]:
    """Return precedences that no order satisfies, each beginning with the vehicle at which the one
    before it ends; empty if there is an order. Two vehicles are preferred to longer circles."""
    by_pair: dict[tuple[str, str], Precedence] = {}
    for each in precedences:
        by_pair.setdefault((each.first, each.then), each)
    for first, second in itertools.combinations(names, 2):
        if (first, second) in by_pair and (second, first) in by_pair:
            return [by_pair[first, second], by_pair[second, first]]
    sorter: TopologicalSorter[str] = TopologicalSorter()
    for first, then in by_pair:
        sorter.add(then, first)
    try:
        sorter.prepare()
    except CycleError as error:
        return [by_pair[pair] for pair in itertools.pairwise(error.args[1])]
    return []


def _without_order(
    circle: Sequence[Precedence], fleet: Fleet, corridors: dict[str, Corridor]
) -> str:
    if len(circle) == 2:
        whys = [each.why for each in circle]
    else:
        whys = [f"{p.first} must fly before {p.then} because {p.why}" for p in circle]
    names = sorted((each.first for each in circle), key=list(corridors).index)
    remedies = ["move a home or target farther away", *_remedies(fleet, corridors)]
    return (
        f"there is no order in which {_and(names)} can fly: {_and(whys)}; a waiting or hanging "
        f"vehicle must be at least {OBSTACLE_M:g} m away from another vehicle's corridor: "
        f"{', or '.join(remedies)}"
    )


def _and(parts: Sequence[str]) -> str:
    *others, last = parts
    comma = "," if " " in last else ""
    return f"{', '.join(others)}{comma} and {last}"


def _remedies(fleet: Fleet, corridors: dict[str, Corridor]) -> list[str]:
    """Return changes with which the whole fleet can be flown, found by planning it with each."""
    nearest = assign_nearest(fleet)
    by_nearest = "set assign: nearest if the targets are interchangeable"
    radius_m = max(corridor.radius_m for corridor in corridors.values())
    by_room = (
        f"use a motion-capture system or Lighthouse (frame: room), with which a corridor radius of "
        f"{WANDER_M + ROOM_ERROR_M:.2f} m is enough instead of {radius_m:.2f} m"
    )
    single = [(nearest, by_nearest), (_in_room_axes(fleet), by_room)]
    found = [words for changed, words in single if _can_be_flown(changed)]
    if not found and _can_be_flown(_in_room_axes(nearest)):
        found = [f"{by_nearest}, and {by_room}"]
    return found


def _in_room_axes(fleet: Fleet) -> Fleet:
    """Return the fleet as it would be with motion capture."""
    vehicles = []
    for vehicle in fleet.vehicles:
        positioning = vehicle.profile.positioning.model_copy(update={"by": "mocap"})
        profile = vehicle.profile.model_copy(update={"positioning": positioning})
        vehicles.append(replace(vehicle, frame="room", profile=profile))
    return replace(fleet, vehicles=tuple(vehicles))


def _beyond_fence(vehicle: FleetVehicle, away_m: float, fleet: Fleet) -> str:
    others = [each for each in fleet.vehicles if each.name != vehicle.name]
    near_m, near = min(
        ((math.dist(vehicle.home_m, each.target_m), each.name) for each in others),
        default=(math.inf, ""),
    )
    advice = []
    if near_m < away_m:
        advice.append(
            f"if the targets are swapped (the target of {near} is only {near_m:.2f} m from this "
            f"home), correct target_m"
        )
        if _can_be_flown(assign_nearest(fleet)):
            advice.append("if they are interchangeable, set assign: nearest")
    otherwise = "otherwise, " if advice else ""
    if away_m > FAR_M:
        advice.append(f"{otherwise}check home_m and target_m")
    else:
        advice.append(f"{otherwise}move its home nearer to the target, or set a larger fence")
    return (
        f"the target of {vehicle.name} is {away_m:.2f} m from its home, and a draught can carry "
        f"the vehicle {WANDER_M:g} m farther, but safety.fence_radius_m is "
        f"{vehicle.profile.safety.fence_radius_m:g} m: {'; '.join(advice)}"
    )


def _like_targets(
    first: FleetVehicle, second: FleetVehicle, apart_m: float, within_m: float
) -> str:
    return (
        f"the targets of {first.name} and {second.name} have a marker id in common and are "
        f"{apart_m:.2f} m apart, within target.expected_within_m ({within_m:g} m): print targets "
        f"with different ids, or hang them farther apart"
    )


def have_common_marker(one: FleetVehicle, other: FleetVehicle) -> bool:
    """True if the targets of the two vehicles have a marker in common, by whichever dictionary it
    is named."""
    ours, theirs = one.profile.target, other.profile.target
    return any(
        own.has_same_pattern(marker)
        for own in (ours.large, ours.small)
        for marker in (theirs.large, theirs.small)
    )
