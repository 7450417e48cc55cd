"""One flight in real time, from options to report: opens the edges, flies, closes them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from perchctl.calibration import profile_camera
from perchctl.camera import FrameSource, open_camera, parse_source
from perchctl.errors import ConnectionFailed, InvalidValue, TimedOut, UsageError, no_simulator
from perchctl.flight.clock import Clock, SimulatedClock, WallClock
from perchctl.flight.loop import FlightParts, fly
from perchctl.link import CflibLink, check_uri
from perchctl.mission import Event, FlightReport, Watcher
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vision import CameraModel, make_pipeline

if TYPE_CHECKING:
    from perchctl.sim import SimProcess
import threading
import time
from dataclasses import field

from perchctl.errors import Interrupted, SafetyAbort, no_motion_capture
from perchctl.flight.clock import wall_date
from perchctl.flight.outside import AtRest
from perchctl.flight.preflight import refuse_strange
from perchctl.link import check_estimator_parameters, vehicle_uri
from perchctl.mission import Operator
from perchctl.positioning import (
    CaptureSource,
    FeedThread,
    PositionFeed,
    StandingFeed,
    check_reachable,
    load_comparison,
    open_capture,
)
from perchctl.profile import PositioningConfig

PLAIN_SEED = 11
"""Of the first flight that a newcomer sees: nothing goes wrong in it that would need words."""


@dataclass(frozen=True)
class FlyOptions:
    """What is flown, and where: the command line on top of the profile."""

    profile: Profile
    profile_path: Path
    uri: str
    source: str
    seed: int = PLAIN_SEED
    log_dir: Path = Path("perchctl-logs")
    record: bool = False

    @property
    def simulated(self) -> bool:
        return self.uri.startswith("sim://")


@dataclass(frozen=True)
class SessionResult:
    """How the flight ended; `miss_m` where a simulator measures it."""

    report: FlightReport
    miss_m: float | None = None


def check_options(options: FlyOptions) -> None:
    """What can be refused before anything is opened. Errors: InvalidValue, UsageError."""
    check_uri(options.uri)
    check_positioning(options.profile, simulated=options.simulated)
    source = parse_source(options.source)
    if source.scheme == "sim" and not options.simulated:
        raise UsageError(
            f"source {source} belongs to the simulated vehicle, but the URI is "
            f"{options.uri}; name the camera with --source (camera:N, http://..., aideck://HOST)"
        )
    if not source.live and not options.simulated:
        raise UsageError(
            f"source {source} is a recording, and {options.uri} a real vehicle: it would "
            f"be steered by pictures of another flight; fly sim://, or name a camera with --source"
        )
    if options.seed < 0:
        raise InvalidValue(f"seed {options.seed} is negative; seeds are 0, 1, 2, ...")


def fly_session(
    options: FlyOptions,
    watchers: tuple[Watcher, ...] = (),
    switch: OperatorSwitch | None = None,
    watch_source: Callable[[FrameSource], FrameSource] = lambda source: source,
    remarks: Callable[[], Sequence[str]] = tuple,
    before_arming: Callable[[], None] | None = None,
) -> SessionResult:
    """Fly once, in real time through cflib. Errors: the tree of `perchctl.errors`.

    `switch` carries the operator's commands. `watch_source` may put a source around the camera's,
    to look at its frames on their way. `remarks`: as `FlightParts` has them. `before_arming` is
    called once vehicle and camera have answered; what it raises ends the session on the ground.
    """
    check_options(options)
    require_comparison(options.profile.positioning, options.uri, simulated=options.simulated)
    profile, switch = options.profile, switch or OperatorSwitch()
    camera = profile_camera(profile.camera)
    pipeline = make_pipeline(profile, camera)
    with contextlib.ExitStack() as stack:
        uri, spec, simulated = options.uri, options.source, None
        clock: WallClock | SimulatedClock = WallClock()
        tell: Callable[[Event], str] = _tell_nothing
        if options.simulated:
            simulated = stack.enter_context(simulated_vehicle(options, camera))
            clock, tell = _simulated_clock(options, simulated)
            uri = simulated.uri
            spec = simulated.stream_url if spec.startswith("sim:") else spec
        source = open_camera(spec, clock.now, profile.camera, size_px=camera.size_px)
        stack.callback(source.close)
        source = watch_source(source)
        positioning = capture_for_vehicle(
            profile.positioning, simulated.capture if simulated else None
        )
        capture = opened_capture(stack, positioning, clock)
        link = CflibLink(uri, profile.link, clock.now, positioning=positioning)
        try:
            link.connect()
            if before_arming is not None:
                before_arming()
            positions = started_feed(stack, capture, link, positioning, clock, profile)
            switch.listening = True
            parts = FlightParts(
                link, source, clock, profile, pipeline, watchers, switch.read,
                tell, positions, remarks,
            )  # fmt: skip
            if isinstance(clock, WallClock):
                report = fly(parts)
            else:
                slow = clock.remarks
                with clock.waiting_for_loop():
                    report = fly(replace(parts, remarks=lambda: (*remarks(), *slow())))
        finally:
            switch.listening = True  # while closing, Ctrl-C must not cut the wait short
            link.close()
        return SessionResult(report, miss_m=_true_miss_m(simulated))


def _true_miss_m(simulated: SimProcess | None) -> float | None:
    """Measured by the simulator; a simulator that is gone does not spoil the report."""
    if simulated is None:
        return None
    with contextlib.suppress(ConnectionFailed, TimedOut):
        return float(simulated.truth()["gear_miss_m"])
    return None


def simulated_vehicle(options: FlyOptions, camera: CameraModel) -> SimProcess:
    """Started, with its camera's stream. Errors: UsageError without the simulator."""
    if find_spec("mujoco") is None:
        raise no_simulator()
    from perchctl.sim import SimProcess, draw_capture, draw_scenario

    return SimProcess.start(
        draw_scenario(options.profile, options.seed),
        camera=camera,
        target=options.profile.target,
        capture=draw_capture(options.profile, options.seed),
    )


