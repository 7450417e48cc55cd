"""One flight in real time from Python, with the command's safety."""

from __future__ import annotations

import contextlib
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from perchctl.camera import FrameSource, WrappedSource
from perchctl.check import warnings_before_flight
from perchctl.errors import Note, require_type
from perchctl.flight import (
    FlyOptions,
    OperatorSwitch,
    check_options,
    fly_session,
    operator_signals,
)
from perchctl.mission import Event, FlightReport, Phase, Tick, Transition, Watcher
from perchctl.profile import Profile, load_profile
from perchctl.record import LogWatcher
from perchctl.vision import Frame


@dataclass(frozen=True)
class Flight:
    """A finished flight in real time: how it ended, its log for `read_log`, and of a simulated
    vehicle that perched the gear's distance from the target's centre, m."""

    report: FlightReport
    log: Path
    miss_m: float | None


def fly(
    profile: Profile | Path | str = "sim",
    uri: str | None = None,
    source: str | None = None,
    *,
    on_tick: Callable[[Tick], object] = lambda tick: None,
    on_event: Callable[[Event], object] = lambda event: None,
    should_stop: Callable[[], bool] = lambda: False,
    rows: Sequence[Transition] = (),
    seed: int = FlyOptions.seed,
    log_dir: Path | str | None = None,
    record: bool | None = None,
) -> Flight:
    """Fly once in real time, with the checks, planner, watchdog and log of `perchctl fly --yes`.
    **It arms at once.** In the main thread press Ctrl-C to land, and again to cut the motors.
    Warnings of the checks, and an incomplete log, are Python warnings (`perchctl.errors.Note`).

    Args:
        profile: a profile, its name or its file.
        uri, source: vehicle and camera, instead of the profile's. A script that flies ``sim://``
            needs ``if __name__ == "__main__":``, for the simulator's process.
        on_tick: called 50 times a second with a `Tick`: telemetry, target, planner's state and
            command; it must return within milliseconds.
        on_event: called with each new phase and each note.
        should_stop: called in each tick; once it returns True, the vehicle lands.
        rows: your own transitions, besides those of the profile; a replay does not know them.
        seed: of the simulated scenario.
        log_dir: folder of the log, instead of the profile's.
        record: keep the pictures beside the log; by default only of real vehicles.

    Raises:
        InvalidValue, NotFound, UsageError, ConnectionFailed, TimedOut, SafetyAbort, Interrupted:
        it refused to take off. In flight: the error of your function, raised after the landing.
    """
    profile = load_profile(profile)
    uri = profile.link.uri if uri is None else uri
    source = profile.camera.source if source is None else source
    require_type("uri", uri, str)
    require_type("source", source, str)
    require_type("seed", seed, int)
    log_dir = Path(profile.log.directory if log_dir is None else log_dir)
    options = FlyOptions(profile, Path(profile.name), uri, source, seed, log_dir)
    check_options(options)
    for warning in warnings_before_flight(options):
        warnings.warn(warning, Note, stacklevel=2)
    record = not options.simulated if record is None else record
    flown_seed = seed if options.simulated else None
    log = LogWatcher.open_real_time(log_dir, profile, uri, source, flown_seed, record)
    switch, caller = OperatorSwitch(), _UserCallbacks(on_tick, on_event)
    with contextlib.ExitStack() as stack:
        if threading.current_thread() is threading.main_thread():
            stack.enter_context(operator_signals(switch, partial(print, file=sys.stderr)))
        try:
            report, miss_m = fly_session(
                options,
                (log, caller),
                switch,
                lambda camera: log.watch_source(_Stoppable(camera, should_stop, switch)),
                log.remarks,
                rows=rows,
            )
        except BaseException as error:
            log.abandon(str(error) or type(error).__name__)
            raise
        miss_m = miss_m if report.phase is Phase.PERCHED else None
        summary = log.close(report, miss_m)
    problem = None if summary is None else summary.log_problem
    if problem is not None:
        warnings.warn(f"the flight's log is incomplete: {problem}", Note, stacklevel=2)
    return Flight(report, log.path, miss_m)


@dataclass
class _UserCallbacks(Watcher):
    """Calls a user's functions; what one raises lands the vehicle, as of any watcher."""

    on_tick: Callable[[Tick], object]
    on_event: Callable[[Event], object]

    def tick(self, tick: Tick) -> None:
        self.on_tick(tick)

    def event(self, event: Event) -> None:
        self.on_event(event)


class _Stoppable(WrappedSource):
    """Asks whether to stop in the loop's own thread: the watchdog's must not hang in it."""

    def __init__(
        self, source: FrameSource, should_stop: Callable[[], bool], switch: OperatorSwitch
    ) -> None:
        super().__init__(source)
        self._should_stop, self._switch = should_stop, switch

    def poll(self, now_s: float) -> Frame | None:
        if self._should_stop():
            self._switch.land()
        return super().poll(now_s)
