"""What seeds draw in the shipped worlds, each condition by itself."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

import itertools

from perchctl.profile import Profile, load_profile
from perchctl.sim import Scenario, draw_capture, draw_scenario

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


def test_one_range_moves_no_other_value_of_a_seed() -> None:
    """So that one condition can be taken away, and all else is as it was."""
    whole = asdict(draw_scenario(load_profile("extreme"), 7))
    for key, value, fields in (
        ("target_tilt_deg", [0.0, 0.0], {"target_tilt_rad"}),
        ("radio_loss", [0.0, 0.0], {"radio_loss"}),
        ("mass_kg", [0.04, 0.04], {"mass_kg", "first_contact_force_n"}),
        ("capture_hole_s", [0.0, 0.0], {"capture_holes_s"}),
    ):
        other = asdict(draw_scenario(changed("extreme", **{key: value}), 7))
        moved = {name for name in whole if whole[name] != other[name]}
        assert moved - {"first_contact_force_n"} == fields - {"first_contact_force_n"}, key


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
    assert all(length_s == 1.0 for _, length_s in holes)
    assert all(b[0] > a[0] + a[1] for a, b in itertools.pairwise(holes))
    assert draw_capture(profile, 4) is None


@pytest.mark.parametrize("frames", [None, (0, 0), (9, 9), (8, 9)])
def test_lost_frames_leave_what_is_drawn_after_them(frames: tuple[int, int] | None) -> None:
    profile = load_profile("sim")
    without = profile.model_copy(
        update={"simulation": profile.simulation.model_copy(update={"camera_burst_frames": frames})}
    )
    for seed in range(20):
        whole = asdict(draw_scenario(profile, seed)) | {"camera_burst": None}
        assert asdict(draw_scenario(without, seed)) | {"camera_burst": None} == whole
