"""What those who look on are given: every tick, what happened, and how the flight ended."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, Protocol, runtime_checkable

from perchctl.geometry import Array
from perchctl.mission.ending import ContactError, Touchdown
from perchctl.mission.findings import Findings
from perchctl.mission.state import Observation, Outcome, Phase, PlannerState, Severity
from perchctl.vehicle import Command, ExternalPosition, Telemetry
from perchctl.vision import Consistency, PictureKind, PipelineOutput, TargetEstimate


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


# --- A command that went to the vehicle in the loop's place ------------------------------------


SentBy = Literal["watchdog", "rescue", "reconnect", "farewell"]


@dataclass(frozen=True)
class SentCommand:
    """One that no turn of the loop decided. Handed to the link at `t_s`, on the loop's clock: as
    of any packet, whether it arrives is not known.

    Attributes:
        by: ``watchdog`` while the loop is silent, and the operator's stop; ``rescue`` after an
            error; ``reconnect``, an order once more over a link that was lost; ``farewell``, the
            zero setpoint with which the link is closed.
    """

    t_s: float
    by: SentBy
    command: Command


# --- One turn of the loop, whole: what its edges gave, what was known, and what was decided ----
# From a flight's turns it can be decided again (`perchctl.analysis`).


TurnRole = Literal["waiting", "redone", "flown", "failed"]


@dataclass(frozen=True)
class ExternalPositions:
    """Positions from outside, as the vehicle is handed them: how old the newest is, why none is
    sent now (None while they are), how many were sent, and how many a second, and the newest."""

    age_s: float
    problem: str | None
    sent: int
    rate_hz: float
    place: ExternalPosition | None


@dataclass(frozen=True)
class FrameSeen:
    """A frame as its source gave it, without its picture: a `perchctl.vision.types.Frame`.
    `checksum`: the picture's, None where nobody looked at it, or nobody records it."""

    index: int
    t_s: float
    t_arrival_s: float
    fields: PictureKind | None = None
    repeated: bool = False
    checksum: int | None = None


@dataclass(frozen=True)
class TurnInputs:
    """What link and camera gave in one turn.

    Attributes:
        samples: the telemetry, in the order in which it came.
        late: the telemetry that came while camera or vision hung.
        frame: None where no frame was there.
        problem, ended, live: what the source said of itself.
        look: the frame was to be looked at.
    """

    samples: tuple[Telemetry, ...] = ()
    late: tuple[Telemetry, ...] = ()
    frame: FrameSeen | None = None
    problem: str | None = None
    ended: bool = False
    live: bool = True
    look: bool = True


@dataclass(frozen=True, eq=False)
class PoseSeen:
    """An unfiltered pose of the target, as `perchctl.vision.types.MarkerPose` has it."""

    t_s: float
    e_m: Array
    e_yaw_rad: float


@dataclass(frozen=True)
class TurnTiming:
    """How long a turn's parts took: taking in and looking, deciding, sending, and all of it but
    what looks on."""

    pipeline_s: float
    planner_s: float
    send_s: float
    turn_s: float


@dataclass(frozen=True, eq=False)
class Turn:
    """Whole and exact.

    Attributes:
        number: counts all turns of a flight from 0; a gap is a turn that is not there.
        role: ``waiting`` before take-off; ``flown``; ``redone``: decided before a hang was
            noticed, not sent, and decided anew in the next turn; or ``failed``: the planner
            raised on it, and there is no next one.
        began_s: when it took in; `t_s`, for when it was decided, is later where it hung.
        poses: by ``large``, ``small``, ``joint``, of this turn's picture; of a field's the later.
        observation, command: what the planner saw and decided; None while waiting, and no command
            of one that failed.
        phase, row, held, attempts, outcome, reason: the planner's, once it had decided. No reason
            at all: the log is of before version 4, and does not hold the outcome, either.
        error: the name of what the planner raised on a turn that failed.
        timing: None in lockstep.
    """

    number: int
    role: TurnRole
    began_s: float
    t_s: float
    taken: TurnInputs
    poses: dict[str, PoseSeen] = field(default_factory=dict)
    observation: Observation | None = None
    command: Command | None = None
    phase: Phase | None = None
    row: str = ""
    held: bool = False
    attempts: int = 0
    outside: ExternalPositions | None = None
    timing: TurnTiming | None = None
    outcome: Outcome | None = None
    reason: str | None = None
    error: str | None = None
