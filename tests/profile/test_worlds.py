"""The harder worlds: profiles that differ from `sim` in what a seed draws from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from perchctl.errors import InvalidValue, ProfileNote
from perchctl.profile import Profile, SimulationConfig, changed_profile, load_profile


@pytest.mark.parametrize("name", ["rough", "extreme"])
def test_a_harder_world_is_sim_in_all_else(name: str) -> None:
    """It settles less exactly there."""
    sim, world = load_profile("sim"), load_profile(name)
    assert world.simulation != sim.simulation == SimulationConfig()
    ascend = world.planner.ascend.model_copy(update={"settle_xy_m": sim.planner.ascend.settle_xy_m})
    assert world.planner.model_copy(update={"ascend": ascend}) == sim.planner
    assert world.planner.ascend.settle_xy_m > sim.planner.ascend.settle_xy_m
    assert sim == world.model_copy(
        update={key: getattr(sim, key) for key in ("name", "description", "simulation", "planner")}
    )


def test_the_set_of_earlier_versions_is_named_with_the_profile_to_extend(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: sim\nsimulation: {set: rough}\n")
    with pytest.raises(InvalidValue, match=r"simulation\.set.*extend the profile rough"):
        load_profile(str(path))
    with pytest.raises(InvalidValue, match=r"simulation\.set"):
        changed_profile(load_profile("sim"), ["simulation.set=rough"])
    path.write_text("extends: sim\nsimulation: {set: nominal, gloss: [0.2, 0.8]}\n")
    with pytest.warns(ProfileNote, match="no longer used"):
        assert load_profile(str(path)).simulation == SimulationConfig()


def test_a_log_of_an_earlier_version_is_read() -> None:
    """It holds every key of the world in which was flown."""
    values = load_profile("extreme").model_dump(mode="json")
    values["simulation"] |= {"set": "extreme", "gust_mps": [0.2, 0.6], "drift_xyz_mps": None}
    values["simulation"] |= {"camera_burst_start_s": [4.0, 22.0]}
    assert Profile.model_validate(values) == load_profile("extreme")


@pytest.mark.parametrize(
    "keys",
    [
        {"radio_loss": (0.0, 0.9)},
        {"radio_burst_s": (0.0, 0.1)},
        {"target_tilt_deg": (3.0, 1.0)},
        {"cell_charge": (0.0, 1.0)},
    ],
)
def test_what_cannot_be_is_refused(keys: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        SimulationConfig.model_validate(keys)
