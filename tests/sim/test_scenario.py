"""What seeds draw in the shipped worlds, when a radio is silent, and what explains an event."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.display.panel import event_text
from perchctl.faults.edges import FaultyRadio
from perchctl.flight import fly_lockstep
from perchctl.link import Packet, Radio
from perchctl.link.mock import TELEMETRY_DELAY_S
from perchctl.mission import Event, EventKind, Phase
from perchctl.mission.state import Severity
from perchctl.profile import Profile, load_profile
from perchctl.record import read_log
from perchctl.sim import EventExplainer, Scenario, draw_capture, draw_scenario, radio_bursts
from perchctl.sim.scenario import CONNECTED_S, LOSSES, Bursts
from tests.helpers.flights import SEED, short_profile
from tests.helpers.loop_rig import Watcher

NOMINAL_SHA256 = "b8d613ad776dbc378846d5e8d02d5fcdc3e0384a4bfb241e780905d9d4b55071"
"""Of the nominal scenarios of seeds 0 to 20: figures of earlier campaigns are of these."""


def changed(name: str, **keys: Any) -> Profile:
    values = load_profile(name).model_dump(mode="json")
    values["simulation"] |= keys
    return Profile.model_validate(values)


def rounded(value: Any) -> Any:
    """To what no computer's sine can change."""
    if isinstance(value, float):
        return round(value, 9)
    return [rounded(each) for each in value] if isinstance(value, (list, tuple)) else value


def test_the_nominal_scenarios_stay_as_they_are() -> None:
    plain = asdict(Scenario())
    digest = hashlib.sha256()
    for seed in range(21):
        drawn = asdict(draw_scenario(load_profile("sim"), seed))
        told = {key: rounded(value) for key, value in drawn.items() if value != plain[key]}
        digest.update(json.dumps(told, sort_keys=True).encode())
    assert digest.hexdigest() == NOMINAL_SHA256


@pytest.mark.parametrize("name", ["rough", "extreme"])
def test_a_harder_world_is_drawn_within_its_ranges(name: str) -> None:
    profile = load_profile(name)
    sim = profile.simulation
    for seed in range(12):
        drawn = draw_scenario(profile, seed)
        assert drawn == draw_scenario(profile, seed)
        assert sim.mass_kg[0] <= drawn.mass_kg <= sim.mass_kg[1]
        assert math.hypot(*drawn.draught_mps) <= sim.draught_mps[1]
        tilt_deg = math.degrees(math.hypot(*drawn.target_tilt_rad))
        assert sim.target_tilt_deg[0] - 1e-9 <= tilt_deg <= sim.target_tilt_deg[1] + 1e-9
        assert drawn.cell_resistance_ohm is not None
        assert drawn.cell_charge <= sim.cell_charge[1]
        assert sim.radio_loss[0] <= drawn.radio_loss <= sim.radio_loss[1]


@pytest.mark.parametrize(
    ("world", "key", "value", "field"),
    [
        ("extreme", "target_tilt_deg", [0.0, 0.0], "target_tilt_rad"),
        ("extreme", "radio_loss", [0.0, 0.0], "radio_loss"),
        ("extreme", "mass_kg", [0.04, 0.04], "mass_kg"),
        ("extreme", "capture_hole_s", [0.0, 0.0], "capture_holes_s"),
        *(("sim", "camera_burst_frames", frames, "camera_burst")
          for frames in (None, (0, 0), (9, 9), (8, 9))),
    ],
)  # fmt: skip
def test_one_range_moves_no_other_value_of_a_seed(
    world: str, key: str, value: Any, field: str
) -> None:
    """So that one condition can be taken away, and all else is as it was."""
    ever: set[str] = set()
    for seed in range(20):
        whole = asdict(draw_scenario(load_profile(world), seed))
        other = asdict(draw_scenario(changed(world, **{key: value}), seed))
        moved = {name for name in whole if whole[name] != other[name]}
        assert moved <= {field, "first_contact_force_n"}  # of which the weight is a part
        ever |= moved
    assert field in ever


def test_a_motion_capture_has_the_scenarios_holes() -> None:
    profile = changed("extreme", capture_hole_every_s=5.0)
    values = profile.model_dump(mode="json")
    values["positioning"] |= {"by": "mocap", "system": "optitrack", "host": "127.0.0.1"}
    by_mocap = Profile.model_validate(values)
    settings, holes = draw_capture(by_mocap, 4), draw_scenario(by_mocap, 4).capture_holes_s
    assert settings is not None
    assert holes
    assert [(a, b - a) for a, b, _ in settings.faults] == [
        (begin_s, pytest.approx(length_s)) for begin_s, length_s in holes
    ]
    assert all(fault.occluded for *_, fault in settings.faults)
    assert all(b[0] > a[0] + a[1] for a, b in itertools.pairwise(holes))
    assert draw_capture(profile, 4) is None


# --- A radio that fails by bursts -----------------------------------------------------------------


STEP_S = 0.005
PACKET = Packet(7, 0, b"\x07")


