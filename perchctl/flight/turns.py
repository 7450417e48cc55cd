"""Each turn of the loop as a value, for the log; and how long its parts took."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Protocol, runtime_checkable

from perchctl.flight.clock import Clock, SimulatedClock, WallClock
from perchctl.flight.inputs import FlightInputs
from perchctl.mission import (
    ExternalPositions,
    Observation,
    PlannerState,
    Turn,
    TurnTiming,
    Watcher,
)
from perchctl.positioning import FeedStatus
from perchctl.values import replace
from perchctl.vehicle import Command


@runtime_checkable
class TurnWatcher(Watcher, Protocol):
    """A watcher of the turns without a tick, too: before take-off, and those decided anew."""

    def turn(self, turn: Turn) -> None: ...


Decision = tuple[PlannerState, Command, FeedStatus | None]


class Turns:
    """Counts the loop's turns, and reports them to their watchers. In lockstep there are no
    timings: the same seed gives the same turns."""

    def __init__(
        self,
        clock: Clock,
        watchers: Iterable[Watcher],
        wall: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._wall = wall if isinstance(clock, (WallClock, SimulatedClock)) else None
        self._watchers = [w for w in watchers if isinstance(w, TurnWatcher)]
        self._count = 0
        self._began_s = 0.0
        self._laps_s = [0.0]
        self._open: tuple[Observation, Decision | None] | None = None  # observed, not yet reported

    @property
    def are_watched(self) -> bool:
        """True if somebody records them."""
        return bool(self._watchers)

    def begin(self, now_s: float) -> None:
        """Note when a turn of the loop begins."""
        self._began_s, self._laps_s = now_s, []
        self.lap()

    def lap(self) -> None:
        """Note the end of a part of the turn: begun, taken in, decided, sent."""
        if self._wall is not None:
            self._laps_s.append(self._wall())

    def waiting(self, inputs: FlightInputs, now_s: float, outside: FeedStatus | None) -> None:
        """Report a turn before take-off."""
        turn = Turn(
            self._counted(), "waiting", now_s, now_s, inputs.taken, inputs.poses,
            outside=external_positions(outside),
        )  # fmt: skip
        self._report(turn)

    def observed(self, obs: Observation) -> None:
        """Note what the planner is about to decide on."""
        self._open = obs, None

    def decided(
        self, obs: Observation, new: PlannerState, command: Command, outside: FeedStatus | None
    ) -> None:
        """Note that the planner has decided: what fails from now on is not its fault."""
        self._open = obs, (new, command, outside)

    def redone(
        self, inputs: FlightInputs, obs: Observation, new: PlannerState, command: Command
    ) -> None:
        """Report a turn that is not sent, and decided anew in the next one."""
        self._report(replace(self.flown(inputs, obs, new, command, None), role="redone"))

    def failed(self, inputs: FlightInputs, error: BaseException) -> None:
        """Report the turn in which the flight broke off. It holds what the planner was given, and
        what it had decided unless it raised: the command may have been sent."""
        if self._open is None:
            return
        obs, decision = self._open
        if decision is not None:
            turn = self.flown(inputs, obs, *decision)
            self._report(replace(turn, timing=None))  # by now the rescue's time is in it
        elif isinstance(error, Exception):  # else the planner was only interrupted
            self._open = None
            turn = Turn(
                self._counted(), "failed", self._began_s, obs.t_s, inputs.taken, inputs.poses,
                observation=obs, error=type(error).__name__,
            )  # fmt: skip
            self._report(turn)

    def flown(
        self,
        inputs: FlightInputs,
        obs: Observation,
        new: PlannerState,
        command: Command,
        outside: FeedStatus | None,
    ) -> Turn:
        """Return the turn, once its command was sent."""
        self._open = None
        return Turn(
            number=self._counted(),
            role="flown",
            began_s=self._began_s,
            t_s=obs.t_s,
            taken=inputs.taken,
            poses=inputs.poses,
            observation=obs,
            command=command,
            phase=new.phase,
            row=new.row,
            held=bool(new.hold),
            attempts=new.attempts,
            outside=external_positions(outside),
            timing=self._timing(),
            outcome=new.outcome,
            reason=new.reason,
        )

    def _timing(self) -> TurnTiming | None:
        if self._wall is None:
            return None
        # A part that a turn did not come to took no time.
        laps_s = [*self._laps_s, *[self._laps_s[-1]] * 3]
        began_s, seen_s, decided_s, sent_s = laps_s[:4]
        return TurnTiming(
            seen_s - began_s, decided_s - seen_s, sent_s - decided_s, self._wall() - began_s
        )

    def _counted(self) -> int:
        self._count += 1
        return self._count - 1

    def _report(self, turn: Turn) -> None:
        for watcher in self._watchers:
            watcher.turn(turn)


def external_positions(status: FeedStatus | None) -> ExternalPositions | None:
    """Return the feed's status as the log has it."""
    if status is None:
        return None
    return ExternalPositions(status.age_s, status.problem, status.sent, status.rate_hz, status.pose)
