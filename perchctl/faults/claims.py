"""What the program says at its end, as claims that can be true or false of a vehicle.

A flight ends by a row of the mission's table, in a phase, with an outcome; each of the three
becomes a sentence or an exit code that somebody acts on, and each claims something. They are found
by name, not by the wording of the sentence.
"""

from __future__ import annotations

from typing import Literal

from perchctl.flight import RESCUED
from perchctl.mission import RESCUE, Event, EventKind, Finding, FlightReport, Outcome, Phase

Claim = Literal[
    "hangs on the target", "held off the target", "hangs", "stands", "hangs or stands",
    "motors off", "locked", "ended by the supervisor", "tilted", "not seen down",
]  # fmt: skip
"""A claim of hanging or standing includes that the motors are off. `not seen down` claims that
no telemetry has shown the vehicle at rest with its motors off."""
Claims = set[Claim]
ROW_CLAIMS: dict[str, Claims] = {
    "operator-stop": {"motors off"},
    "hung-but-locked": {"hangs", "locked"},
    "locked": {"locked", "motors off"},
    "tumbled": {"ended by the supervisor", "motors off"},
    "crashed": {"ended by the supervisor", "motors off"},
    "tilted": {"tilted", "motors off"},
    "perched": {"hangs on the target"},
    "hung": {"hangs"},
    "landed": {"stands"},
    "held-elsewhere": {"held off the target"},
    "hangs-or-stands": {"hangs or stands"},
    "landing-timeout": {"not seen down"},
}
"""The claims in the sentence of each transition that ends a flight."""
PHASE_CLAIMS: dict[Phase, Claims] = {Phase.PERCHED: {"hangs"}, Phase.LANDED: {"stands"}}
OUTCOME_CLAIMS: dict[Outcome, Claims] = {
    Outcome.PERCHED: {"hangs on the target"},
    Outcome.TARGET_NOT_FOUND: {"stands"},
    Outcome.ATTEMPTS_USED_UP: {"hangs or stands"},
    Outcome.SAFETY: set(),
    Outcome.EMERGENCY: {"motors off"},
    Outcome.OPERATOR: {"hangs or stands"},
}
"""The claims in the meaning of each outcome's exit code (`perchctl.errors.EXIT_CODES`)."""
NOT_KNOWN, UNCONFIRMED = "hangs-or-stands", "landing-timeout"
HELD_ELSEWHERE = "held-elsewhere"
"""The transitions of flights whose end the program does not know: whether the vehicle hangs or
stands, and whether it came down at all."""
RESCUE_CLAIMS: dict[Finding | None, Claims] = {
    Finding.STANDS: {"stands"},
    Finding.HANGS: {"hangs"},
    Finding.HELD: {"held off the target"},
    Finding.UNKNOWN: {"hangs or stands"},
    None: {"not seen down"},
}
"""The claims in the note of a rescue, by its finding."""
REFUSAL_CLAIMS: Claims = {"stands"}
"""A refusal claims that no motor was started."""


def last_row(report: FlightReport) -> str:
    """Return the name of the transition that ended the flight; empty without one."""
    return report.history[-1].row if report.history else ""


def claims_of(report: FlightReport) -> Claims:
    """Return all claims that a report makes about the vehicle."""
    claims = ROW_CLAIMS.get(last_row(report), set()) | PHASE_CLAIMS.get(report.phase, set())
    locked: Claims = {"locked"} if report.locked else set()
    return claims | OUTCOME_CLAIMS[report.outcome] | locked


def claims_of_rescue(event: Event) -> Claims:
    """Return the claims of a rescue's note; none for any other event."""
    if event.kind is not EventKind.NOTE or RESCUE not in event.reason:
        return set()
    found = next(found for found, text in RESCUED.items() if event.reason.endswith(text))
    return RESCUE_CLAIMS[found]