def _tell_nothing(event: Event) -> str:
    """A real flight has no scenario."""
    return ""


def _simulated_clock(
    options: FlyOptions, simulated: SimProcess
) -> tuple[SimulatedClock, Callable[[Event], str]]:
    """The simulated vehicle's time, and what its scenario did at the time of an event."""
    from perchctl.sim import CLOCK_MARGIN_S, EventExplainer, draw_scenario

    clock = SimulatedClock(simulated.shared_time, CLOCK_MARGIN_S)
    tell = EventExplainer(draw_scenario(options.profile, options.seed))
    return clock, lambda event: tell(event, event.t_s - clock.zero_s)


# --- The operator's commands: Ctrl-C, the other signals, and the live page's STOP button -------


AGAIN_S = 0.5
"""A second press counts this long after the first."""
HELD_S = 0.3
"""Presses that follow each other faster are one: a key held down repeats at 5 to 33 Hz."""
DELAY_S = 1.0
"""A keyboard waits at most this long before it repeats a key that is held down; 0.25 to 0.66 s are
usual."""
INSIST_S = 2.0
"""Who presses on for so long wants the motors stopped, by a key held down or by hammering."""
_EPS_S = 1e-9


@dataclass
class OperatorSwitch:
    """Ctrl-C as the planner understands it: once lands, twice stops.

    `press` is Ctrl-C. A second press is one after at least `HELD_S` of silence and `AGAIN_S` after
    the first. The first repetition of a key held down looks like that, too, so after a silence of
    up to `DELAY_S` it counts once no other has followed it for `HELD_S`. Presses that still follow
    each other `INSIST_S` after the first are a stop as well. `land` is for STOP on the live page
    and for the signals that ask a program to end: it lands as one Ctrl-C does, however often it
    comes, and never adds up to a stop of the motors. All methods may be called from any thread.

    Until the flight loop listens there is nothing to land: `leave` raises `Interrupted`.
    """

    listening: bool = False
    landing_requested: bool = False
    clock: Callable[[], float] = time.monotonic
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _first_s: float | None = None
    _last_s: float = 0.0
    _second_s: float | None = None
    _stopped: bool = False

    def read(self) -> Operator:
        with self._lock:
            self._confirm(self.clock())
            if self._stopped:
                return Operator.STOP
            pressed = self._first_s is not None or self.landing_requested
            return Operator.LAND if pressed else Operator.NONE

    def land(self) -> None:
        self.landing_requested = True

    def press(self) -> None:
        with self._lock:
            now_s = self.clock()
            self._confirm(now_s)
            silent_s = now_s - self._last_s
            if self._first_s is None:
                self._first_s = now_s
            elif silent_s < HELD_S - _EPS_S:  # a key has begun to repeat, or it is hammered
                self._second_s = None
                self._stopped |= now_s - self._first_s >= INSIST_S - _EPS_S
            elif now_s - self._first_s >= AGAIN_S - _EPS_S:
                self._second_s = now_s
                self._stopped |= silent_s > DELAY_S + _EPS_S
            self._last_s = now_s

    def leave(self) -> None:
        """On a signal, in the main thread."""
        if not self.listening:
            raise Interrupted("interrupted before take-off: nothing was started")

    def _confirm(self, now_s: float) -> None:
        second_s = self._second_s
        if second_s is not None and now_s - second_s >= HELD_S - _EPS_S:
            self._stopped = True


