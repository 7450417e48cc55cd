"""`perchctl log`: what one does with a flight's log."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from perchctl.analysis import (
    Comparison,
    FlightAnalysis,
    check_readable,
    list_logs,
    list_text,
    newest_logs,
    replay_lines,
    replay_record,
    show_record,
    show_text,
    write_report,
)
from perchctl.analysis import replay as replay_flight
from perchctl.commands.command_line import (
    Command,
    ForceOption,
    JsonOption,
    LogArgument,
    LogDirOption,
    LogProfileOption,
    complete_log,
    complete_profile,
    examples,
    new_app,
    reporting,
)
from perchctl.commands.output import print_record, say
from perchctl.errors import InvalidValue, ReplayDiffers, UsageError
from perchctl.files import check_output, same_file, write_files
from perchctl.log import (
    FlightLog,
    export_mcap,
    log_table,
    log_values,
    path_beside,
    read_log,
    recorded_pictures,
    recording_path,
)
from perchctl.profile import Profile, changed_profile, load_profile

FORMATS = (".png", ".pdf", ".svg")
DRAWN_IN = "what plots are drawn in"
PAGE_SUFFIXES = (".html", ".htm")
MOST_LISTED = 10
STDOUT = Path("-")

app = new_app()


@app.callback(invoke_without_command=True)
def _top(context: typer.Context) -> None:
    """After a flight: show, draw, compare, export, replay or report its log.

    They work on logs of flights that were killed, of simulated ones, of an older perchctl;
    replay needs whole turns, which logs of versions 1 and 2 do not hold. Where FILE is left out
    it is the newest log; compare wants two.
    """
    if context.invoked_subcommand is None:
        print(context.get_help())


# --- which log, and its analysis ------------------------------------------------------------


def _log_file(file: Path | None, profile: str | None, log_dir: Path | None) -> Path:
    """The log that is named; else the newest of the folder, which is printed.

    Errors: NotFound, InvalidValue (a profile), UsageError.
    """
    if file is None:
        (newest,) = newest_logs(_log_folder(profile, log_dir), 1)
        say(f"the newest log: {newest}")
        return newest
    for option, value in (("--profile", profile), ("--log-dir", log_dir)):
        if value is not None:
            raise UsageError(f"{option} says where the newest log is, but {file} is named: "
                             f"leave out one of them")  # fmt: skip
    return file


def _log_folder(profile: str | None, log_dir: Path | None) -> Path:
    """Where `fly` puts the logs. Errors: NotFound, InvalidValue, UsageError."""
    if log_dir is not None:
        if profile is not None:
            raise UsageError("--profile and --log-dir both say where the logs are: leave out one")
        return log_dir
    return Path((Profile() if profile is None else load_profile(profile)).log.directory)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[FlightLog]:
    """The log; within, a value in it that no flight writes is an error of the file. So what reads
    values stands within, and what decides and draws after it, where a fault is the program's.

    Errors: NotFound, InvalidValue.
    """
    log = read_log(path)
    with log_values(path):
        yield log


# --- the subcommands ------------------------------------------------------------------------


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl log show",
        "perchctl log show perchctl-logs/flight.jsonl --json",
        "perchctl log show --list -n 20",
    ),
)
@reporting
def show(
    file: LogArgument = None,
    listed: Annotated[bool, typer.Option("--list", help="The newest logs, a line each.")] = False,
    count: Annotated[
        int | None, typer.Option("--count", "-n", min=1, help="How many --list shows. Default: 10.")
    ] = None,
    profile: LogProfileOption = None,
    log_dir: LogDirOption = None,
    as_json: JsonOption = False,
) -> int:
    """Show a flight: how it ended and why, its phases, holds, battery, frames, findings."""
    if listed:
        if file is not None:
            raise UsageError(
                f"--list is of a folder, and {file} is named: leave it out, or name the "
                f"folder with --log-dir"
            )
        folder = _log_folder(profile, log_dir)
        logs = list_logs(folder, count or MOST_LISTED)
        if as_json:
            print_record({"folder": str(folder), "logs": logs})
        else:
            print(list_text(logs))
        return 0
    if count is not None:
        raise UsageError("--count is of --list: add that, or leave it out")
    with _opened(_log_file(file, profile, log_dir)) as log:
        if as_json:
            print_record(show_record(FlightAnalysis(log)))
        else:
            print(show_text(FlightAnalysis(log)))
    return 0


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl log plot",
        "perchctl log plot perchctl-logs/flight.jsonl",
        "perchctl log plot -o flight.pdf --force",
    ),
)
@reporting
def plot(
    file: LogArgument = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="The picture: .png, .pdf or .svg. Default: .png beside the log."
        ),
    ] = None,
    force: ForceOption = False,
    profile: LogProfileOption = None,
    log_dir: LogDirOption = None,
    as_json: JsonOption = False,
) -> int:
    """Draw a flight: errors, detections, lost frames, height, battery, the last seconds."""
    path = _log_file(file, profile, log_dir)
    picture = output or path_beside(path, ".png")
    with _opened(path) as log:
        check_output(picture, FORMATS, force, DRAWN_IN)
        outcome = FlightAnalysis(log).summary.outcome
    from perchctl.analysis import plot_flight

    plot_flight(log, picture)
    if as_json:
        print_record({"log": str(path), "plot": str(picture), "outcome": outcome})
    else:
        print(f"plot:      {picture}")
    return 0


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl log compare before.jsonl after.jsonl",
        "perchctl log compare perchctl-logs/monday.jsonl perchctl-logs/tuesday.jsonl",
        "perchctl log compare before.jsonl after.jsonl --json",
    ),
)
@reporting
def compare(
    one: Annotated[
        Path, typer.Argument(metavar="A", help="A flight log.", autocompletion=complete_log)
    ],
    other: Annotated[
        Path, typer.Argument(metavar="B", help="Another one.", autocompletion=complete_log)
    ],
    as_json: JsonOption = False,
) -> int:
    """Compare two flights: what differs, and in which keys their profiles do."""
    with _opened(one) as log, _opened(other) as other_log:
        found = Comparison((FlightAnalysis(log), FlightAnalysis(other_log)))
        record, text = found.record(), found.text()
    if as_json:
        print_record(record)
    else:
        print(text)
    return 0


class _Form(StrEnum):
    """In which an export is written."""

    CSV = "csv"
    PARQUET = "parquet"
    MCAP = "mcap"

    @property
    def ending(self) -> str:
        return f".{self}"


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl log export --csv",
        "perchctl log export perchctl-logs/flight.jsonl -o flight.parquet",
        "perchctl log export --mcap",
    ),
)
@reporting
def export(
    file: LogArgument = None,
    csv: Annotated[bool, typer.Option("--csv", help="A table for any program, t_s first.")] = False,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="The same table for pandas, polars, DuckDB.")
    ] = False,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="For Foxglove, rosbag2 and PlotJuggler.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="The file, whose ending names the format, too; - is stdout, for CSV. "
            "Default: beside the log, by its name.",
        ),
    ] = None,
    force: ForceOption = False,
    profile: LogProfileOption = None,
    log_dir: LogDirOption = None,
    as_json: JsonOption = False,
) -> int:
    """Write a log in a form that other programs open."""
    asked = [form for form, is_asked in zip(_Form, (csv, parquet, mcap), strict=True) if is_asked]
    form = _form(asked, output)
    if output == STDOUT and (form is not _Form.CSV or as_json):
        beside_it = "--json" if form is _Form.CSV else f"--{form}"
        raise UsageError(f"-o - is CSV on stdout, which {beside_it} does not go with: name a file")
    path = _log_file(file, profile, log_dir)
    if output == STDOUT:
        with _opened(path) as log:
            text = log_table(log).csv()
        sys.stdout.write(text)
        return 0
    beside = ("_export" if form is _Form.MCAP else "") + form.ending
    place = output or path_beside(path, beside)
    check_output(place, (form.ending,), force, f"what --{form} writes")
    if form is _Form.MCAP:
        done = _write_mcap(path, place, force)
    else:
        done = _write_table(path, place, form)
    if as_json:
        print_record({"log": str(path), "output": str(place), "format": str(form), **done})
        return 0
    counts = [f"{done[key]} {key}" for key in ("rows", "columns", "pictures") if key in done]
    print(f"export:    {place} ({', '.join(counts)})")
    if "layout" in done:
        print(f"layout:    {done['layout']}, for Foxglove")
    return 0


def _form(asked: Sequence[_Form], output: Path | None) -> _Form:
    """What is asked for by name, or else by the output's ending. Errors: UsageError."""
    if len(asked) > 1:
        raise UsageError(f"--{asked[0]} and --{asked[1]} are two files: ask for one at a time")
    if asked:
        return asked[0]
    if output == STDOUT:
        return _Form.CSV
    for form in _Form:
        if output is not None and output.suffix.lower() == form.ending:
            return form
    raise UsageError(
        "say in which form: --csv, --parquet or --mcap, or by the name, as in -o flight.csv"
    )


