"""Where physics or the firmware leave no better end, and what is then expected.

An excuse takes away the flags it names, from the flights for which it holds, and no other.
Each holds by what was true in the flight (`Facts`), not by what was drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from perchctl.faults.effects import (
    Effect,
    Killed,
    MagnetHolds,
    MagnetLetsGo,
    Operator,
    Silence,
    Suspended,
)
from perchctl.faults.oracle import Flag
from perchctl.flight.operator import AGAIN_S, HELD_S
from perchctl.mission.guards import CATCHABLE_M

CUT_S = 1.9
"""Silence for longer ends in the firmware's cut (2.0 s after the last setpoint)."""
LEAST_LIFT = 1.02
"""Over the weight: with less nothing is held in the air."""
NOTICED_S, DOWN_MPS = 1.5, 0.4
"""How long a low battery takes to be believed, and how fast a landing goes at best."""


@dataclass(frozen=True)
class Facts:
    """What was true in the flight. Times None: never.

    `own_landing`: the vehicle's own landing ran as the fault began. `weak_s`: when battery
    and motors could first not lift the weight any more; `low_s`, `low_m`: when the battery
    was first low under load, and how high the vehicle was then. `hung_m`: height of the
    last hanging.
    """

    effects: tuple[Effect, ...]
    begin_s: float | None
    report_s: float | None
    let_go_s: float | None
    own_landing: bool
    weak_s: float | None
    low_s: float | None
    low_m: float
    hung_m: float | None


@dataclass(frozen=True)
class Excuse:
    """`expected` are the flags that are no fault of the program then."""

    name: str
    when: Callable[[Facts], bool]
    expected: frozenset[Flag]
    reason: str


def _flags(*flags: Flag) -> frozenset[Flag]:
    return frozenset(flags)


def _mute_s(facts: Facts) -> float:
    """For how long nothing of the program reached the vehicle, at most."""
    lasting = [0.0]
    for effect in facts.effects:
        match effect:
            case Killed():
                lasting.append(float("inf"))
            case Suspended(for_s) | Silence(for_s, up=True):
                lasting.append(for_s)
    return max(lasting)


def _is_cut(facts: Facts) -> bool:
    return facts.begin_s is not None and _mute_s(facts) >= CUT_S and not facts.own_landing


def _killed_in_landing(facts: Facts) -> bool:
    killed = any(isinstance(effect, Killed) for effect in facts.effects)
    return facts.begin_s is not None and killed and facts.own_landing


def _stopped_by_operator(facts: Facts) -> bool:
    begun = facts.begin_s is not None
    return begun and any(
        isinstance(effect, Operator) and _is_double(effect.presses_s) for effect in facts.effects
    )


def _is_double(presses_s: tuple[float, ...]) -> bool:
    """A second press, later than the repetitions of a key held down."""
    if len(presses_s) < 2:
        return False
    return presses_s[-1] - presses_s[0] > AGAIN_S and presses_s[-1] - presses_s[-2] > HELD_S


def _lets_go_later(facts: Facts) -> bool:
    let_go = any(isinstance(effect, MagnetLetsGo) for effect in facts.effects)
    after = facts.report_s is not None and facts.let_go_s is not None
    return let_go and after and (facts.let_go_s or 0.0) >= (facts.report_s or 0.0)


def _too_low_to_catch(facts: Facts) -> bool:
    weak = any(isinstance(effect, (MagnetHolds, MagnetLetsGo)) for effect in facts.effects)
    return weak and facts.hung_m is not None and facts.hung_m < CATCHABLE_M


def _sags_too_fast(facts: Facts) -> bool:
    if facts.weak_s is None:
        return False
    down_s = NOTICED_S + facts.low_m / DOWN_MPS
    return facts.low_s is None or facts.weak_s - facts.low_s < down_s


CUT = Excuse(
    "cut by the firmware", _is_cut, _flags("fell", "locked_needlessly"),
    "2 s after the last setpoint the firmware cuts the motors and locks; nothing that the "
    "program sends arrives any more",
)  # fmt: skip
LEFT_LANDING = Excuse(
    "lands alone", _killed_in_landing, _flags("flies_on"),
    "the vehicle flies its own landing to the end without the program: it comes down, softly",
)  # fmt: skip
OPERATOR_STOPS = Excuse(
    "the operator's word", _stopped_by_operator, _flags("fell", "locked_needlessly"),
    "a second Ctrl-C is an emergency stop: it cuts the motors and locks",
)  # fmt: skip
LETS_GO_LATER = Excuse(
    "let go after the flight", _lets_go_later, _flags("fell"),
    "the whole weight has hung for the time it was watched; the program is no longer there "
    "when the magnet lets go",
)  # fmt: skip
TOO_LOW = Excuse(
    "too low to catch", _too_low_to_catch, _flags("fell"),
    "a fall from standing motors takes up to 0.8 m to catch; it hung lower than 1 m",
)  # fmt: skip
NO_LIFT = Excuse(
    "too weak to hover", lambda facts: facts.weak_s is not None, _flags("fell"),
    "what battery and motors can lift is less than the weight: four times what the weak motor "
    "gives, for with more of the others it turns over",
)  # fmt: skip
SAGS_TOO_FAST = Excuse(
    "sags too fast", _sags_too_fast, _flags("fell"),
    "from the voltage at which it lands to the one that does not lift the weight any more it "
    "has less time than the way down takes",
)  # fmt: skip

EXCUSES = (
    CUT, LEFT_LANDING, OPERATOR_STOPS, LETS_GO_LATER, TOO_LOW, NO_LIFT, SAGS_TOO_FAST,
)  # fmt: skip
