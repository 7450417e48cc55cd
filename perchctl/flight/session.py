"""One flight from options to report: opens the edges, flies, closes them again.

The command line calls `fly_session`; nothing here knows typer.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from perchctl.calibration.files import load_calibration
from perchctl.camera.mirror import UnmirroredSource
from perchctl.camera.open import ALLOWED, open_source
from perchctl.camera.source import FrameSource
from perchctl.display.page.flight import FlightView, flight_view
from perchctl.errors import ConnectionFailed, Interrupted, InvalidValue, TimedOut, UsageError
from perchctl.flight.loop import FlightParts, FlightReport, Watcher, fly
from perchctl.link.cflib_link import CflibLink
from perchctl.link.uri import check_uri
from perchctl.mission.state import Operator
from perchctl.pipeline import PipelineSetup, make_setup
from perchctl.profile import Profile, find_calibration
from perchctl.vision.types import CameraModel

SOURCE_SCHEMES = ("camera", "video", "images", "http", "https", "sim")


@dataclass(frozen=True)
class FlyOptions:
    """What the command line asked for, on top of the profile."""

    profile: Profile
    profile_path: Path
    uri: str
    source: str
    seed: int = 0
    log_dir: Path = Path("perchctl-logs")
    view: bool = False
    view_port: int = 0

    @property
    def simulated(self) -> bool:
        return self.uri.startswith("sim://")


@dataclass(frozen=True)
class SessionResult:
    """How the flight ended; `miss_m` where a simulator knows it."""

    report: FlightReport
    miss_m: float | None = None


class WallClock:
    """The one clock of a real-time flight."""

    def now(self) -> float:
        return time.monotonic()

    def wait_until(self, t_s: float) -> None:
        left_s = t_s - time.monotonic()
        if left_s > 0:
            time.sleep(left_s)


@dataclass
class OperatorSwitch:
    """Ctrl-C as the planner understands it: once lands, twice stops.

    `land` is the word of the live page's STOP button: it lands as one Ctrl-C does, however
    often it is pressed, and never adds up to a stop of the motors.

    Until the flight loop listens there is nothing to land, and the first Ctrl-C
    leaves by `Interrupted`.
    """

    listening: bool = False
    presses: int = 0
    landing_asked: bool = False
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def read(self) -> Operator:
        return Operator(min(max(self.presses, int(self.landing_asked)), 2))

    def land(self) -> None:
        self.landing_asked = True

    def press(self, _signal: int = 0, _frame: FrameType | None = None) -> None:
        if not self.listening:
            raise Interrupted("Ctrl-C before take-off: nothing was started")
        self.presses += 1

    @contextlib.contextmanager
    def installed(self) -> Iterator[OperatorSwitch]:
        """Takes SIGINT and SIGTERM for the duration (main thread only)."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        names = (signal.SIGINT, signal.SIGTERM)
        old = {name: signal.signal(name, self.press) for name in names}
        try:
            yield self
        finally:
            for name, handler in old.items():
                signal.signal(name, handler)


def camera_model(profile: Profile, profile_path: Path | None) -> CameraModel:
    return load_calibration(find_calibration(profile.camera.calibration, profile_path))


def pipeline_setup(profile: Profile, camera: CameraModel) -> PipelineSetup:
    return make_setup(
        profile.detector,
        profile.pose,
        profile.kalman,
        profile.merge,
        profile.target,
        profile.camera.mount.T_body_cam,
        profile.vehicle.gear_body_m,
        camera,
    )


def check_options(options: FlyOptions) -> None:
    """What can be refused before anything is opened. Errors: InvalidValue, UsageError."""
    check_uri(options.uri)
    if options.source.partition(":")[0] not in SOURCE_SCHEMES:
        raise InvalidValue(f"camera source {options.source!r} is unknown; allowed are {ALLOWED}")
    if options.source.startswith("sim:") and not options.simulated:
        raise UsageError(
            f"source {options.source} belongs to the simulated vehicle, but the URI is "
            f"{options.uri}; name the camera with --source (camera:N, http://...)"
        )
    if options.seed < 0:
        raise InvalidValue(f"seed {options.seed} is negative; seeds are 0, 1, 2, ...")


def fly_session(options: FlyOptions, watchers: tuple[Watcher, ...] = ()) -> SessionResult:
    """Fly once, in real time through cflib. Errors: the tree of `perchctl.errors`."""
    check_options(options)
    camera = camera_model(options.profile, options.profile_path)
    setup = pipeline_setup(options.profile, camera)
    clock = WallClock()
    switch = OperatorSwitch()
    with switch.installed(), contextlib.ExitStack() as stack:
        view = stack.enter_context(live_page(options, camera, switch))
        uri, spec, simulated = options.uri, options.source, None
        if options.simulated:
            simulated = stack.enter_context(_simulated_vehicle(options, camera))
            uri = simulated.uri
            spec = simulated.stream_url if spec.startswith("sim:") else spec
        source: FrameSource = open_source(
            spec,
            options.profile.camera.latency_s,
            camera.size_px,
            clock.now,
            options.profile.camera.start_timeout_s,
        )
        stack.callback(source.close)
        if options.profile.camera.mirrored:
            source = UnmirroredSource(source)
        if view is not None:
            source, watchers = view.watched(source), (*watchers, view)
        link = CflibLink(uri, options.profile.link, clock.now)
        try:
            link.connect()
            switch.listening = True
            parts = FlightParts(link, source, clock, options.profile, setup, watchers, switch.read)
            report = fly(parts)
        finally:
            switch.listening = True  # while closing, Ctrl-C must not cut the wait short
            link.close()
        miss_m = _true_miss_m(simulated)
    return SessionResult(report, miss_m=miss_m)


def _true_miss_m(simulated: Any | None) -> float | None:
    """What the simulator knows; a simulator that is gone does not spoil the report."""
    if simulated is None:
        return None
    with contextlib.suppress(ConnectionFailed, TimedOut):
        return float(simulated.truth()["gear_miss_m"])
    return None


def live_page(
    options: FlyOptions, camera: CameraModel, switch: OperatorSwitch
) -> contextlib.AbstractContextManager[FlightView | None]:
    """The page of `--view`, with STOP wired to the switch; None without it.

    Errors: InvalidValue for a port in use."""
    if not options.view:
        return contextlib.nullcontext()
    return flight_view(
        camera,
        f"perchctl fly {options.uri}",
        options.profile.target.large.side_m,
        options.view_port,
        switch.land,
        lambda text: print(f"perchctl: {text}", file=sys.stderr),
    )


def _simulated_vehicle(options: FlyOptions, camera: CameraModel) -> Any:
    try:
        from perchctl.sim.draw import draw_scenario
        from perchctl.sim.process.handle import SimProcess
    except ImportError as error:
        raise UsageError(
            f"sim:// needs the simulator, which is not installed ({error.name} is missing); "
            f"install it with: {sys.executable} -m pip install 'perchctl[sim]'"
        ) from None
    scenario = draw_scenario(options.profile, options.seed)
    return SimProcess.start(scenario, camera=camera, target=options.profile.target)
