"""How a flight met the floor: felt, true of the vehicle, and told whoever flew the way down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path

import pytest

from perchctl.analysis import FlightAnalysis, show_record, show_text
from perchctl.analysis.report import ReportedFlight, page_of
from perchctl.display import summary_card
from perchctl.mission import (
    ContactError,
    EventKind,
    ImuMotion,
    Operator,
    Phase,
    Touchdown,
)
from perchctl.mission.context import Context
from perchctl.mission.imu import Blow
from perchctl.mission.report import touchdown_of
from perchctl.record import FlightSummary, read_log, summary_text
from perchctl.vehicle import Telemetry
from tests.helpers import log
from tests.helpers.loop_rig import PROFILE, Broken, Guarded, Rig, Vehicle, hanging_camera
from tests.helpers.mission import observation, state_in

HARD = Touchdown(0.9, 3.1)
SENTENCE = "touched down hard: 0.9 m/s, 3.1 g"


# --- True of the vehicle ---------------------------------------------------------------------


# --- A blow, sample by sample ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "blow", "told"),
    [
        ({}, Blow(9.0, -0.9, 0.0, 3.1), True),
        ({}, Blow(4.0, -0.9, 0.0, 3.1), False),  # long before
        ({}, Blow(9.0, -0.9, 0.0, 3.1, 0.8), False),  # in the air
        ({"phase": Phase.PERCHED}, Blow(9.0, -0.9, 0.0, 3.1), False),
        ({}, Blow(), False),
    ],
)
def test_only_the_floor_is_a_touchdown(state: dict[str, object], blow: Blow, told: bool) -> None:
    ended = replace(state_in(Phase.LANDED, z_m=0.0), **state)  # type: ignore[arg-type]
    obs = observation(10.0, 0.0, imu=ImuMotion(t_s=10.0, blow=blow))
    assert touchdown_of(Context(ended, obs, PROFILE)) == (HARD if told else None)


# --- Whoever flew the way down -------------------------------------------------------------------


def striking() -> Callable[[Telemetry], Telemetry]:
    """Samples of a vehicle that comes down at 0.9 m/s and meets the floor."""
    before: list[Telemetry] = []
    struck: list[float] = []

    def changed(sample: Telemetry) -> Telemetry:
        z_m = sample.position_m[2]
        last_m = before[-1].position_m[2] if before else 0.0
        before.append(sample)
        if z_m < last_m - 1e-6 and z_m > 0.0:
            return replace(sample, velocity_mps=(0.0, 0.0, -0.9))
        if z_m == 0.0 and last_m > 0.0:
            struck.append(sample.t_s)
        if struck and sample.t_s < struck[0] + 0.025:
            return replace(sample, acc_z_g=3.1)
        return sample

    return changed


@pytest.mark.parametrize("hung", [False, True])
def test_the_report_has_it_whether_the_planner_or_the_watchdog_brought_it_down(hung: bool) -> None:
    link = Guarded(striking())
    rig = Rig(link)
    if hung:
        rig.camera = hanging_camera(link, 12.0)
    else:
        rig.operator = lambda: Operator.LAND if link.now_s > 4.0 else Operator.NONE
    report = rig.fly()
    assert bool(link.own) is hung
    assert report.phase is Phase.LANDED
    assert report.touchdown == HARD


def test_the_rescue_says_so() -> None:
    rig = Rig(Vehicle(striking()))

    def leave(tick: object) -> None:
        if rig.link.now_s > 4.0:
            raise Broken

    rig.watcher.on_tick = leave
    with pytest.raises(Broken):
        rig.fly()
    note = next(e for e in rig.watcher.events if e.kind is EventKind.NOTE and "Broken" in e.reason)
    assert note.reason.endswith(f"; it {SENTENCE}")


# --- What is told ---------------------------------------------------------------------------------


def test_all_that_tell_of_a_flight_tell_touchdown_and_contact(tmp_path: Path) -> None:
    """The summary, `log show`, `log report` and the live page; a soft touchdown is not told."""
    soft = FlightSummary("landed", "the operator asked to land", touchdown=Touchdown(0.3, 1.9))
    assert "touched down" not in summary_text(soft)
    assert soft.as_record()["touchdown_mps"] == 0.3
    told = FlightSummary("perched", "r", contact=ContactError(1.8e-3, 0.6e-3), touchdown=HARD)
    end = log.SUMMARY | told.as_record() | {"outcome": "landed", "attempts": 1}
    flown = read_log(log.write(tmp_path / "f.jsonl", summary=end))
    flight = FlightAnalysis(flown)
    for text in (summary_text(told), show_text(flight)):
        assert "\ncontact:   1.8 +- 0.6 mm off centre" in text
        assert f"\nvehicle:   {SENTENCE}" in text
    for record in (told.as_record(), show_record(flight)):
        assert (record["contact_aside_m"], record["contact_sigma_m"]) == (1.8e-3, 0.6e-3)
        assert (record["touchdown_mps"], record["touchdown_g"]) == (0.9, 3.1)
    whole = ReportedFlight(flight)
    assert "1.8 +- 0.6 mm off centre" in unescape(page_of([whole])).replace("\xa0", " ")
    assert f"It {SENTENCE}" in [sentence.text for sentence in whole.story]
    rows = summary_card(FlightSummary.of(flown), flown.path)["rows"]
    assert ["contact", "1.8 +- 0.6 mm off centre"] in rows
    assert ["vehicle", SENTENCE] in rows
