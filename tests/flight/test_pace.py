"""A computer that is too slow for a simulated flight in real time is named for it."""

from __future__ import annotations

from typing import Any, cast

import pytest

from perchctl.flight.pace import FEWEST_HZ, PaceWatcher, judged
from perchctl.mission.state import Outcome, Phase, PlannerState
from perchctl.mission.watch import FlightReport, Tick
from perchctl.vehicle import Idle
from tests.helpers.mission import telemetry

REPORT = FlightReport(Phase.LANDED, Outcome.SAFETY, "no picture for 3.0 s", 0, 9.0, False)


def watched(frames_hz: float, late_s: float = 0.0, phase: Phase = Phase.SEARCH) -> PaceWatcher:
    """Five seconds at 50 Hz with so many pictures, and one late turn."""
    pace, seen = PaceWatcher(), 0
    for i in range(250):
        t_s = 0.02 * i
        new = int(t_s * frames_hz) > seen
        seen += int(new)
        output = cast(Any, object()) if new else None
        late = late_s if i == 100 else 0.0
        state = PlannerState(phase=phase)
        pace.tick(Tick(t_s, telemetry(t_s), output, None, state, Idle(), late, 0.0, 0.0))
    return pace


@pytest.mark.parametrize(
    ("pace", "behind_s", "words"),
    [
        (watched(3.0), 0.0, "too slow for a flight in real time: 3 frames a second"),
        (watched(30.0, late_s=1.6), 0.0, "loop 1.6 s late"),
        (watched(30.0), 0.8, "simulator 0.8 s behind"),
    ],
)
def test_an_abort_on_a_slow_computer_names_the_computer(
    pace: PaceWatcher, behind_s: float, words: str
) -> None:
    report = judged(REPORT, pace, behind_s, 30.0)
    assert words in report.reason
    assert report.reason.startswith("this computer is too slow")
    assert report.reason.endswith("no picture for 3.0 s")
    assert report.outcome is Outcome.SAFETY


def test_a_computer_that_keeps_up_is_not_blamed() -> None:
    assert judged(REPORT, watched(30.0, late_s=0.1), 0.05, 30.0) is REPORT
    assert watched(30.0).frames_hz > FEWEST_HZ


def test_a_flight_that_ended_well_is_left_as_it_is() -> None:
    perched = FlightReport(Phase.PERCHED, Outcome.PERCHED, "hanging still", 1, 9.0, False)
    assert judged(perched, watched(3.0, 2.0), 5.0, 30.0) is perched


def test_where_no_picture_is_looked_at_none_is_missed() -> None:
    assert watched(0.0, phase=Phase.COMPLETE).frames_hz == float("inf")
    assert watched(0.0, phase=Phase.LANDING).frames_hz == float("inf")


def test_a_slow_camera_is_not_a_slow_computer() -> None:
    assert judged(REPORT, watched(7.0), 0.0, 10.0) is REPORT
    assert judged(REPORT, watched(3.0), 0.0, 10.0) is not REPORT
