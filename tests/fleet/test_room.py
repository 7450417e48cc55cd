"""The simulated room: places, distances, and the air between vehicles."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.fleet import load_fleet
from perchctl.fleet.room import (
    COLLISION_HALF_HEIGHT_M,
    COLLISION_RADIUS_M,
    START_ERROR_M,
    Room,
    place_fleet,
)
from perchctl.fleet.schedule import estimate_corridor, flown_profile
from perchctl.sim import downwash_mps
from tests.fleet.rig import fleet

SHIPPED = load_fleet()
HOVER_N = 0.42


def flying(x_m: float, y_m: float, z_m: float, *, turns: bool = True) -> Any:
    """As much of a simulated vehicle as the room sees, in the vehicle's own axes."""
    lift_n = HOVER_N / 4.0 if turns else 0.0
    world = SimpleNamespace(
        x_m=x_m,
        y_m=y_m,
        z_m=z_m,
        downwash_mps=0.0,
        powertrain=SimpleNamespace(forces_n=(lift_n,) * 4),
    )
    firmware = SimpleNamespace(motors=(float(turns),) * 4)
    return SimpleNamespace(world=world, firmware=firmware, capture=None)


def two(home_m: tuple[float, float] = (1.0, 0.0)) -> Room:
    """v0 at the origin, v1 at `home_m`, both exactly where the file says."""
    planned = fleet([((0.0, 0.0), (0.0, 0.0)), (home_m, home_m)])
    placed = place_fleet(planned, 1)
    exact = zip(placed, planned.vehicles, strict=True)
    return Room([replace(p, true=replace(v, frame="home")) for p, v in exact])


def test_each_vehicle_stands_nearly_where_the_file_says_below_one_ceiling() -> None:
    placed = place_fleet(SHIPPED, 7)
    assert len({each.scenario.ceiling_z_m for each in placed}) == 1
    assert len({each.scenario.seed for each in placed}) == 4
    for vehicle, each in zip(SHIPPED.vehicles, placed, strict=True):
        assert math.dist(vehicle.home_m, each.true.home_m) <= math.sqrt(2.0) * START_ERROR_M
        target_m = each.true.to_room(each.scenario.target_xy_m)
        assert target_m == pytest.approx(vehicle.target_m)
    assert placed == place_fleet(SHIPPED, 7)
    assert placed != place_fleet(SHIPPED, 8)


def test_a_neighbour_s_target_is_where_it_hangs() -> None:
    """From the own target, turned as the own one."""
    north, east, *_ = place_fleet(SHIPPED, 7)
    (x_m, y_m), turn_rad = next(
        (each.xy_m, each.yaw_rad)
        for each in north.scenario.neighbours
        if math.hypot(*each.xy_m) == pytest.approx(math.dist((-0.1, 1.5), (1.5, 0.1)))
    )
    heading_rad = math.radians(north.true.heading_deg) + north.scenario.target_yaw_rad
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    assert (-0.1 + c * x_m - s * y_m, 1.5 + s * x_m + c * y_m) == pytest.approx((1.5, 0.1))
    theirs_rad = math.radians(east.true.heading_deg) + east.scenario.target_yaw_rad
    assert turn_rad == pytest.approx(theirs_rad - heading_rad)


def test_a_vehicle_flies_by_its_own_corridor() -> None:
    for vehicle in (*SHIPPED.vehicles, *fleet([((3.0, 1.0), (4.0, 2.0))]).vehicles):
        section = flown_profile(vehicle).safety.corridor
        assert section is not None
        assert dict(section) == vars(estimate_corridor(vehicle))
        assert vehicle.profile.safety.corridor is None


def test_distances_count_while_one_flies_and_are_level() -> None:
    room = two()
    room.update()
    assert math.isinf(room.least_m), "both stand"
    room.bodies["v0"].follow(flying(0.3, 0.0, 1.5))
    room.update()
    assert (room.least_m, room.least_both_m) == (pytest.approx(0.7), math.inf)
    room.bodies["v1"].follow(flying(0.1, 0.0, 0.5))
    room.update()
    assert room.least_both_m == pytest.approx(0.8)
    assert room.least_m == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("x_m", "z_m", "collide"),
    [
        (0.0, 2.1 * COLLISION_HALF_HEIGHT_M, False),
        (0.0, 1.9 * COLLISION_HALF_HEIGHT_M, True),
        (1.9 * COLLISION_RADIUS_M, 0.0, True),
        (2.1 * COLLISION_RADIUS_M, 0.0, False),
        (1.6 * COLLISION_RADIUS_M, 1.6 * COLLISION_HALF_HEIGHT_M, False),
    ],
)
def test_two_ellipsoids_that_touch_are_a_collision(x_m: float, z_m: float, collide: bool) -> None:
    room = two()
    room.bodies["v0"].follow(flying(0.0, 0.0, 1.0))
    room.bodies["v1"].follow(flying(x_m - 1.0, 0.0, 1.0 + z_m, turns=False))
    room.update()
    room.update()
    assert room.collided == ({("v0", "v1")} if collide else set())


def test_one_that_falls_with_its_motors_off_collides_with_one_that_stands() -> None:
    """The least distances are of vehicles that fly, so they do not count it."""
    room = two()
    room.bodies["v0"].follow(flying(0.9, 0.0, 0.7, turns=False))
    room.update()
    assert room.collided == set()
    room.bodies["v0"].follow(flying(0.95, 0.0, 0.3, turns=False))
    room.update()
    assert room.collided == {("v0", "v1")}
    assert math.isinf(room.least_m)


def test_the_upper_one_blows_down_on_the_lower_one_alone() -> None:
    room = two()
    low, high = flying(0.0, 0.0, 0.5), flying(-0.9, 0.0, 1.5)
    room.bodies["v0"].follow(low)
    room.bodies["v1"].follow(high)
    room.update()
    assert low.world.downwash_mps == pytest.approx(downwash_mps(HOVER_N, 1.0, 0.1))
    assert high.world.downwash_mps == 0.0
    high.firmware.motors = (0.0,) * 4
    room.update()
    assert low.world.downwash_mps == 0.0


def test_what_has_ended_stays_where_it_is_and_blows_no_more() -> None:
    room = two()
    room.bodies["v1"].follow(flying(-0.5, 0.0, 2.0))
    room.bodies["v1"].rest()
    assert room.bodies["v1"].place_m == (0.5, 0.0, 2.0)
    low = flying(0.5, 0.0, 0.5)
    room.bodies["v0"].follow(low)
    room.update()
    assert low.world.downwash_mps == 0.0
    assert room.least_m == 0.0


def test_a_motion_capture_sees_the_others_where_they_are() -> None:
    room = two()
    own = flying(0.0, 0.0, 1.0)
    own.capture = SimpleNamespace(settings=SimpleNamespace(others=room.others_of("v0")))
    room.bodies["v0"].follow(own)
    room.bodies["v1"].follow(flying(0.2, 0.3, 1.1))
    room.update()
    assert own.capture.others_m == [pytest.approx((1.2, 0.3, 1.1))]
