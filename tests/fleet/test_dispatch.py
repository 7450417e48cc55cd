"""Distances between vehicles in the air, as far as the fleet's parent knows them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from perchctl.corridor import Point
from perchctl.errors import InvalidValue
from perchctl.fleet import make_plan
from perchctl.fleet.dispatch import (
    FRESH_PLACE_S,
    FRESH_STATUS_S,
    HUNG_S,
    NEAR_MARGIN_M,
    VehicleView,
    decide,
    find_climb_obstacle,
    find_near_pairs,
    find_unwatched,
)
from perchctl.fleet.messages import BEAT_S, Result, Stage, Status, VehicleOutcome
from perchctl.fleet.radio import SLOWEST_PERIOD_S
from perchctl.fleet.schedule import TARGET_ALONE_M
from perchctl.mission import OperatorRequest, Phase
from tests.fleet.rig import fleet, on_air

PLAN = make_plan(
    on_air([f"radio://{n}/{80 + 4 * n}/2M/E7E7E7E70{n}" for n in range(4)])  # real, in the room
)
NAMES = [vehicle.name for vehicle in PLAN.fleet.vehicles]
LEAST_M = PLAN.separation_m - NEAR_MARGIN_M

lengths = st.floats(-1.0, 1.0)
ages = st.one_of(st.none(), st.floats(0.0, 2.0 * FRESH_PLACE_S))
places = st.one_of(
    st.none(),
    st.tuples(lengths, lengths),
    st.tuples(lengths, st.sampled_from([math.nan, math.inf])),
)
statuses = st.builds(
    Status,
    stage=st.sampled_from([Stage.READY, Stage.FLYING, Stage.FLYING, Stage.ENDING]),
    telemetry_age_s=ages,
    loop_age_s=ages,
    place_m=places,
)
silences = st.floats(0.0, FRESH_PLACE_S)
fleets = st.tuples(
    *[
        st.builds(
            VehicleView,
            name=st.just(name),
            status=st.one_of(st.none(), statuses),
            silent_s=silences,
        )
        for name in NAMES
    ]
)


def flying(name: str, place_m: Point | None, age_s: float = 0.1) -> VehicleView:
    status = Status(stage=Stage.FLYING, telemetry_age_s=age_s, loop_age_s=0.0, place_m=place_m)
    return VehicleView(name=name, status=status)


def is_known(view: VehicleView) -> bool:
    place_m = None if view.status is None else view.status.place_m
    return (
        place_m is not None
        and all(map(math.isfinite, place_m))
        and view.place_age_s <= FRESH_PLACE_S
    )


@given(fleets)
def test_exactly_the_known_and_near_land(views: tuple[VehicleView, ...]) -> None:
    expected = set()
    for one, other in itertools.combinations(views, 2):
        if one.is_in_air and other.is_in_air and is_known(one) and is_known(other):
            assert one.status is not None
            assert other.status is not None
            here, there = one.status.place_m, other.status.place_m
            assert here is not None
            assert there is not None
            if math.dist(here, there) < LEAST_M:
                expected.add((one.name, other.name))
    assert {(pair.first, pair.second) for pair in find_near_pairs(PLAN, views)} == expected


@given(fleets)
def test_each_in_the_air_is_either_known_or_named(views: tuple[VehicleView, ...]) -> None:
    """Unknown is never taken for far enough."""
    in_air = [view for view in views if view.is_in_air]
    unknown = {view.name for view in in_air if not is_known(view)}
    assert set(find_unwatched(PLAN, views)) == (unknown if len(in_air) > 1 else set())


@given(fleets)
def test_the_order_of_the_vehicles_does_not_count(views: tuple[VehicleView, ...]) -> None:
    def pairs(of: tuple[VehicleView, ...]) -> set[frozenset[str]]:
        return {frozenset((p.first, p.second)) for p in find_near_pairs(PLAN, of)}

    assert pairs(views) == pairs(views[::-1])


@given(fleets, st.floats(0.0, 10.0))
def test_an_older_position_lands_nobody_else(views: tuple[VehicleView, ...], more_s: float) -> None:
    older = tuple(replace(view, silent_s=view.silent_s + more_s) for view in views)
    assert set(find_near_pairs(PLAN, older)) <= set(find_near_pairs(PLAN, views))


@given(lengths, lengths, lengths, lengths)
def test_two_who_keep_the_plans_separation_with_both_errors_fly_on(
    x: float, y: float, u: float, v: float
) -> None:
    """Each of the two positions is wrong by as much as the plan allows for."""
    true_m = math.dist((x, y), (u, v))
    if true_m >= PLAN.separation_m and true_m > 0.0:
        share = (true_m - 0.999 * NEAR_MARGIN_M) / true_m
        there = x + share * (u - x), y + share * (v - y)
        assert find_near_pairs(PLAN, [flying("v0", (x, y)), flying("v1", there)]) == ()


def test_the_reason_names_the_other_and_the_distance() -> None:
    (pair,) = find_near_pairs(PLAN, [flying("v0", (0.0, 0.0)), flying("v1", (0.0, 0.2))])
    assert pair.why("v0") == "0.20 m from v1 in the air"
    assert pair.why("v1") == "0.20 m from v0 in the air"
    assert str(pair) == "v0 and v1 were 0.20 m apart in the air"


def test_one_that_has_ended_is_not_in_the_air() -> None:
    hangs = replace(
        flying("v0", (0.0, 0.0)),
        result=Result(exit_code=0, outcome=VehicleOutcome.PERCHED, reason=""),
    )
    assert find_near_pairs(PLAN, [hangs, flying("v1", (0.0, 0.2))]) == ()


def test_positions_that_share_no_world_are_not_compared() -> None:
    plan = make_plan(
        replace(
            PLAN.fleet,
            vehicles=tuple(replace(v, frame="home") for v in PLAN.fleet.vehicles),
        )
    )
    views = [flying("v0", (0.0, 0.0)), flying("v1", (0.0, 0.0))]
    assert (find_near_pairs(plan, views), find_unwatched(plan, views)) == ((), ())


def test_a_simulated_vehicle_is_where_it_flies_from_its_home() -> None:
    """The axes of its process begin there, though its motion capture measures in the room's."""
    plan = make_plan(fleet([((0.0, 0.0), (0.0, 0.0)), ((2.0, 0.0), (2.0, 0.0))]))
    near = [flying("v0", (1.0, 0.0)), flying("v1", (-0.9, 0.0))]
    assert [p.distance_m for p in find_near_pairs(plan, near)] == [pytest.approx(0.1)]
    assert find_near_pairs(plan, [flying("v0", (0.0, 0.0)), flying("v1", (0.0, 0.0))]) == ()


