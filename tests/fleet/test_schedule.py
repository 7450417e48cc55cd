"""Who flies when: laws of every schedule, and what cannot be flown."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import replace

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from perchctl.corridor import Point
from perchctl.errors import InvalidValue
from perchctl.fleet import load_fleet
from perchctl.fleet.assignment import assign_nearest
from perchctl.fleet.fleet import Fleet, FleetVehicle
from perchctl.fleet.schedule import (
    OBSTACLE_M,
    ROOM_ERROR_M,
    SEPARATION_M,
    START_SEPARATION_M,
    TARGET_ALONE_M,
    WANDER_M,
    Schedule,
    corridor_radius_m,
    estimate_corridor,
    make_schedule,
    vehicle_corridor,
)
from tests.fleet.rig import FENCE_M, base, fleet
from tests.fleet.test_corridor import moved

LENGTH = st.floats(-4.0, 4.0)
POINT = st.tuples(LENGTH, LENGTH)
PLACES = st.lists(st.tuples(POINT, POINT), min_size=1, max_size=5)
ORDER = st.sampled_from(["one-at-a-time", "together", "2 at a time"])


def schedule_or_none(planned: Fleet) -> Schedule | None:
    try:
        return make_schedule(planned)
    except InvalidValue:
        return None


def refusal(planned: Fleet) -> str:
    with pytest.raises(InvalidValue) as caught:
        make_schedule(planned)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# --- Laws ---


@given(PLACES, ORDER, st.sampled_from([0.2, SEPARATION_M, 1.0]))
def test_no_schedule_lets_two_vehicles_meet(
    places: list[tuple[Point, Point]], order: str, separation_m: float
) -> None:
    """In the air together only apart; and nobody flies where another one waits or hangs."""
    planned = fleet(places, order=order, separation_m=separation_m)
    schedule = schedule_or_none(planned)
    assume(schedule is not None)
    assert schedule is not None
    assert sorted(itertools.chain(*schedule.groups)) == sorted(v.name for v in planned.vehicles)
    corridors = {vehicle.name: vehicle_corridor(vehicle) for vehicle in planned.vehicles}
    flown: set[str] = set()
    for group in schedule.groups:
        assert 0 < len(group) <= planned.most_at_once
        for a, b in itertools.combinations(group, 2):
            assert corridors[a].distance_m(corridors[b]) >= separation_m
            assert corridors[a].distance_to_m(corridors[b].home_m) >= START_SEPARATION_M
            assert corridors[b].distance_to_m(corridors[a].home_m) >= START_SEPARATION_M
        for name in group:
            for other in corridors.keys() - set(group):
                place = corridors[other].target_m if other in flown else corridors[other].home_m
                assert corridors[name].distance_to_m(place) >= OBSTACLE_M
        flown.update(group)


@given(PLACES, ORDER, st.floats(-math.pi, math.pi), POINT)
def test_a_schedule_does_not_depend_on_the_room_s_axes(
    places: list[tuple[Point, Point]], order: str, angle_rad: float, shift: Point
) -> None:
    there = [tuple(moved(p, angle_rad, shift) for p in ends) for ends in places]
    here, turned = fleet(places, order=order), fleet(there, order=order)  # type: ignore[arg-type]
    gaps = [
        gap
        for a, b in itertools.permutations(map(vehicle_corridor, here.vehicles), 2)
        for limit, gap in (
            (SEPARATION_M, a.distance_m(b)),
            (START_SEPARATION_M, a.distance_to_m(b.home_m)),
            (OBSTACLE_M, a.distance_to_m(b.home_m)),
            (OBSTACLE_M, a.distance_to_m(b.target_m)),
        )
        if abs(gap - limit) < 1e-6
    ]
    assume(not gaps)  # a gap at its limit may fall on either side
    before, after = schedule_or_none(here), schedule_or_none(turned)
    assert (before and before.groups) == (after and after.groups)


@given(st.lists(st.tuples(POINT, POINT), min_size=1, max_size=5))
def test_nearest_targets_are_as_good_as_the_best_of_all_assignments(
    places: list[tuple[Point, Point]],
) -> None:
    homes, targets = [home for home, _ in places], [target for _, target in places]
    found = assign_nearest(fleet(places))

    def cost(ends: list[Point]) -> float:
        return sum(math.dist(home, end) ** 2 for home, end in zip(homes, ends, strict=True))

    chosen = [vehicle.target_m for vehicle in found.vehicles]
    assert sorted(chosen) == sorted(targets)
    best = min(cost(list(order)) for order in itertools.permutations(targets))
    assert cost(chosen) == pytest.approx(best, abs=1e-9)
    for vehicle in found.vehicles:
        assert vehicle.profile.target.expected_xy_m == vehicle.to_estimate(vehicle.target_m)


@given(POINT, POINT, POINT, st.floats(-180, 180))
def test_the_fence_of_an_estimate_is_the_corridor_in_the_room(
    home: Point, target: Point, place: Point, heading_deg: float
) -> None:
    vehicle: FleetVehicle = fleet([(home, target)]).vehicles[0]
    vehicle = replace(vehicle, frame="home", heading_deg=heading_deg)
    room_m = vehicle_corridor(vehicle).distance_to_m(place)
    own_m = estimate_corridor(vehicle).distance_to_m(vehicle.to_estimate(place))
    assert own_m == pytest.approx(room_m, abs=1e-9)


# --- Radius ---


def test_the_radius_follows_from_what_measures_the_position() -> None:
    room, deck, alone = (
        fleet([((0, 0), (1, 0))], by).vehicles[0] for by in ("mocap", "deck", "target")
    )
    assert corridor_radius_m(room) == pytest.approx(WANDER_M + ROOM_ERROR_M)
    assert corridor_radius_m(deck) == corridor_radius_m(room), "a Lighthouse deck, as it says"
    flow = replace(deck, frame="home")
    assert corridor_radius_m(room) < corridor_radius_m(flow) < corridor_radius_m(alone)
    assert corridor_radius_m(alone) == TARGET_ALONE_M
    longer = flow.profile.with_({"planner.search.attempts": 12})
    assert corridor_radius_m(replace(flow, profile=longer)) > corridor_radius_m(flow)


# --- Orders ---


def test_disjoint_corridors_fly_together_and_as_many_as_the_order_says() -> None:
    places = [((3.0 * n, 0.0), (3.0 * n + 0.2, 0.0)) for n in range(3)]
    assert make_schedule(fleet(places, order="together")).groups == (("v0", "v1", "v2"),)
    assert make_schedule(fleet(places, order="2 at a time")).groups == (("v0", "v1"), ("v2",))
    assert make_schedule(fleet(places)).groups == (("v0",), ("v1",), ("v2",))


def test_near_corridors_fly_one_after_the_other() -> None:
    schedule = make_schedule(
        fleet([((0, 0), (0.2, 0)), ((1, 0), (1.2, 0)), ((4, 0), (4, 0))], order="together")
    )
    assert schedule.groups == (("v0", "v2"), ("v1",))
    assert [c.why for c in schedule.conflicts] == ["their corridors are 0.10 m apart"]
    assert not schedule.may_fly_together("v1", "v0")
    assert schedule.may_fly_together("v1", "v2")


def test_who_waits_in_another_s_corridor_flies_first() -> None:
    """v0 flies over v1's home to a target beyond it."""
    schedule = make_schedule(fleet([((0, 0), (3, 0)), ((1.5, 0.2), (1.5, 2.5))]))
    assert schedule.groups == (("v1",), ("v0",))
    assert schedule.precedences[0].why == ("v1 waits on the floor 0.15 m inside the corridor of v0")


