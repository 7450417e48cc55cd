"""The records of a flight: events, ticks, and each turn of the loop whole and exact.

From a flight's turns it can be decided again (`perchctl.analysis`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, Protocol

from perchctl.geometry import Array
from perchctl.mission.belief.quality import position_loss_text
from perchctl.mission.observation import Observation
from perchctl.mission.phase import Claim, Outcome, Phase, Severity
from perchctl.mission.rest import RestState
from perchctl.mission.state import PlannerState
from perchctl.profile import Profile
from perchctl.vehicle import Command, ExternalPosition, Telemetry, is_battery_reading
from perchctl.vision import CameraErrors, PictureKind, PipelineOutput, TargetEstimate

TurnRole = Literal["waiting", "redone", "flown", "failed"]


class EventKind(Enum):
    """The kind of an `Event`."""

    PHASE = "phase"  # a phase was entered
    HOLD = "hold"  # the vehicle is held in place
    NOTE = "note"  # something worth a line


@dataclass(frozen=True)
class Event:
    """Something that happened in a flight, for its log and its displays."""

    t_s: float
    kind: EventKind
    reason: str  # a sentence without its end
    phase: Phase | None = None  # the one entered, or the one that was flown
    row: str = ""  # the table's transition; empty at the start and where there was none
    severity: Severity = Severity.CONTINUE
    simulated: str = ""  # what the simulated scenario did that led to it
    rest: RestState | None = None  # where a rescue found the vehicle; None in all other events
    claims: Claim = Claim.NONE  # the transition's

    @classmethod
    def of_rescue(cls, t_s: float, error: BaseException, rest: RestState, text: str) -> Event:
        """The note on a vehicle's fate after an error in flight, as the rescue found it."""
        reason = f"{type(error).__name__} in flight: {text}"
        return cls(t_s, EventKind.NOTE, reason, rest=rest)

    @classmethod
    def of_tick(
        cls, before: PlannerState | None, state: PlannerState, obs: Observation, profile: Profile
    ) -> list[Event]:
        """The events of one tick; `before`: the state before it, None in the first tick."""
        events: list[Event] = []
        if before is None:
            before = PlannerState.on_ground(obs, profile)
            events.append(cls(obs.t_s, EventKind.PHASE, before.reason, before.phase))
            if not is_battery_reading(obs.telemetry.battery_v):
                grace_s = profile.safety.battery_stale_s
                text = f"no battery reading: landing after {grace_s:.0f} s at most"
                events.append(cls(obs.t_s, EventKind.NOTE, text, before.phase))
        if state.phase is not before.phase:
            entered = EventKind.PHASE, state.reason, state.phase, state.row, state.severity
            events.append(cls(obs.t_s, *entered, claims=state.entry.claims))
        elif state.pause and not before.pause:
            held = EventKind.HOLD, state.pause, state.phase
            events.append(cls(obs.t_s, *held, severity=Severity.HOLD))
        elif (
            state.belief.stale_s == obs.t_s
            and before.belief.stale_s != before.t_s
            and not state.hold
        ):
            text = position_loss_text(state.belief.seen(obs, profile))
            events.append(cls(obs.t_s, EventKind.NOTE, text, state.phase))
        return events


@dataclass(frozen=True)
class SentCommand:
    """A command that no turn of the loop decided, handed to the link at `t_s` on the loop's clock;
    whether it arrived is unknown.

    `by`: ``watchdog`` while the loop is silent, and the operator's stop; ``rescue`` after an error;
    ``reconnect``, an order once more over a link that was lost; ``preflight``, the arming of a
    vehicle that does not arm itself; ``farewell``, its disarming, and the zero setpoint that closes
    the link.
    """

    t_s: float
    by: str
    command: Command


@dataclass(frozen=True)
class ExternalPositions:
    """External positions sent to the vehicle: how many, at what rate, the newest and its age."""

    age_s: float  # of the newest
    problem: str | None  # why none is sent now
    sent: int
    rate_hz: float
    place: ExternalPosition | None  # the newest


