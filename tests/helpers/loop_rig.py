"""A flight loop on a scripted vehicle, a scripted camera and a clock that nobody waits for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from perchctl.flight import FlightParts, fly
from perchctl.flight.loop import PositionStatus
from perchctl.flight.watchdog import rescue
from perchctl.link.protocol import Guard, SentCallback, ignore_sent
from perchctl.mission import (
    Event,
    FlightReport,
    Observation,
    OperatorRequest,
    Phase,
    PlannerState,
    RestStateReport,
    SentCommand,
    Tick,
)
from perchctl.perception import History
from perchctl.profile import Profile
from perchctl.vehicle import (
    HL_ACTIVE,
    Command,
    ExternalPosition,
    Idle,
    Land,
    PositionSetpoint,
    StopMotors,
    Telemetry,
)
from perchctl.vision import CameraModel, Frame, Pipeline, make_pipeline
from tests.helpers.hangs import hang_in_the_camera
from tests.helpers.mission import (
    AIRBORNE,
    HOVER_THRUST,
    READY,
    changed,
    remembering,
    telemetry,
)

SIZE_PX = (64, 48)
CAMERA = CameraModel(
    SIZE_PX, np.array([[40.0, 0.0, 32.0], [0.0, 40.0, 24.0], [0.0, 0.0, 1.0]]), np.zeros(5)
)
PROFILE = Profile()
SOON = {"planner.landing.timeout_s": 8.0}
"""For a landing that this vehicle never ends: it obeys no thrust, and flies on unheard."""
SOON_GIVEN_UP = changed(SOON, PROFILE)
SETUP = make_pipeline(PROFILE, CAMERA)
CLIMB_MPS, SINK_MPS = 0.5, 0.4


class Broken(RuntimeError):
    pass


class Vehicle:
    """A link to a vehicle that does as it is told: takes off, lands, stops; it records commands.

    `changed` alters each sample; None leaves it out. `delay_s` later it has arrived.
    """

    def __init__(
        self,
        changed: Callable[[Telemetry], Telemetry | None] = lambda sample: sample,
        delay_s: float = 0.01,
    ) -> None:
        self.now_s, self.dies_at_s = 0.0, math.inf
        self.sent: list[tuple[float, Command]] = []
        self.places: list[tuple[float, ExternalPosition]] = []
        self.closed = False
        self._changed = changed
        self._delay_s = delay_s
        self.z_m = 0.0
        self._goal_m: float | None = None
        self.by_itself = False
        self.motors = False
        self._off_s = -math.inf
        self._samples: list[Telemetry] = []
        self._was_asked = False

    def advance_to(self, t_s: float) -> None:
        while self.now_s < t_s - 1e-9:
            self.now_s = min(self.now_s + 0.01, t_s)
            self._live(0.01)

    def telemetry(self) -> list[Telemetry]:
        """What has arrived: at first also what was heard in the two seconds before the flight, as
        by a link that was opened before a question."""
        if not self._was_asked:
            self._was_asked = True
            before = [self._changed(self._sample(-0.01 * k)) for k in range(200, 0, -1)]
            self._samples = [sample for sample in before if sample is not None] + self._samples
        due_s = self.now_s - self._delay_s + 1e-9
        arrived = [s for s in self._samples if s.t_s <= due_s]
        self._samples = [s for s in self._samples if s.t_s > due_s]
        return arrived

    def send(self, command: Command) -> None:
        self.sent.append((self.now_s, command))
        match command:
            case PositionSetpoint(z_m=height):
                self._goal_m, self.motors, self.by_itself = height, True, False
            case Land(height, _):
                self._goal_m, self.motors, self.by_itself = height, True, True
            case StopMotors():
                self._stop()

    def connect(self) -> None:
        return None

    def decks(self) -> tuple[str, ...]:
        return ("bcFlow2",)

    def problem(self, now_s: float) -> str | None:
        return "the script ended the link" if now_s >= self.dies_at_s else None

    def send_external(self, place: ExternalPosition) -> bool:
        self.places.append((self.now_s, place))
        return True

    def set_guard(self, guard: Guard, on_sent: SentCallback = ignore_sent) -> None:
        self.watchdog, self.told = guard, on_sent

    def close(self) -> None:
        self.closed = True

    def _live(self, dt_s: float) -> None:
        if self._goal_m is not None and self.motors:
            way = self._goal_m - self.z_m
            self.z_m += max(-SINK_MPS * dt_s, min(CLIMB_MPS * dt_s, way))
            if self.by_itself and self.z_m <= 0.0 and self._goal_m <= 0.0:
                self.z_m = 0.0
                self._stop()
        changed = self._changed(self._sample(self.now_s))
        if changed is not None:
            self._samples.append(changed)

    def _sample(self, t_s: float) -> Telemetry:
        in_air = self.motors or t_s - self._off_s < 2.0
        bits = AIRBORNE if in_air else READY
        if self.motors and self.by_itself:
            bits |= HL_ACTIVE
        thrust = HOVER_THRUST if self.motors else 0.0
        return telemetry(t_s, self.z_m, supervisor=bits, thrust=thrust)

    def _stop(self) -> None:
        if self.motors:
            self._off_s = self.now_s
        self.motors = False

    def said(self, kind: type) -> list[float]:
        """When commands of that kind were sent."""
        return [t_s for t_s, command in self.sent if isinstance(command, kind)]


HANG_AT_S = 2.5


class Guarded(Vehicle):
    """A scripted vehicle whose link asks the watchdog every 50 ms, as the real ones do."""

    watchdog: Any = None

    def __init__(self, changed: Callable[[Telemetry], Telemetry | None] = lambda s: s) -> None:
        super().__init__(changed)
        self.own: list[tuple[float, Command]] = []
        self._asked_s = 0.0

    def advance_to(self, t_s: float) -> None:
        while self.now_s < t_s - 1e-9:
            super().advance_to(min(self.now_s + 0.01, t_s))
            if self.watchdog is not None and self.now_s >= self._asked_s + 0.05 - 1e-9:
                self._asked_s = self.now_s
                arrived = [s for s in self._samples if s.t_s <= self.now_s - 0.01]
                command = self.watchdog(self.now_s, arrived[-1] if arrived else None, ())
                if command is not None:
                    self.own.append((self.now_s, command))
                    self.send(command)
                    self.told(SentCommand(self.now_s, "watchdog", command))


class Clock:
    def __init__(self, link: Vehicle) -> None:
        self._link = link

    def now(self) -> float:
        return self._link.now_s

    def wait_until(self, t_s: float) -> None:
        self._link.advance_to(max(t_s, self._link.now_s))


class SleepyClock(Clock):
    """A computer that is suspended once, at `at_s`, for `for_s`."""

    def __init__(self, link: Vehicle, at_s: float, for_s: float) -> None:
        super().__init__(link)
        self._at_s, self._for_s = at_s, for_s
        self._slept = False

    def wait_until(self, t_s: float) -> None:
        super().wait_until(t_s)
        if not self._slept and self.now() >= self._at_s:
            self._slept = True
            self._link.advance_to(self.now() + self._for_s)


@cache
def noise(number: int) -> np.ndarray:
    """The same picture for each flight, which none may change."""
    rng = np.random.default_rng(number)
    picture = rng.normal(120, 6, SIZE_PX[::-1]).clip(0, 255).astype(np.uint8)
    picture.setflags(write=False)
    return picture


@dataclass
class Camera:
    """Gives a frame a tick; `alter` changes it, or None gives none."""

    alter: Callable[[Frame], Frame | None] = lambda frame: frame
    live: bool = True
    frames: int | None = None
    size_px: tuple[int, int] = SIZE_PX
    count: int = 0
    told: str | None = None

    @property
    def finished(self) -> bool:
        return self.frames is not None and self.count >= self.frames

    def poll(self, now_s: float) -> Frame | None:
        if self.finished:
            return None
        self.count += 1
        return self.alter(Frame(self.count, now_s - 0.05, noise(self.count), now_s))

    def problem(self, now_s: float) -> str | None:
        return self.told

    def describe(self) -> str:
        return "the scripted camera"

    def close(self) -> None:
        return None


@dataclass
class Watcher:
    """Remembers what it saw; `on_tick` may steer, or raise, which ends the flight of a `Rig`."""

    on_tick: Callable[[Tick], None] = lambda tick: None
    ticks: list[Tick] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    problem: str | None = None

    def tick(self, tick: Tick) -> None:
        self.ticks.append(tick)
        self.on_tick(tick)

    def event(self, event: Event) -> None:
        self.events.append(event)


@dataclass
class Rig:
    """A vehicle, a camera, a watcher and a loop around them."""

    link: Vehicle = field(default_factory=Vehicle)
    camera: Camera = field(default_factory=Camera)
    watcher: Watcher = field(default_factory=Watcher)
    clock: Clock | None = None
    profile: Profile = PROFILE
    setup: Pipeline = SETUP
    operator: Callable[[], OperatorRequest] = lambda: OperatorRequest.NONE
    positions: PositionStatus | None = None

    def parts(self) -> FlightParts:
        return FlightParts(
            self.link,
            self.camera,
            self.clock or Clock(self.link),
            self.profile,
            self.setup,
            operator=self.operator,
            positions=self.positions,
            judges=(self.watcher,),
        )

    def fly(self) -> FlightReport:
        return fly(self.parts())

    def rescue(self, known: Telemetry, age_s: float = 0.0, **state: Any) -> RestStateReport:
        """A rescue of what was flying as `known` and `state` say, its positions `age_s` old."""
        ground = replace(known, position_m=(0.0, 0.0, 0.0))
        told = {"phase": Phase.ALIGN, "hover_thrust": HOVER_THRUST, "last_telemetry": known} | state
        before = PlannerState.initial_on_ground(Observation(known.t_s, ground), self.profile)
        before = remembering(before, **told)
        began_s = self.link.now_s
        return rescue(
            self.link,
            self.clock or Clock(self.link),
            self.profile,
            self.operator,
            before,
            History((known,)),
            lambda now_s: age_s + now_s - began_s if age_s else 0.0,
        )

    def refused(self, error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            self.fly()
        assert not [c for _, c in self.link.sent if not isinstance(c, Idle)]


def hung_rig(for_s: float) -> tuple[Rig, Guarded]:
    """A loop whose camera hangs at `HANG_AT_S`, and whose operator lands two seconds later."""
    link = Guarded()
    rig = Rig(link)
    hang_in_the_camera(link, rig.camera, HANG_AT_S, for_s)
    rig.operator = lambda: (
        OperatorRequest.LAND if link.now_s > HANG_AT_S + 2.0 + for_s else OperatorRequest.NONE
    )
    return rig, link
