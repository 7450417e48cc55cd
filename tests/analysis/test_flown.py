"""Reports of flights that were flown: perched, landed by a fault, killed."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

import cv2

from perchctl.analysis.report import ReportedFlight, reported_flight
from perchctl.faults import FaultResult
from perchctl.faults.catalogue import BY_NAME, Case
from perchctl.faults.effects import FOR_EVER, Effect, camera_fault, killed
from perchctl.faults.flight import fly_with_fault
from perchctl.mission import Phase
from perchctl.record import read_log
from perchctl.sim import draw_scenario
from tests.helpers.flights import SEED, short_profile

pytestmark = pytest.mark.long

SNOW_S = 0.7
FAULTS: dict[str, tuple[str, Phase, Effect]] = {
    "perched": ("camera-snow", Phase.ASCEND, partial(camera_fault, kind="snow", for_s=SNOW_S)),
    "landed": ("camera-silent", Phase.ALIGN, partial(camera_fault, kind="silent", for_s=FOR_EVER)),
    "killed": ("killed", Phase.ASCEND, partial(killed)),
}


def flown(name: str, folder: Path) -> FaultResult:
    """`perched`: snow for a while in the ascent; `landed`: the camera falls silent in the
    alignment, for ever; `killed`: the program is, in the ascent."""
    cv2.setNumThreads(1)
    profile = short_profile()
    fault, phase, effect = FAULTS[name]
    case = Case(BY_NAME[fault], phase, 0.3, (effect,))
    scenario, log = draw_scenario(profile, SEED), folder / f"{name}.jsonl"
    return fly_with_fault(profile, case, scenario, log)


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, FaultResult]]:
    folder = tmp_path_factory.mktemp("flights")
    return folder, {name: flown(name, folder) for name in FAULTS}


def told(flights: tuple[Path, dict[str, FaultResult]], name: str) -> ReportedFlight:
    return reported_flight(flights[0] / f"{name}.jsonl")


def test_snow_is_told_with_its_true_times(
    flights: tuple[Path, dict[str, FaultResult]],
) -> None:
    begin_s = flights[1]["perched"].begin_s
    assert begin_s is not None
    flight = told(flights, "perched")
    begin_s = read_log(flights[0] / "perched.jsonl").since(begin_s)
    lost = [s for s in flight.story if "lost for" in s.text or "No picture" in s.text]
    assert len(lost) == 1, flight.story
    assert lost[0].t_s == pytest.approx(begin_s, abs=0.15)
    found = re.search(r"for (\d\.\d) s", lost[0].text)
    assert found is not None
    assert float(found[1]) == pytest.approx(SNOW_S, abs=0.2)
    assert flight.outcome == "perched"
    assert flight.story[-1].text.startswith("Perched")


def test_a_silent_camera_lands_it_and_a_killed_flight_has_no_end(
    flights: tuple[Path, dict[str, FaultResult]],
) -> None:
    flight = told(flights, "landed")
    assert flight.outcome == "landed"
    assert any("No picture" in s.text for s in flight.story)
    assert any("it landed" in s.text for s in flight.story)
    assert {a.about for a in flight.advice} >= {"video"}

    flight = told(flights, "killed")
    assert flight.outcome == "unfinished"
    assert "The log ends here, in ASCEND" in flight.story[-1].text