# --- Positions from outside for one flight in real time: capture, feed, and the thread between ---


STRANGE_S = 0.5
"""For so long it is looked whether positions are of another world, before they are used."""


def check_positioning(profile: Profile, *, simulated: bool) -> None:
    """What can be refused before anything is opened. Errors: InvalidValue, UsageError."""
    config = profile.positioning
    check_estimator_parameters(profile.link.parameters, config)
    if config.by != "mocap":
        return
    if not simulated:
        check_reachable(config)
    elif find_spec("motioncapture") is None:  # its room has a capture of its own
        raise no_motion_capture()


def require_comparison(config: PositioningConfig, uri: str, *, simulated: bool) -> None:
    """Raises SafetyAbort for a capture that no hand has compared of late with this vehicle:
    that its axes are swapped does not show at rest. The simulator's own room is right as it is
    built."""
    if config.by != "mocap" or simulated:
        return
    objected = load_comparison(config, vehicle_uri(uri)).objection(wall_date())
    if objected is not None:
        raise SafetyAbort(": ".join(objected))


def opened_capture(
    stack: contextlib.ExitStack, config: PositioningConfig, clock: Clock
) -> CaptureSource | None:
    """The capture, None with decks. Errors: InvalidValue, UsageError, ConnectionFailed."""
    if config.by != "mocap":
        return None
    capture = open_capture(config, clock.now)
    stack.callback(capture.close)
    return capture


def capture_for_vehicle(
    config: PositioningConfig, simulated: tuple[str, str] | None
) -> PositioningConfig:
    """With the capture that measures this vehicle: a simulated one's is at `simulated`, its kind
    and address, and in no lab."""
    if simulated is None:
        return config
    system, host = simulated
    return config.model_copy(update={"system": system, "host": host})


def started_feed(
    stack: contextlib.ExitStack,
    capture: CaptureSource | None,
    link: CflibLink,
    config: PositioningConfig,
    clock: Clock,
    profile: Profile,
) -> PositionFeed | None:
    """The vehicle's estimate settled on what the capture says, and positions on their way until
    `stack` ends: the link is closed before that, since a vehicle that lands still needs them.
    None with decks, and where the target is the positioning system.

    Errors: those of `CflibLink.settle`, and SafetyAbort for positions of another world."""
    if config.by == "target":
        _settle_standing(link, clock, profile)
        return None  # what follows is seen, and sent, by the loop
    if capture is None:
        return None
    feed = PositionFeed(capture, link.external, config)
    thread = FeedThread(feed, clock.now)
    stack.callback(thread.close)
    thread.start()
    _refuse_strange(feed, link, clock, profile)
    link.settle(feed)
    return feed


def _settle_standing(link: CflibLink, clock: Clock, profile: Profile) -> None:
    """On the ground, which is the world's origin: the estimate is settled there."""
    feed = StandingFeed(link.external, profile.safety.ground_z_m)
    thread = FeedThread(feed, clock.now, 1.0 / profile.positioning.rate_hz)
    thread.start()
    try:
        link.settle(feed)
    finally:
        thread.close()


def _refuse_strange(feed: PositionFeed, link: CflibLink, clock: Clock, profile: Profile) -> None:
    """Before an estimate is set to them, and before their scatter or their place is taken for
    something else. What is late is left to those who wait for it."""
    end_s, newest, at_rest = clock.now() + STRANGE_S, None, AtRest()
    while (now_s := clock.now()) < end_s:
        newest = next(reversed(link.telemetry()), newest)
        refuse_strange(feed.status(now_s), newest, profile, now_s, at_rest)
        clock.wait_until(now_s + 0.02)
