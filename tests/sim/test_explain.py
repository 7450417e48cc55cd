"""What the scenario did is told with the event that it led to, and with no other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.display.panel import event_text
from perchctl.flight import fly_lockstep
from perchctl.mission import Event, EventKeeper, EventKind, Phase
from perchctl.mission.state import Severity
from perchctl.record import read_log
from perchctl.sim import EventExplainer, Scenario, draw_scenario
from perchctl.sim.bursts import Bursts
from perchctl.sim.explain import LOSSES
from tests.helpers.flights import SEED, short_profile

BURST = Scenario(camera_rate_hz=30.0, camera_burst=(10.0, 15))
WEAK = Scenario(mass_kg=0.04, first_contact_force_n=0.2 * 0.04 * 9.81)


def phase(row: str, t_s: float = 0.0) -> Event:
    return Event(t_s, EventKind.PHASE, "why", Phase.RECOVER, row, Severity.BACK_OFF)


def hold(reason: str) -> Event:
    return Event(0.0, EventKind.HOLD, reason, Phase.ASCEND, severity=Severity.HOLD)


HIDDEN = Scenario(capture_holes_s=((8.0, 1.0),))
NO_PICTURE = hold("no picture for 0.5 s")


@pytest.mark.parametrize(
    ("scenario", "event", "t_s", "words"),
    [
        *((BURST, phase(row), 10.6, "15 frames lost") for row in LOSSES),
        (BURST, NO_PICTURE, 10.6, "15 frames lost"),
        (WEAK, phase("slipped"), 5.0, "the first contact holds 20 % of the weight"),
        (Scenario(no_target=True), phase("searched-out"), 9.0, "there is no target"),
        (HIDDEN, phase("position-lost"), 9.5, "the motion capture did not see it for 1.0 s"),
    ],
)
def test_a_condition_is_told_with_what_it_led_to(
    scenario: Scenario, event: Event, t_s: float, words: str
) -> None:
    assert EventExplainer(scenario)(event, t_s) == words
    assert EventExplainer(Scenario())(event, t_s) == ""


@pytest.mark.parametrize(
    ("scenario", "event", "t_s"),
    [
        (BURST, phase("ascend-lost"), 9.9),
        (BURST, phase("ascend-lost"), 12.0),
        (BURST, hold("telemetry is 0.5 s old"), 10.6),
        (BURST, phase("slipped"), 10.6),
        (HIDDEN, phase("position-lost"), 11.0),
    ],
)
def test_it_is_not_told_with_others(scenario: Scenario, event: Event, t_s: float) -> None:
    assert EventExplainer(scenario)(event, t_s) == ""


def test_only_the_first_slip_is_told() -> None:
    tell = EventExplainer(WEAK)
    assert tell(phase("slipped"), 5.0)
    assert tell(phase("slipped"), 9.0) == ""


def test_a_silent_radio_is_told_and_not_one_that_was_heard() -> None:
    scenario = Scenario(seed=1, radio_loss=0.1, radio_burst_s=0.5)
    bursts = Bursts(1, 0.1, 0.5)
    begin_s = next(t / 100.0 for t in range(100000) if bursts.lost(t / 100.0))
    tell = EventExplainer(scenario)
    assert tell(hold("telemetry is 0.3 s old"), begin_s - 0.1) == ""
    for event in (hold("telemetry is 0.3 s old"), phase("link-lost")):
        assert tell(event, begin_s + 0.3).startswith("the radio passed nothing")
        assert EventExplainer(Scenario())(event, begin_s + 0.3) == ""
    assert tell(phase("slipped"), begin_s + 0.3) == ""


@pytest.mark.long
def test_a_flight_says_it_in_its_events_and_in_its_log(tmp_path: Path) -> None:
    """The ascent lasts from 4.4 to 10 s."""
    profile = short_profile({"planner.attempts": 1})
    scenario = replace(draw_scenario(profile, SEED), camera_burst=(6.0, 14))
    keeper, log = EventKeeper(), tmp_path / "f.jsonl"
    flight = fly_lockstep(profile, SEED, log, scenario=scenario, watchers=(keeper,))
    told = [event for event in keeper.seen if event.simulated]
    assert [event_text(event) for event in told] == [
        "RECOVER: target lost in ascent (simulated: 14 frames lost)"
    ]
    assert [e.get("simulated") for e in read_log(log).events if e.get("simulated")] == [
        "14 frames lost"
    ]
    assert [event for event in flight.report.history if event.simulated] == told
