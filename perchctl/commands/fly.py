"""`perchctl fly`: resolve the options, fly, write log and plot, and return the exit code."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import calibration as calibrations
from perchctl import camera as cameras
from perchctl import check as checks
from perchctl import display as displays
from perchctl import flight as flights
from perchctl import mission as missions
from perchctl import profile as profiles
from perchctl import record as records
from perchctl import target as targets
from perchctl.commands.command_line import (
    EXIT_TABLE,
    JsonOption,
    PositioningOption,
    ProfileOption,
    SourceOption,
    UriOption,
    ViewOption,
    command,
    new_app,
)
from perchctl.commands.interrupt import ignore_signals, interruptible
from perchctl.commands.output import (
    add_problem,
    ask_to_confirm,
    print_lines,
    print_result,
    say,
    say_on_terminal,
    stdin_number,
)
from perchctl.commands.profile import front_left_edges
from perchctl.errors import (
    EXIT_CODES,
    InvalidValue,
    PerchError,
    UsageError,
)
from perchctl.wrapping import wrap_line

SeedOption = Annotated[
    int | None, typer.Option("--seed", min=0, help="Seed of the simulated scenario. Default: 11.")
]
LogDirOption = Annotated[
    Path | None, typer.Option("--log-dir", help="Folder for the flight log and plot.")
]
RecordOption = Annotated[
    bool | None,
    typer.Option(
        "--record/--no-record",
        help="Record the images to an MCAP file next to the log. Default: only for a real vehicle.",
    ),
]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Show the resolved plan without connecting to anything.")
]
YesOption = Annotated[
    bool, typer.Option("--yes", "-y", help="Arm without asking for confirmation.")
]

app = new_app()


@command(
    app,
    "perchctl fly",
    "perchctl fly -p my_vehicle.yaml --dry-run",
    "perchctl fly -p my_vehicle.yaml --uri radio://0/80/2M/E7E7E7E7E7 --view",
    ending=EXIT_TABLE,
)
def fly(
    profile: ProfileOption = "sim",
    uri: UriOption = None,
    source: SourceOption = None,
    positioning: PositioningOption = None,
    seed: SeedOption = None,
    log_dir: LogDirOption = None,
    record: RecordOption = None,
    dry_run: DryRunOption = False,
    yes: YesOption = False,
    as_json: JsonOption = False,
    view: ViewOption = False,
) -> int:
    """Fly a perching mission: find the target, align, ascend, perch, stop the motors.

    Without options, perchctl flies the simulated vehicle. Press Ctrl-C to land. Press it again to
    cut the motors. The space bar cuts the motors at once.
    """
    say_on_terminal(f"reading profile {profile}")
    options = resolve_options(profile, uri, source, positioning, seed, log_dir, record)
    refuse_hover(options.profile)
    return plan_or_fly(options, dry_run=dry_run, yes=yes, as_json=as_json, view=view)


def refuse_hover(profile: profiles.Profile) -> None:
    """Raise InvalidValue if the profile's mission is a hover; called by commands that perch."""
    if profile.planner.hover is not None:
        raise InvalidValue(
            "planner.hover is set, so the vehicle would hover instead of perching: remove it from "
            "the profile, or use `perchctl hover`"
        )


def plan_or_fly(
    options: flights.FlyOptions, *, dry_run: bool, yes: bool, as_json: bool, view: bool
) -> int:
    """Show the plan for a flight, or fly it; return the exit code. Errors: UsageError if there is
    no terminal for the confirmation, and the errors of the flight."""
    if dry_run:
        refused = plan_problem(options)
        print_result(add_problem(plan_record(options), refused) if as_json else plan_text(options))
        if refused is None:
            return 0
        say(f"{command_name(options.profile)} would refuse to start: {refused}")
        return refused.exit_code
    for warning in checks.warnings_before_flight(options):
        say(f"check: {warning}")
    options.require_lift_check()
    asks = not (yes or options.simulated)
    if asks and not sys.stdin.isatty():
        raise UsageError(
            f"arming {options.uri} needs your confirmation, and the input is not a "
            "terminal: add --yes"
        )
    return fly_and_report(options, as_json, view, asks)


