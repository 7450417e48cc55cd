"""Expected outcomes: each by its cause, and only for a while after it began."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest

from perchctl.faults import effects as e
from perchctl.faults.expected_outcomes import EXPECTED_OUTCOMES, ExpectedOutcome, unexpected_flags
from perchctl.faults.oracle import FLAGS
from perchctl.faults.truth import Facts

BLOW = partial(e.push, force_n=(0.7, 0.0, 0.0), for_s=0.04)
WEAK = partial(e.thrust_changed, to=(0.85, 1.0, 1.0, 1.0))
SAGS = partial(e.battery_sags, rate_vps=0.1, by_v=0.6)
OUTCOMES = {outcome.name: outcome for outcome in EXPECTED_OUTCOMES}


def test_they_name_flags() -> None:
    assert all(outcome.flags and {*outcome.flags} <= {*FLAGS} for outcome in EXPECTED_OUTCOMES)
    assert {*OUTCOMES} == {*CAUSED}


@pytest.mark.parametrize(
    ("name", "facts", "cause_s"),
    [
        ("started again", Facts(rebooted_s=5.0), 5.0),
        ("started again", Facts((partial(e.reboots, boots_s=1.0),), begin_s=5.0), None),
        ("cut by the firmware", Facts(silence_lock_s=7.0), 7.0),
        ("cut by the firmware", Facts(), None),
        (
            "lands alone",
            Facts((partial(e.killed),), killed_s=6.0, was_landing_onboard=True),
            6.0,
        ),
        ("lands alone", Facts((partial(e.killed),), killed_s=6.0), None),
        (
            "lands alone",
            Facts((partial(e.hung, for_s=9.0),), killed_s=6.0, was_landing_onboard=True),
            None,
        ),
        ("the operator's word", Facts(stop_s=9.0), 9.0),
        (
            "the operator's word",
            Facts((partial(e.operator, presses_s=(0.0, 0.8)),), begin_s=5.0),
            None,
        ),
        ("let go after the flight", Facts(magnet_failed_s=21.0, hung_through_watch=True), 21.0),
        ("let go after the flight", Facts(magnet_failed_s=21.0), None),
        ("too low to catch", Facts(slipped_s=8.0, slip_height_m=0.8), 8.0),
        ("knocked off the magnet", Facts((BLOW,), 7.9, slipped_s=8.0, toppled=True), 8.0),
        ("knocked off the magnet", Facts((BLOW,), 7.9, slipped_s=8.0), None),
        ("knocked off the magnet", Facts((BLOW,), 7.0, slipped_s=8.0, toppled=True), None),
        ("knocked off the magnet", Facts((), 7.9, slipped_s=8.0, toppled=True), None),
        ("too low to catch", Facts(slipped_s=8.0, slip_height_m=1.2), None),
        ("released in silence", Facts(released_in_silence_s=8.0), 8.0),
        ("released in silence", Facts(slipped_s=8.0), None),
        ("too weak to hover", Facts((WEAK,), weak_s=6.0), 6.0),
        ("too weak to hover", Facts(weak_s=6.0), None),
        ("sags too fast", Facts((SAGS,), weak_s=10.0, battery_low_s=8.0, battery_low_m=2.0), 10.0),
        ("sags too fast", Facts((SAGS,), weak_s=10.0), 10.0),
        ("sags too fast", Facts(weak_s=10.0), None),
        ("sags too fast", Facts((SAGS,), weak_s=15.0, battery_low_s=8.0, battery_low_m=2.0), None),
        ("sags too fast", Facts((SAGS,), weak_s=10.0, battery_low_s=8.0, battery_low_m=0.1), None),
        ("sags too fast", Facts((SAGS,), battery_low_s=8.0, battery_low_m=2.0), None),
    ],
)
def test_each_by_its_cause(name: str, facts: Facts, cause_s: float | None) -> None:
    assert OUTCOMES[name].cause(facts) == cause_s


CAUSED: dict[str, Facts] = {
    "started again": Facts(rebooted_s=10.0),
    "cut by the firmware": Facts(silence_lock_s=10.0),
    "lands alone": Facts((partial(e.killed),), killed_s=10.0, was_landing_onboard=True),
    "the operator's word": Facts(stop_s=10.0),
    "let go after the flight": Facts(magnet_failed_s=10.0, hung_through_watch=True),
    "knocked off the magnet": Facts(effects=(BLOW,), begin_s=9.95, slipped_s=10.0, toppled=True),
    "released in silence": Facts(released_in_silence_s=10.0),
    "too low to catch": Facts(slipped_s=10.0, slip_height_m=0.8),
    "too weak to hover": Facts((WEAK,), weak_s=10.0),
    "sags too fast": Facts((SAGS,), weak_s=10.0),
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
            assert unexpected_flags({flag: t_s}, facts) == counted


def test_other_flags_count_whatever_was_expected() -> None:
    flags: dict[Any, float] = {"fell": 10.5, "lied": 10.5}
    assert unexpected_flags(flags, Facts(stop_s=10.0)) == ("lied",)
    assert unexpected_flags(flags, Facts()) == ("fell", "lied")
