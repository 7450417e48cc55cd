"""The named worlds of `simulation.set`: defaults that written keys win over."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from perchctl.errors import InvalidValue
from perchctl.profile import Profile, SimulationConfig, load_profile
from perchctl.profile.simulation import NOMINAL, WORLDS, in_world


def simulated(**keys: Any) -> SimulationConfig:
    return SimulationConfig.model_validate(keys)


def test_nominal_is_the_defaults_as_they_stand() -> None:
    assert simulated(set=NOMINAL) == simulated() == load_profile("sim").simulation
    assert WORLDS[NOMINAL] == {}


@pytest.mark.parametrize("name", ["rough", "extreme"])
def test_a_set_gives_the_defaults_and_written_keys_win(name: str) -> None:
    world = simulated(set=name)
    for key, value in WORLDS[name].items():
        assert getattr(world, key) == value, key
        assert getattr(world, key) != getattr(simulated(), key), key
    light = simulated(set=name, mass_kg=(0.04, 0.04))
    assert light.mass_kg == (0.04, 0.04)
    assert light.model_copy(update={"mass_kg": world.mass_kg}) == world


@pytest.mark.parametrize("name", ["rough", "extreme"])
def test_the_shipped_profile_is_sim_in_that_world(name: str) -> None:
    """It settles less exactly there, and is sim in all else."""
    sim, world = load_profile("sim"), load_profile(name)
    assert world.simulation == simulated(set=name)
    ascend = world.planner.ascend.model_copy(update={"settle_xy_m": sim.planner.ascend.settle_xy_m})
    assert world.planner.model_copy(update={"ascend": ascend}) == sim.planner
    assert world.planner.ascend.settle_xy_m > sim.planner.ascend.settle_xy_m
    assert sim == world.model_copy(
        update={key: getattr(sim, key) for key in ("name", "description", "simulation", "planner")}
    )


def test_from_one_world_to_another_what_was_written_stays() -> None:
    """Written out, every key of a profile is given, and its set alone would change nothing."""
    rough = Profile.model_validate(load_profile("rough").model_dump()).simulation
    assert in_world(rough, "extreme") == simulated(set="extreme")
    assert in_world(in_world(rough, "extreme"), NOMINAL) == simulated()
    light = simulated(set="rough", mass_kg=(0.04, 0.04))
    assert in_world(light, "extreme") == simulated(set="extreme", mass_kg=(0.04, 0.04))
    with pytest.raises(ValidationError):
        in_world(rough, "hard")


def test_a_world_written_out_is_read_back_as_it_was() -> None:
    """As a log keeps it, with every key."""
    profile = load_profile("extreme")
    assert Profile.model_validate(profile.model_dump(mode="json")) == profile


def test_an_unknown_set_names_the_three(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: sim\nsimulation: {set: hard}\n")
    with pytest.raises(InvalidValue) as caught:
        load_profile(str(path))
    said = str(caught.value)
    assert "simulation.set" in said
    assert "found 'hard'" in said
    assert "\n" not in said
    assert all(name in said for name in WORLDS)
    with pytest.raises(ValidationError):
        simulated(set=["rough"])


def test_every_value_of_a_world_is_one_that_a_profile_may_have() -> None:
    for name, values in WORLDS.items():
        assert simulated(**values).model_dump(exclude={"set"}) == simulated(set=name).model_dump(
            exclude={"set"}
        )


@pytest.mark.parametrize(
    "keys",
    [
        {"gloss": (-0.1, 0.2)},
        {"radio_loss": (0.0, 0.9)},
        {"radio_burst_s": (0.0, 0.1)},
        {"target_tilt_deg": (3.0, 1.0)},
        {"cell_charge": (0.0, 1.0)},
        {"flow_reach_m": 0.0},
    ],
)
def test_what_cannot_be_is_refused(keys: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        simulated(**keys)