def resolve_options(
    profile_name: str = "sim",
    uri: str | None = None,
    source: str | None = None,
    positioning: str | None = None,
    seed: int | None = None,
    log_dir: Path | None = None,
    record: bool | None = None,
) -> flights.FlyOptions:
    """Merge the options from the command line (None: not given) with the profile. Errors: NotFound,
    InvalidValue, UsageError."""
    profile = with_positioning(profiles.load_profile(profile_name), positioning)
    options = flights.FlyOptions(
        profile=profile,
        profile_path=profiles.find_profile(profile_name),
        # An empty URI or source comes from an unset shell variable: report an error instead of
        # using the profile's.
        uri=profile.link.uri if uri is None else uri,
        source=profile.camera.source if source is None else source,
        seed=flights.FlyOptions.seed if seed is None else seed,
        log_dir=log_dir or Path(profile.log.directory),
    )
    options = replace(options, record=not options.simulated if record is None else record)
    flights.check_options(options)
    return options


def command_name(profile: profiles.Profile) -> str:
    """Return the name of the command that flies the profile's mission."""
    return "fly" if profile.planner.hover is None else "hover"


def with_positioning(profile: profiles.Profile, method: str | None) -> profiles.Profile:
    """Return the profile with the positioning method of `--positioning`, or unchanged for None.
    Errors: InvalidValue."""
    if method is None:
        return profile
    if method not in positioning_methods():
        raise InvalidValue(
            f"--positioning {method!r} is unknown; allowed are {', '.join(positioning_methods())}"
            f"{profiles.PositioningConfig.deck_note(method)}"
        )
    return profile.with_({"positioning.by": method})


def positioning_methods() -> tuple[str, ...]:
    """Return the positioning methods that `--positioning` accepts."""
    methods: tuple[str, ...] = get_args(profiles.PositioningConfig.model_fields["by"].annotation)
    return methods


def ask_before_arming(uri: str) -> None:
    """Ask for permission to arm; raise UsageError unless the answer is yes."""
    if not ask_to_confirm(f"About to arm and fly {uri}. Is the space under the target clear?"):
        raise UsageError("not confirmed: nothing was started")


def fly_and_report(
    options: flights.FlyOptions, as_json: bool, view: bool, confirm: bool = False
) -> int:
    """Fly, write log and plot, and report how the flight ended; return the exit code. `view`: open
    the live page. `confirm`: ask on the terminal before arming."""
    simulated_seed = options.seed if options.simulated else None
    log = records.LogWatcher.open_real_time(
        options.log_dir,
        options.profile,
        options.uri,
        options.source,
        simulated_seed,
        options.record,
    )
    panel = displays.FlightPanel(sys.stderr)
    say(f"connecting to {options.uri}")
    switch, page = flights.OperatorSwitch(), None
    detached: tuple[str, ...] = ()
    # Once the vehicle has landed, there is nothing left to stop, and the results must be reported.
    with ignore_signals(), contextlib.ExitStack() as stack:
        try:
            page = stack.enter_context(flight_page(options, view, switch))
            report, miss_m = _session(options, log, panel, switch, page, confirm)
            detached = report.detached_watcher_messages
        except BaseException as error:
            detached = tuple(getattr(error, "__notes__", ()))
            # End the page first: a disk that does not respond can delay closing the log, and
            # meanwhile the Land button would seem active.
            if page is not None:
                page.fail(error, log.path if log.has_begun else None)
            log.abandon(str(error) or type(error).__name__)
            raise
        finally:
            panel.close()
            if panel.failure is not None:
                say(panel.failure)
            for sentence in detached:
                say(sentence)
        summary = log.close(report, miss_m if report.phase is missions.Phase.PERCHED else None)
        assert summary is not None
        written = print_lines(summary.text(log.path), stdout=not as_json)
        if page is not None:
            page.end(summary, log.path)
    code = summary.exit_code or (0 if written else InvalidValue.exit_code)
    plot = draw_flight_plot(log.path, options.profile)
    if plot is not None:
        print_lines(f"plot:      {plot}", stdout=not as_json)
    if as_json:
        print_result(flight_record(summary, code, log.path, plot))
    return code


