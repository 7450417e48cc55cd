"""The options of `perchctl log replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.cli.app import ForceOption, JsonOption, LogArgument, perform, reported
from perchctl.commands.cli.complete import complete_profile


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
        from perchctl.commands.log_replay import ReplayRequest, run

        perform(
            run,
            ReplayRequest(file, tuple(settings or ()), profile, pictures, output, force, as_json),
        )
