"""By the target alone, a camera whose measured latency changes in flight."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import pytest

from perchctl.faults.catalogue import BY_NAME, Case
from perchctl.faults.effects import camera_fault
from perchctl.faults.flight import fly_with_fault
from perchctl.mission import Phase
from perchctl.profile import load_profile
from perchctl.record import read_log
from perchctl.sim import draw_scenario

pytestmark = pytest.mark.long

LATENCY_S, LATER_S = 0.04, 0.11


@pytest.mark.parametrize("seed", [20261128, 20261132, 20261133])
def test_a_latency_that_falls_in_the_ascent_is_followed_and_named(
    seed: int, tmp_path: Path
) -> None:
    """From 150 to 40 ms. An ascent hardly moves sideways: it shows upwards. Not followed, the
    vehicle swings up and down until it meets the ceiling hard."""
    cv2.setNumThreads(1)
    profile = load_profile("target_only")
    assert profile.camera.latency_s == "measured"
    # without the scenario's gap in the images, which may interrupt the ascent
    drawn = draw_scenario(profile, seed)
    scenario = replace(drawn, camera_latency_s=LATENCY_S, camera_burst=None)
    late = partial(camera_fault, kind="late", late_s=LATER_S, for_s=8.0)
    case = Case(BY_NAME["camera-late"], Phase.APPROACH, 0.0, (late,))
    path = tmp_path / "flight.jsonl"
    flown = fly_with_fault(profile, case, scenario, path)
    assert flown.counted == ()
    assert flown.outcome == "perched"
    log = read_log(path)
    over_s = (flown.begin_s or 0.0) + 8.0
    (told,) = [event for event in log.events if "latency changed from 1" in event["reason"]]
    assert told["phase"] == "ASCEND"
    assert log.to_flight_s(over_s) < log.to_flight_s(told["t_s"]) < log.to_flight_s(over_s) + 6.0
