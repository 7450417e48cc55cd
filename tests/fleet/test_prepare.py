"""What each vehicle's process is given before it starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from perchctl.corridor import Corridor
from perchctl.fleet import Fleet, flight_options, load_fleet, make_plan
from tests.fleet.rig import fleet, on_air

NORTH, EAST = "radio://0/80/2M/E7E7E7E701", "radio://1/84/2M/E7E7E7E702"


@pytest.mark.parametrize(
    "planned",
    [
        load_fleet(),
        fleet([((1.0, 2.0), (1.5, 2.0)), ((5.0, 2.0), (5.0, 2.5))]),
        on_air([NORTH, EAST]),
    ],
    ids=["deck", "simulated-capture", "real-in-the-room"],
)
def test_each_flies_by_its_corridor_in_its_own_axes(planned: Fleet, tmp_path: Path) -> None:
    plan = make_plan(planned)
    for name, options in flight_options(plan, tmp_path, 0, None).items():
        vehicle, safety = plan.fleet.vehicle(name).as_flown, options.profile.safety
        assert safety.corridor is not None
        corridor = Corridor(**dict(safety.corridor))
        assert corridor.radius_m == plan.corridors[name].radius_m
        assert corridor.contains(*vehicle.to_estimate(vehicle.home_m), 0.0)
        assert options.profile.target.expected_xy_m == corridor.target_m
        assert corridor.contains(*corridor.target_m, corridor.target_top_m)
        if options.simulated:
            assert (corridor.home_m, options.sim_target_xy_m) == ((0.0, 0.0), corridor.target_m)
        else:
            assert (corridor.home_m, options.uri) == (vehicle.home_m, vehicle.uri)
