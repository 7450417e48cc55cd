"""`perchctl log`: show, plot, compare, export, replay, film and report flights from their logs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, TypeVar

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import analysis
from perchctl import fleet as fleets
from perchctl import profile as profiles
from perchctl import record as records
from perchctl.commands.command_line import (
    ForceOption,
    Group,
    JsonOption,
    command,
    new_app,
)
from perchctl.commands.output import print_result, say, say_on_terminal
from perchctl.errors import NotFound, ReplayDiffers
from perchctl.files import check_output, write_files

T = TypeVar("T")
PLOTS = ((".png", ".pdf", ".svg"), "a plot")
FILMS = ((".mp4", ".gif"), "a film")
EXPORTS = ((".csv",), "an export")
PAGES = ((".html", ".htm"), "a page")
"""File suffixes of each output, the default first, and the name of the output."""

LogArgument = Annotated[
    Path | None,
    typer.Argument(
        help="Flight log, or a folder with logs (the newest is used). Default: perchctl-logs."
    ),
]
app = new_app(Group)


def _log_file(place: Path | None) -> Path:
    """Return the given log. If none is given, print and return the newest log in the folder (by
    default, the folder that `fly` writes to). Errors: NotFound."""
    if place is not None and not place.is_dir():
        say_on_terminal(f"reading {place}")
        return place
    say_on_terminal("looking for the newest log")
    folder = Path(profiles.Profile().log.directory) if place is None else place
    (newest,) = analysis.newest_logs(folder, 1)
    say(f"the newest log: {newest}")
    return newest


def _place(log: Path, output: Path | None, kind: tuple[tuple[str, ...], str], force: bool) -> Path:
    """Return the output path: `output`, or by default a path next to the log. Errors:
    InvalidValue."""
    suffixes, content = kind
    place = output or records.path_beside(log, suffixes[0])
    check_output(place, suffixes, force, content)
    return place


def _counted(items: Iterable[T], advance: Callable[[], None]) -> Iterator[T]:
    """Yield the items, and call `advance` after each."""
    for item in items:
        yield item
        advance()


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[records.FlightLog]:
    """Yield the log. The block must only read values: any error in it is reported as an error in
    the file. Errors: NotFound, InvalidValue."""
    log = records.read_log(path)
    with records.wrap_log_errors(path):
        yield log


@command(
    app,
    "perchctl log show",
    "perchctl log show perchctl-logs/flight.jsonl --json",
    "perchctl log show perchctl-logs",
    short_help="Show how and why a flight ended: phases, holds, battery, frames and findings.",
)
def show(file: LogArgument = None, as_json: JsonOption = False) -> None:
    """Show, plot, compare, export, replay, film or summarise a flight from its log.

    All subcommands read the logs of real and simulated flights, even if perchctl was killed in
    flight, and the logs of older perchctl versions. The exception is replay: it needs complete tick
    records, which log versions 1 and 2 do not contain.
    """
    with _opened(_log_file(file)) as log:
        flight = analysis.FlightAnalysis(log)
        print_result(analysis.show_record(flight) if as_json else analysis.show_text(flight))


@command(
    app,
    "perchctl log plot",
    "perchctl log plot perchctl-logs/flight.jsonl",
    "perchctl log plot -o flight.pdf --force",
)
def plot(
    file: LogArgument = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Plot to write: .png, .pdf or .svg. Default: .png next to the log.",
        ),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Plot a flight: detections, lost frames, height, battery and the last seconds.

    If fly has already drawn the plot next to the log, perchctl only prints its path.
    """
    path = _log_file(file)
    beside = records.path_beside(path, PLOTS[0][0])
    with _opened(path) as log:
        if output is None and not force and beside.is_file():
            say("this flight has already been plotted; add --force to draw the plot again")
            print(f"plot:      {beside}")
            return
        picture = _place(path, output, PLOTS, force)
    say_on_terminal(f"drawing {picture}")
    analysis.plot_flight(log, picture)
    print(f"plot:      {picture}")


@command(
    app,
    "perchctl log compare before.jsonl after.jsonl",
    "perchctl log compare perchctl-logs/monday.jsonl perchctl-logs/tuesday.jsonl",
    "perchctl log compare before.jsonl after.jsonl --json",
)
def compare(
    one: Annotated[Path, typer.Argument(metavar="A", help="First flight log.")],
    other: Annotated[Path, typer.Argument(metavar="B", help="Second flight log.")],
    as_json: JsonOption = False,
) -> None:
    """List the differences between two flights, and between their profiles."""
    say_on_terminal(f"reading {one} and {other}")
    with _opened(one) as log, _opened(other) as other_log:
        found = analysis.FlightComparison(
            (analysis.FlightAnalysis(log), analysis.FlightAnalysis(other_log))
        )
        record, text = found.record(), found.text()
    print_result(record if as_json else text)