@pytest.mark.parametrize(("share", "mean_s"), [(0.03, 0.1), (0.2, 0.3)])
def test_share_and_length_of_bursts_are_what_is_asked_for(share: float, mean_s: float) -> None:
    until_s, bursts = 2000.0, Bursts(3, share, mean_s, 0.0)
    lost = [bursts.lost(step * STEP_S) for step in range(round(until_s / STEP_S))]
    runs = [sum(run) * STEP_S for is_lost, run in itertools.groupby(lost) if is_lost]
    spread = 4.0 / math.sqrt(len(runs))
    assert sum(runs) / until_s == pytest.approx(share, rel=1.5 * spread)
    assert sum(runs) / len(runs) == pytest.approx(mean_s, rel=spread + STEP_S / mean_s)
    # Not all alike: as many are longer than twice the mean as an exponential has.
    long = sum(length_s > 2.0 * mean_s for length_s in runs) / len(runs)
    assert long == pytest.approx(math.exp(-2.0), rel=0.35)
    seldom = Bursts(3, share, mean_s, 0.0)
    assert lost[::40] == [seldom.lost(step * STEP_S) for step in range(0, len(lost), 40)]


def test_nothing_is_lost_before_the_take_off_nor_without_a_share() -> None:
    bursts, none = Bursts(1, 0.5, 0.5), Bursts(1, 0.0, 0.1)
    assert not any(bursts.lost(step * STEP_S) for step in range(int(CONNECTED_S / STEP_S)))
    assert not none.lost(1e6)
    assert none.newest is None
    assert radio_bursts(Scenario()) is None


def test_both_directions_are_lost_together_and_faults_are_laid_over_the_same_radio() -> None:
    scenario = Scenario(seed=2, radio_loss=0.3, radio_burst_s=0.3)
    radio, same = Radio(radio_bursts(scenario)), Bursts(2, 0.3, 0.3)
    faulty = FaultyRadio(Radio(radio_bursts(scenario)))
    for step in range(4000):
        t_s = step * STEP_S
        lost = same.lost(t_s)
        for each in (radio, faulty):
            assert each.uplink_arrives(PACKET, t_s) is not lost
            assert each.downlink_delay_s("fast", t_s) == (None if lost else TELEMETRY_DELAY_S)
    faulty.cut = True
    assert not faulty.uplink_arrives(PACKET, 21.0)


# --- What explains an event -----------------------------------------------------------------------


BURST = Scenario(camera_rate_hz=30.0, camera_burst=(10.0, 15))
WEAK = Scenario(mass_kg=0.04, first_contact_force_n=0.2 * 0.04 * 9.81)
HIDDEN = Scenario(capture_holes_s=((8.0, 1.0),))
SILENT = Scenario(seed=1, radio_loss=0.1, radio_burst_s=0.5)


def silent_s() -> float:
    """The begin of the first burst of `SILENT`."""
    bursts = Bursts(1, 0.1, 0.5)
    return next(t / 100.0 for t in range(100000) if bursts.lost(t / 100.0))


def phase(row: str) -> Event:
    return Event(0.0, EventKind.PHASE, "why", Phase.RECOVER, row, Severity.BACK_OFF)


def hold(reason: str) -> Event:
    return Event(0.0, EventKind.HOLD, reason, Phase.ASCEND, severity=Severity.HOLD)


OLD = hold("telemetry is 0.3 s old")


@pytest.mark.parametrize(
    ("scenario", "event", "t_s", "words"),
    [
        *((BURST, phase(row), 10.6, "15 frames lost") for row in LOSSES),
        (BURST, hold("no picture for 0.5 s"), 10.6, "15 frames lost"),
        (WEAK, phase("slipped"), 5.0, "20 % of the weight"),
        (Scenario(no_target=True), phase("searched-out"), 9.0, "no target"),
        (HIDDEN, phase("position-lost"), 9.5, "for 1.0 s"),
        (SILENT, OLD, silent_s() + 0.3, "the radio"),
        (SILENT, phase("link-lost"), silent_s() + 0.3, "the radio"),
    ],
)
def test_a_condition_is_named_with_the_event_that_it_led_to(
    scenario: Scenario, event: Event, t_s: float, words: str
) -> None:
    explain = EventExplainer(scenario)
    assert words in explain(event, t_s)
    assert EventExplainer(Scenario())(event, t_s) == ""
    if event.row == "slipped":  # only the first contact is weak
        assert explain(event, t_s) == ""


@pytest.mark.parametrize(
    ("scenario", "event", "t_s"),
    [
        (BURST, phase("ascend-lost"), 9.9),
        (BURST, phase("ascend-lost"), 12.0),
        (BURST, OLD, 10.6),
        (BURST, phase("slipped"), 10.6),
        (HIDDEN, phase("position-lost"), 11.0),
        (SILENT, OLD, silent_s() - 0.1),
        (SILENT, phase("slipped"), silent_s() + 0.3),
    ],
)
def test_a_condition_is_not_named_with_others(scenario: Scenario, event: Event, t_s: float) -> None:
    assert EventExplainer(scenario)(event, t_s) == ""


@pytest.mark.long
def test_a_flight_names_it_in_its_events_and_in_its_log(tmp_path: Path) -> None:
    """The ascent lasts from 4.4 to 10 s."""
    profile = short_profile({"planner.attempts": 1})
    scenario = replace(draw_scenario(profile, SEED), camera_burst=(6.0, 14))
    keeper, log = Watcher(), tmp_path / "f.jsonl"
    flight = fly_lockstep(profile, SEED, log, scenario=scenario, watchers=(keeper,))
    named = [event for event in keeper.events if event.simulated]
    assert ["14 frames lost" in event_text(event) for event in named] == [True]
    recorded = [e.get("simulated") for e in read_log(log).events if e.get("simulated")]
    assert recorded == ["14 frames lost"]
    assert [event for event in flight.report.history if event.simulated] == named
