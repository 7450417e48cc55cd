"""How a fleet's flight ends: its exit code and its record."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from perchctl.errors import EXIT_CODES, ConnectionFailed
from perchctl.fleet import FleetOutcome, as_error, flight_options, load_fleet, make_plan, worst_of
from perchctl.fleet.fleet import vehicle_seed
from perchctl.fleet.messages import Pace, Result, VehicleOutcome
from perchctl.fleet.outcome import fleet_exit_code, worst_code
from perchctl.mission import Phase

PACE = Pace(flown_s=20.0, wall_s=40.0, gap_p50_s=0.02, gap_p99_s=0.05, gap_max_s=0.1, cores=0.4)
PERCHED = Result(
    exit_code=0,
    outcome=VehicleOutcome.PERCHED,
    reason="hanging still",
    has_flown=True,
    ended_s=130.0,
    place_m=(0.3, 0.1),
    miss_m=0.002,
    log="logs/flight_east.jsonl",
    pace=PACE,
)


def ended(code: int) -> Result:
    return Result(exit_code=code, outcome=VehicleOutcome.FAILED, reason="so it was")


def test_each_end_of_a_mission_is_an_outcome_and_only_one_of_them_hangs() -> None:
    ends = {phase: VehicleOutcome.from_phase(phase) for phase in Phase if phase.is_final}
    assert len(set(ends.values())) == len(ends)
    assert VehicleOutcome.FAILED not in ends.values(), "which no mission ends in"
    hanging = [p for p, outcome in ends.items() if replace(PERCHED, outcome=outcome).hangs]
    assert hanging == [Phase.PERCHED]


def test_the_exit_code_is_0_only_if_all_hang() -> None:
    assert fleet_exit_code([PERCHED] * 4) == 0
    for code in EXIT_CODES:
        assert fleet_exit_code([PERCHED, ended(code)]) == code


@pytest.mark.parametrize(
    ("codes", "worst"),
    [
        ((130, 10, 130, 130), 10),
        ((53, 52, 130), 53),
        ((0, 50, 52), 52),
        ((0, 99), 1),
        ((99, 52), 52),
        ((99, 130), 1),
    ],
)
def test_it_is_the_code_of_whoever_fared_worst(codes: tuple[int, ...], worst: int) -> None:
    assert fleet_exit_code([ended(code) for code in codes]) == worst
    results = {str(code): ended(code) for code in codes}
    assert worst_code([results[worst_of(results)].exit_code]) == worst


def test_a_failure_on_the_ground_is_an_error_of_its_own_kind() -> None:
    results = {"north": ended(130), "east": replace(ended(10), reason="no Crazyflie answers")}
    assert worst_of(results) == "east"
    error = as_error("east", results["east"])
    assert isinstance(error, ConnectionFailed)
    assert str(error) == "east: no Crazyflie answers"


def test_the_record_says_who_hangs_where_and_when(tmp_path: Path) -> None:
    plan = make_plan(load_fleet())
    options = flight_options(plan, tmp_path, 3, None)
    outcome = FleetOutcome(
        plan=plan,
        options=options,
        started=datetime(2026, 11, 30, tzinfo=UTC),
        started_s=100.0,
        results={"north": ended(52), "east": PERCHED},
    )
    record = json.loads(json.dumps(outcome.record()))
    east = record["vehicles"][1]
    assert (record["exit_code"], record["hanging"], record["ratio"]) == (52, 1, 0.5)
    assert (east["ended_s"], east["place_m"], east["miss_m"]) == (30.0, [1.5, 0.1], 0.002)
    assert east["log"] == "flight_east.jsonl"
    assert east["seed"] == vehicle_seed(3, 1)
    assert "0.50 s of simulated time per second" in outcome.text()


def test_a_record_of_a_fleet_that_still_flies_claims_no_success(tmp_path: Path) -> None:
    """It is written again each time a vehicle ends, and stays if the command is killed."""
    plan = make_plan(load_fleet())
    names = [vehicle.name for vehicle in plan.fleet.vehicles]
    flying = FleetOutcome(
        plan=plan,
        options=flight_options(plan, tmp_path, 3, None),
        started=datetime(2026, 11, 30, tzinfo=UTC),
        started_s=100.0,
        results={names[0]: PERCHED},
    )
    record = flying.record()
    assert (record["exit_code"], record["error"]) == (1, EXIT_CODES[1])
    assert record["unfinished"] == names[1:]
    for name in names[1:]:
        assert f"{name:<12}unknown: check where the vehicle is" in flying.text()
    ended_record = replace(flying, results=dict.fromkeys(names, PERCHED)).record()
    assert (ended_record["exit_code"], ended_record["error"]) == (0, None)
    assert ended_record["unfinished"] == []
    results = dict.fromkeys(names, PERCHED)
    assert replace(flying, results=results, failed=True).exit_code == 1, "the parent's own failure"


def test_each_simulated_vehicle_has_a_seed_and_a_target_of_its_own(tmp_path: Path) -> None:
    plan = make_plan(load_fleet())
    options = flight_options(plan, tmp_path, 0, None)
    assert options["east"].sim_target_xy_m == pytest.approx((0.3, 0.1))
    seeds = {vehicle_seed(fleet, number) for fleet in range(20) for number in range(32)}
    assert len(seeds) == 20 * 32
