"""Expected outcomes: each by its cause, and only for a while after it began."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest

from perchctl.faults import FAULTS
from perchctl.faults import effects as e
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
from perchctl.faults.truth import Facts

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
