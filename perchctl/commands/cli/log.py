"""`perchctl log`: a command of its own for each thing that one does with a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.command_line import (
    Command,
    ForceOption,
    JsonOption,
    LogArgument,
    LogDirOption,
    LogProfileOption,
    complete_log,
    complete_profile,
    new_app,
    perform,
    reported,
)


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
) -> None:
    """Draw a flight: errors, detections, lost frames, height, battery, the last seconds."""
    with reported(as_json):
        from perchctl.commands.log_plot import run

        perform(run, file, output, force, profile, log_dir, as_json)


def show(
    file: LogArgument = None,
    listed: Annotated[bool, typer.Option("--list", help="The newest logs, a line each.")] = False,
    count: Annotated[
        int | None, typer.Option("--count", "-n", min=1, help="How many --list shows. Default: 10.")
    ] = None,
    profile: LogProfileOption = None,
    log_dir: LogDirOption = None,
    as_json: JsonOption = False,
) -> None:
    """Tell a flight: how it ended and why, its phases, holds, battery, frames, findings."""
    with reported(as_json):
        from perchctl.commands.log_show import run

        perform(run, file, listed, count, profile, log_dir, as_json)


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
) -> None:
    """Write one page that tells the flight, or several, in sentences and plots."""
    with reported(as_json):
        from perchctl.commands.log_report import run

        perform(run, files or (), output, force, profile, log_dir, as_json)


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
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Draw both into it: .png, .pdf or .svg."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Decide a flight again from its log, and demand the same commands, bit by bit.

    With pictures beside the log they are looked at again, too, and have to give the same poses.
    With --set or --profile it says what would have been decided otherwise.

    Exit codes: 0 where nothing differs, 61 where something does.
    """
    with reported(as_json):
        from perchctl.commands.log_replay import run

        perform(run, file, settings or (), profile, pictures, output, force, as_json)


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
) -> None:
    """Write a log in a form that other programs open."""
    with reported(as_json):
        from perchctl.commands.log_export import run

        asked = {"csv": csv, "parquet": parquet, "mcap": mcap}
        forms = [form for form, is_asked in asked.items() if is_asked]
        perform(run, file, forms, output, force, profile, log_dir, as_json)


def compare(
    one: Annotated[
        Path, typer.Argument(metavar="A", help="A flight log.", autocompletion=complete_log)
    ],
    other: Annotated[
        Path, typer.Argument(metavar="B", help="Another one.", autocompletion=complete_log)
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Draw both over each other, too: .png, .pdf or .svg."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare two flights: what differs, and in which keys their profiles do."""
    with reported(as_json):
        from perchctl.commands.log_compare import run

        perform(run, one, other, output, force, as_json)


app = new_app()

for _name, _command in (
    ("show", show),
    ("plot", plot),
    ("compare", compare),
    ("export", export),
    ("replay", replay),
    ("report", report),
):
    _summary = (_command.__doc__ or "").split("\n\n")[0]
    app.command(_name, short_help=_summary, cls=Command)(_command)


@app.callback(invoke_without_command=True)
def _top(context: typer.Context) -> None:
    """After a flight: its log shown, drawn, compared, exported, replayed, told.

    They work on logs of flights that were killed, of simulated ones, of an older perchctl;
    replay needs whole turns, which logs of versions 1 and 2 do not hold. Where FILE is left out
    it is the newest log; compare wants two.
    """
    if context.invoked_subcommand is None:
        print(context.get_help())
