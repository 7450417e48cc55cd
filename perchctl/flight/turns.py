"""Each turn of the loop as a value, for the log; and how long its parts took."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from perchctl.flight.clock import Clock, SimulatedClock, WallClock
from perchctl.flight.inputs import FlightInputs
from perchctl.mission import (
    ExternalPositions,
    Observation,
    PlannerState,
    Turn,
    TurnRole,
    TurnTiming,
    TurnWatcher,
    Watcher,
)
from perchctl.positioning import FeedStatus
from perchctl.values import replace
from perchctl.vehicle import Command


class Turns:
    """Counts them. In lockstep there are no timings: the same seed gives the same turns."""

    def __init__(
        self,
        clock: Clock,
        watchers: Iterable[Watcher],
        wall: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._wall = wall if isinstance(clock, (WallClock, SimulatedClock)) else None
        self._told = [w for w in watchers if isinstance(w, TurnWatcher)]
        self._count = 0
        self._began_s = 0.0
        self._laps_s = [0.0]
        self._undecided: Observation | None = None
        self._untold: tuple[Observation, PlannerState, Command, FeedStatus | None] | None = None

    @property
    def are_told(self) -> bool:
        """Whether somebody records them."""
        return bool(self._told)

    def begin(self, now_s: float) -> None:
        self._began_s, self._laps_s = now_s, []
        self.lap()

    def lap(self) -> None:
        """Begun; taken in; decided; sent."""
        if self._wall is not None:
            self._laps_s.append(self._wall())

    def waiting(self, inputs: FlightInputs, now_s: float, outside: FeedStatus | None) -> None:
        turn = Turn(
            self._counted(), "waiting", now_s, now_s, inputs.taken, inputs.poses,
            outside=told_of(outside),
        )  # fmt: skip
        self._tell(turn)

    def redone(
        self, inputs: FlightInputs, obs: Observation, new: PlannerState, command: Command
    ) -> None:
        self._tell(self._turn("redone", inputs, obs, new, command, None))

    def observed(self, obs: Observation) -> None:
        """What is about to be decided on."""
        self._undecided = obs

    def decided(
        self,
        obs: Observation,
        new: PlannerState,
        command: Command,
        outside: FeedStatus | None,
    ) -> None:
        """The planner has done its part: what fails from now on is not its fault."""
        self._undecided, self._untold = None, (obs, new, command, outside)

    def failed(self, inputs: FlightInputs, error: BaseException) -> None:
        """The flight broke off. Where the planner raised, tell what it was shown: by that its
        fault can be found again. Where it had decided, tell what: it may have been sent."""
        obs, untold = self._undecided, self._untold
        self._undecided = self._untold = None
        if untold is not None:
            obs, new, command, outside = untold
            turn = self._turn("flown", inputs, obs, new, command, told_of(outside))
            self._tell(replace(turn, timing=None))  # by now the rescue's time is in it
        elif obs is not None and isinstance(error, Exception):  # else it was only interrupted
            self._tell(
                Turn(
                    self._counted(), "failed", self._began_s, obs.t_s, inputs.taken, inputs.poses,
                    observation=obs, error=type(error).__name__,
                )
            )  # fmt: skip

    def flown(
        self,
        inputs: FlightInputs,
        obs: Observation,
        new: PlannerState,
        command: Command,
        outside: FeedStatus | None,
    ) -> Turn:
        return self._turn("flown", inputs, obs, new, command, told_of(outside))

    def _turn(
        self,
        role: TurnRole,
        inputs: FlightInputs,
        obs: Observation,
        new: PlannerState,
        command: Command,
        outside: ExternalPositions | None,
    ) -> Turn:
        self._undecided = self._untold = None
        return Turn(
            number=self._counted(),
            role=role,
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
            outside=outside,
            timing=self._timing(),
            outcome=new.outcome,
            reason=new.reason,
        )

    def _timing(self) -> TurnTiming | None:
        if self._wall is None:
            return None
        # Of a turn that was not sent, or not decided, that part took no time.
        laps_s = [*self._laps_s, *[self._laps_s[-1]] * 3]
        began_s, seen_s, decided_s, sent_s = laps_s[:4]
        return TurnTiming(
            seen_s - began_s, decided_s - seen_s, sent_s - decided_s, self._wall() - began_s
        )

    def _counted(self) -> int:
        self._count += 1
        return self._count - 1

    def _tell(self, turn: Turn) -> None:
        for watcher in self._told:
            watcher.turn(turn)


def told_of(status: FeedStatus | None) -> ExternalPositions | None:
    if status is None:
        return None
    return ExternalPositions(status.age_s, status.problem, status.sent, status.rate_hz, status.pose)
