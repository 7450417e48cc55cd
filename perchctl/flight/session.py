"""One flight in real time, from options to report: opens the edges, flies, closes them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from perchctl.calibration import profile_camera
from perchctl.camera import (
    ALLOWED_SOURCES,
    SCHEMES,
    FrameSource,
    is_live,
    open_source,
    scheme_of,
    without_password,
)
from perchctl.errors import ConnectionFailed, InvalidValue, TimedOut, UsageError, no_simulator
from perchctl.flight.clock import Clock, SimulatedClock, WallClock
from perchctl.flight.loop import FlightParts, fly
from perchctl.flight.operator import OperatorSwitch
from perchctl.flight.positions import (
    capture_for_vehicle,
    check_positioning,
    opened_capture,
    require_comparison,
    started_feed,
)
from perchctl.link import CflibLink, check_uri
from perchctl.mission import Event, FlightReport, Watcher
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vision import CameraModel, make_pipeline

if TYPE_CHECKING:
    from perchctl.sim import SimProcess


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
    shown = without_password(options.source)
    if scheme_of(options.source) not in SCHEMES:
        raise InvalidValue(f"camera source {shown!r} is unknown; allowed are {ALLOWED_SOURCES}")
    if options.source.startswith("sim:") and not options.simulated:
        raise UsageError(
            f"source {shown} belongs to the simulated vehicle, but the URI is "
            f"{options.uri}; name the camera with --source (camera:N, http://..., aideck://HOST)"
        )
    if not is_live(options.source) and not options.simulated:
        raise UsageError(
            f"source {shown} is a recording, and {options.uri} a real vehicle: it would "
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
        if options.simulated:
            simulated = stack.enter_context(simulated_vehicle(options, camera))
            clock, uri = SimulatedClock(simulated.shared_time), simulated.uri
            spec = simulated.stream_url if spec.startswith("sim:") else spec
        config = profile.camera
        source = open_source(
            spec, config.start_latency_s, camera.size_px, clock.now, config.start_timeout_s,
            config=config,
        )  # fmt: skip
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
                _teller(options, clock), positions, remarks,
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


def _teller(options: FlyOptions, clock: Clock) -> Callable[[Event], str]:
    """What the simulated scenario did, by the time at which the simulation was then."""
    if not isinstance(clock, SimulatedClock):
        return lambda event: ""
    from perchctl.sim import EventExplainer, draw_scenario

    tell = EventExplainer(draw_scenario(options.profile, options.seed))
    return lambda event: tell(event, event.t_s - clock.zero_s)


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
