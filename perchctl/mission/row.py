"""One row of the mission's table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from perchctl.mission.context import Context
from perchctl.mission.state import MotorStop, Outcome, Phase, Severity

Guard = Callable[[Context], bool]


@dataclass(frozen=True, eq=False)
class Row:
    """From any of `phases`, when `when` holds, to `to`.

    `reason` is shown to the user; `motor_stop` is what a row into ABORTED does to the motors.
    """

    name: str
    phases: frozenset[Phase]
    when: Guard
    to: Phase
    reason: str | Callable[[Context], str]
    severity: Severity = Severity.CONTINUE
    outcome: Outcome | None = None
    counts_attempt: bool = False
    motor_stop: MotorStop = MotorStop.NONE

    def explain(self, c: Context) -> str:
        return self.reason if isinstance(self.reason, str) else self.reason(c)


def risen(before: Severity, row: Severity) -> Severity:
    """The flight's severity after a row: from `LAND` on it only rises."""
    return max(before, row) if before >= Severity.LAND else row