@dataclass(frozen=True)
class FrameRecord:
    """A `perchctl.vision.Frame` as its source gave it, without its picture."""

    index: int
    t_s: float
    t_arrival_s: float
    fields: PictureKind | None = None
    repeated: bool = False
    checksum: int | None = None  # the picture's; None if it was not searched, or not recorded


@dataclass(frozen=True)
class TurnInputs:
    """The samples that the link, and the frame that the camera gave in one turn. `late`: samples
    that came while camera or vision hung; `look`: the frame was to be searched; `sends_sights`: the
    target's sights were the vehicle's position; `drops_sightings`: the sights before this turn were
    forgotten, since positions had led astray."""

    samples: tuple[Telemetry, ...] = ()  # in the order in which they came
    late: tuple[Telemetry, ...] = ()  # those that came while camera or vision hung
    frame: FrameRecord | None = None
    problem: str | None = None  # problem, ended, live: the source's own
    ended: bool = False
    live: bool = True
    look: bool = True
    sends_sights: bool = True
    drops_sightings: bool = False


@dataclass(frozen=True, eq=False)
class UnfilteredPose:
    """An unfiltered pose of the target; the fields are those of `perchctl.vision.MarkerPose`."""

    t_s: float
    e_m: Array
    e_yaw_rad: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Turn:
    """One turn of the loop, whole and exact.

    `role`: ``waiting`` before take-off; ``flown``; ``redone``: decided before a hang was noticed,
    not sent, and decided anew in the next turn; ``failed``: the planner raised on it.
    `phase` to `reason` are the planner's after its decision.
    """

    number: int  # from 0; a gap is a turn that is missing
    role: TurnRole
    began_s: float
    t_s: float  # for which it was decided; later than `began_s` where it hung
    taken: TurnInputs
    poses: dict[str, UnfilteredPose] = field(default_factory=dict)
    observation: Observation | None = None  # None while waiting
    command: Command | None = None  # None while waiting, and of one that failed
    phase: Phase | None = None
    row: str = ""
    held: bool = False
    attempts: int = 0
    outside: ExternalPositions | None = None
    outcome: Outcome | None = None
    reason: str | None = None  # None: of a log before version 4, without outcome, too
    error: str | None = None  # name of what the planner raised


@dataclass(frozen=True, eq=False, kw_only=True)
class Tick:
    """A flown turn with the planner's whole state and the pipeline's output, of which the log keeps
    only parts.

    `output` is None where no new frame was searched; `consistency`: errors of latency and mounting,
    if worked out in this turn.
    """

    turn: Turn
    state: PlannerState
    output: PipelineOutput | None = None
    consistency: CameraErrors | None = None

    @property
    def observation(self) -> Observation:
        assert self.turn.observation is not None, "a turn that was flown has one"
        return self.turn.observation

    @property
    def command(self) -> Command:
        assert self.turn.command is not None, "a turn that was flown has one"
        return self.turn.command

    @property
    def t_s(self) -> float:
        return self.observation.t_s

    @property
    def telemetry(self) -> Telemetry:
        return self.observation.telemetry

    @property
    def target(self) -> TargetEstimate | None:
        """The estimate that the planner steered by."""
        return self.observation.target

    @property
    def loop_late_s(self) -> float:
        return self.observation.loop_late_s

    @property
    def camera_age_s(self) -> float:
        return self.observation.camera_age_s

    @property
    def telemetry_age_s(self) -> float:
        """The age of the oldest part of the newest telemetry."""
        return self.t_s - self.telemetry.t_s + self.telemetry.behind_s

    @property
    def delay_used_s(self) -> float:
        """What is taken off the frames' times."""
        return self.observation.delay_s

    @property
    def outside(self) -> ExternalPositions | None:
        """None where decks measure the position."""
        return self.turn.outside


class Watcher(Protocol):
    """Receiver of ticks and events: flight log, panel, live page. One that raises is detached, and
    the flight goes on without it; an attribute `name` names it in the message."""

    def tick(self, tick: Tick) -> None:
        """Handle a turn that was flown."""
        return

    def event(self, event: Event) -> None:
        """Handle an event of the flight."""
        return

    @property
    def problem(self) -> str | None:
        """Why the watcher lost records; None while it has lost none."""
        return None