# --- Refusals ---


def test_who_would_hang_in_each_other_s_corridor_is_refused_with_both_names() -> None:
    assert refusal(fleet([((0, 0), (1, 0)), ((2, 0), (1.2, 0))])) == (
        "there is no order in which v0 and v1 can fly: v1 hangs 0.15 m inside the corridor of v0, "
        "and v0 hangs 0.15 m inside the corridor of v1; a waiting or hanging vehicle must be at "
        "least 0.24 m away from another vehicle's corridor: move a home or target farther away"
    )


def test_a_drifting_estimate_is_the_reason_that_is_named() -> None:
    sentence = refusal(fleet([((0, 0), (0.2, 0)), ((1, 0), (1, 0.2))], "target"))
    assert "there is no order in which v0 and v1 can fly" in sentence
    assert "a corridor radius of 0.35 m is enough instead of 1.00 m" in sentence


def test_the_largest_radius_is_named_even_if_others_meet_first() -> None:
    """v0 and v1, which are in room axes, have to swap targets; v2 and v3 need smaller corridors."""
    ways: list[tuple[Point, Point]] = [((0, 0), (1, 0)), ((1, 0), (0, 0))]
    near: list[tuple[Point, Point]] = [((10, 0), (10.1, 0)), ((10.8, 0), (10.9, 0))]
    planned, drifting = fleet(ways + near), deck(ways + near).vehicles[2:]
    sentence = refusal(replace(planned, vehicles=(*planned.vehicles[:2], *drifting)))
    assert sentence.startswith("there is no order in which v0 and v1 can fly")
    wide_m = corridor_radius_m(drifting[0])
    assert wide_m > WANDER_M + ROOM_ERROR_M
    assert f"a corridor radius of 0.35 m is enough instead of {wide_m:.2f} m" in sentence


def test_a_circle_of_three_is_refused() -> None:
    """Each waits in the way of the next one."""
    ways: list[tuple[Point, Point]] = [((0, 0), (2, 0)), ((2, 0), (2, 2)), ((2, 2), (0, 0.4))]
    sentence = refusal(fleet(ways, order="together"))
    assert re.match(
        r"there is no order in which v0, v1 and v2 can fly: v\d must fly before v\d because v\d "
        r"(waits|hangs) .*, v\d must fly before v\d because .*, and v\d must fly before v\d be",
        sentence,
    )


