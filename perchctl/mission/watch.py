"""What those who look on are given: every tick, what happened, and how the flight ended."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol, runtime_checkable

from perchctl.mission.ending import ContactError, Touchdown
from perchctl.mission.findings import Findings
from perchctl.mission.sent import SentCommand
from perchctl.mission.state import Outcome, Phase, PlannerState, Severity
from perchctl.mission.turn import ExternalPositions, Turn
from perchctl.vehicle import Command, Telemetry
from perchctl.vision import Consistency, PipelineOutput, TargetEstimate


class EventKind(Enum):
    """What happened: a phase was entered, the vehicle is held, or something to note."""

    PHASE = "phase"  # a phase was entered
    HOLD = "hold"  # the vehicle is held in place
    NOTE = "note"  # something worth a line


RESCUE = " in flight: "
"""In the note of what a rescue did after an error, behind the error's name."""


@dataclass(frozen=True)
class Event:
    """Something that happened. It becomes words only where it is shown.

    Attributes:
        phase: the phase entered, or the one that was flown.
        row: the row of the mission's table that was taken; empty at the start and for
            what is no transition.
        reason: why, in a sentence without its end.
        simulated: what the simulated scenario did that led to it, empty where nothing is known.
    """

    t_s: float
    kind: EventKind
    reason: str
    phase: Phase | None = None
    row: str = ""
    severity: Severity = Severity.CONTINUE
    simulated: str = ""


@dataclass(frozen=True, eq=False)
class Tick:
    """All that one turn of the loop knew and did, for the log and the display.

    `output` is what this tick's new frame gave, None without one; `target` the estimate
    that the planner steered by. `consistency`: what the flight shows of latency and mounting,
    in the ticks in which that was worked out anew; `delay_used_s` is in the frames' times.
    `outside`: None where the vehicle's decks measure its position. `turn`: the same turn whole
    and exact, to be decided again.
    """

    t_s: float
    telemetry: Telemetry
    output: PipelineOutput | None
    target: TargetEstimate | None
    state: PlannerState
    command: Command
    loop_late_s: float
    camera_age_s: float
    telemetry_age_s: float
    consistency: Consistency | None = None
    delay_used_s: float = 0.0
    outside: ExternalPositions | None = None
    turn: Turn | None = None


class Watcher(Protocol):
    """Something that looks on: flight log, panel, live page. Must not raise."""

    def tick(self, tick: Tick) -> None: ...

    def event(self, event: Event) -> None: ...

    @property
    def problem(self) -> str | None: ...


@runtime_checkable
class TurnWatcher(Watcher, Protocol):
    """One that is told of the turns without a tick, too: before take-off, and those that were
    decided anew."""

    def turn(self, turn: Turn) -> None: ...


@runtime_checkable
class SentWatcher(Watcher, Protocol):
    """One that is told of what was sent in the loop's place, too."""

    def sent(self, sent: SentCommand) -> None:
        """Called by whoever sent it, in its own thread: must neither wait nor raise."""


class EventKeeper:
    """Keeps what happened, to be told afterwards."""

    problem: str | None = None

    def __init__(self) -> None:
        self.seen: list[Event] = []

    def tick(self, tick: Tick) -> None:
        return None

    def event(self, event: Event) -> None:
        self.seen.append(event)


@dataclass(frozen=True)
class FlightReport:
    """How the flight ended; `history` are its phases' events, the first at the start.
    `findings`: what it showed of latency and mounting, where it was long enough. `contact`: of what
    hangs. `touchdown`: of what met the floor, as far as that was felt."""

    phase: Phase
    outcome: Outcome
    reason: str
    attempts: int
    duration_s: float
    locked: bool
    history: tuple[Event, ...] = ()
    findings: Findings | None = None
    contact: ContactError | None = None
    touchdown: Touchdown | None = None
