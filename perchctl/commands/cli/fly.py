"""The options of `perchctl fly`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.command_line import (
    EXIT_TABLE,
    Command,
    PositioningOption,
    ProfileOption,
    SourceOption,
    UriOption,
    ViewOption,
    ViewPortOption,
    new_app,
    perform,
    reported,
)


def fly(
    profile: ProfileOption = "sim",
    uri: UriOption = None,
    source: SourceOption = None,
    positioning: PositioningOption = None,
    seed: Annotated[
        int | None, typer.Option("--seed", help="Seed of the simulated scenario; 11 by default.")
    ] = None,
    log_dir: Annotated[
        Path | None, typer.Option("--log-dir", help="Folder for the flight log and its plot.")
    ] = None,
    record: Annotated[
        bool | None,
        typer.Option(
            "--record/--no-record",
            help="Keep the pictures, in an MCAP file beside the log; by default of real vehicles.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show the resolved plan; connect nothing.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before arming.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object on stdout at the end.")
    ] = False,
    view: ViewOption = False,
    view_port: ViewPortOption = 0,
) -> None:
    """Fly the seven phases: find the target, align, ascend, perch, stop the motors.

    Without options it flies the simulated vehicle. Ctrl-C once lands, again after half
    a second, or held for two, cuts the motors.
    """
    with reported(as_json):
        from perchctl.commands.fly import FlyRequest, run

        request = FlyRequest(
            profile=profile,
            uri=uri,
            source=source,
            positioning=positioning,
            seed=seed,
            log_dir=log_dir,
            record=record,
            dry_run=dry_run,
            yes=yes,
            as_json=as_json,
            view=view,
            view_port=view_port,
        )
        perform(run, request)


app = new_app()
app.command(cls=Command, epilog=EXIT_TABLE)(fly)
