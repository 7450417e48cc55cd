"""Replay the decisions of a flight: pass the recorded observations to the planner again.

The planner is pure, so the same observations and the same profile must give the same commands. The
commands are bit-identical on the computer that ran the flight, and equal within a tolerance on any
other, whose libraries may round differently. A turn is one iteration of the flight loop.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from perchctl.errors import InvalidValue
from perchctl.mission import Observation, PlannerState, TickRecord, load_table, step_mission
from perchctl.profile import Profile
from perchctl.record import FlightLog, log_names, to_exact_json
from perchctl.vehicle import Command

FieldDifference = tuple[str, Any, Any]
"""The full name of a field, and its recorded and replayed values in exact form."""


@dataclass(frozen=True, eq=False)
class ReplayedDecision:
    """Result of replaying the planner for one turn (one iteration of the flight loop).

    Attributes:
        tick: number of turns flown before this one.
        difference: first field that differs from the log; None if there is none.
        error: class name of the exception that the planner raised, or None.
    """

    tick: int
    turn: TickRecord
    difference: FieldDifference | None
    error: str | None = None


def turns_and_gap_text(log: FlightLog) -> tuple[list[TickRecord], str]:
    """The turns up to the first one that is missing from the log, and a sentence that names the
    missing turn or says that the last turns may be missing (empty if the log is complete). Errors:
    InvalidValue."""
    if not log.turn_records:
        made_by = f"perchctl {log.header.get('perchctl', 'of unknown version')}"
        raise InvalidValue(
            f"{log.path}: contains no complete tick, so it cannot be replayed; {made_by} wrote "
            f"it in log version {log.header.get('version')}, and a replay needs version 3 or "
            "later"
        )
    for number, turn in enumerate(log.turns):
        if turn.number != number:
            return log.turns[:number], (
                f"tick record {number} is missing from the log: the flight cannot be replayed "
                "beyond it"
            )
    problem = (log.summary or {}).get("problem")
    if problem:
        return log.turns, (
            f"records are missing from the log ({problem}): they may include ticks after the "
            "last one in the log, which cannot be replayed"
        )
    return log.turns, ""


def replay_decisions(
    turns: Iterable[TickRecord],
    profile: Profile,
    observation_of: Callable[[TickRecord], Observation | None] = lambda turn: turn.observation,
    comparison: Comparison | None = None,
) -> Iterator[ReplayedDecision]:
    """Replay the planner turn by turn.

    `observation_of` returns a turn's observation (default: as recorded), or None to skip the turn.
    Only turns that were flown advance the planner's state. Like a flight, the replay ends at the
    first turn in which the planner raises an exception. By default, `comparison` compares values
    bit for bit.
    """
    comparison = comparison or Comparison()
    state: PlannerState | None = None
    table, tick = load_table(profile.planner.rows), 0
    for turn in turns:
        obs = observation_of(turn)
        if obs is None or turn.role == "waiting":
            continue
        try:
            new, command = step_mission(state, obs, profile, table)
        except Exception as error:
            name = type(error).__name__
            differs = None
            if turn.role != "failed" or ("Turn", "error") not in comparison.unknown:
                differs = comparison.difference("error", turn.planner_exception_name, name)
            yield ReplayedDecision(tick, turn, differs, name)
            return  # later turns cannot be replayed
        yield ReplayedDecision(tick, turn, _difference(turn, new, command, comparison))
        if turn.role == "flown":
            state, tick = new, tick + 1


def _difference(
    turn: TickRecord, state: PlannerState, command: Command, comparison: Comparison
) -> FieldDifference | None:
    if turn.role == "failed":
        return comparison.difference("error", turn.planner_exception_name, None)
    if turn.command is None:
        return None
    replayed = {
        "phase": state.phase,
        "transition_name": state.transition_name,
        "is_holding_position": bool(state.hold_reason),
        "failed_attempts": state.failed_attempts,
        "command": command,
        "outcome": state.outcome,
        "reason": state.transition_reason,
    }
    logged = log_names(TickRecord)
    return comparison.first_difference(
        (logged.keys[n], getattr(turn, n), value)
        for n, value in replayed.items()
        if (logged.owner, logged.keys[n]) not in comparison.unknown
    )


# --- Find the first field in which two values differ ---


@dataclass(frozen=True)
class Comparison:
    """How recorded and replayed values are compared: by default bit for bit, so that 0.0 differs
    from -0.0, and NaN equals NaN.

    Attributes:
        unknown: fields that are not compared, each given as (dataclass name, field name).
        tolerances: permitted difference for the numbers in a field, in the field's unit, keyed by
            field name; the empty name stands for all other fields.

    The names of dataclasses and fields are those used in the log.
    """

    unknown: Collection[tuple[str, str]] = ()
    tolerances: Mapping[str, float] = field(default_factory=dict)

    def difference(self, name: str, recorded: Any, replayed: Any) -> FieldDifference | None:
        """Return the first subfield of the field `name` in which the two values differ, or None.

        If the two values have different classes, they are returned whole, as text that names the
        class.
        """
        if type(recorded) is not type(replayed):
            return name, _shown(recorded), _shown(replayed)
        one, other = to_exact_json(recorded), to_exact_json(replayed)
        if json.dumps(one) == json.dumps(other):
            return None
        parts: list[FieldDifference]
        if dataclasses.is_dataclass(recorded):
            logged = log_names(recorded.__class__)
            parts = [
                (f"{name}.{key}", getattr(recorded, n), getattr(replayed, n))
                for n, key in logged.keys.items()
                if (logged.owner, key) not in self.unknown
            ]
        elif isinstance(recorded, dict):
            keys = {**recorded, **replayed}
            parts = [(f"{name}.{key}", recorded.get(key), replayed.get(key)) for key in keys]
        elif isinstance(recorded, (tuple, list, np.ndarray)) and len(recorded) == len(replayed):
            parts = [(f"{name}[{k}]", recorded[k], replayed[k]) for k in range(len(recorded))]
        elif isinstance(recorded, float) and abs(recorded - replayed) <= self._tolerance(name):
            return None
        else:
            return name, one, other
        return self.first_difference(parts)

    def first_difference(self, fields: Iterable[FieldDifference]) -> FieldDifference | None:
        """Return the first difference among `fields` (name, recorded value, replayed value), or
        None."""
        found = (self.difference(*each) for each in fields)
        return next((difference for difference in found if difference is not None), None)

    def _tolerance(self, name: str) -> float:
        last = name.rpartition(".")[2].partition("[")[0]
        to_the_bit = -1.0  # a negative tolerance, so that even 0.0 and -0.0 differ
        return self.tolerances.get(last, self.tolerances.get("", to_the_bit))


def _shown(value: Any) -> Any:
    exact = to_exact_json(value)
    return {type(value).__name__: exact} if dataclasses.is_dataclass(value) else exact
