"""The work behind `perchctl fly`: options in, a flight, its log, plot and exit code out."""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from perchctl.calibration import profile_camera
from perchctl.check import warnings_before_flight
from perchctl.commands.flight_plot import plot_of
from perchctl.commands.fly_plan import plan, plan_text, weights_text
from perchctl.commands.interrupt import drawn, signals_to_operator, unheeded
from perchctl.commands.output import confirmed, print_record, say, tell
from perchctl.commands.page import page_port
from perchctl.commands.positioning import positioned
from perchctl.display import (
    DisplayWatcher,
    FlightPage,
    failed_card,
    flight_page,
    make_reporter,
    summary_card,
)
from perchctl.errors import (
    EXIT_CODES,
    AttemptsUsedUp,
    EmergencyStopped,
    Interrupted,
    LogIncomplete,
    SafetyAbort,
    TargetNotFound,
    UsageError,
)
from perchctl.flight import (
    PLAIN_SEED,
    FlyOptions,
    OperatorSwitch,
    SessionResult,
    check_options,
    fly_session,
    require_comparison,
)
from perchctl.log import FlightSummary, LogWatcher, summary_text
from perchctl.mission import Event, EventKind, Outcome, Phase, Watcher
from perchctl.profile import find_profile, load_profile

EXIT_CODE_OF: dict[Outcome, int] = {
    Outcome.PERCHED: 0,
    Outcome.TARGET_NOT_FOUND: TargetNotFound.exit_code,
    Outcome.ATTEMPTS_USED_UP: AttemptsUsedUp.exit_code,
    Outcome.SAFETY: SafetyAbort.exit_code,
    Outcome.EMERGENCY: EmergencyStopped.exit_code,
    Outcome.OPERATOR: Interrupted.exit_code,
}


@dataclass(frozen=True)
class FlyRequest:
    """The command line as it was given; None is not given."""

    profile: str = "sim"
    uri: str | None = None
    source: str | None = None
    positioning: str | None = None
    seed: int | None = None
    log_dir: Path | None = None
    record: bool | None = None
    dry_run: bool = False
    yes: bool = False
    as_json: bool = False
    view: bool = False
    view_port: int = 0


def run(request: FlyRequest) -> int:
    """Fly, or show the plan; returns the exit code.

    Errors: those before the flight, and unforeseen ones after the vehicle was landed.
    """
    options = resolve(request)
    if request.dry_run:
        if request.as_json:
            print_record(plan(options))
        else:
            print(plan_text(options))
        return 0
    for warning in warnings_before_flight(options):
        say(f"check: {warning}")
    require_comparison(options.profile.positioning, options.uri, simulated=options.simulated)
    asks = not (request.yes or options.simulated)
    if asks and not sys.stdin.isatty():
        raise UsageError(f"about to arm {options.uri}, and there is nobody to ask: add --yes")
    return fly(options, request.as_json, page_port(request.view, request.view_port), asks)


def resolve(request: FlyRequest) -> FlyOptions:
    """The command line on top of the profile. Errors: NotFound, InvalidValue, UsageError."""
    profile = positioned(load_profile(request.profile), request.positioning)
    options = FlyOptions(
        profile=profile,
        profile_path=find_profile(request.profile),
        # An empty URI or source is an unset shell variable: not the profile's, but an error.
        uri=profile.link.uri if request.uri is None else request.uri,
        source=profile.camera.source if request.source is None else request.source,
        seed=PLAIN_SEED if request.seed is None else request.seed,
        log_dir=request.log_dir or Path(profile.log.directory),
    )
    record = not options.simulated if request.record is None else request.record
    options = replace(options, record=record)
    check_options(options)
    if request.seed is not None and not options.simulated:
        say(f"--seed {request.seed} is of simulated flights: it changes nothing at {options.uri}")
    return options


def ask_before_arming(uri: str) -> None:
    """Raises UsageError without a yes from the terminal."""
    if not confirmed(f"About to arm and fly {uri}. Is the space under the target clear?"):
        raise UsageError("not confirmed: nothing was started")


