"""The catalogue: every fault can be drawn, and the same again."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perchctl.errors import InvalidValue
from perchctl.faults import FAULTS, select_faults
from perchctl.faults.catalogue import (
    AIR,
    BY_NAME,
    FROM_THE_START,
    HEALTHY,
    USUAL_S,
    Fault,
    draw_case,
    draw_fault_case,
)
from perchctl.faults.oracle import emergency_stop_s
from perchctl.flight import OperatorSwitch
from perchctl.mission import OperatorRequest, Phase
from perchctl.sim import Neighbour, Scenario

SCENARIO = Scenario(seed=5)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name)
def test_a_fault_is_well_formed(fault: Fault) -> None:
    assert re.fullmatch(r"[a-z]+(-[a-z]+)*", fault.name)
    assert set(fault.phases) <= set(AIR)
    assert set(USUAL_S) == set(AIR) | {Phase.HOVER}
    for seed in range(20):
        for phase in fault.phases:
            case = draw_fault_case(fault, phase, np.random.default_rng(seed), SCENARIO)
            assert 0.0 <= case.moment_s <= USUAL_S[phase]
            assert case.effects
            assert (case.landed_from is not None) == (phase is Phase.LANDING)
            assert (case.first_hold_ratio is not None) == (phase is Phase.RECOVER)
            assert all(effect.keywords.get("for_s", 1.0) > 0.0 for effect in case.effects)
            text = case.text or ""
            assert text.startswith(fault.name)
            assert fault.description in text
            drawn = [key for effect in case.effects for key in effect.keywords]
            assert all(f"{key}=" in text for key in drawn)
            assert ("from the start" in text) == (fault.phases == FROM_THE_START)
            assert ("the operator ended" in text) == (phase is Phase.LANDING)
            assert ("the magnet held only" in text) == (phase is Phase.RECOVER)


def test_a_flight_without_a_fault_names_none() -> None:
    assert HEALTHY.text is None


def rounded(value: Any) -> Any:
    """To what no computer's sine can change."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(each) for each in value]
    return round(float(value), 9) if isinstance(value, float) else value


def test_the_same_seeds_draw_the_same_cases_for_ever() -> None:
    """Campaigns of before are repeated by their seeds."""
    drawn = hashlib.sha256()
    for seed in range(1000):
        case = draw_case(seed, SCENARIO)
        effects = [(effect.func.__name__, effect.keywords) for effect in case.effects]
        told = (case.fault.name, case.phase, case.moment_s, effects)
        then = (case.landed_from, case.landed_after_s, case.first_hold_ratio)
        drawn.update(repr((rounded(told), rounded(then))).encode())
    assert drawn.hexdigest()[:16] == "f8208484787cc1ce"


def test_a_second_target_leaves_those_of_the_neighbours_where_they_hang() -> None:
    """In a fleet, a camera may see both."""
    fleet = replace(SCENARIO, neighbours=(Neighbour((1.5, 0.0), 0.3, 145, 254),))
    (effect,) = draw_case(3, fleet, [BY_NAME["second-target"]]).effects
    theirs, second = effect(fleet).neighbours
    assert theirs == fleet.neighbours[0]
    assert second.large_id is None, "the same markers as its own"


@pytest.mark.parametrize(("name", "stops"), [("operator-held", False), ("operator-hammers", True)])
def test_a_key_that_is_held_is_no_stop_and_one_that_is_hammered_is(name: str, stops: bool) -> None:
    """By the oracle's reading of the law and by the program's, with the presses as drawn and as the
    simulated clock delivers them (seed 20761168)."""
    for seed in range(100):
        case = draw_fault_case(BY_NAME[name], Phase.ALIGN, np.random.default_rng(seed), SCENARIO)
        presses_s = case.effects[0].keywords["presses_s"]
        if seed % 2:
            late_s = np.random.default_rng(seed).choice([0.0, 0.01], len(presses_s))
            steps_s = [math.ceil(round(100 * press_s, 6)) / 100 for press_s in presses_s]
            presses_s = [step_s + more_s for step_s, more_s in zip(steps_s, late_s, strict=True)]
        now_s = [0.0]
        switch = OperatorSwitch(listening=True, clock=lambda: now_s[0])  # noqa: B023
        for now_s[0] in presses_s:
            switch.press()
        now_s[0] += 1.0
        assert (switch.read() is OperatorRequest.CUT_MOTORS) is stops
        assert (emergency_stop_s(presses_s) is not None) is stops


def test_a_selection_by_name() -> None:
    assert select_faults("all") == FAULTS
    assert [fault.name for fault in select_faults("hung, killed")] == ["hung", "killed"]
    with pytest.raises(InvalidValue, match=r"unknown; did you mean kick\? `--faults list` lists"):
        select_faults("kik")
    with pytest.raises(InvalidValue, match=r"'hanged' is unknown.*--faults list"):
        select_faults("killed,hanged")
    assert {draw_case(seed, SCENARIO, select_faults("slow")).fault.name for seed in range(5)} == {
        "slow"
    }