def draw_flight_plot(log_path: Path, profile: profiles.Profile) -> Path | None:
    """Plot the flight next to its log if the profile says so, and return the plot's path. If
    plotting fails or is interrupted, only print a warning."""
    if not profile.log.plot:
        return None
    picture = records.path_beside(log_path, ".png")
    try:
        with interruptible():
            from perchctl.analysis import plot_flight

            plot_flight(records.read_log(log_path), picture)
    except (Exception, KeyboardInterrupt) as error:
        say(f"the plot could not be drawn: {str(error) or 'Ctrl-C'}")
        return None
    return picture


def flight_record(
    summary: records.FlightSummary, code: int, log: Path, plot: Path | None
) -> dict[str, Any]:
    """Return the JSON object for `--json`; its `error` is None if neither the flight nor the log
    failed."""
    return summary.as_record() | {
        "lost_records": summary.lost_records,
        "log_problem": summary.log_problem,
        "error": None if code == 0 else f"{EXIT_CODES[code]}: {summary.reason}".rstrip(": "),
        "exit_code": code,
        "log": str(log),
        "plot": None if plot is None else str(plot),
    }


def _session(
    options: flights.FlyOptions,
    log: records.LogWatcher,
    panel: displays.FlightPanel,
    switch: flights.OperatorSwitch,
    page: displays.FlightPage | None,
    asks: bool,
) -> tuple[missions.FlightReport, float | None]:
    watchers: tuple[missions.Watcher, ...] = (log, panel)
    if page is not None:
        watchers = (*watchers, page)
    with flights.operator_signals(switch, say), contextlib.ExitStack() as stack:

        def before_arming() -> None:
            if asks:
                ask_before_arming(options.uri)
            has_key = stack.enter_context(flights.cut_key(switch, stdin_number()))
            panel.help = flights.STOP_HELP, flights.KEY_HELP if has_key else ""
            print_lines("\n".join(filter(None, panel.help)))

        return flights.fly_session(
            options, watchers, switch, remarks=log.remarks, before_arming=before_arming
        )


@contextlib.contextmanager
def flight_page(
    options: flights.FlyOptions, view: bool, switch: flights.OperatorSwitch
) -> Iterator[displays.FlightPage | None]:
    """Yield the live page with buttons to land and to cut the motors; None if `view` is False."""
    if not view:
        yield None
        return
    title = f"perchctl {command_name(options.profile)} {options.uri}"
    camera = calibrations.profile_camera(options.profile.camera)
    with displays.live_page(camera, title, view, say, switch.land, switch.cut) as page:
        yield None if page is None else displays.FlightPage.of(page, options.profile)


# --- `perchctl fly --dry-run`: show the resolved flight plan without opening anything


_COLUMN, _WIDTH = 13, 80


def plan_problem(options: flights.FlyOptions) -> PerchError | None:
    """Return the error that `fly` would raise for these options before it opens anything."""
    try:
        checks.warnings_before_flight(options)
        options.require_lift_check()
    except PerchError as error:
        return error
    return None


def plan_record(options: flights.FlyOptions) -> dict[str, Any]:
    """Return the fully resolved flight plan, without connecting to anything."""
    calibration = profiles.find_calibration(options.profile.camera.calibration)
    mask = options.profile.camera.mask
    rows = checks.profile_rows(options.profile, source=options.source, uri=options.uri)
    compared = checks.comparison_rows(
        options.profile.positioning,
        options.uri,
        datetime.now().astimezone(),
        simulated=options.simulated,
    )
    return {
        "uri": options.uri,
        "source": cameras.without_password(options.source),
        "seed": options.seed if options.simulated else None,
        "profile_file": str(options.profile_path),
        "calibration_file": str(calibration),
        "mask_file": None if mask is None else str(profiles.find_mask(mask)),
        "log_directory": str(options.log_dir),
        "record": options.record,
        "profile": cameras.profile_record(options.profile),
        "check": [dataclasses.asdict(row) for row in (*rows, *compared)],
    }


