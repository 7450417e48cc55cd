"""A whole mission that hovers below the target: what it claims is true, logged, and replays."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.analysis import read_log as read_analysis
from perchctl.analysis import replay
from perchctl.analysis.report import read_reported_flight, report_html
from perchctl.analysis.show import show_record, show_text
from perchctl.faults.catalogue import BY_NAME, draw_fault_case
from perchctl.faults.flight import fly_with_fault
from perchctl.flight import fly_lockstep
from perchctl.mission import Outcome, Phase, Tick, Watcher
from perchctl.mission.phases.hover import is_hovering
from perchctl.profile import Profile
from perchctl.record import FlightSummary, LogWatcher, read_log
from perchctl.sim import draw_scenario
from tests.helpers.flights import SEED, short_profile

BELOW_M, DURATION_S = 0.5, 4.0
WAY = ["APPROACH", "SEARCH", "ESTIMATE", "ALIGN", "ASCEND", "HOVER", "LANDING", "LANDED"]


def hovering(**hover: float) -> Profile:
    given: dict[str, Any] = {"below_m": BELOW_M, "duration_s": DURATION_S, **hover}
    return short_profile({"planner.hover": given})


@dataclass
class Truth(Watcher):
    """Where the vehicle truly was while its hover's time ran."""

    log: LogWatcher
    times_s: list[float] = field(default_factory=list)
    miss_m: list[float] = field(default_factory=list)
    height_m: list[float] = field(default_factory=list)
    name: str = "the truth"

    def tick(self, tick: Tick) -> None:
        if is_hovering(tick.state):
            assert self.log.truth is not None
            (_, _, z_m), miss_m = self.log.truth()
            self.times_s.append(tick.t_s)
            self.miss_m.append(miss_m)
            self.height_m.append(z_m)


@pytest.fixture(scope="module")
def log_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hover") / "flight_hover.jsonl"


def test_what_a_hover_claims_is_true_of_the_vehicle(log_path: Path) -> None:
    log = LogWatcher.open_lockstep(log_path, hovering(), SEED)
    truth = Truth(log)
    flight = fly_lockstep(hovering(), SEED, log, watchers=(truth,))
    summary = flight.close_log(log)
    report = flight.report
    assert (report.phase, report.outcome, report.attempts) == (Phase.LANDED, Outcome.HOVERED, 1)
    assert [event.phase.value for event in report.history if event.phase] == WAY
    assert report.reason == "hovered for 4 s, 0.5 m below the target; motors off"
    assert summary is not None
    assert (summary.exit_code, summary.is_hover_completed) == (0, True)
    assert (flight.fell, flight.hanging, flight.locked) == (False, False, False)
    # By the simulator: all the time, under the target, at that height.
    assert truth.times_s[-1] - truth.times_s[0] >= DURATION_S - 0.05
    assert max(truth.miss_m) < 0.04
    scenario, gear_m = flight.scenario, hovering().vehicle.gear_body_m[2]
    place_m = scenario.ceiling_z_m - gear_m - BELOW_M
    assert np.abs(np.array(truth.height_m) - place_m).max() < 0.06
    assert report.hover is not None
    x_m, y_m, z_m = report.hover.gear_to_hover_position_rms_xyz_m
    assert max(x_m, y_m) < 0.02
    assert z_m < 0.03


def test_its_log_shows_the_hover_and_replays(log_path: Path) -> None:
    log = read_log(log_path)
    assert not replay(log).differences
    summary = FlightSummary.from_log(log)
    assert summary.hover is not None
    assert summary.is_hover_completed
    analysis = read_analysis(log_path)
    shown = show_text(analysis)
    assert shown.startswith("LANDED: hovered for 4 s, 0.5 m below the target; motors off [hovered]")
    assert summary.hover.text in " ".join(shown.split())
    record = show_record(analysis)
    assert record["hover_below_m"] == BELOW_M
    assert record["hover_s"] >= DURATION_S - 0.1
    told = read_reported_flight(log_path)
    assert (told.title, told.outcome_grade) == ("Hovered and landed", "good")
    page = report_html([told])
    assert "PERCH <small>" not in page
    assert 'class="p hover"' in page
    assert "it hovered under the target" in page


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["target-covered", "link-silent", "camera-silent", "kick", "exception", "battery-low"]
)
def test_a_fault_in_a_hover_ends_well(name: str) -> None:
    """Judged by the truth: no fall, no flight astray, and nothing claimed that is not so."""
    profile = hovering(duration_s=20.0)
    scenario = draw_scenario(profile, SEED)
    case = draw_fault_case(BY_NAME[name], Phase.HOVER, np.random.default_rng(SEED), scenario)
    result = fly_with_fault(profile, case, scenario)
    assert result.begin_s is not None
    assert not result.counted
