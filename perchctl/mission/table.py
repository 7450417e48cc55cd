"""The mission as one ordered table: the first matching row wins, and safety rows come first.

The diagram and the table in docs/mission.md are generated from `TABLE`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Set
from dataclasses import replace
from inspect import isfunction
from typing import TypeVar

from perchctl.errors import InvalidValue
from perchctl.extensions import error_at, load_extension
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.phase import PRE_CONTACT_PHASES, PRE_LANDING_PHASES, Outcome, Phase, Severity
from perchctl.mission.phases.align import ALIGN
from perchctl.mission.phases.approach import APPROACH
from perchctl.mission.phases.ascend import ASCEND
from perchctl.mission.phases.complete import COMPLETE
from perchctl.mission.phases.estimate import ESTIMATE
from perchctl.mission.phases.final import ABORTED, LANDED, PERCHED
from perchctl.mission.phases.hover import HOVER
from perchctl.mission.phases.landing import LANDING
from perchctl.mission.phases.perch import PERCH
from perchctl.mission.phases.recover import RECOVER
from perchctl.mission.phases.search import SEARCH
from perchctl.mission.safety import SAFETY_ROWS
from perchctl.mission.transition import Transition

Returned = TypeVar("Returned")

PHASES: dict[Phase, PhaseDefinition] = {
    each.phase: each
    for each in (
        APPROACH,
        SEARCH,
        ESTIMATE,
        ALIGN,
        ASCEND,
        PERCH,
        COMPLETE,
        RECOVER,
        HOVER,
        LANDING,
        PERCHED,
        LANDED,
        ABORTED,
    )
}
"""Definition of each phase."""
EXIT_ROWS: tuple[Transition, ...] = tuple(row for phase in PHASES.values() for row in phase.exits)
"""The phases' own rows, in the order of `PHASES`."""
TABLE: tuple[Transition, ...] = (*SAFETY_ROWS, *EXIT_ROWS)
"""The built-in table: safety rows first, then the exits of the phases."""
PHASE_TIMED_CONDITIONS = tuple(each for phase in PHASES.values() for each in phase.timed_conditions)
"""The phases' own conditions; `update_belief` updates those of the belief."""


def find_first_matching_transition(
    c: Context, table: tuple[Transition, ...] = TABLE
) -> Transition | None:
    """Return the row of `table` that decides this tick; None if no row applies, so that the mission
    stays in its phase. A row applies if the present phase is one of its phases and its `when` is
    true. Once the mission is landing, rows to a phase before the landing are skipped.

    The first row that applies decides, unless it makes the mission wait in its phase. A wait delays
    only normal progress (severity `CONTINUE`): the first later row that applies, has a higher
    severity and is not a wait itself then decides instead, if there is one.
    """
    landing, phase = c.state.severity >= Severity.LAND, c.state.phase
    waits: Transition | None = None
    for row in table:
        undoes = landing and row.to in PRE_LANDING_PHASES
        goes_on = waits is not None and row.severity is Severity.CONTINUE
        if undoes or goes_on or phase not in row.phases or not row.when(c):
            continue
        if not row.keeps_mission_in(phase):
            return row
        waits = waits or row
    return waits


# --- Your own rows ---


TRANSITIONS_ALLOWED_FOR_USER_ROWS = frozenset(
    (phase, row.to, row.severity)
    for row in TABLE
    for phase in row.phases & PRE_CONTACT_PHASES - {row.to}
    if row.severity >= Severity.HOLD and not row.to.is_final
) | {(Phase.ALIGN, Phase.ALIGN, Severity.HOLD)}
"""Combinations of phase, next phase and severity allowed for your own rows: wait in ALIGN, or
interrupt the mission as the built-in table does. None of these transitions makes the vehicle climb,
stops a motor, or proves a contact."""


