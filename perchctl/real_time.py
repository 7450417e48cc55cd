"""Fly in real time from Python, with the same safeguards as `perchctl fly`."""

from __future__ import annotations

import contextlib
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from perchctl.check import warnings_before_flight
from perchctl.errors import Note, require_type
from perchctl.extensions import error_at
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


@dataclass(frozen=True)
class Flight:
    """A finished flight in real time: how it ended, its log (for `read_log`) and, if a simulated
    vehicle perched, the distance of the gear from the target's centre, m."""

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
    **It arms the vehicle without asking.** Ctrl-C works if you call this function in the main
    thread. Press Ctrl-C to land. Press it again to cut the motors. Warnings from the checks, and an
    incomplete log, are reported as Python warnings (`perchctl.errors.Note`).

    Args:
        profile: a profile, its name, or its file.
        uri, source: vehicle and camera, instead of the profile's. A script that flies ``sim://``
            needs ``if __name__ == "__main__":``, because it starts the simulator's process.
        on_tick: called 50 times a second with a `Tick`: telemetry, target, planner's state and
            command; it must return within milliseconds. If it raises an exception, it is not called
            again, the flight continues, and a warning is issued.
        on_event: called with each new phase and each note. An error in `on_event` is treated in the
            same way as one in `on_tick`.
        should_stop: called in each tick; once it returns True or raises an exception, the vehicle
            lands.
        rows: your own transitions, in addition to those of the profile. A replay does not use them.
        seed: seed of the simulated scenario.
        log_dir: folder for the log, instead of the profile's.
        record: store the images next to the log; by default only for real vehicles.

    Raises:
        InvalidValue, NotFound, UsageError, ConnectionFailed, TimedOut, SafetyAbort, Interrupted:
        the flight was refused before take-off. KeyboardInterrupt and SystemExit raised by your
        functions, once the vehicle has landed.
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
    switch = OperatorSwitch()
    stopper = _Stopper(should_stop, switch)
    with contextlib.ExitStack() as stack:
        stack.callback(stopper.warn)
        if threading.current_thread() is threading.main_thread():
            stack.enter_context(operator_signals(switch, partial(print, file=sys.stderr)))
        try:
            report, miss_m = fly_session(
                options,
                (log, _OnTick(on_tick), _OnEvent(on_event)),
                switch,
                stopper.ask,
                lambda: [*log.remarks(), *stopper.remarks()],
                rows=rows,
            )
        except BaseException as error:
            log.abandon(str(error) or type(error).__name__)
            for sentence in getattr(error, "__notes__", ()):
                warnings.warn(sentence, Note, stacklevel=2)
            raise
        miss_m = miss_m if report.phase is Phase.PERCHED else None
        summary = log.close(report, miss_m)
    problem = None if summary is None else summary.log_problem
    if problem is not None:
        warnings.warn(f"the flight log is incomplete: {problem}", Note, stacklevel=2)
    for sentence in report.detached_watcher_messages:
        warnings.warn(sentence, Note, stacklevel=2)
    return Flight(report, log.path, miss_m)


@dataclass(frozen=True)
class _OnTick(Watcher):
    call: Callable[[Tick], object]
    name: str = "on_tick"

    def tick(self, tick: Tick) -> None:
        self.call(tick)


@dataclass(frozen=True)
class _OnEvent(Watcher):
    call: Callable[[Event], object]
    name: str = "on_event"

    def event(self, event: Event) -> None:
        self.call(event)


class _Stopper:
    """Calls `should_stop` and commands the landing. Runs in the loop's own thread, because the
    watchdog's thread must not be blocked by user code. If the function raises an exception, the
    vehicle lands, because the function may have been about to return True; it is not called
    again."""

    def __init__(self, should_stop: Callable[[], bool], switch: OperatorSwitch) -> None:
        self._should_stop, self._switch = should_stop, switch
        self._error: str | None = None
        self._remarks: list[str] = []

    def ask(self) -> None:
        try:
            if self._error is None and self._should_stop():
                self._switch.land()
        except Exception as error:
            self._switch.land()
            self._error = f"should_stop raised {error_at(error)}"
            self._remarks.append(f"{self._error}: landing")

    def remarks(self) -> list[str]:
        remarks, self._remarks = self._remarks, []
        return remarks

    def warn(self) -> None:
        if self._error is not None:
            warnings.warn(f"{self._error}: the flight was ended", Note, stacklevel=3)
