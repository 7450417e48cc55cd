"""Reports of flights that were flown: perched, landed by a fault, killed."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

import cv2

from perchctl.analysis.report import ReportedFlight, read_reported_flight
from perchctl.faults.catalogue import BY_NAME, Case
from perchctl.faults.effects import Effect, camera_fault, killed
from perchctl.faults.flight import fly_with_fault
from perchctl.mission import Phase
from perchctl.sim import draw_scenario
from tests.helpers.flights import SEED, short_profile

pytestmark = pytest.mark.long

SNOW_S = 0.7
FAULTS: dict[str, tuple[str, Phase, Effect]] = {
    "perched": ("camera-snow", Phase.ASCEND, partial(camera_fault, kind="snow", for_s=SNOW_S)),
    "unfinished": ("killed", Phase.ASCEND, partial(killed)),
}


def flown(outcome: str, folder: Path) -> tuple[ReportedFlight, float | None]:
    """A flight with that outcome, and when its fault began, s from the first tick: snow for a while
    in the ascent, or the program is killed in it."""
    cv2.setNumThreads(1)
    profile = short_profile()
    fault, phase, effect = FAULTS[outcome]
    case = Case(BY_NAME[fault], phase, 0.3, (effect,))
    path = folder / "f.jsonl"
    result = fly_with_fault(profile, case, draw_scenario(profile, SEED), path)
    flight = read_reported_flight(path)
    assert flight.outcome == outcome
    begin_s = result.begin_s
    return flight, None if begin_s is None else flight.flight.log.to_flight_s(begin_s)


def test_snow_is_told_with_its_true_times(tmp_path: Path) -> None:
    flight, begin_s = flown("perched", tmp_path)
    (lost,) = [s for s in flight.story if "lost for" in s.text or "No usable picture" in s.text]
    assert lost.t_s == pytest.approx(begin_s, abs=0.15)
    found = re.search(r"for (\d\.\d) s", lost.text)
    assert found is not None
    assert float(found[1]) == pytest.approx(SNOW_S, abs=0.2)
    assert flight.story[-1].text.startswith("Perched")


def test_a_killed_flight_has_no_end(tmp_path: Path) -> None:
    flight, _ = flown("unfinished", tmp_path)
    assert "The log ends here, in ASCEND" in flight.story[-1].text
