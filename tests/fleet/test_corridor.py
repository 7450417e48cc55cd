"""Distances between corridors: their laws, and the corridor as a fence."""

from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from perchctl.corridor import Corridor, Point, segment_distance_m

LENGTH = st.floats(-8.0, 8.0, allow_nan=False)
POINT = st.tuples(LENGTH, LENGTH)
RADIUS = st.floats(0.05, 1.5)


def corridor(home: Point, target: Point, radius_m: float = 0.5) -> Corridor:
    return Corridor(
        home_m=home, target_m=target, radius_m=radius_m, way_top_m=1.6, target_top_m=3.0
    )


CORRIDOR = st.builds(corridor, POINT, POINT, RADIUS)


def moved(point: Point, angle_rad: float, shift: Point) -> Point:
    (x, y), c, s = point, math.cos(angle_rad), math.sin(angle_rad)
    return c * x - s * y + shift[0], s * x + c * y + shift[1]


def moved_corridor(each: Corridor, angle_rad: float, shift: Point) -> Corridor:
    ends = (moved(point, angle_rad, shift) for point in (each.home_m, each.target_m))
    return corridor(*ends, each.radius_m)


@given(CORRIDOR, CORRIDOR)
def test_distance_is_symmetric_and_the_way_has_no_direction(a: Corridor, b: Corridor) -> None:
    assert a.distance_m(b) == b.distance_m(a)
    back = corridor(a.target_m, a.home_m, a.radius_m)
    assert back.distance_m(b) == pytest.approx(a.distance_m(b), abs=1e-9)


@given(CORRIDOR, CORRIDOR, st.floats(-math.pi, math.pi), POINT)
def test_distance_does_not_depend_on_the_room_s_axes(
    a: Corridor, b: Corridor, angle_rad: float, shift: Point
) -> None:
    there = moved_corridor(a, angle_rad, shift).distance_m(moved_corridor(b, angle_rad, shift))
    assert there == pytest.approx(a.distance_m(b), abs=1e-6)


@given(CORRIDOR, CORRIDOR)
def test_no_two_places_of_two_corridors_are_nearer_than_their_distance(
    a: Corridor, b: Corridor
) -> None:
    """Against many points of both lines; the nearest of them is not much farther off."""
    shares = [n / 40 for n in range(41)]

    def points(each: Corridor) -> list[Point]:
        (x, y), (u, v) = each.home_m, each.target_m
        return [(x + s * (u - x), y + s * (v - y)) for s in shares]

    nearest_m = min(math.dist(p, q) for p in points(a) for q in points(b))
    exact_m = a.distance_m(b) + a.radius_m + b.radius_m
    step_m = (math.dist(a.home_m, a.target_m) + math.dist(b.home_m, b.target_m)) / 40
    assert nearest_m - step_m - 1e-9 <= exact_m <= nearest_m + 1e-9


@given(CORRIDOR, st.floats(0, 1), st.floats(-math.pi, math.pi), st.floats(0.0, 2.0))
def test_a_place_beside_the_way_is_inside_up_to_the_radius(
    each: Corridor, share: float, angle_rad: float, away: float
) -> None:
    (x, y), (u, v) = each.home_m, each.target_m
    out_m = away * each.radius_m
    place = (
        x + share * (u - x) + out_m * math.cos(angle_rad),
        y + share * (v - y) + out_m * math.sin(angle_rad),
    )
    distance_m = each.distance_to_m(place)
    assert distance_m <= out_m - each.radius_m + 1e-9
    assume(abs(distance_m) > 1e-9)
    assert each.contains(*place, 0.5) == (distance_m < 0.0)


def test_crossing_ways_touch_and_parallel_ones_keep_their_distance() -> None:
    assert segment_distance_m((-1, 0), (1, 0), (0, -1), (0, 1)) == 0.0
    assert segment_distance_m((0, 0), (4, 0), (1, 3), (2, 3)) == 3.0
    assert segment_distance_m((0, 0), (0, 0), (3, 4), (3, 4)) == 5.0
    assert segment_distance_m((0, 0), (2, 0), (1, 0), (3, 0)) == 0.0


def test_only_the_column_under_the_target_reaches_the_ceiling() -> None:
    each = corridor((0, 0), (2, 0))
    assert each.contains(0.0, 0.4, 1.6)
    assert not each.contains(0.0, 0.4, 1.7)
    assert each.contains(2.0, 0.4, 2.9)
    assert not each.contains(2.0, 0.4, 3.1)
    assert each.contains(0.0, 0.0, -0.5), "a landing aims below the floor"


@pytest.mark.parametrize("axis", range(3))
def test_what_is_unknown_is_outside(axis: int) -> None:
    place = [0.0, 0.0, 0.5]
    place[axis] = math.nan
    assert not corridor((0, 0), (2, 0)).contains(*place)
