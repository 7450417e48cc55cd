"""Fly a whole fleet in lockstep: one room, one clock, and the same result for the same seed.

Each vehicle flies in lockstep and is judged as in `perchctl simulate --faults`. Each flight runs in
a `ThreadCoroutine` that pauses at each tick of the room's clock:

    for each group of the schedule:
        until all of its flights have ended:
            the clock advances by TICK_S
            each flight runs until its own clock has reached the room's     (in the fleet's order)
            the room measures distances, and updates the downwash on each vehicle

Meanwhile, the vehicles of later groups wait on the floor at their homes. A vehicle whose flight has
ended stays where it is, whether it is hanging, standing or lying. A vehicle of the next group takes
off only if none of these vehicles is in its way. As in a real flight, a vehicle begins to climb
only while `find_climb_obstacle` finds no other vehicle near its climb; the statuses that this
decision needs arrive without delay.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from perchctl.campaign import run_measured
from perchctl.corridor import Point
from perchctl.errors import ConnectionFailed, InvalidValue, did_you_mean
from perchctl.faults import (
    COMMON_CAUSES,
    FAULTS,
    HEALTHY,
    Case,
    FaultResult,
    FaultyFlight,
    draw_case,
)
from perchctl.fleet.coroutine import ThreadCoroutine
from perchctl.fleet.dispatch import VehicleView, find_climb_obstacle
from perchctl.fleet.fleet import vehicle_seed
from perchctl.fleet.messages import Result, VehicleOutcome
from perchctl.fleet.plan import FleetPlan
from perchctl.fleet.results import FleetResult, fleet_outcome, refused_vehicle
from perchctl.fleet.room import PlacedVehicle, Room, body_name, place_fleet
from perchctl.fleet.schedule import OBSTACLE_M, gap_text
from perchctl.fleet.vehicle_process import flight_status

TICK_S = 0.02
"""Period of the room's clock, s; a vehicle that flies at 0.4 m/s moves 8 mm in this time. Larger: a
collision between two ticks is missed, and the downwash is late. Smaller: the flights wait for each
other more often."""
AT_HOME_M = 0.12
"""Distance from its home within which a landed vehicle counts as being where the plan expects it,
m; it is the radius of a vehicle according to Crazyswarm. Larger: a plan is trusted although its
obstacles have moved."""
CAUSE_S = (1.0, 25.0)
"""Times after the start of a group within which a common cause begins, s: after 25 s nearly all
vehicles are hanging."""
FOR_GOOD_S = 1e3
"""Duration above which a common cause is permanent, longer than any flight, s."""
_FAULT_STREAM = 32
_FAULT_BY_NAME = {fault.name: fault for fault in FAULTS}
_CAUSE_BY_NAME = {cause.name: cause for cause in COMMON_CAUSES}


def fleet_faults() -> dict[str, str]:
    """The names and descriptions of all faults in one vehicle and of all common causes (faults that
    affect several vehicles at once)."""
    causes = {
        name: f"in several vehicles: {c.fault.description}" for name, c in _CAUSE_BY_NAME.items()
    }
    return {name: fault.description for name, fault in _FAULT_BY_NAME.items()} | causes


def plan_sha256(plan: FleetPlan) -> str:
    """Return the SHA-256 of everything that can affect a fleet's flight, for a results file."""
    profiles = [vehicle.profile.model_dump(mode="json") for vehicle in plan.fleet.vehicles]
    text = json.dumps([plan.record(), profiles], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def select_fleet_faults(names: str) -> tuple[str, ...]:
    """Return the faults and common causes listed by name in `names`, separated by commas; ``all``
    selects all of them. Errors: InvalidValue."""
    if names == "all":
        return (*_FAULT_BY_NAME, *_CAUSE_BY_NAME)
    found = [part.strip() for part in names.split(",")]
    unknown = next((name for name in found if name not in {*_FAULT_BY_NAME, *_CAUSE_BY_NAME}), None)
    if unknown is not None:
        meant = did_you_mean(unknown, (*_FAULT_BY_NAME, *_CAUSE_BY_NAME))
        raise InvalidValue(f"fault {unknown!r} is unknown; {meant}`--faults list` lists all")
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class Trouble:
    """The faults in the fleet for one seed.

    Attributes:
        name: the name of a fault or common cause; "none" if there is none.
        cases: the case for each affected vehicle.
        group, at_s: a common cause begins `at_s` after the start of this group (counted from 0).
            None: each case begins by itself.
    """

    name: str = HEALTHY.fault.name
    cases: dict[str, Case]
    group: int = 0
    at_s: float | None = None

    @property
    def texts(self) -> dict[str, str]:
        """What is injected into each affected vehicle, in words."""
        if self.at_s is None:
            return {name: case.text for name, case in self.cases.items() if case.text is not None}
        begins = f"{self.at_s:.1f} s after group {self.group + 1} started"
        return {name: case.text_at(begins) for name, case in self.cases.items()}


def draw_trouble(
    plan: FleetPlan, placed: Sequence[PlacedVehicle], faults: Sequence[str], seed: int
) -> Trouble:
    """Draw a fault or common cause from the names `faults` with a seed; none if there are no
    names."""
    if not faults:
        return Trouble(cases={})
    rng = np.random.default_rng([seed, _FAULT_STREAM])
    name = faults[int(rng.integers(len(faults)))]
    number = int(rng.integers(len(placed)))
    if name in _FAULT_BY_NAME:
        one = placed[number]
        case = draw_case(vehicle_seed(seed, number), one.scenario, [_FAULT_BY_NAME[name]])
        return Trouble(name=name, cases={one.name: case})
    cause = _CAUSE_BY_NAME[name]
    case = cause.draw(rng, placed[number].scenario)
    whom = _whom(cause.whom, plan, [each.name for each in placed], number, rng)
    cases = dict.fromkeys(whom, case)
    if cause.whom == "pair" and len(whom) == 2:
        cases = swapped_cases(case, *whom)
    group = int(rng.integers(len(plan.schedule.groups)))
    at_s = round(float(rng.uniform(*CAUSE_S)), 3)
    return Trouble(name=name, cases=cases, group=group, at_s=at_s)


def swapped_cases(case: Case, first: str, second: str) -> dict[str, Case]:
    """Make the cases for two vehicles whose rigid bodies swap names, from the case for one of
    them."""
    return {
        name: replace(
            case, effects=tuple(partial(e, swapped_with=body_name(other)) for e in case.effects)
        )
        for name, other in ((first, second), (second, first))
    }


def _whom(
    whom: str, plan: FleetPlan, names: list[str], number: int, rng: np.random.Generator
) -> Sequence[str]:
    match whom:
        case "pair" if len(names) > 1:
            others = [name for name in names if name != names[number]]
            return names[number], others[int(rng.integers(len(others)))]
        case "dongle" if plan.dongles:
            return plan.dongles[int(rng.integers(len(plan.dongles)))].vehicles
    return names


# --- One fleet's flight ---


class _Seat:
    """One vehicle's flight in the room: a thread that waits at each tick."""

    def __init__(
        self,
        placed: PlacedVehicle,
        case: Case,
        room: Room,
        clock: _Clock,
        climb_withheld: Callable[[str], str | None],
    ) -> None:
        self._placed, self._case, self._room, self._clock = placed, case, room, clock
        self._climb_withheld = climb_withheld
        self._begin_s = clock.t_s
        self.name = placed.name
        self.flight: FaultyFlight | None = None
        self.known_m: Point = placed.profile.safety.corridor.home_m  # type: ignore[union-attr]
        self.coroutine = ThreadCoroutine(self._fly, f"flight of {placed.name}")

    def _fly(self) -> FaultResult:
        placed = self._placed
        try:
            self.flight = flight = FaultyFlight(
                placed.profile,
                self._case,
                placed.scenario,
                on_sample=self._wait,
                others=self._room.others_of(self.name) or None,
                climb_withheld=partial(self._climb_withheld, self.name),
            )
        except ConnectionFailed as error:  # if motion capture does not see the vehicle, for example
            return refused_vehicle(str(error))
        self._room.bodies[self.name].follow(flight.vehicle)
        return flight.fly()

    def _wait(self, t_s: float) -> None:
        """Wait for the room's clock once this flight's own clock has reached it."""
        while self._begin_s + t_s >= self._clock.t_s - 1e-6:
            self.coroutine.pause()

    def view(self) -> VehicleView:
        """Return what the parent would know about this vehicle now. A program that has ended sends
        nothing more."""
        flight = self.flight
        if flight is None or flight.newest_tick is None:
            return VehicleView(name=self.name)  # on the floor
        turned_s = self._clock.t_s - self._begin_s - flight.newest_tick.t_s
        status, ended = flight_status(flight.newest_tick), flight.end is not None
        return VehicleView(
            name=self.name,
            status=replace(status, loop_age_s=0.0 if ended else turned_s),
            silent_s=turned_s if ended else 0.0,
            result=None if flight.end is None else _flown_result(flight.end),
        )

    def note_place(self) -> None:
        """Record the vehicle's estimated position, in its own axes, which is all that the parent
        knows."""
        if self.flight is not None:
            read = self.flight.vehicle.firmware.log_value
            self.known_m = read("stateEstimate.x"), read("stateEstimate.y")


def _flown_result(end: str) -> Result:
    """Return the part of a flight's result that `find_climb_obstacle` uses."""
    outcome = {
        "perched": VehicleOutcome.PERCHED,
        "landed": VehicleOutcome.LANDED,
        "aborted": VehicleOutcome.ABORTED,
    }.get(end, VehicleOutcome.FAILED)
    return Result(exit_code=0, outcome=outcome, reason="", has_flown=True)


class _Clock:
    """The room's time."""

    def __init__(self) -> None:
        self._ticks = 0

    @property
    def t_s(self) -> float:
        return self._ticks * TICK_S

    def advance(self) -> None:
        self._ticks += 1


class FleetFlight:
    """One flight of a fleet, ready for a single call of `fly`."""

    def __init__(self, plan: FleetPlan, placed: Sequence[PlacedVehicle], trouble: Trouble) -> None:
        self._plan, self._trouble = plan, trouble
        self._placed = {each.name: each for each in placed}
        self._room, self._clock = Room(placed), _Clock()
        self._results: dict[str, FaultResult] = {}
        self._flying: list[_Seat] = []  # flights of the current group, also those that have ended
        # known positions, in room axes, of the vehicles whose flights have ended
        self._known_m: dict[str, Point] = {}
        self._landed_all = ""  # the vehicle whose failure makes all the others land
        self._cause_has_begun = False

    def fly(self, seed: int) -> FleetResult:
        """Fly one group after another, and return how each vehicle's flight ended."""
        for number, group in enumerate(self._plan.schedule.groups):
            self._land_after_failure([])  # even if no vehicle of the group has started
            starters = [name for name in group if not self._refuse(name)]
            self._fly_group(starters, number)
        room, results = self._room, [self._results[name] for name in self._placed]
        return FleetResult(
            seed=seed,
            outcome=fleet_outcome(results),
            fault=self._trouble.name,
            names=tuple(self._placed),
            vehicles=tuple(replace(result, seed=seed) for result in results),
            collisions=len(room.collided),
            collided=tuple(sorted(room.collided)),
            least_distance_m=_finite(room.least_m),
            least_distance_in_air_m=_finite(room.least_both_m),
            separation_m=self._plan.separation_m,
            time_s=self._clock.t_s,
            injected=self._trouble.texts,
        )

    def _fly_group(self, names: Sequence[str], number: int) -> None:
        begin_s, cause_s = self._clock.t_s, self._trouble.at_s
        waiting = cause_s is not None and number == self._trouble.group
        with self._seats(names) as seats:
            self._flying = list(seats)
            while seats:
                self._clock.advance()
                for seat in list(seats):
                    if seat.coroutine.resume():
                        self._end(seat)
                        seats.remove(seat)
                self._room.update()
                if waiting and cause_s is not None and self._clock.t_s >= begin_s + cause_s:
                    waiting = False
                    self._begin_cause(seats)
                self._land_after_failure(seats)

    @contextmanager
    def _seats(self, names: Sequence[str]) -> Iterator[list[_Seat]]:
        with ExitStack() as stack:
            seats = []
            for name in names:
                case = self._trouble.cases.get(name, HEALTHY)
                seats.append(
                    _Seat(self._placed[name], case, self._room, self._clock, self._climb_withheld)
                )
                stack.callback(seats[-1].coroutine.close)
            yield seats

    def _climb_withheld(self, name: str) -> str | None:
        """Return why the vehicle must not begin its climb now, as the parent would decide."""
        return find_climb_obstacle(self._plan, name, [seat.view() for seat in self._flying])

    def _begin_cause(self, seats: Sequence[_Seat]) -> None:
        self._cause_has_begun = True
        for seat in seats:
            flight = seat.flight
            if seat.name in self._trouble.cases and flight is not None and flight.end is None:
                flight.begin_fault()

    def _end(self, seat: _Seat) -> None:
        result = seat.coroutine.result
        assert result is not None
        body = self._room.bodies[seat.name]
        seat.note_place()
        self._results[seat.name] = result
        body.rest()
        vehicle = self._plan.fleet.vehicle(seat.name)
        # An estimate in room axes shows where the vehicle really started; the axes of its
        # simulation have their origin there. For any other estimate, the parent assumes the start
        # given in the file.
        axes = self._placed[seat.name].true if vehicle.frame == "room" else vehicle
        hangs = result.outcome == "perched"
        self._known_m[seat.name] = vehicle.target_m if hangs else axes.to_room(seat.known_m)

    def _land_after_failure(self, seats: Sequence[_Seat]) -> None:
        """With ``on_failure: land-all``, land all others once one vehicle has ended without
        perching."""
        if self._plan.fleet.on_failure != "land-all" or self._landed_all:
            return
        ended = {name: result.outcome for name, result in self._results.items()}
        ended |= {s.name: s.flight.end for s in seats if s.flight is not None and s.flight.end}
        failed = next((name for name, end in ended.items() if end != "perched"), None)
        if failed is None:
            return
        self._landed_all = failed
        for seat in seats:
            if seat.flight is not None and seat.flight.end is None:
                seat.flight.land()

    # --- Vehicles that must not start ---

    def _refuse(self, name: str) -> bool:
        """If this vehicle must not take off, record that it was refused and is still at its home,
        and return True."""
        reason = self._refusal(name)
        if not reason:
            return False
        self._results[name] = refused_vehicle(reason)
        self._known_m[name] = self._plan.fleet.vehicle(name).home_m
        return True

    def _refusal(self, name: str) -> str:
        if self._landed_all:
            return f"{self._landed_all} has failed, and on_failure is land-all"
        if self._is_lasting(name):
            return f"{self._trouble.name}: {self._trouble.cases[name].fault.description}"
        return next(filter(None, (self._in_the_way(other, name) for other in self._known_m)), "")

    def _in_the_way(self, other: str, name: str) -> str:
        """Return why the vehicle `other`, whose flight has ended, is in the way of the vehicle
        `name`; empty if it is not. A vehicle at an unknown position (NaN) is always in the way."""
        place_m, result = self._known_m[other], self._results[other]
        hangs = result.outcome == "perched"
        does = "is hanging" if hangs else "is on the floor"
        if not all(map(math.isfinite, place_m)):
            return f"the position of {other} is unknown"
        gap_m = self._plan.corridors[name].distance_to_m(place_m)
        if gap_m < OBSTACLE_M:
            return f"{other} {does} {gap_text(gap_m)} this vehicle's corridor"
        away_m = math.dist(place_m, self._plan.fleet.vehicle(other).home_m)
        together = self._plan.schedule.may_fly_together(other, name)
        if not (hangs or together or away_m <= AT_HOME_M):
            return (
                f"{other} is on the floor {away_m:.2f} m from its home, in a corridor that is "
                "too close to this vehicle's"
            )
        return ""

    def _is_lasting(self, name: str) -> bool:
        """True if a common cause that affects this vehicle has begun and is permanent. A cause
        never begins if its group ends before the time at which it is due."""
        case = self._trouble.cases.get(name)
        return self._cause_has_begun and case is not None and case.lasts_s > FOR_GOOD_S


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None


def fly_fleet(plan: FleetPlan, faults: tuple[str, ...], seed: int) -> FleetResult:
    """Fly a fleet with one seed to the end. Any executor can send this function to a worker.

    `faults`: names from `select_fleet_faults`, one of which is drawn with the seed; if there are
    none, no fault is injected.
    """

    def fly() -> FleetResult:
        placed = place_fleet(plan.fleet, seed)
        return FleetFlight(plan, placed, draw_trouble(plan, placed, faults, seed)).fly(seed)

    return run_measured(fly)
