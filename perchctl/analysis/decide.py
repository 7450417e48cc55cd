"""A flight decided again: the recorded observations through the planner.

The planner is pure, so the same observations and the same profile have to give the same
commands, to the bit.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from perchctl.errors import InvalidValue
from perchctl.mission import Observation, PlannerState, Turn, step_mission, table_of
from perchctl.profile import Profile
from perchctl.record import FlightLog, to_exact_json
from perchctl.vehicle import Command

FieldDifference = tuple[str, Any, Any]
"""The whole name of a field, and its recorded and replayed value in their exact form."""


@dataclass(frozen=True, eq=False)
class ReplayedDecision:
    """Result of replaying the planner on one turn.

    Attributes:
        tick: number of flown turns before this turn.
        difference: first field that differs from the log, or None. The planner's exceptions are not
            compared for logs before version 4, which do not hold them.
        error: class name of the exception that the planner raised, or None.
    """

    tick: int
    turn: Turn
    difference: FieldDifference | None
    error: str | None = None


def turns_and_gap_text(log: FlightLog) -> tuple[list[Turn], str]:
    """The turns before the first turn missing from the log, and a sentence that names the
    missing turn (empty if none is missing). Errors: InvalidValue."""
    if not log.turn_records:
        made_by = f"perchctl {log.header.get('perchctl', 'of unknown version')}"
        raise InvalidValue(
            f"{log.path}: it holds no whole turn of a flight and cannot be replayed; {made_by} "
            f"wrote it, in version {log.header.get('version')}, and turns are written since 3"
        )
    for number, turn in enumerate(log.turns):
        if turn.number != number:
            return log.turns[:number], (
                f"turn {number} is not in the log, which has lost records: what came after it "
                f"cannot be replayed"
            )
    return log.turns, ""


def replay_decisions(
    turns: Iterable[Turn],
    profile: Profile,
    observation_of: Callable[[Turn], Observation | None] = lambda turn: turn.observation,
) -> Iterator[ReplayedDecision]:
    """Replay the planner turn by turn.

    `observation_of` returns a turn's observation (default: as recorded), or None to skip the turn.
    Only flown turns advance the planner's state. The replay ends with the first turn on which the
    planner raises, as a flight does.
    """
    state: PlannerState | None = None
    table, tick = table_of(profile.planner.rows), 0
    for turn in turns:
        obs = observation_of(turn)
        if obs is None or turn.role == "waiting":
            continue
        try:
            new, command = step_mission(state, obs, profile, table)
        except Exception as error:
            name = type(error).__name__
            yield ReplayedDecision(tick, turn, field_difference("error", turn.error, name), name)
            return  # what came after it cannot be decided
        yield ReplayedDecision(tick, turn, _difference(turn, new, command))
        if turn.role == "flown":
            state, tick = new, tick + 1


def _difference(turn: Turn, state: PlannerState, command: Command) -> FieldDifference | None:
    if turn.role == "failed":
        return field_difference("error", turn.error, None)
    if turn.command is None:
        return None
    replayed = {
        "phase": state.phase,
        "row": state.row,
        "held": bool(state.hold),
        "attempts": state.attempts,
        "command": command,
    }
    if turn.reason is not None:  # not in a log before version 4
        replayed |= {"outcome": state.outcome, "reason": state.reason}
    return first_field_difference((n, getattr(turn, n), value) for n, value in replayed.items())


# --- In which field two values first differ, to the bit: 0.0 is not -0.0, and NaN is NaN ---


def field_difference(name: str, recorded: Any, replayed: Any) -> FieldDifference | None:
    """The first subfield of field `name` in which its two values differ, or None.

    Values of different classes are returned whole, as text with their class.
    """
    if type(recorded) is not type(replayed):
        return name, _shown(recorded), _shown(replayed)
    return _first_differing(name, to_exact_json(recorded), to_exact_json(replayed))


def first_field_difference(fields: Iterable[FieldDifference]) -> FieldDifference | None:
    """The first difference among fields (name, recorded and replayed value), or None."""
    return next((d for field in fields if (d := field_difference(*field)) is not None), None)


def _first_differing(name: str, one: Any, other: Any) -> FieldDifference | None:
    if json.dumps(one) == json.dumps(other):
        return None
    parts: list[FieldDifference] = []
    if isinstance(one, dict) and isinstance(other, dict):
        parts = [(f"{name}.{key}", one.get(key), other.get(key)) for key in {**one, **other}]
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        pairs = zip(one, other, strict=True)
        parts = [(f"{name}[{k}]", a, b) for k, (a, b) in enumerate(pairs)]
    within = next((d for part in parts if (d := _first_differing(*part)) is not None), None)
    return within or (name, one, other)


def _shown(value: Any) -> Any:
    exact = to_exact_json(value)
    return {type(value).__name__: exact} if dataclasses.is_dataclass(value) else exact
