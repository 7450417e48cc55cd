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
from perchctl.mission import Observation, PlannerState, Turn, step_mission
from perchctl.profile import Profile
from perchctl.record import FlightLog, to_exact_json
from perchctl.vehicle import Command

FieldDifference = tuple[str, Any, Any]
"""The whole name of a field, and its recorded and replayed value in their exact form."""


@dataclass(frozen=True, eq=False)
class ReplayedDecision:
    """Result of replaying the planner on one turn.

    Attributes:
        tick: number of turns that were flown before it.
        difference: the first field in which it differs; None without one. A log before version 4
            does not hold what the planner raised and has no difference there.
        error: the name of what the planner raised, None where it did not.
    """

    tick: int
    turn: Turn
    difference: FieldDifference | None
    error: str | None = None


def replayable_turns(log: FlightLog) -> tuple[list[Turn], str]:
    """Return a log's turns up to a gap, and a sentence on it, else empty. Errors: InvalidValue."""
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
    seen: Callable[[Turn], Observation | None] = lambda turn: turn.observation,
) -> Iterator[ReplayedDecision]:
    """Replay the planner turn by turn on the observations that `seen` returns, by default the
    recorded ones. Only flown turns advance its state. It ends where the planner raises."""
    state: PlannerState | None = None
    tick = 0
    for turn in turns:
        obs = seen(turn)
        if obs is None or turn.role == "waiting":
            continue
        try:
            new, command = step_mission(state, obs, profile)
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


def field_difference(name: str, one: Any, other: Any) -> FieldDifference | None:
    """Return the first differing field, or None; two kinds of command are shown as a whole."""
    if type(one) is not type(other):
        return name, _shown(one), _shown(other)
    return _first_differing(name, to_exact_json(one), to_exact_json(other))


def first_field_difference(fields: Iterable[FieldDifference]) -> FieldDifference | None:
    """Return the first difference among the fields; None without one."""
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
