"""A result is the same after its line in a campaign's file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.faults import FAULTS, FaultResult
from perchctl.faults.catalogue import draw_case
from perchctl.faults.flight import _parameters
from perchctl.flight import FlightResult
from perchctl.flight.record import flown_record, result_from, result_record
from perchctl.profile import load_profile
from perchctl.sim import draw_scenario
from tests.helpers.flights import SHORT

SCENARIO = draw_scenario(load_profile("sim"), 17)
FLOWN = FlightResult(
    17, "perched", "hanging still", 0.1 / 3, 20.0, 1, False, False, 5.0 / 3,
    Path("logs/a.jsonl"), None, 4.0, 200.0, SCENARIO,
)  # fmt: skip
FAULTY = FaultResult(
    3, "killed", "SEARCH", 0.3, None, {"Kill": {"at": [1.0, "a"]}}, "gone", "", "killed",
    {"fell": 1.25, "lied": 2.0}, ("lied",), None, 12.0, None, 0.1, way=("SEARCH", "ALIGN"),
)  # fmt: skip


def _line(record: dict[str, object]) -> dict[str, object]:
    read = json.loads(json.dumps(record, allow_nan=False))
    assert isinstance(read, dict)
    return read


@pytest.mark.parametrize("result", [FLOWN, replace(FLOWN, miss_m=None, log=None, scenario=None)])
def test_a_flight_comes_back(result: FlightResult) -> None:
    record = _line(result_record(result))
    assert result_from(record) == result
    assert record["seed"] == 17
    assert record["timings"] == {
        "realtime_factor": 5.0 / 3, "cpu_s": 4.0, "peak_memory_mb": 200.0,
    }  # fmt: skip


def test_a_flight_with_a_fault_comes_back() -> None:
    assert result_from(_line(result_record(FAULTY)), FaultResult) == FAULTY


def test_each_fault_has_parameters_with_a_form() -> None:
    scenario = draw_scenario(load_profile(SHORT), 1)
    for fault in FAULTS:
        for seed in range(4):
            parameters = _parameters(draw_case(seed, scenario, [fault]))
            result = replace(FAULTY, parameters=parameters)
            assert result_from(_line(result_record(result)), FaultResult) == result


def test_what_a_computer_measured_is_not_the_flight() -> None:
    elsewhere = replace(FLOWN, realtime_factor=9.0, cpu_s=1.0, peak_memory_mb=9.0, log=None)
    assert flown_record(elsewhere) == flown_record(FLOWN)
    assert flown_record(replace(FLOWN, miss_m=0.1)) != flown_record(FLOWN)
    moved = replace(SCENARIO, mass_kg=0.05)
    assert flown_record(replace(FLOWN, scenario=moved)) != flown_record(FLOWN)


def test_what_is_no_result_is_refused() -> None:
    record = result_record(FLOWN)
    for wrong in (
        {},
        {**record, "outcome": "lost"},
        {**record, "more": 1},
        {**record, "timings": 1},
    ):
        with pytest.raises(ValueError, match=r"needed|none of|no field|missing"):
            result_from(wrong)
