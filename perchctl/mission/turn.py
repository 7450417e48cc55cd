"""One turn of the loop, whole: what its edges gave, what was known, and what was decided.

From a flight's turns it can be decided again (`perchctl.replay`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from perchctl.geometry import Array
from perchctl.mission.state import Observation, Outcome, Phase
from perchctl.vehicle import Command, ExternalPosition, Telemetry
from perchctl.vision import PictureKind

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