def _write_table(path: Path, place: Path, form: _Form) -> dict[str, Any]:
    with _opened(path) as log:
        table = log_table(log)
        if form is _Form.CSV:
            content = table.csv().encode("utf-8", errors="backslashreplace")
        else:
            content = table.parquet()
    write_files({place: content})
    return {"rows": table.rows, "columns": len(table.columns)}


def _write_mcap(path: Path, place: Path, force: bool) -> dict[str, Any]:
    own = recording_path(path)
    if same_file(place, own):
        raise InvalidValue(
            f"{own} is the flight's own recording, with its pictures: open that, or name another "
            f"file with -o"
        )
    with _opened(path) as log:
        done = export_mcap(log, place, force)
    for note in done.notes:
        say(note)
    return {"layout": str(done.layout), "pictures": done.pictures, "notes": list(done.notes)}


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl log replay",
        "perchctl log replay --set planner.align.xy_m=0.02",
        "perchctl log replay flight.jsonl --profile mine --json",
    ),
)
@reporting
def replay(
    file: LogArgument = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="What if this key of the profile had been another; may be given several times.",
        ),
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            "-p",
            help="What if this profile had been flown, by name or path.",
            autocompletion=complete_profile,
        ),
    ] = None,
    pictures: Annotated[
        bool,
        typer.Option(
            "--pictures/--no-pictures", help="See the recorded pictures again, where there are any."
        ),
    ] = True,
    as_json: JsonOption = False,
) -> int:
    """Decide a flight again from its log, and demand the same commands, bit by bit.

    With pictures beside the log they are looked at again, too, and have to give the same poses.
    With --set or --profile it says what would have been decided otherwise.

    Exit codes: 0 where nothing differs, 61 where something does.
    """
    path = _log_file(file, None, None)
    with _opened(path) as log:
        wanted = None
        if profile is not None or settings:
            base = log.flown_profile if profile is None else load_profile(profile)
            wanted = changed_profile(base, settings or ())
        check_readable(log)
    is_recorded = pictures and recording_path(path).is_file()
    found = replay_flight(log, recorded_pictures(path) if is_recorded else None, wanted)
    if wanted is not None and not found.changed:
        say("nothing was changed: that is what was flown")
    if as_json:
        print_record(replay_record(found))
    else:
        for note in found.notes:
            say(note)
        print("\n".join(replay_lines(found)))
    return 0 if found.same else ReplayDiffers.exit_code


