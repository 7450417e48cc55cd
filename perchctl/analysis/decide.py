"""A flight decided again: the recorded observations through the planner.

The planner is pure, so the same observations and the same profile have to give the same
commands, to the bit.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from perchctl.errors import InvalidValue
from perchctl.mission import Observation, PlannerState, Turn, step_mission
from perchctl.profile import Profile
from perchctl.record import FlightLog, to_exact
from perchctl.vehicle import Command


@dataclass(frozen=True, eq=False)
class Decided:
    """One turn, decided again: `state` and `command` are the replay's, what was flown is in
    `turn`. `tick` counts the turns that were flown, from 0. `error` names what the planner raised:
    then the state is the one before, None at the first turn, and there is no command."""

    tick: int
    turn: Turn
    observation: Observation
    state: PlannerState | None
    command: Command | None
    error: str | None = None

    @property
    def differs(self) -> bool:
        return self.difference is not None

    @cached_property
    def difference(self) -> tuple[str, Any, Any] | None:
        """The first field in which the turn differs; None without one. Where the planner raised,
        that is what it raised; a log before version 4 does not hold that, and has no difference."""
        turn, state = self.turn, self.state
        if turn.role == "failed" or self.error is not None:
            return first_differing("error", turn.error, self.error)
        if turn.command is None or state is None:
            return None
        told: tuple[tuple[str, Any, Any], ...] = ()
        if turn.reason is not None:
            told = (
                ("outcome", turn.outcome, state.outcome),
                ("reason", turn.reason, state.reason),
            )
        return next(
            (
                found
                for name, recorded, replayed in (
                    ("phase", turn.phase, state.phase),
                    ("row", turn.row, state.row),
                    ("held", turn.held, bool(state.hold)),
                    ("attempts", turn.attempts, state.attempts),
                    ("command", turn.command, self.command),
                    *told,
                )
                if (found := first_differing(name, recorded, replayed)) is not None
            ),
            None,
        )


def whole_turns(log: FlightLog) -> tuple[list[Turn], str]:
    """Return what can be replayed of a log: its turns up to the first that is missing, and a
    sentence about that one, empty where none is. Errors: InvalidValue."""
    if not log.turn_records:
        raise InvalidValue(_why_no_turns(log))
    for number, turn in enumerate(log.turns):
        if turn.number != number:
            return log.turns[:number], (
                f"turn {number} is not in the log, which has lost records: what came after it "
                f"cannot be replayed"
            )
    return log.turns, ""


def decide(
    turns: Iterable[Turn],
    profile: Profile,
    seen: Callable[[Turn], Observation | None] = lambda turn: turn.observation,
) -> Iterator[Decided]:
    """Decide each turn of the planner in order, with the observation that `seen` gives for it: by
    default the recorded one. A turn that was decided anew is decided, but does not count. The one
    on which the planner raises is the last, in a flight as here."""
    state: PlannerState | None = None
    tick = 0
    for turn in turns:
        obs = seen(turn)
        if obs is None or turn.role == "waiting":
            continue
        try:
            new, command = step_mission(state, obs, profile)
        except Exception as error:
            yield Decided(tick, turn, obs, state, None, type(error).__name__)
            return  # what came after it cannot be decided
        yield Decided(tick, turn, obs, new, command)
        if turn.role == "flown":
            state, tick = new, tick + 1


def first_of(decided: Iterable[Decided], t0_s: float) -> Difference | None:
    """Return the first turn that was decided otherwise than it was flown; None without one."""
    for each in decided:
        found = each.difference
        if found is not None:
            return Difference(each.tick, each.turn.t_s - t0_s, *found)
    return None


def _why_no_turns(log: FlightLog) -> str:
    made_by = f"perchctl {log.header.get('perchctl', 'of unknown version')}"
    if log.header.get("version") in (1, 2):
        return (
            f"{log.path}: {made_by} wrote it, which did not record whole turns: it cannot be "
            f"replayed (perchctl log show and log plot read it)"
        )
    return f"{log.path}: it holds no turn of a flight: there is nothing to replay"


# --- True if two values are the same to the bit, and in which field they first are not ----------


@dataclass(frozen=True)
class Difference:
    """The first difference of a replay from its flight.

    `tick` counts the turns from take-off from 0, as the log's ticks do; of a turn before that
    it is negative. `t_s`: since the log began. `recorded`, `replayed`: as JSON has them.
    """

    tick: int
    t_s: float
    field: str
    recorded: Any
    replayed: Any


def first_differing(name: str, one: Any, other: Any) -> tuple[str, Any, Any] | None:
    """Return the first differing field's whole name, and both values in their exact form; None
    where nothing differs."""
    if same(one, other):
        return None
    parts: list[tuple[str, Any, Any]] = []
    if dataclasses.is_dataclass(one) and type(one) is type(other):
        names = [f.name for f in dataclasses.fields(one)]
        parts = [(f"{name}.{n}", getattr(one, n), getattr(other, n)) for n in names]
    elif isinstance(one, dict) and isinstance(other, dict):
        keys = [*one, *(key for key in other if key not in one)]
        parts = [(f"{name}.{_key(k)}", one.get(k), other.get(k)) for k in keys]
    elif _is_row(one) and _is_row(other) and len(one) == len(other):
        pairs = zip(one, other, strict=True)
        parts = [(f"{name}[{k}]", a, b) for k, (a, b) in enumerate(pairs)]
    within = next((d for part in parts if (d := first_differing(*part)) is not None), None)
    return within or (name, _shown(one), _shown(other))


def same(one: Any, other: Any) -> bool:
    """True if both are the same to the bit: 0.0 is not -0.0, and NaN is NaN. Two kinds of command
    without a field are two."""
    if dataclasses.is_dataclass(one) and type(one) is not type(other):
        return False
    return json.dumps(to_exact(one)) == json.dumps(to_exact(other))


def _is_row(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return isinstance(value, (list, tuple))


def _key(key: Any) -> str:
    return str(getattr(key, "value", key))


def _shown(value: Any) -> Any:
    exact = to_exact(value)
    if dataclasses.is_dataclass(value):  # which of several is the difference
        return {type(value).__name__: exact}
    return exact
