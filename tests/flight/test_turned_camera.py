"""A camera 90 deg from what the profile says: it stops; with the measured numbers it perches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import MountingReport, solve_carry, solve_pivot
from perchctl.flight import fly_lockstep
from perchctl.log import FlightLog, read_log
from perchctl.mission import Outcome, Phase
from perchctl.profile import Profile, load_profile, write_profile_values
from perchctl.sim import Scenario, draw_scenario
from tests.helpers.mounting import hand, seen

SEEDS = range(20)
MISS_LIMIT_M = 0.010
"""The others': the largest of the profile's undisturbed campaign is 8 mm."""


def wrong(profile: Profile, deg: float = -90.0) -> Profile:
    """The profile of somebody who has the camera turned by so much on the vehicle's top."""
    mount = profile.camera.mount
    x, y, z = mount.rpy_deg
    turned = mount.model_copy(update={"rpy_deg": (x, y, z + deg)})
    camera = profile.camera.model_copy(update={"mount": turned})
    return profile.model_copy(update={"camera": camera})


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


def _from_align_m(log: FlightLog) -> float:
    """How far the true vehicle went, aside, from where it began to align."""
    x, y = log.column("true_x_m"), log.column("true_y_m")
    first = next(i for i, record in enumerate(log.records) if record["phase"] == "ALIGN")
    return float(np.hypot(x[first:] - x[first], y[first:] - y[first]).max())


@pytest.mark.campaign
@pytest.mark.parametrize("seed", SEEDS)
def test_flown_as_it_is_it_stops_and_names_the_cause(seed: int, tmp_path: Path) -> None:
    """One of the three turns a seed."""
    cv2.setNumThreads(1)
    profile = load_profile("sim")
    deg = (90.0, -90.0, 180.0)[seed % 3]
    path, scenario = tmp_path / "flight.jsonl", draw_scenario(profile, seed)
    flight = fly_lockstep(wrong(profile, deg), log=path, scenario=scenario)
    assert flight.report.phase is Phase.LANDED
    assert flight.report.outcome is Outcome.SAFETY
    assert f"camera seems turned by about {abs(deg):.0f} deg" in flight.report.reason.replace(
        "-", ""
    )
    assert _from_align_m(read_log(path)) < 0.3
    assert not flight.fell


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
