"""A row of the mission's table, and constructors for the kinds of rows."""

from __future__ import annotations

from collections.abc import Callable, Set
from dataclasses import dataclass

from perchctl.mission.context import Context
from perchctl.mission.phase import AIRBORNE_PHASES, Outcome, Phase, Severity, VehicleDiagnosis
from perchctl.vehicle import EmergencyStop, StopMotors

Predicate = Callable[[Context], bool]
Reason = str | Callable[[Context], str]
OutcomeAfterTransition = Outcome | Callable[[Outcome | None], Outcome | None]


@dataclass(frozen=True, eq=False)
class Transition:
    """A row of the table: from any of `phases` to the phase `to` if `when` returns True.

    `name` identifies the row in logs. `when` is called with a `Context`. `reason`, a string or a
    function of the context, is shown to the user. `severity` says whether the row is normal
    progress, a hold, the end of an attempt, a landing or a motor stop. `outcome`, a value or a
    function of the previous outcome, says why the flight ends; None keeps the previous outcome.
    `stop_command` is the command that a transition into ABORTED sends at once. `diagnosis` is what
    the row asserts about the vehicle.
    """

    name: str
    phases: Set[Phase]
    when: Predicate
    to: Phase
    reason: Reason
    severity: Severity = Severity.CONTINUE
    outcome: OutcomeAfterTransition | None = None
    stop_command: EmergencyStop | StopMotors | None = None
    diagnosis: VehicleDiagnosis = VehicleDiagnosis.NONE

    def keeps_mission_in(self, phase: Phase) -> bool:
        """True if this row makes a mission in `phase` wait there: it leads to `phase` and has the
        severity HOLD."""
        return self.to is phase and self.severity is Severity.HOLD

    def reason_text(self, c: Context) -> str:
        """Return the reason in words; a `reason` that is a function is called with `c`."""
        return self.reason if isinstance(self.reason, str) else self.reason(c)

    def outcome_after_transition(self, previous_outcome: Outcome | None) -> Outcome | None:
        """Return the flight's outcome after this transition: `previous_outcome` if the row has no
        outcome of its own. None means that no outcome has been decided."""
        if self.outcome is None or isinstance(self.outcome, Outcome):
            return self.outcome or previous_outcome
        return self.outcome(previous_outcome)


def motor_cut_row(
    name: str, when: Predicate, reason: str, outcome: Outcome = Outcome.SAFETY
) -> Transition:
    """Return a row that stops the motors in any airborne phase as soon as `when` is true, and locks
    the vehicle: the firmware then refuses to fly until it is restarted. The other arguments are the
    fields of `Transition`."""
    return _abort_row(name, when, reason, outcome, EmergencyStop())


def supervisor_abort_row(name: str, supervisor_bit: int, reason: str) -> Transition:
    """Return a row called `name` that stops the motors in any airborne phase and ends the flight in
    ABORTED, with the outcome SAFETY, once the firmware's supervisor has set `supervisor_bit`, a bit
    mask such as `perchctl.vehicle.TUMBLED`. `reason` is shown to the user."""

    def when(c: Context) -> bool:
        return c.telemetry.has_bit(supervisor_bit)

    return _abort_row(name, when, reason, Outcome.SAFETY, StopMotors())


def _abort_row(
    name: str,
    when: Predicate,
    reason: str,
    outcome: Outcome,
    stop_command: EmergencyStop | StopMotors,
) -> Transition:
    return Transition(
        name,
        AIRBORNE_PHASES,
        when,
        Phase.ABORTED,
        reason,
        Severity.STOP,
        outcome,
        stop_command=stop_command,
    )


def land_row(
    name: str,
    phases: Set[Phase],
    when: Predicate,
    reason: Reason,
    outcome: Outcome = Outcome.SAFETY,
    diagnosis: VehicleDiagnosis = VehicleDiagnosis.NONE,
) -> Transition:
    """Return a row that ends the mission and starts the landing from any of `phases` once `when` is
    true. The other arguments are the fields of `Transition`."""
    return Transition(
        name, phases, when, Phase.LANDING, reason, Severity.LAND, outcome, diagnosis=diagnosis
    )


def back_off_row(
    name: str,
    phases: Set[Phase],
    when: Predicate,
    reason: Reason,
    diagnosis: VehicleDiagnosis = VehicleDiagnosis.NONE,
) -> Transition:
    """Return a row into RECOVER from any of `phases` once `when` is true. It ends the attempt,
    which counts as failed: the vehicle descends a little and tries again. The other arguments are
    the fields of `Transition`."""
    return Transition(
        name, phases, when, Phase.RECOVER, reason, Severity.BACK_OFF, diagnosis=diagnosis
    )


def abort_during_landing_row(
    name: str, when: Predicate, reason: Reason, diagnosis: VehicleDiagnosis = VehicleDiagnosis.NONE
) -> Transition:
    """Return a row from LANDING to ABORTED, for a landing that could not be confirmed as completed:
    it applies once `when` is true. The row has no stop command of its own; ABORTED stops the motors
    if their thrust has been ramped down or the descent has reached its end. The other arguments are
    the fields of `Transition`."""
    return Transition(
        name,
        {Phase.LANDING},
        when,
        Phase.ABORTED,
        reason,
        Severity.LAND,
        Outcome.SAFETY,
        diagnosis=diagnosis,
    )