def fly(options: FlyOptions, as_json: bool, port: int | None, asks: bool = False) -> int:
    """Fly, log, plot, report how it ended; returns the exit code. `port` of the live page; `asks`:
    somebody at the terminal has to say yes before it arms."""
    simulated_seed = options.seed if options.simulated else None
    log = LogWatcher.real_time(
        options.log_dir, options.profile, options.uri, options.source, simulated_seed,
        options.record,
    )  # fmt: skip
    reporter = make_reporter(stream=sys.stderr)
    merges = ""
    if options.profile.merge.method == "weights":
        merges = f"; merges with {weights_text(options)}"
        log.event(Event(time.monotonic(), EventKind.NOTE, merges.removeprefix("; ")))
    say(f"connecting to {options.uri}{merges}")
    switch, page = OperatorSwitch(), None
    # Once it has landed nothing is left to stop, but much to tell.
    with unheeded(), contextlib.ExitStack() as stack:
        try:
            page = stack.enter_context(live_page(options, port, switch))
            result = _session(options, log, DisplayWatcher(reporter), switch, page, asks)
        except BaseException as error:
            # The page first: a disk that hangs holds up the log's end, and STOP would seem ready.
            if page is not None:
                page.end(failed_card(error, log.path if log.begun else None))
            log.abandon(str(error) or type(error).__name__)
            raise
        finally:
            reporter.close()
        perched = result.report.phase is Phase.PERCHED
        summary = log.close(result.report, result.miss_m if perched else None)
        assert summary is not None
        tell(summary_text(summary, log.path))
        if page is not None:
            page.end(summary_card(summary, log.path))
    code = exit_code(result.report.outcome, summary)
    plot = drawn(lambda: plot_of(log.path, options.profile))
    if plot is not None:
        tell(f"plot:      {plot}")
    if as_json:
        print_record(flight_record(summary, code, log.path, plot))
    return code


def flight_record(
    summary: FlightSummary, code: int, log: Path, plot: Path | None
) -> dict[str, Any]:
    """The one object of `--json`; `error` is None where the flight and its log are good."""
    return summary.as_record() | {
        "lost_records": summary.lost_records,
        "log_problem": summary.log_problem,
        "error": None if code == 0 else f"{EXIT_CODES[code]}: {summary.reason}".rstrip(": "),
        "exit_code": code,
        "log": str(log),
        "plot": None if plot is None else str(plot),
    }


def exit_code(outcome: Outcome, summary: FlightSummary) -> int:
    """Of the flight; of its log where the flight was good and the log is not."""
    code = EXIT_CODE_OF[outcome]
    return LogIncomplete.exit_code if code == 0 and summary.log_problem is not None else code


def _session(
    options: FlyOptions,
    log: LogWatcher,
    display: Watcher,
    switch: OperatorSwitch,
    page: FlightPage | None,
    asks: bool,
) -> SessionResult:
    """The session with the signals on its switch, and with the live page where there is one."""
    watchers: tuple[Watcher, ...] = (log, display)
    watched = log.watched
    if page is not None:
        watchers = (*watchers, page)
        watched = lambda source: page.watched(log.watched(source))  # noqa: E731
    with signals_to_operator(switch, say):
        ask = partial(ask_before_arming, options.uri) if asks else None
        return fly_session(options, watchers, switch, watched, log.remarks, ask)


def live_page(
    options: FlyOptions, port: int | None, switch: OperatorSwitch
) -> contextlib.AbstractContextManager[FlightPage | None]:
    """The page of `--view`, with STOP wired to the switch; None without it.

    Errors: InvalidValue for a port in use."""
    if port is None:
        return contextlib.nullcontext()
    return flight_page(
        profile_camera(options.profile.camera),
        f"perchctl fly {options.uri}",
        options.profile.target.large.side_m,
        port,
        switch.land,
        say,
    )
