"""Expected outcomes: each by its cause, and only for a while after it began."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest

from perchctl.faults import FAULTS
from perchctl.faults import effects as e
from perchctl.faults.catalogue import Case, draw_case
from perchctl.faults.expected_outcomes import (
    BROWN_OUT,
    CUT,
    EXPECTED_OUTCOMES,
    KNOCKED_OFF,
    LEFT_LANDING,
    LETS_GO_LATER,
    NO_LIFT,
    OPERATOR_STOPS,
    SAGS_TOO_FAST,
    TOO_LOW,
    ExpectedOutcome,
    unexpected,
)
from perchctl.faults.oracle import FLAGS
from perchctl.faults.truth import LEAST_LIFT, Facts
from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import Phase
from perchctl.profile import Profile, load_profile
from perchctl.sim import MOTOR_FORCE_N, Scenario, draw_scenario, most_thrust_n

BLOW = partial(e.push, force_n=(0.7, 0.0, 0.0), for_s=0.04)


def test_they_name_flags_and_reasons() -> None:
    used = {outcome.name for fault in FAULTS for outcome in fault.expected}
    assert used == {outcome.name for outcome in EXPECTED_OUTCOMES}
    for outcome in EXPECTED_OUTCOMES:
        assert outcome.reason
        assert outcome.flags
        assert set(outcome.flags) <= set(FLAGS)
        assert outcome.within_s > 0.0


@pytest.mark.parametrize(
    ("outcome", "facts", "cause_s"),
    [
        (BROWN_OUT, Facts(rebooted_s=5.0), 5.0),
        (BROWN_OUT, Facts(effects=(partial(e.reboots, boots_s=1.0),), begin_s=5.0), None),
        (CUT, Facts(cut_s=7.0), 7.0),
        (CUT, Facts(), None),
        (LEFT_LANDING, Facts(effects=(partial(e.killed),), killed_s=6.0, own_landing=True), 6.0),
        (LEFT_LANDING, Facts(effects=(partial(e.killed),), killed_s=6.0), None),
        (
            LEFT_LANDING,
            Facts(effects=(partial(e.hung, for_s=9.0),), killed_s=6.0, own_landing=True),
            None,
        ),
        (OPERATOR_STOPS, Facts(stop_s=9.0), 9.0),
        (
            OPERATOR_STOPS,
            Facts(effects=(partial(e.operator, presses_s=(0.0, 0.8)),), begin_s=5.0),
            None,
        ),
        (LETS_GO_LATER, Facts(let_go_s=21.0, watched=True), 21.0),
        (LETS_GO_LATER, Facts(let_go_s=21.0), None),
        (TOO_LOW, Facts(slipped_s=8.0, slipped_m=0.8), 8.0),
        (KNOCKED_OFF, Facts((BLOW,), 7.9, slipped_s=8.0, toppled=True), 8.0),
        (KNOCKED_OFF, Facts((BLOW,), 7.9, slipped_s=8.0), None),
        (KNOCKED_OFF, Facts((BLOW,), 7.0, slipped_s=8.0, toppled=True), None),
        (KNOCKED_OFF, Facts((), 7.9, slipped_s=8.0, toppled=True), None),
        (TOO_LOW, Facts(slipped_s=8.0, slipped_m=1.2), None),
        (NO_LIFT, Facts(weak_s=6.0), 6.0),
        (NO_LIFT, Facts(), None),
        (SAGS_TOO_FAST, Facts(weak_s=10.0, low_s=8.0, low_m=2.0), 10.0),
        (SAGS_TOO_FAST, Facts(weak_s=10.0), 10.0),
        (SAGS_TOO_FAST, Facts(weak_s=15.0, low_s=8.0, low_m=2.0), None),
        (SAGS_TOO_FAST, Facts(weak_s=10.0, low_s=8.0, low_m=0.1), None),
        (SAGS_TOO_FAST, Facts(low_s=8.0, low_m=2.0), None),
    ],
)
def test_each_by_its_cause(outcome: ExpectedOutcome, facts: Facts, cause_s: float | None) -> None:
    assert outcome.cause(facts) == cause_s


CAUSED: dict[str, Facts] = {
    BROWN_OUT.name: Facts(rebooted_s=10.0),
    CUT.name: Facts(cut_s=10.0),
    LEFT_LANDING.name: Facts(effects=(partial(e.killed),), killed_s=10.0, own_landing=True),
    OPERATOR_STOPS.name: Facts(stop_s=10.0),
    LETS_GO_LATER.name: Facts(let_go_s=10.0, watched=True),
    KNOCKED_OFF.name: Facts(effects=(BLOW,), begin_s=9.95, slipped_s=10.0, toppled=True),
    TOO_LOW.name: Facts(slipped_s=10.0, slipped_m=0.8),
    NO_LIFT.name: Facts(weak_s=10.0),
    SAGS_TOO_FAST.name: Facts(weak_s=10.0),
}
"""What brings each about, at 10 s."""


@pytest.mark.parametrize("outcome", EXPECTED_OUTCOMES, ids=lambda outcome: outcome.name)
def test_what_came_before_the_cause_or_long_after_is_no_consequence_of_it(
    outcome: ExpectedOutcome,
) -> None:
    facts, after_s = CAUSED[outcome.name], outcome.within_s
    for flag in FLAGS:
        covered = () if flag in outcome.flags else (flag,)
        for t_s, counted in (
            (9.9, (flag,)),
            (10.1, covered),
            (9.9 + after_s, covered),
            (10.1 + after_s, (flag,)),
        ):
            assert unexpected({flag: t_s}, (outcome,), facts) == counted


def test_other_flags_count_whatever_was_expected() -> None:
    flags: dict[Any, float] = {"fell": 10.5, "lied": 10.5}
    assert unexpected(flags, (CUT, OPERATOR_STOPS), Facts(stop_s=10.0)) == ("lied",)
    assert unexpected(flags, (), Facts(stop_s=10.0)) == ("fell", "lied")


# --- how many drawn cases may have one ------------------------------------------------

RELEASED_S, TEARS_OFF_N = 1.0, 0.42
"""The motors stand still no sooner after the contact, and what a hanging vehicle needs at the least
to be torn off."""
WATCHED_S, LOOKED_S = 5.2, 6.0
"""From contact to the end of the watch, with the shipped profiles' times, and for how long the
oracle looks on from there."""


def may_come(outcome: ExpectedOutcome, case: Case, scenario: Scenario) -> bool:
    """Whether the cause of a rare outcome may come in a drawn case, by what was drawn alone: at
    most as strict as the flight itself is."""
    for effect in case.effects:
        act, values = effect.func, effect.keywords
        if outcome is LETS_GO_LATER and act is e.magnet_lets_go:
            return WATCHED_S < float(values["after_s"]) < WATCHED_S + LOOKED_S
        if outcome is TOO_LOW and act in (e.magnet_holds, e.magnet_lets_go):
            return scenario.ceiling_z_m < 1.0
        if outcome is KNOCKED_OFF and act is e.push:
            hangs = case.phase is Phase.COMPLETE and case.moment_s > RELEASED_S
            hangs = hangs or case.landed_from in (Phase.PERCH, Phase.COMPLETE)
            return hangs and math.hypot(*values["force_n"]) > TEARS_OFF_N
        if outcome is NO_LIFT and act is e.thrust_changed:
            return is_too_weak(scenario, min(values["to"]), 0.0)
        if outcome is SAGS_TOO_FAST and act is e.battery_sags:
            return is_too_weak(scenario, 1.0, values["by_v"])
    return False


def is_too_weak(scenario: Scenario, strength: float, by_v: float) -> bool:
    lift_n = strength * most_thrust_n(scenario.battery_rest_v - by_v - 0.1)
    weight_n = scenario.mass_kg * GRAVITY_MPS2
    return bool(min(4.0 * MOTOR_FORCE_N, lift_n) < LEAST_LIFT * weight_n)


@pytest.mark.parametrize("name", ["sim", "target_only"])
def test_fewer_than_one_drawn_case_in_a_hundred_may_have_a_rare_one(name: str) -> None:
    """The user's stop, the firmware's own cut, a killed program and the battery's break-down
    aside."""
    profile: Profile = load_profile(name)
    drawn, rare = 5000, 0
    for seed in range(drawn):
        fault = draw_case(seed, Scenario()).fault  # whatever the scenario, the same one
        outcomes = [outcome for outcome in fault.expected if not outcome.chosen]
        if outcomes:
            scenario = draw_scenario(profile, seed)
            case = draw_case(seed, scenario)
            rare += any(may_come(outcome, case, scenario) for outcome in outcomes)
    assert 0 < rare < 0.01 * drawn
