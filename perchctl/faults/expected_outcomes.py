"""Where physics or the firmware leave no better end, and what is then expected.

An expected outcome takes away the flags it names, and no other, where they were raised after its
cause began and within a stated time of it. Its cause is what was true in the flight (`Facts`), not
what was drawn, and not what the program reported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from perchctl.faults.effects import killed, push
from perchctl.faults.oracle import Flag
from perchctl.faults.truth import Facts

CATCHABLE_M = 1.0  # lower, a slip reaches the floor (docs/firmware.md, "Catching a slip")
NOTICED_S, DOWN_MPS = 1.5, 0.4
"""How long a low battery takes to be believed, and how fast a landing goes at best."""
PUSHED_OFF_S = 0.2
"""A blow of 0.04 s has torn it off by then, or not at all."""


@dataclass(frozen=True)
class ExpectedOutcome:
    """An outcome that no program could avoid: `flags` raised from the time of `cause` (None: it
    never came) until `within_s` later do not count. `chosen`: the user, the firmware or the
    battery decides it, so that no program could make it rare."""

    name: str
    cause: Callable[[Facts], float | None]
    within_s: float
    flags: tuple[Flag, ...]
    reason: str

    def covers(self, flag: Flag, t_s: float, facts: Facts) -> bool:
        """Return True if a flag raised at `t_s` is a consequence of the cause."""
        cause_s = self.cause(facts)
        return cause_s is not None and flag in self.flags and 0.0 <= t_s - cause_s <= self.within_s


def unexpected(
    flags: Mapping[Flag, float], outcomes: Sequence[ExpectedOutcome], facts: Facts
) -> tuple[Flag, ...]:
    """Return the flags that no expected outcome covers: those that count."""
    return tuple(
        flag
        for flag, t_s in flags.items()
        if not any(outcome.covers(flag, t_s, facts) for outcome in outcomes)
    )


FALL: tuple[Flag, ...] = ("fell", "slid")
CUT_DOWN: tuple[Flag, ...] = (*FALL, "strayed", "locked_needlessly")


def _killed_in_landing(facts: Facts) -> float | None:
    return facts.killed_s if facts.does(killed) and facts.own_landing else None


def _knocked_off(facts: Facts) -> float | None:
    if (
        not facts.does(push)
        or facts.begin_s is None
        or facts.slipped_s is None
        or not facts.toppled
    ):
        return None
    return facts.slipped_s if 0.0 <= facts.slipped_s - facts.begin_s <= PUSHED_OFF_S else None


def _sagged_too_fast(facts: Facts) -> float | None:
    if facts.weak_s is None:
        return None
    down_s = NOTICED_S + facts.low_m / DOWN_MPS
    in_time = facts.low_s is not None and facts.weak_s - facts.low_s >= down_s
    return None if in_time else facts.weak_s


CUT = ExpectedOutcome(
    "cut by the firmware",
    lambda facts: facts.cut_s,
    4.0,
    CUT_DOWN,
    "2 s after the last setpoint the firmware cuts the motors and locks; nothing that the "
    "program sends arrives any more",
)
LEFT_LANDING = ExpectedOutcome(
    "lands alone",
    _killed_in_landing,
    20.0,
    ("flies_on",),
    "the vehicle flies its own landing to the end without the program: it comes down, softly",
)
OPERATOR_STOPS = ExpectedOutcome(
    "the operator's word",
    lambda facts: facts.stop_s,
    4.0,
    CUT_DOWN,
    "a second Ctrl-C is an emergency stop: it cuts the motors and locks",
)
LETS_GO_LATER = ExpectedOutcome(
    "let go after the flight",
    lambda facts: facts.let_go_s if facts.watched else None,
    4.0,
    FALL,
    "the whole weight has hung for the time it is watched; the program is no longer there "
    "when the magnet lets go",
)
TOO_LOW = ExpectedOutcome(
    "too low to catch",
    lambda facts: facts.slipped_s if facts.slipped_m < CATCHABLE_M else None,
    4.0,
    FALL,
    "a fall from standing motors takes up to 0.8 m to catch; it hung lower than 1 m",
)
KNOCKED_OFF = ExpectedOutcome(
    "knocked off the magnet",
    _knocked_off,
    4.0,
    FALL,
    "a blow has torn it off while its motors stood still, and turned it over before they turned",
)
NO_LIFT = ExpectedOutcome(
    "too weak to hover",
    lambda facts: facts.weak_s,
    15.0,
    FALL,
    "what battery and motors can lift is less than the weight: four times what the weak motor "
    "gives, for with more of the others it turns over",
)
SAGS_TOO_FAST = ExpectedOutcome(
    "sags too fast",
    _sagged_too_fast,
    15.0,
    FALL,
    "from the voltage at which it lands to the one that does not lift the weight any more it "
    "has less time than the way down takes",
)
BROWN_OUT = ExpectedOutcome(
    "started again",
    lambda facts: facts.rebooted_s,
    4.0,
    (*FALL, "strayed"),
    "a vehicle that starts again in the air stops its motors; nothing that the program sends can "
    "be flown",
)
EXPECTED_OUTCOMES = (
    BROWN_OUT,
    CUT,
    LEFT_LANDING,
    OPERATOR_STOPS,
    LETS_GO_LATER,
    TOO_LOW,
    KNOCKED_OFF,
    NO_LIFT,
    SAGS_TOO_FAST,
)