def add_rows(
    rows: Iterable[Transition], table: tuple[Transition, ...] = TABLE
) -> tuple[Transition, ...]:
    """Return the table with your own rows, in their order, after all safety rows and before the
    exits of the phases.

    A row of your own may wait in ALIGN, or lead to an earlier phase, to RECOVER or to LANDING
    (`TRANSITIONS_ALLOWED_FOR_USER_ROWS`). Your own rows do not apply in COMPLETE and LANDING.
    Raises InvalidValue for a row that is not allowed, is not a valid `Transition`, or has a name
    that is taken. If a function of a row raises in flight, InvalidValue names the row, and the
    vehicle lands.
    """
    names, own = {row.name for row in table}, list[Transition]()
    for row in rows if isinstance(rows, Iterable) else (rows,):
        _check_row_types(row)
        if row.name in names:
            raise InvalidValue(f"row {row.name!r}: another row has that name; rename it")
        names.add(row.name)
        for phase in row.phases:
            if (phase, row.to, row.severity) not in TRANSITIONS_ALLOWED_FOR_USER_ROWS:
                may = sorted(
                    f"{to.name} ({how.name})"
                    for at, to, how in TRANSITIONS_ALLOWED_FOR_USER_ROWS
                    if at is phase
                )
                raise InvalidValue(
                    f"row {row.name!r} leads from {phase.name} to {row.to.name} "
                    f"({row.severity.name}); allowed from {phase.name}: {', '.join(may) or 'none'}"
                )
        if row.stop_command is not None or row.outcome is not None or row.diagnosis:
            raise InvalidValue(f"row {row.name!r} must not set stop_command, outcome or diagnosis")
        outcome = Outcome.SAFETY if row.to is Phase.LANDING else None
        when, reason = (
            _wrap_errors_with_row_name(row.name, row.when),
            _wrap_errors_with_row_name(row.name, row.reason_text),
        )
        phases = frozenset(row.phases)  # an immutable copy, so that it cannot change in flight
        own.append(replace(row, phases=phases, when=when, reason=reason, outcome=outcome))
    at = next(i for i, row in enumerate(table) if row in EXIT_ROWS)
    return (*table[:at], *own, *table[at:])


def _check_row_types(row: object) -> None:
    """Raise InvalidValue unless `row` is a `Transition` whose fields have the right types."""
    if not (
        isinstance(row, Transition)
        and isinstance(row.phases, Set)
        and row.phases
        and all(isinstance(phase, Phase) for phase in (*row.phases, row.to))
        and isinstance(row.severity, Severity)
        and callable(row.when)
        and (isinstance(row.reason, str) or callable(row.reason))
    ):
        raise InvalidValue(
            f"row {getattr(row, 'name', row)!r} must be a Transition in which phases is a set of "
            f"Phase, to is a Phase, severity is a Severity, when is a function, and reason is a "
            f"text or a function"
        )


def _wrap_errors_with_row_name(
    row_name: str, function: Callable[[Context], Returned]
) -> Callable[[Context], Returned]:
    """Return a function that calls `function` and, if that raises an exception, raises InvalidValue
    with the row's name instead. `function` is the `when` or `reason` of your own row called
    `row_name`."""

    def call(c: Context) -> Returned:
        try:
            return function(c)
        except Exception as error:
            raise InvalidValue(f"your own row {row_name!r} raised {error_at(error)}") from error

    return call


def load_table(extension_name: str | None) -> tuple[Transition, ...]:
    """Return the transition table of one flight: the built-in one, extended by your own rows
    (`add_rows`) if the profile's `planner.rows` names them.

    `extension_name`, the value of `planner.rows`, is ``module:attribute`` of the rows, or of a
    function that returns them; with None, the result is the built-in table. Raises NotFound if
    there is no such attribute, and InvalidValue if the function raises an exception or `add_rows`
    rejects a row.
    """
    if extension_name is None:
        return TABLE
    own = load_extension(extension_name, "planner.rows")
    try:
        # The profile in a log may name any object, so only a function is called.
        own = own() if isfunction(own) else own
    except Exception as error:
        raise InvalidValue(f"planner.rows: {extension_name} raised {error_at(error)}") from error
    return add_rows(own)
