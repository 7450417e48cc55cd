"""A camera 90 deg from what the profile says perches by the numbers that a hand has measured.

Flown as it is, it stops (`test_flights.py`, and the fault `camera-turned` of the campaigns).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import MountingReport, solve_carry, solve_pivot
from perchctl.flight import fly_lockstep
from perchctl.mission import Phase
from perchctl.profile import Profile, load_profile, write_profile_values
from perchctl.sim import Scenario, draw_scenario
from tests.helpers.mounting import hand, seen

SEEDS = range(20)
MISS_LIMIT_M = 0.010
"""The others': the largest of the profile's undisturbed campaign is 8 mm."""


def measured(scenario: Scenario, seed: int, path: Path) -> Profile:
    """The wrong profile, once that very vehicle was carried and pivoted by a hand and the numbers
    were written into it, by all that `calibrate mount --write` does behind the pictures."""
    path.write_text("extends: sim\ncamera:\n  mount: {rpy_deg: [0, 0, -90]}  # a guess\n")
    parts = []
    for part in ("carry", "pivot"):
        held = hand(part, seed)
        own = replace(
            held.scenario,
            T_body_cam_true=scenario.T_body_cam_true,
            camera_latency_s=scenario.camera_latency_s,
        )
        parts.append(seen(replace(held, scenario=own)))
    found = MountingReport(load_profile(str(path)), solve_carry(parts[0]), solve_pivot(parts[1]))
    write_profile_values(path, found.profile_values())
    return load_profile(str(path))


@pytest.mark.campaign
@pytest.mark.parametrize("seed", SEEDS)
def test_flown_with_the_measured_numbers_it_perches(seed: int, tmp_path: Path) -> None:
    cv2.setNumThreads(1)
    scenario = draw_scenario(load_profile("sim"), seed)
    flight = fly_lockstep(measured(scenario, seed, tmp_path / "mine.yaml"), scenario=scenario)
    assert flight.report.phase is Phase.PERCHED, flight.report.reason
    assert flight.hanging
    assert flight.miss_m < MISS_LIMIT_M
    assert not flight.locked
    assert not flight.fell