def test_the_slowest_telemetry_that_perchctl_chooses_is_fresh() -> None:
    assert 2.0 * SLOWEST_PERIOD_S + BEAT_S < FRESH_PLACE_S


# --- Permission to climb ---

DENSE = make_plan(
    fleet([((1.2 * n, 0.0), (1.2 * n, 1.0)) for n in range(3)], order="together")
)  # as near to each other as the plan allows, but for 0.1 m
CORRIDORS = DENSE.corridors
TARGETS = {vehicle.name: vehicle.target_m for vehicle in DENSE.fleet.vehicles}
CLIMB_M = {name: CORRIDORS[name].radius_m + DENSE.separation_m for name in TARGETS}
shares, angles = st.floats(0.0, 1.0), st.floats(-math.pi, math.pi)


def in_own_axes(name: str, room_m: Point, **status: Any) -> VehicleView:
    """A vehicle of `DENSE` that flies at this place of the room."""
    flown = flying(name, DENSE.fleet.vehicle(name).as_flown.to_estimate(room_m))
    assert flown.status is not None
    return replace(flown, status=replace(flown.status, **status))


def places_in(name: str, beyond_m: float = 0.0) -> st.SearchStrategy[Point]:
    """Places in the corridor of a vehicle, or up to so far beside it."""
    corridor = CORRIDORS[name]
    most_m = corridor.radius_m + beyond_m

    def place(along: float, away: float, angle_rad: float) -> Point:
        x, y = (
            a + along * (b - a) for a, b in zip(corridor.home_m, corridor.target_m, strict=True)
        )
        return x + away * most_m * math.cos(angle_rad), y + away * most_m * math.sin(angle_rad)

    return st.builds(place, shares, shares, angles)