@command(
    app,
    "perchctl log export",
    "perchctl log export perchctl-logs/flight.jsonl -o flight.csv",
    "perchctl log export perchctl-logs --force",
)
def export(
    file: LogArgument = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="File to write: .csv. Default: next to the log."),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Export a log as a CSV table for other programs."""
    path = _log_file(file)
    place = _place(path, output, EXPORTS, force)
    with _opened(path) as log:
        table = log.csv()
    write_files({place: table.encode("utf-8", errors="backslashreplace")})
    columns = table.partition("\n")[0].count(",") + 1
    print(f"export:    {place} ({len(log.records)} rows, {columns} columns)")


@command(
    app,
    "perchctl log replay",
    "perchctl log replay --set planner.align.xy_m=0.02",
    "perchctl log replay flight.jsonl --profile mine --json",
)
def replay(
    file: LogArgument = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Replay with another value of this profile key. Repeatable.",
        ),
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option("--profile", "-p", help="Replay with another profile, by name or path."),
    ] = None,
    pictures: Annotated[
        bool,
        typer.Option(
            "--pictures/--no-pictures",
            help="If there is a recording next to the log, process its images again.",
        ),
    ] = True,
    as_json: JsonOption = False,
) -> int:
    """Replay a flight from its log, and verify that every command is bit-for-bit identical.

    If there is a recording next to the log, perchctl also processes its images again and
    verifies the poses. With --set or --profile, it reports which decisions would have been
    different.

    The exit code is 0 if nothing differs, and 61 if anything does.
    """
    path = _log_file(file)
    with _opened(path) as log:
        wanted = None
        if profile is not None or settings:
            base = log.flown_profile if profile is None else profiles.load_profile(profile)
            wanted = profiles.apply_settings(base, settings or ())
    is_recorded = pictures and records.path_beside(path, ".mcap").is_file()
    from perchctl.commands.progress import count_bar

    with count_bar("pictures", None, is_recorded) as advance:
        recorded = _counted(records.recorded_pictures(path), advance) if is_recorded else None
        found = analysis.replay(log, recorded, wanted)
    if wanted is not None and not found.changed_keys:
        say("no key differs from the flown profile: this replays the flight as it was flown")
    if as_json:
        print_result(found.record())
    else:
        for note in found.notes:
            say(note)
        print("\n".join(found.lines()))
    return 0 if found.is_identical else ReplayDiffers.exit_code


@command(
    app,
    "perchctl log report",
    "perchctl log report perchctl-logs/*.jsonl -o session.html",
    "perchctl log report perchctl-logs/fleet_20261130_120000_atrium",
    "perchctl log report flight.jsonl --film --force",
)
def report(
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Flight logs, or folders of fleets. Default: the newest in perchctl-logs."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Page to write: .html.")
    ] = None,
    with_film: Annotated[bool, typer.Option("--film", help="Embed a film of each flight.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a page that describes one or more flights in sentences and plots.

    If you pass the folder of a fleet flight (with a fleet.json), perchctl writes one page
    about all of its vehicles.
    """
    logs: list[Path] = []
    names: dict[Path, str] = {}
    for file in files or (None,):
        fleet = fleets.read_fleet_folder(file) if file is not None and file.is_dir() else None
        if fleet is None:
            logs.append(_log_file(file))
            continue
        for name, line in fleet.lines.items():
            where = fleet.logs.get(name)
            say(f"{line} ({'no log' if where is None else where.name})")
        logs += fleet.logs.values()
        names |= {log: name for name, log in fleet.logs.items()}
    if not logs:
        raise NotFound("no vehicle of this fleet has left a log: there is nothing to report")
    if output is None and (names or len(logs) > 1):
        output = logs[0].with_name("fleet.html" if names else "session.html")
    place = _place(logs[0], output, PAGES, force)
    from perchctl.commands.progress import done_of_total_bar

    label, total = ("images of a film", None) if with_film else ("flights", len(logs))
    with done_of_total_bar(label, total) as progress:
        page = analysis.write_report(logs, place, with_film, names, progress)
    say(page.outcome_counts_text)
    print_result({"report": str(place), "flights": page.record()} if as_json else place)


@command(
    app,
    "perchctl log film",
    "perchctl log film flight.jsonl -o flight.mp4",
    "perchctl log film flight.jsonl -o flight.gif --rate 6 --width 640",
    "perchctl log film perchctl-logs/fleet_20261130_120000_atrium",
)
def film(
    file: LogArgument = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Film to write: .mp4 or .gif. Default: .mp4 next to the log."
        ),
    ] = None,
    rate_hz: Annotated[
        float, typer.Option("--rate", min=1.0, max=60.0, help="Frames per second.")
    ] = 15.0,
    width_px: Annotated[
        int, typer.Option("--width", min=320, max=1920, help="Width of the film, px.")
    ] = 960,
    force: ForceOption = False,
) -> None:
    """Make a film of a flight: camera image, side view to scale, error and thrust.

    The camera image needs a recording next to the log (fly --record). If you pass the folder of a
    fleet flight (with a fleet.json), perchctl makes one film of all its vehicles: room from
    above, heights and camera images.
    """
    fleet = fleets.read_fleet_folder(file) if file is not None and file.is_dir() else None
    if fleet is not None:
        if not fleet.logs:
            raise NotFound("no vehicle of this fleet has left a log: there is nothing to film")
        say_on_terminal(f"reading {file}")
        first = next(iter(fleet.logs.values()))
        place = _place(first, output or first.with_name("fleet.mp4"), FILMS, force)
        from perchctl.commands.progress import done_of_total_bar

        filmed = fleet.filmed()
        with done_of_total_bar("pictures") as progress:
            analysis.write_fleet_film(filmed, place, rate_hz, width_px, progress)
        print(f"film:      {place}")
        return
    path = _log_file(file)
    place = _place(path, output, FILMS, force)
    is_recorded = records.path_beside(path, ".mcap").is_file()
    with _opened(path) as log:
        flight = analysis.FlightAnalysis(log)
    from perchctl.commands.progress import done_of_total_bar

    pictures = records.recorded_pictures(path) if is_recorded else None
    with done_of_total_bar("pictures") as progress:
        analysis.write_film(flight, pictures, place, rate_hz, width_px, progress)
    print(f"film:      {place}")
