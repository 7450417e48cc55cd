"""What seeds draw in the shipped worlds, and when a radio is silent."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from dataclasses import asdict
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.link import Packet, Radio
from perchctl.link.mock import TELEMETRY_DELAY_S
from perchctl.profile import PositioningConfig, Profile, load_profile
from perchctl.sim import Scenario, draw_capture, draw_scenario
from perchctl.sim.scenario import CONNECTED_S, RadioBursts

NOMINAL_SHA256 = "0d7b914ee7c3fb50209b00bc41ef25e0e4f67dbcc5ae86827fc12721db6a8b22"
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
    as_it_is, with_another = load_profile(world), changed(world, **{key: value})
    for seed in range(20):
        whole = asdict(draw_scenario(as_it_is, seed))
        other = asdict(draw_scenario(with_another, seed))
        moved = {name for name in whole if whole[name] != other[name]}
        assert moved <= {field, "first_contact_force_n"}  # of which the weight is a part
        ever |= moved
    assert field in ever


def test_a_motion_capture_has_the_scenarios_holes() -> None:
    profile = changed("extreme", capture_hole_every_s=5.0)
    assert draw_capture(profile, 4) is None
    by_mocap = profile.model_copy(update={"positioning": PositioningConfig(by="mocap", host="lab")})
    settings, holes = draw_capture(by_mocap, 4), draw_scenario(by_mocap, 4).capture_holes_s
    assert settings is not None
    assert [fault.occluded for *_, fault in settings.faults] == [True] * len(holes)
    for (from_s, to_s, _), (begin_s, length_s) in zip(settings.faults, holes, strict=True):
        assert (from_s, to_s - from_s) == (begin_s, pytest.approx(length_s))
    assert all(b[0] > a[0] + a[1] for a, b in itertools.pairwise(holes))


# --- A radio that fails by bursts -----------------------------------------------------------------


STEP_S = 0.005
PACKET = Packet(7, 0, b"\x07")


@pytest.mark.parametrize(("share", "mean_s"), [(0.03, 0.1), (0.2, 0.3)])
def test_share_and_length_of_bursts_are_what_is_asked_for(share: float, mean_s: float) -> None:
    until_s, bursts = 2000.0, RadioBursts(3, share, mean_s)
    assert not any(bursts.is_lost(step * STEP_S) for step in range(round(CONNECTED_S / STEP_S)))
    times_s = [CONNECTED_S + step * STEP_S for step in range(round(until_s / STEP_S))]
    lost = [bursts.is_lost(t_s) for t_s in times_s]
    runs = [sum(run) * STEP_S for is_lost, run in itertools.groupby(lost) if is_lost]
    spread = 4.0 / math.sqrt(len(runs))
    assert sum(runs) / until_s == pytest.approx(share, rel=1.5 * spread)
    assert sum(runs) / len(runs) == pytest.approx(mean_s, rel=spread + STEP_S / mean_s)
    # Not all alike: as many are longer than twice the mean as an exponential has.
    long = sum(length_s > 2.0 * mean_s for length_s in runs) / len(runs)
    assert long == pytest.approx(math.exp(-2.0), rel=0.35)
    seldom = RadioBursts(3, share, mean_s)
    assert lost[::40] == [seldom.is_lost(t_s) for t_s in times_s[::40]]


def test_both_directions_are_lost_together() -> None:
    scenario = Scenario(seed=2, radio_loss=0.3, radio_burst_s=0.3)
    radio, same = Radio(scenario.radio_bursts()), RadioBursts(2, 0.3, 0.3)
    for step in range(4000):
        t_s = step * STEP_S
        lost = same.is_lost(t_s)
        assert radio.uplink_arrives(PACKET, t_s) is not lost
        assert radio.downlink_delay_s("fast", t_s) == (None if lost else TELEMETRY_DELAY_S)
