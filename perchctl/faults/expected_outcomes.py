"""Expected outcomes: failures that physics or the firmware make unavoidable, so that they do not
count against the program.

Their causes are taken from the ground truth of the flight (`Facts`), not from the drawn fault or
the program's reports.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from perchctl.faults.effects import battery_sags, killed, push, thrust_changed
from perchctl.faults.oracle import Flag
from perchctl.faults.truth import Facts

# after a slip below this height, the vehicle hits the floor (docs/firmware.md, "Catching a slip")
CATCHABLE_M = 1.0
NOTICED_S = 1.5
"""Time within which the program must recognise that the battery is low, s. Larger: a late landing
is excused."""
FASTEST_LANDING_MPS = 0.4
"""Highest speed of a landing, m/s. Smaller: a slow landing is excused."""
PUSHED_OFF_S = 0.2
"""Longest time until a blow of 0.04 s tears the vehicle off the magnet, s."""


FALL: tuple[Flag, ...] = ("fell", "slid")
CUT_DOWN: tuple[Flag, ...] = (*FALL, "strayed", "locked_needlessly")


@dataclass(frozen=True)
class ExpectedOutcome:
    """An outcome that no program could avoid. `cause` returns the time at which its cause occurred,
    or None; `flags` raised within `within_s` after that time do not count. `reason` must fit into
    one line of the table."""

    name: str
    reason: str
    cause: Callable[[Facts], float | None]
    flags: tuple[Flag, ...] = FALL
    within_s: float = 4.0

    def covers(self, flag: Flag, t_s: float, facts: Facts) -> bool:
        """True if this outcome excuses `flag`, raised at `t_s`."""
        cause_s = self.cause(facts)
        return cause_s is not None and flag in self.flags and 0.0 <= t_s - cause_s <= self.within_s


def _killed_in_landing(facts: Facts) -> float | None:
    return facts.killed_s if facts.has_effect(killed) and facts.was_landing_onboard else None


def _let_go_later(facts: Facts) -> float | None:
    return facts.magnet_failed_s if facts.hung_through_watch else None


def _too_low(facts: Facts) -> float | None:
    return facts.slipped_s if facts.slip_height_m < CATCHABLE_M else None


def _knocked_off(facts: Facts) -> float | None:
    slipped_s, begin_s = facts.slipped_s, facts.begin_s
    if slipped_s is None or begin_s is None or not (facts.toppled and facts.has_effect(push)):
        return None
    return slipped_s if 0.0 <= slipped_s - begin_s <= PUSHED_OFF_S else None


def _too_weak(facts: Facts) -> float | None:
    return facts.weak_s if facts.has_effect(thrust_changed) else None


def _sagged_too_fast(facts: Facts) -> float | None:
    if facts.weak_s is None or not facts.has_effect(battery_sags):
        return None
    down_s = NOTICED_S + facts.battery_low_m / FASTEST_LANDING_MPS
    in_time = facts.battery_low_s is not None and facts.weak_s - facts.battery_low_s >= down_s
    return None if in_time else facts.weak_s


EXPECTED_OUTCOMES = (
    ExpectedOutcome(
        "started again",
        "a vehicle that restarts in the air has no thrust",
        lambda facts: facts.rebooted_s,
        (*FALL, "strayed"),
    ),
    ExpectedOutcome(
        "cut by the firmware",
        "2 s after the last setpoint the firmware cuts the motors and locks the vehicle",
        lambda facts: facts.silence_lock_s,
        CUT_DOWN,
    ),
    ExpectedOutcome(
        "lands alone",
        "a landing flown by the firmware continues without perchctl",
        _killed_in_landing,
        ("flies_on",),
        20.0,
    ),
    ExpectedOutcome(
        "the operator's word",
        "cutting the motors on the operator's command locks the vehicle",
        lambda facts: facts.stop_s,
        CUT_DOWN,
    ),
    ExpectedOutcome(
        "let go after the flight",
        "the magnet failed after perchctl had finished monitoring the hanging vehicle",
        _let_go_later,
    ),
    ExpectedOutcome(
        "released in silence",
        "0.5 s after the last setpoint the firmware replaces it; the magnet then let go",
        lambda facts: facts.released_in_silence_s,
        within_s=2.0,
    ),
    ExpectedOutcome(
        "too low to catch",
        "recovering from a fall takes up to 0.8 m of height; the vehicle was hanging below 1 m",
        _too_low,
    ),
    ExpectedOutcome(
        "knocked off the magnet",
        "a blow turned the vehicle over before its motors spun up",
        _knocked_off,
    ),
    ExpectedOutcome(
        "too weak to hover",
        "four motors as weak as the weakest one cannot lift the weight",
        _too_weak,
        within_s=15.0,
    ),
    ExpectedOutcome(
        "sags too fast",
        "the battery cannot keep the vehicle in the air for the whole descent",
        _sagged_too_fast,
        within_s=15.0,
    ),
)


def unexpected_flags(flags: Mapping[Flag, float], facts: Facts) -> tuple[Flag, ...]:
    """Return the flags that count against the program: those that no expected outcome covers."""
    return tuple(
        flag
        for flag, t_s in flags.items()
        if not any(outcome.covers(flag, t_s, facts) for outcome in EXPECTED_OUTCOMES)
    )
