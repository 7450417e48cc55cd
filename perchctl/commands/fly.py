"""The work behind `perchctl fly`: options in, a flight, its log, plot and exit code out."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from pathlib import Path
from typing import Any

from perchctl.calibration.files import load_calibration
from perchctl.commands.interrupt import signals_to
from perchctl.display.page.flight import FlightPage, flight_page
from perchctl.display.panel import make_reporter
from perchctl.display.watch import DisplayWatcher
from perchctl.errors import (
    AttemptsUsedUp,
    EmergencyStopped,
    Interrupted,
    SafetyAbort,
    TargetNotFound,
)
from perchctl.flight.operator import OperatorSwitch
from perchctl.flight.session import FlyOptions, SessionResult, check_options, fly_session
from perchctl.log.read import read_log
from perchctl.log.summary import summary_text
from perchctl.log.watch import LogWatcher
from perchctl.mission.state import Outcome, Phase
from perchctl.mission.watch import Event, EventKind, Watcher
from perchctl.profile import (
    Profile,
    find_calibration,
    find_profile,
    find_weights,
    load_profile,
    read_weights,
)

EXIT_CODE_OF: dict[Outcome, int] = {
    Outcome.PERCHED: 0,
    Outcome.TARGET_NOT_FOUND: TargetNotFound.exit_code,
    Outcome.ATTEMPTS_USED_UP: AttemptsUsedUp.exit_code,
    Outcome.SAFETY: SafetyAbort.exit_code,
    Outcome.EMERGENCY: EmergencyStopped.exit_code,
    Outcome.OPERATOR: Interrupted.exit_code,
}


def resolve(
    profile_name: str, uri: str | None, source: str | None, seed: int, log_dir: Path | None
) -> FlyOptions:
    """The command line on top of the profile. Errors: NotFound, InvalidValue, UsageError."""
    profile = load_profile(profile_name)
    options = FlyOptions(
        profile=profile,
        profile_path=find_profile(profile_name),
        # An empty one is an unset shell variable, not a wish for the simulated vehicle.
        uri=profile.link.uri if uri is None else uri,
        source=profile.camera.source if source is None else source,
        seed=seed,
        log_dir=log_dir or Path(profile.log.directory),
    )
    check_options(options)
    return options


def plan(options: FlyOptions) -> dict[str, Any]:
    """What would be flown, fully resolved; nothing is connected."""
    calibration = find_calibration(options.profile.camera.calibration)
    return {
        "uri": options.uri,
        "source": options.source,
        "seed": options.seed if options.simulated else None,
        "profile_file": str(options.profile_path),
        "calibration_file": str(calibration),
        "log_directory": str(options.log_dir),
        "profile": options.profile.model_dump(mode="json"),
    }


def plan_json(options: FlyOptions) -> str:
    return json.dumps(plan(options))


def plan_text(options: FlyOptions) -> str:
    """The plan for people: what, where, and the phases with their numbers."""
    resolved, planner = plan(options), options.profile.planner
    search, ascend, perch = planner.search, planner.ascend, planner.perch
    target = options.profile.target
    merge = options.profile.merge
    how = weights_text(options) if merge.method == "weights" else "joint solve"
    press = (
        f"raw thrust {perch.thrust}" if perch.mode == "raw" else f"press {perch.press_m} m above"
    )
    lines = [
        f"vehicle      {resolved['uri']}" + (f", seed {options.seed}" if options.simulated else ""),
        f"camera       {resolved['source']}, calibration {resolved['calibration_file']}",
        f"profile      {resolved['profile_file']}: {options.profile.description}".rstrip(": "),
        f"target       {target.large.side_m * 1e3:g} mm {target.large.dictionary}/"
        f"{target.large.id} around {target.small.side_m * 1e3:g} mm "
        f"{target.small.dictionary}/{target.small.id}",
        f"merge        {how}",
        f"1 APPROACH   take off to {planner.takeoff_height_m:g} m",
        f"2 SEARCH     {search.attempts} attempts of {search.wait_s:g} s, {search.step_m:g} m "
        f"higher each, at most {search.max_height_m:g} m",
        f"3 ESTIMATE   {planner.estimate.dwell_s:g} s of steady pose",
        f"4 ALIGN      within {planner.align.xy_m * 1e3:g} mm and {planner.align.yaw_deg:g} deg "
        f"for {planner.align.dwell_s:g} s",
        f"5 ASCEND     at {ascend.speed_mps:g} m/s to {ascend.standoff_m * 1e3:g} mm under the "
        f"target, settle within {ascend.settle_xy_m * 1e3:g} mm",
        f"6 PERCH      {press}, at most {perch.timeout_s:g} s",
        f"7 COMPLETE   release in {planner.complete.steps} steps, watch for "
        f"{planner.complete.watch_s:g} s",
        f"attempts     {planner.attempts}, perching time {planner.perching_time_s:g} s",
        f"log          {resolved['log_directory']}",
    ]
    return "\n".join(lines)


def weights_text(options: FlyOptions) -> str:
    """Which merge weights fly, and where they are from: date, method, data."""
    merge = options.profile.merge
    numbers = ", ".join(f"{axis} {w:g}" for axis, w in merge.weights.model_dump().items())
    if merge.weights_file is None:
        return f"weights {numbers} (of the profile)"
    path = find_weights(merge.weights_file, options.profile_path)
    fitted = read_weights(path)
    origin = [fitted.date and f"of {fitted.date}", fitted.method]
    if fitted.data.sha256:
        origin.append(f"data {fitted.data.sha256[:12]}")
    said = ", ".join(part for part in origin if part)
    return f"weights {numbers} (from {path}{': ' + said if said else ''})"


def run(options: FlyOptions, *, as_json: bool = False, page_port: int | None = None) -> int:
    """Fly, log, plot, say how it ended; returns the exit code. Errors before the flight
    and unforeseen ones are raised, after the vehicle has been landed.

    `page_port`: where to serve the live page (0: any free port); None: no page.
    """
    simulated_seed = options.seed if options.simulated else None
    log = LogWatcher.real_time(
        options.log_dir, options.profile, options.uri, options.source, simulated_seed
    )
    reporter = make_reporter(stream=sys.stderr)
    merges = ""
    if options.profile.merge.method == "weights":
        merges = f"; merges with {weights_text(options)}"
        log.event(Event(time.monotonic(), EventKind.NOTE, merges.removeprefix("; ")))
    print(f"perchctl: connecting to {options.uri}{merges}", file=sys.stderr)
    try:
        result = _fly(options, (log, DisplayWatcher(reporter)), page_port)
    except BaseException as error:
        log.abandon(str(error) or type(error).__name__)
        raise
    finally:
        reporter.close()
    perched = result.report.phase is Phase.PERCHED
    summary = log.close(result.report, result.miss_m if perched else None)
    assert summary is not None
    plot = _plot(log.path, options.profile)
    print(summary_text(summary, log.path, plot), file=sys.stderr)
    code = EXIT_CODE_OF[result.report.outcome]
    if as_json:
        print(json.dumps(summary.as_record() | {"exit_code": code, "log": str(log.path)}))
    return code


def _fly(
    options: FlyOptions, watchers: tuple[Watcher, ...], page_port: int | None
) -> SessionResult:
    """The session, with Ctrl-C on its switch and the live page, if asked for, around it."""
    switch = OperatorSwitch()
    with signals_to(switch.press), live_page(options, page_port, switch) as page:
        if page is None:
            return fly_session(options, watchers, switch)
        return fly_session(options, (*watchers, page), switch, page.watched)


def live_page(
    options: FlyOptions, port: int | None, switch: OperatorSwitch
) -> contextlib.AbstractContextManager[FlightPage | None]:
    """The page of `--view`, with STOP wired to the switch; None without it.

    Errors: InvalidValue for a port in use."""
    if port is None:
        return contextlib.nullcontext()
    return flight_page(
        load_calibration(options.profile.camera.calibration),
        f"perchctl fly {options.uri}",
        options.profile.target.large.side_m,
        port,
        switch.land,
        lambda text: print(f"perchctl: {text}", file=sys.stderr),
    )


def _plot(path: Path, profile: Profile) -> Path | None:
    """The flight's picture; a plot that fails is a warning, the flight is over."""
    if not profile.log.plot:
        return None
    from perchctl.log.plot import plot_flight

    picture = path.with_suffix(".png")
    try:
        plot_flight(read_log(path), picture)
    except Exception as error:
        print(f"perchctl: the plot could not be drawn: {error}", file=sys.stderr)
        return None
    return picture
