"""The messages between a fleet's parent process and the process of one vehicle.

    parent  --- Order, ten times a second and when it changes --->  vehicle
    parent  <-- Status, ten times a second, and one Result -------  vehicle

Every message contains a complete state, never only what has changed. If a message is lost, late or
duplicated, the next one corrects it, and no message needs an answer. The command in the last
`Order` that arrives stays valid, and without another order the vehicle lands after
`perchctl.fleet.parent_watch.PARENT_SILENCE_S`. A permission to take off is valid only for the
iteration of the flight loop (turn) that reads it, and a permission to climb only while it is fresh.
A command to land or to cut the motors takes precedence over both permissions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

from perchctl.corridor import Point
from perchctl.mission import OperatorRequest, Phase

BEAT_S = 0.1
"""Time between two messages in each direction, s. Longer: only a few messages arrive within the
second after which a silent parent counts as dead. Shorter: the messages cost computing time."""


class Stage(Enum):
    """The stages of a vehicle's process."""

    STARTING = "starting"  # vehicle or camera have not answered yet
    CHECKING = "checking"  # on the floor, its checks not yet passed
    READY = "ready"  # on the floor, disarmed; only permission is missing
    FLYING = "flying"  # from its first setpoint to the end of its mission
    ENDING = "ending"  # landed or hanging; link and log are being closed

    @property
    def is_before_takeoff(self) -> bool:
        """True on the floor, before the first setpoint."""
        return self in (Stage.STARTING, Stage.CHECKING, Stage.READY)


class VehicleOutcome(Enum):
    """How one vehicle ended."""

    PERCHED = "perched"  # it is hanging with its motors off
    LANDED = "landed"
    ABORTED = "aborted"
    FAILED = "failed"  # its flight raised an exception, or its process was lost

    @classmethod
    def from_phase(cls, phase: Phase) -> VehicleOutcome:
        """The outcome of a mission that ended in this phase. Raises KeyError if the phase is not
        final."""
        return {
            Phase.PERCHED: cls.PERCHED,
            Phase.LANDED: cls.LANDED,
            Phase.ABORTED: cls.ABORTED,
        }[phase]


@dataclass(frozen=True, kw_only=True)
class Order:
    """Everything that the parent wants from one vehicle. An order is also a sign of life, so it is
    sent repeatedly.

    Attributes:
        may_take_off: permission to take off; has no effect in the air.
        may_climb: permission to begin the climb to the target; has no effect once it has begun.
        why_not_climb: reason why the vehicle may not begin the climb, for display.
        sent_s: time of the decision by `time.monotonic`, a clock that all processes share.
        word: the operator's command; once a vehicle has received one, it stays in effect.
    """

    may_take_off: bool = False
    may_climb: bool = False
    why_not_climb: str = ""
    word: OperatorRequest = OperatorRequest.NONE
    sent_s: float = field(default=-math.inf, compare=False)


@dataclass(frozen=True, kw_only=True)
class Status:
    """The state of a vehicle's flight, for the parent's decisions and for display. Unknown numbers
    are None.

    Attributes:
        phase: phase of its mission; None on the floor, before the mission.
        reason: what it waits for on the floor, or why it is in its phase.
        height_m: height above the ground.
        error_m: horizontal distance of the target from the gear.
        telemetry_age_s: age of the oldest part of the newest telemetry.
        loop_age_s: time since the last iteration (turn) of its flight loop; None before the first.
        place_m: its position in the axes of its estimate; None while the estimate cannot be
            trusted.
        log: its log file, once the flight has begun; needed if the process ends without a `Result`.
        picture_port: local port at which its process serves its images; None without a page.
    """

    stage: Stage = Stage.STARTING
    phase: Phase | None = None
    reason: str = ""
    height_m: float | None = None
    error_m: float | None = None
    battery_v: float | None = None
    telemetry_age_s: float | None = None
    loop_age_s: float | None = None
    place_m: Point | None = None
    log: str | None = None
    picture_port: int | None = None


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How well the computer kept pace with one flight, from the first tick to the last.

    Attributes:
        flown_s, wall_s: duration on the loop's clock, which a simulator may provide, and on the
            wall clock.
        gap_p50_s, gap_p99_s, gap_max_s: time between two setpoints, on the wall clock.
        cores: CPU time of the vehicle's process per second, without its simulator.
    """

    flown_s: float
    wall_s: float
    gap_p50_s: float
    gap_p99_s: float
    gap_max_s: float
    cores: float

    @property
    def ratio(self) -> float:
        """Ratio of flight time to wall-clock time: 1 in real time."""
        return self.flown_s / self.wall_s


@dataclass(frozen=True, kw_only=True)
class Result:
    """How one vehicle's flight ended; the last message from its process.

    Attributes:
        has_flown: False if it never took off.
        ended_s: time of its last tick by `time.monotonic`, a clock that all processes share; None
            if there was no tick.
        place_m: its last position, in the axes of its estimate; None if the estimate was old or
            could not be trusted.
    """

    exit_code: int
    outcome: VehicleOutcome
    reason: str
    has_flown: bool = False
    ended_s: float | None = None
    place_m: Point | None = None
    attempts: int = 0
    miss_m: float | None = None
    battery_min_v: float | None = None
    log: str | None = None
    pace: Pace | None = None

    @property
    def hangs(self) -> bool:
        """True if the vehicle is known to be hanging with its motors off."""
        return self.outcome is VehicleOutcome.PERCHED


def find_fault(message: object) -> str | None:
    """Return what is wrong with a message from a vehicle; None for a `Status` or `Result` whose
    decisive fields have the right types."""
    match message:
        case Status():
            numbers = (message.telemetry_age_s, message.loop_age_s)
            is_good = isinstance(message.stage, Stage) and all(map(_is_number, numbers))
            is_good = is_good and isinstance(message.picture_port, int | None)
        case Result():
            is_good = type(message.exit_code) is int
            is_good = is_good and isinstance(message.outcome, VehicleOutcome)
        case _:
            return f"{type(message).__name__} instead of its status"
    if not (is_good and _is_place(message.place_m)):
        return f"{type(message).__name__} with fields of the wrong type"
    return None


def _is_number(value: object) -> bool:
    return value is None or isinstance(value, int | float)


def _is_place(value: object) -> bool:
    if value is None:
        return True
    if not (isinstance(value, tuple) and len(value) == 2):
        return False
    return all(isinstance(part, int | float) for part in value)