def plan_text(options: flights.FlyOptions) -> str:
    """Return the plan as text of 80 columns: vehicle, camera, target, path, and implausible values
    in the profile."""
    resolved, profile, planner = plan_record(options), options.profile, options.profile.planner
    camera, large, small = profile.camera, profile.target.large, profile.target.small
    mask = f", mask {resolved['mask_file']}" if resolved["mask_file"] else ""
    turn = " ".join(f"{angle:g}" for angle in camera.mount.rpy_deg)
    edges = front_left_edges(camera.mount, camera.mirrored)
    late = camera.latency_s
    mission = []
    if planner.hover is not None:
        below_m, duration_s = planner.hover.below_m, planner.hover.duration_s
        hover = f"hover {below_m:g} m below the target for {duration_s:g} s, then land"
        mission = [("mission", hover)]
    rows = [
        ("vehicle", f"{options.uri}{f', seed {options.seed}' if options.simulated else ''}"),
        ("camera", f"{resolved['source']}, calibration {resolved['calibration_file']}{mask}"),
        ("positioning", _positioning(options)),
        ("profile", f"{resolved['profile_file']}: {profile.description}"),
        (
            "target",
            f"{large.side_m * 1e3:g} mm {large.dictionary}/{large.id} around "
            f"{small.side_m * 1e3:g} mm {small.dictionary}/{small.id}",
        ),
        ("gear", f"tip at {_mm(profile.vehicle.gear_body_m)} (forward, left, up)"),
        (
            "mounting",
            f"camera at {_mm(camera.mount.position_m)}, rpy {turn} deg"
            f"{', mirrored' if camera.mirrored else ''}"
            + (
                f": the front is at the picture's {edges[0]} edge, the left side at its "
                f"{edges[1]} edge"
                if edges
                else ""
            ),
        ),
        ("latency", late if isinstance(late, str) else f"{late * 1e3:g} ms"),
        ("merge", f"{profile.merge.method} {profile.merge.weights_file or ''}".rstrip()),
        *mission,
        (
            "path",
            f"take off to {planner.takeoff_height_m:g} m, search up to "
            f"{planner.search.max_height_m:g} m, ascend at {planner.ascend.speed_mps:g} m/s",
        ),
        (
            "limits",
            f"{profile.safety.fence_radius_m:g} m around the take-off point, "
            f"{profile.safety.max_height_m:g} m above the ground; battery "
            f"{profile.safety.min_rest_v:g} V at rest, {profile.safety.min_load_v:g} V in "
            "flight",
        ),
        ("log", f"{resolved['log_directory']}{', with pictures' if options.record else ''}"),
    ]
    rows += [
        (row["verdict"], f"{row['name']}: {row['found']}; {row['advice']}")
        for row in resolved["check"]
        if row["verdict"] in (checks.Verdict.WARN, checks.Verdict.FAIL)
    ]
    return "\n".join(wrap_line(f"{name:{_COLUMN}}{text}", _WIDTH, _COLUMN) for name, text in rows)


def _positioning(options: flights.FlyOptions) -> str:
    profile, config = options.profile, options.profile.positioning
    if config.source.is_target:
        view = targets.overhead_text(
            profile.target, calibrations.profile_camera(profile.camera), profile.camera.mount
        )
        return f"the target, seen by the camera from the ground: {view}"
    if not config.source.is_mocap:
        return "the vehicle's own deck"
    where = "in the simulated room" if options.simulated else f"{config.system}:{config.host}"
    return (
        f"motion capture {where}, body {config.body!r}, {config.send} at most {config.rate_hz:g} Hz"
    )


def _mm(place_m: tuple[float, float, float]) -> str:
    return f"{' '.join(targets.mm_text(part) for part in place_m)} mm"