def permitted(views: Sequence[VehicleView], **given: Any) -> dict[str, bool]:
    given = {"started": True} | given
    orders = decide(DENSE, views, **given).orders
    assert not any(order.may_climb and order.why_not_climb for order in orders.values())
    return {name: order.may_climb for name, order in orders.items()}


@given(st.tuples(*[places_in(name) for name in TARGETS]))
def test_who_keep_to_their_corridors_all_climb(places: tuple[Point, ...]) -> None:
    views = [in_own_axes(name, place) for name, place in zip(TARGETS, places, strict=True)]
    assert all(permitted(views).values())


@given(st.data())
def test_no_plan_that_is_accepted_bars_a_climb(data: st.DataObject) -> None:
    """Of two vehicles that may fly together, none in its corridor is near the other one's climb."""
    points = st.tuples(lengths, lengths)
    ends = data.draw(st.tuples(points, points, points, points))
    (a, b), (c, d) = ends[:2], [(x + 1.5, y) for x, y in ends[2:]]
    try:
        plan = make_plan(fleet([(a, b), (c, d)], order="together"))
    except InvalidValue:
        assume(False)
    assume(len(plan.schedule.groups) == 1)
    corridor = plan.corridors["v0"]
    share, angle_rad = data.draw(shares), data.draw(angles)
    way = zip(corridor.home_m, corridor.target_m, strict=True)
    x_m, y_m = (begin + share * (end - begin) for begin, end in way)
    x_m += corridor.radius_m * math.cos(angle_rad)
    y_m += corridor.radius_m * math.sin(angle_rad)
    flown = plan.fleet.vehicle("v0").as_flown.to_estimate((x_m, y_m))
    assert find_climb_obstacle(plan, "v1", [flying("v0", flown), flying("v1", None)]) is None


@given(st.tuples(*[places_in(name, 2.0) for name in TARGETS]))
def test_exactly_who_has_another_near_its_climb_waits(places: tuple[Point, ...]) -> None:
    views = [in_own_axes(name, place) for name, place in zip(TARGETS, places, strict=True)]
    by_name = dict(zip(TARGETS, places, strict=True))
    for name, may in permitted(views).items():
        gaps_m = [
            math.dist(place, TARGETS[name]) - CLIMB_M[name]
            for other, place in by_name.items()
            if other != name
        ]
        assert may is (min(gaps_m) >= 0.0) or abs(min(gaps_m)) < 1e-5


@given(st.tuples(*[places_in(name, 0.6) for name in TARGETS]), st.floats(0.0, 2.0))
def test_an_older_position_permits_no_climb(places: tuple[Point, ...], more_s: float) -> None:
    """Of a vehicle that is as near to its way as one that has lost its position may be."""
    views = [in_own_axes(name, place) for name, place in zip(TARGETS, places, strict=True)]
    older = [replace(view, silent_s=view.silent_s + more_s) for view in views]
    before = permitted(views)
    assert all(before[name] for name, may in permitted(older).items() if may)


WIDE = make_plan(fleet([((4.0 * n, 0.0), (4.0 * n, 0.0)) for n in range(2)], order="together"))


