"""What the program says at its end, as claims that can be true or false of a vehicle.

A flight ends by a row of the mission's table, in a phase, with an outcome; each of the three
becomes a sentence or an exit code that somebody acts on, and each claims something. They are found
by name, not by the wording of the sentence.
"""

from __future__ import annotations

from typing import Literal

from perchctl.mission import Event, Finding, FlightReport, Outcome, Phase

Claim = Literal[
    "hangs on the target", "held off the target", "hangs", "stands", "hangs or stands",
    "motors off", "locked", "ended by the supervisor", "tilted", "not seen down",
]  # fmt: skip
"""A claim of hanging or standing includes that the motors are off. `not seen down` claims that
no telemetry has shown the vehicle at rest with its motors off."""


def _claims(*claims: Claim) -> frozenset[Claim]:
    return frozenset(claims)


ROW_CLAIMS: dict[str, frozenset[Claim]] = {
    "operator-stop": _claims("motors off"),
    "hung-but-locked": _claims("hangs", "locked"),
    "locked": _claims("locked", "motors off"),
    "tumbled": _claims("ended by the supervisor", "motors off"),
    "crashed": _claims("ended by the supervisor", "motors off"),
    "tilted": _claims("tilted", "motors off"),
    "perched": _claims("hangs on the target"),
    "hung": _claims("hangs"),
    "landed": _claims("stands"),
    "held-elsewhere": _claims("held off the target"),
    "hangs-or-stands": _claims("hangs or stands"),
    "landing-timeout": _claims("not seen down"),
}
"""The claims in the sentence of each transition that ends a flight."""
PHASE_CLAIMS = {Phase.PERCHED: _claims("hangs"), Phase.LANDED: _claims("stands")}
OUTCOME_CLAIMS: dict[Outcome, frozenset[Claim]] = {
    Outcome.PERCHED: _claims("hangs on the target"),
    Outcome.TARGET_NOT_FOUND: _claims("stands"),
    Outcome.ATTEMPTS_USED_UP: _claims("hangs or stands"),
    Outcome.SAFETY: _claims(),
    Outcome.EMERGENCY: _claims("motors off"),
    Outcome.OPERATOR: _claims("hangs or stands"),
}
"""The claims in the meaning of each outcome's exit code (`perchctl.errors.EXIT_CODES`)."""
NOT_KNOWN, UNCONFIRMED = "hangs-or-stands", "landing-timeout"
HELD_ELSEWHERE = "held-elsewhere"
"""The transitions of flights whose end the program does not know: whether the vehicle hangs or
stands, and whether it came down at all."""
RESCUE_CLAIMS: dict[Finding, frozenset[Claim]] = {
    Finding.STANDS: _claims("stands"),
    Finding.HANGS: _claims("hangs"),
    Finding.HELD: _claims("held off the target"),
    Finding.UNKNOWN: _claims("hangs or stands"),
    Finding.UNSEEN: _claims("not seen down"),
}
"""The claims in the note of a rescue, by its finding."""
REFUSAL_CLAIMS = _claims("stands")
"""A refusal claims that no motor was started."""


def last_row(report: FlightReport) -> str:
    """Return the name of the transition that ended the flight; empty without one."""
    return report.history[-1].row if report.history else ""


def claims_of(report: FlightReport) -> frozenset[Claim]:
    """Return all claims that a report makes about the vehicle."""
    return frozenset().union(
        ROW_CLAIMS.get(last_row(report), frozenset()),
        PHASE_CLAIMS.get(report.phase, frozenset()),
        OUTCOME_CLAIMS[report.outcome],
        _claims("locked") if report.locked else _claims(),
    )


def claims_of_rescue(event: Event) -> frozenset[Claim]:
    """Return the claims of a rescue's note; none for any other event."""
    if not event.is_rescue:
        return _claims()
    found = next(found for found in Finding if found.value in event.reason)
    return RESCUE_CLAIMS[found]
