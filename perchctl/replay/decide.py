"""A flight decided again: the recorded observations through the planner.

The planner is pure, so the same observations and the same profile have to give the same
commands, to the bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from perchctl.errors import InvalidValue
from perchctl.log import FlightLog
from perchctl.mission import Observation, PlannerState, Turn, start_mission, step_mission
from perchctl.profile import Profile
from perchctl.replay.compare import Difference, first_differing
from perchctl.vehicle import Command


@dataclass(frozen=True, eq=False)
class Decided:
    """One turn, decided again: `state` and `command` are the replay's, what was flown is in
    `turn`. `tick` counts the turns that were flown, from 0. `error`: the name of what the planner
    raised: then the state is the one before, None at the first turn, and there is no command."""

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
        """The first field in which it does. Of a turn on which the planner raised that is what it
        raised; a log of before version 4 does not tell whether it did, and has none."""
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


@dataclass(frozen=True)
class Whole:
    """The turns of a log up to where the first is missing; `gap` says which, or is empty."""

    turns: Sequence[Turn]
    gap: str = ""


def whole_turns(log: FlightLog) -> Whole:
    """What can be replayed of a log. Errors: InvalidValue."""
    if not log.turn_records:
        raise InvalidValue(_why_no_turns(log))
    for number, turn in enumerate(log.turns):
        if turn.number != number:
            gap = (
                f"turn {number} is not in the log, which has lost records: what came after it "
                f"cannot be replayed"
            )
            return Whole(log.turns[:number], gap)
    return Whole(log.turns)


def decide(
    turns: Iterable[Turn],
    profile: Profile,
    seen: Callable[[Turn], Observation | None] = lambda turn: turn.observation,
) -> Iterator[Decided]:
    """Each turn of the planner, in order, with the observation that `seen` gives for it: by
    default the recorded one. A turn that was decided anew is decided, but does not count; on one
    on which the planner raised it may raise again. Where it raises on another one, that is the
    last."""
    state: PlannerState | None = None
    tick = 0
    for turn in turns:
        obs = seen(turn)
        if obs is None or turn.role == "waiting":
            continue
        if turn.command is None:
            yield _failed_again(tick, turn, obs, state, profile)
            continue
        try:
            new, command = step_mission(state or start_mission(obs), obs, profile)
        except Exception as error:  # what came after it cannot be decided
            yield Decided(tick, turn, obs, state, None, type(error).__name__)
            return
        yield Decided(tick, turn, obs, new, command)
        if turn.role == "flown":
            state, tick = new, tick + 1


def _failed_again(
    tick: int, turn: Turn, obs: Observation, state: PlannerState | None, profile: Profile
) -> Decided:
    try:
        before = state or start_mission(obs)
        new, command = step_mission(before, obs, profile)
    except Exception as error:
        return Decided(tick, turn, obs, state, None, type(error).__name__)
    return Decided(tick, turn, obs, new, command)


def first_of(decided: Iterable[Decided], t0_s: float) -> Difference | None:
    """The first turn that was decided otherwise than it was flown."""
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