@given(away_m=st.floats(0.0, 4.0), angle_rad=angles)
def test_who_was_last_seen_near_a_climb_may_still_be_there(away_m: float, angle_rad: float) -> None:
    """However far from its own way: this vehicle had left it before it fell silent."""
    x_m, y_m = 4.0 + away_m * math.cos(angle_rad), away_m * math.sin(angle_rad)
    last = flying("v0", WIDE.fleet.vehicle("v0").as_flown.to_estimate((x_m, y_m)))
    why = find_climb_obstacle(WIDE, "v1", [replace(last, silent_s=FRESH_STATUS_S)])
    near_m = WIDE.corridors["v1"].radius_m + WIDE.separation_m + TARGET_ALONE_M
    assert (why is not None) is (away_m < near_m) or abs(away_m - near_m) < 1e-5


@pytest.mark.parametrize(
    ("status", "waits"),
    [
        ({}, ["v0", "v2"]),  # which should be known
        ({"place_m": (math.nan, 0.0)}, ["v0", "v2"]),
        ({"phase": Phase.LANDING}, ["v0", "v2"]),
        ({"stage": Stage.ENDING}, []),
        ({"stage": Stage.READY}, []),
    ],
)
def test_nobody_beside_a_vehicle_climbs_whose_place_is_unknown(
    status: dict[str, Any], waits: list[str]
) -> None:
    homes = [in_own_axes(name, TARGETS[name]) for name in TARGETS]
    views = [homes[0], in_own_axes("v1", TARGETS["v1"], **{"place_m": None, **status}), homes[2]]
    assert [name for name in ("v0", "v2") if not permitted(views)[name]] == waits


@pytest.mark.parametrize(
    ("phase", "silent_s", "may"),
    [(Phase.ALIGN, 0.1, True), (Phase.LANDING, 0.1, False), (Phase.ALIGN, 2.0, False)],
)
def test_a_vehicle_that_cannot_share_its_place_is_trusted_until_it_lands_or_is_silent(
    phase: Phase, silent_s: float, may: bool
) -> None:
    vehicles = tuple(replace(each, frame="home") for each in DENSE.fleet.vehicles)
    plan = replace(DENSE, fleet=replace(DENSE.fleet, vehicles=vehicles))
    views = [in_own_axes(name, TARGETS[name], phase=Phase.ALIGN) for name in TARGETS]
    views[1] = replace(
        in_own_axes("v1", TARGETS["v1"], phase=phase, place_m=None), silent_s=silent_s
    )
    assert decide(plan, views, started=True).orders["v0"].may_climb is may


@pytest.mark.parametrize(
    ("outcome", "has_flown", "silent_s", "may"),
    [
        (VehicleOutcome.FAILED, True, 0.1, False),  # a process that was killed in the air
        (VehicleOutcome.ABORTED, True, 3.0, False),  # a landing that nothing confirmed
        (VehicleOutcome.FAILED, True, HUNG_S + 0.1, True),  # it is down by now
        (VehicleOutcome.FAILED, False, 0.1, True),
        (VehicleOutcome.LANDED, True, 0.1, True),
        (VehicleOutcome.PERCHED, True, 0.1, True),
    ],
)
def test_nobody_climbs_beside_a_vehicle_that_may_still_come_down(
    outcome: VehicleOutcome, has_flown: bool, silent_s: float, may: bool
) -> None:
    result = Result(exit_code=52, outcome=outcome, reason="", has_flown=has_flown)
    views = [in_own_axes(name, TARGETS[name]) for name in TARGETS]
    views[1] = replace(views[1], result=result, silent_s=silent_s)
    assert [permitted(views)[name] for name in ("v0", "v2")] == [may, may]


def test_nobody_climbs_before_the_start_or_on_a_command_to_land() -> None:
    views = [in_own_axes(name, TARGETS[name]) for name in TARGETS]
    assert not any(permitted(views, started=False).values())
    assert not any(permitted(views, word=OperatorRequest.LAND).values())
    assert permitted(views, landed=["v1"]) == {"v0": True, "v1": False, "v2": True}
    on_floor = [replace(view, status=Status(stage=Stage.READY)) for view in views]
    assert not any(permitted(on_floor).values())