@app.command(
    cls=Command,
    epilog=examples(
        "perchctl log report",
        "perchctl log report perchctl-logs/*.jsonl -o session.html",
        "perchctl log report flight.jsonl --force",
    ),
)
@reporting
def report(
    files: Annotated[
        list[Path] | None,
        typer.Argument(help="Flight logs; by default the newest.", autocompletion=complete_log),
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="The page: .html.")] = None,
    force: ForceOption = False,
    profile: LogProfileOption = None,
    log_dir: LogDirOption = None,
    as_json: JsonOption = False,
) -> int:
    """Write one page that tells the flight, or several, in sentences and plots."""
    logs: list[Path] = []
    for path in [_log_file(name, profile, log_dir) for name in files or (None,)]:
        if any(path == known or same_file(path, known) for known in logs):
            say(f"{path} is named twice: it is on the page once")
        else:
            logs.append(path)
    one = path_beside(logs[0], PAGE_SUFFIXES[0])
    output = output or (one if len(logs) == 1 else logs[0].with_name("session.html"))
    if any(same_file(output, path) for path in logs):
        raise UsageError(f"{output} is one of the logs; write the page to another file")
    check_output(output, PAGE_SUFFIXES, force, "a page for a browser")
    page = write_report(logs, output)
    if as_json:
        size = output.stat().st_size
        print_record({"report": str(output), "bytes": size, "flights": page.record()})
    else:
        print(output)
        say(page.counts_text)
    return 0


for _command in app.registered_commands:  # in the list of subcommands the first sentence is whole
    _command.short_help = (_command.callback.__doc__ or "").split("\n\n")[0]
