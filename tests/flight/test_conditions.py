"""A seed's conditions, each between what was drawn and nominal, and a failure by flights."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.flight import EndedFlight, ScenarioConditions, minimised_failure, scenario_conditions
from perchctl.flight.conditions import CONDITIONS, NO_CONDITION
from perchctl.flight.failure import Kind
from perchctl.profile import Profile, SimulationConfig, load_profile
from perchctl.sim import draw_scenario
from tests.helpers.flights import short_profile

SIM = load_profile("sim")
GOOD = EndedFlight(0, Kind("perched", "", False, False), "hanging still")
BAD = EndedFlight(0, Kind("landed", "battery-low", False, False), "battery at 2.9 V under load")
OTHER = EndedFlight(0, Kind("landed", "fence", False, False), "outside the fence")


def test_at_their_full_level_they_are_the_seeds_scenario_to_the_bit() -> None:
    for seed in range(20):
        conditions = scenario_conditions(SIM, seed)
        whole = conditions.toned(dict.fromkeys(conditions.names, 1.0))
        assert draw_scenario(whole, seed) == draw_scenario(SIM, seed)


def test_at_level_zero_nothing_is_left_of_them() -> None:
    calm = [
        conditions.toned(dict.fromkeys(conditions.names, 0.0)).simulation
        for conditions in (scenario_conditions(SIM, seed) for seed in range(5))
    ]
    assert all(each == calm[0] for each in calm)
    assert scenario_conditions(SIM.model_copy(update={"simulation": calm[0]}), 7).off == ()


@pytest.mark.parametrize("less", [0.0, 0.5])
def test_toning_one_down_leaves_the_others(less: float) -> None:
    """Whatever is drawn after it."""
    conditions = scenario_conditions(SIM, 2)
    levels = dict.fromkeys(conditions.names, 1.0)
    whole = _told(conditions, levels)
    for name in conditions.names:
        toned = _told(conditions, levels | {name: less})
        assert {other for other in whole if whole[other] != toned[other]} <= {name}, name


def _told(conditions: ScenarioConditions, levels: dict[str, float]) -> dict[str, str]:
    profile = conditions.toned(levels)
    scenario = draw_scenario(profile, conditions.seed)
    return {c.name: c.told(profile, scenario) for c in CONDITIONS if c.told is not None}


def test_a_nominal_world_has_no_other_conditions_than_those_with_words() -> None:
    """What only says when, where to or how much is no condition of its own."""
    named = {condition.name for condition in CONDITIONS}
    for seed in range(20):
        assert set(scenario_conditions(SIM, seed).names) <= named


def test_every_key_of_the_simulation_is_a_condition_or_is_none() -> None:
    """A key that is new is one by itself."""
    named = [key for condition in CONDITIONS for key in condition.keys]
    assert len(set(named)) == len(named)
    assert set(named) <= set(SimulationConfig.model_fields)
    wild = short_profile(
        {
            "simulation.camera_flicker": 0.4, "simulation.no_target": True,
            "simulation.camera_receiver_hz": 25.0, "simulation.estimate_noise_m": 0.02,
            "simulation.neighbours": [[0.5, 0.0, 20.0]], "simulation.camera_fields": "top",
            "simulation.first_contact_fails": 1.0,
        }
    )  # fmt: skip
    conditions = scenario_conditions(wild, 1)
    assert {"camera_flicker", "estimate_noise_m", "receiver", "neighbours", "interlacing", "target",
            "first contact"} <= set(conditions.names)  # fmt: skip
    assert {"camera_flicker", "estimate_noise_m"} <= set(conditions.gradual)
    switches = {"receiver", "neighbours", "interlacing", "target", "first contact"}
    assert not switches & set(conditions.gradual)
    levels = dict.fromkeys(conditions.names, 0.0) | {"camera_flicker": 0.5}
    toned = conditions.toned(levels).simulation
    assert (toned.camera_flicker, toned.neighbours, toned.no_target) == (0.2, (), False)
    assert not NO_CONDITION & set(conditions.values(levels))


def fails_by_weight_and_battery(profile: Profile, seed: int) -> EndedFlight:
    """Fails otherwise where only the battery is weak."""
    scenario = draw_scenario(profile, seed)
    if scenario.battery_rest_v > 3.95:
        return GOOD
    return BAD if scenario.mass_kg > 0.0405 else OTHER


@pytest.mark.parametrize("jobs", [1, 3])
def test_a_failure_keeps_its_kind_and_is_the_same_however_many_fly(jobs: int) -> None:
    seed = next(s for s in range(99) if fails_by_weight_and_battery(SIM, s) == BAD)
    conditions = scenario_conditions(SIM, seed)
    flown: list[EndedFlight] = []
    smaller: list[EndedFlight] = []
    levels = minimised_failure(
        conditions, BAD, None, jobs, flown.append, lambda _levels, ended: smaller.append(ended),
        fails_by_weight_and_battery,
    )  # fmt: skip
    assert {name for name, level in levels.items() if level} == {"mass", "battery"}
    assert set(smaller) == {BAD}
    found = conditions.toned(levels)
    assert fails_by_weight_and_battery(found, seed) == BAD
    scenario = draw_scenario(found, seed)
    assert 0.0405 < scenario.mass_kg < 0.0408
    assert 3.92 < scenario.battery_rest_v <= 3.95


def test_a_refused_flight_is_a_failure_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    from perchctl.errors import InvalidValue
    from perchctl.flight import failure

    def refuse(*_: object) -> None:
        raise InvalidValue("the battery is flat")

    monkeypatch.setattr(failure, "fly_lockstep", refuse)
    ended = failure.fly_to_its_end(SIM, 4)
    assert (ended.failed, ended.kind.row, ended.told) == (
        True, "", "refused: the battery is flat",
    )  # fmt: skip
