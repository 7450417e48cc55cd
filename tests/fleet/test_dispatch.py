"""Distances between vehicles in the air, as far as the fleet's parent knows them."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.corridor import Point
from perchctl.fleet import make_plan
from perchctl.fleet.dispatch import (
    FRESH_PLACE_S,
    NEAR_MARGIN_M,
    VehicleView,
    find_near_pairs,
    find_unwatched,
)
from perchctl.fleet.messages import BEAT_S, Result, Stage, Status, VehicleOutcome
from perchctl.fleet.radio import SLOWEST_PERIOD_S
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