def deck(ways: list[tuple[Point, Point]]) -> Fleet:
    """A fleet of vehicles with Flow decks."""
    planned = fleet(ways, "deck", order="together")
    return replace(planned, vehicles=tuple(replace(v, frame="home") for v in planned.vehicles))


NEAREST = "or set assign: nearest if the targets are interchangeable"
ROOM = "or use a motion-capture system or Lighthouse (frame: room)"
BOTH = "and use a motion-capture system or Lighthouse (frame: room)"
REMEDIES: dict[str, tuple[list[tuple[Point, Point]], list[str]]] = {
    "swapped": ([((0, 0), (1, 0)), ((1, 0), (0, 0))], [NEAREST]),
    "swapped, close": ([((0, 0), (0.7, 0)), ((0.7, 0), (0, 0))], [NEAREST, BOTH]),
    "close": ([((0, 0), (0.1, 0)), ((0.8, 0), (0.9, 0))], [ROOM]),
    "in line": ([((0, 0), (2, 0)), ((0.5, 0), (1, 0)), ((1.5, 0), (1.5, 0))], []),
}


@pytest.mark.parametrize(("ways", "remedies"), REMEDIES.values(), ids=REMEDIES)
def test_a_remedy_is_named_only_if_the_whole_plan_passes_with_it(
    ways: list[tuple[Point, Point]], remedies: list[str]
) -> None:
    sentence = refusal(deck(ways))
    assert "move a home or target farther away" in sentence
    for words in (NEAREST, ROOM, BOTH):
        assert (words in sentence) is (words in remedies), sentence


@given(st.lists(st.tuples(POINT, POINT), min_size=2, max_size=3))
def test_what_a_refusal_advises_can_be_flown(ways: list[tuple[Point, Point]]) -> None:
    planned = deck(ways)
    try:
        make_schedule(planned)
    except InvalidValue as error:
        if NEAREST in str(error) and BOTH not in str(error):
            make_schedule(assign_nearest(planned))
        if ROOM in str(error):
            make_schedule(fleet(ways))
        if BOTH in str(error):
            make_schedule(assign_nearest(fleet(ways)))


def test_a_place_on_the_edge_is_not_0_m_away() -> None:
    schedule = make_schedule(fleet([((0, 0), (1, 0)), ((1.35, 0), (3, 0))]))
    whys = [each.why for each in schedule.precedences]
    assert "v1 waits on the floor at the edge of the corridor of v0" in whys
    schedule = make_schedule(fleet([((0, 0), (0, 1)), ((0.7, 0), (0.7, 1))], order="together"))
    assert [c.why for c in schedule.conflicts] == ["their corridors touch"]


def test_swapped_targets_beyond_the_fence_are_named_as_such() -> None:
    ways: list[tuple[Point, Point]] = [((0, 0), (FENCE_M, 0)), ((FENCE_M, 0), (0, 0.5))]
    sentence = refusal(fleet(ways))
    assert "(the target of v1 is only 0.50 m from this home), correct target_m" in sentence
    assert "if they are interchangeable, set assign: nearest" in sentence


@pytest.mark.parametrize(("away_m", "advice"), [
    (3.0, "move its home nearer to the target, or set a larger fence"),
    (27.0, "check home_m and target_m"),
])  # fmt: skip
def test_a_home_that_is_probably_wrong_needs_no_larger_fence(away_m: float, advice: str) -> None:
    profile = base().with_({"safety.fence_radius_m": 2.0})
    planned = fleet([((0, 0), (away_m, 0))])
    planned = replace(planned, vehicles=(replace(planned.vehicles[0], profile=profile),))
    assert refusal(planned).endswith(f"safety.fence_radius_m is 2 m: {advice}")


def test_a_target_beyond_the_fence_is_refused() -> None:
    sentence = refusal(fleet([((0, 0), (FENCE_M, 0))]))
    assert sentence.startswith(f"the target of v0 is {FENCE_M:.2f} m from its home, and a draught")


def test_targets_that_could_be_taken_for_each_other_are_refused() -> None:
    near = base().with_({"target.expected_within_m": 3.0})
    planned = fleet([((0, 0), (0, 0)), ((2, 0), (2, 0))])
    vehicles = tuple(
        replace(vehicle, profile=near).with_target(vehicle.target_m) for vehicle in planned.vehicles
    )
    assert refusal(replace(planned, vehicles=vehicles)).startswith(
        "the targets of v0 and v1 have a marker id in common and are 2.00 m apart, within"
    )


def test_the_shipped_fleet_flies_in_pairs() -> None:
    assert make_schedule(load_fleet()).groups == (("north", "east"), ("south", "west"))
