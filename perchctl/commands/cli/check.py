"""The options of `perchctl check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.command_line import (
    Command,
    ProfileOption,
    SourceOption,
    UriOption,
    new_app,
    perform,
    reported,
)


def check(
    profile: ProfileOption = "sim",
    uri: UriOption = None,
    source: SourceOption = None,
    seed: Annotated[
        int | None, typer.Option("--seed", help="Seed of the simulated scenario; 11 by default.")
    ] = None,
    log_dir: Annotated[
        Path | None, typer.Option("--log-dir", help="Folder that the flight log will go to.")
    ] = None,
    scan: Annotated[
        bool,
        typer.Option("--scan", help="Only show which vehicles answer, on any channel and rate."),
    ] = False,
    cameras: Annotated[
        bool,
        typer.Option(
            "--cameras",
            help="Only list this computer's cameras: number, name, path, modes, controls.",
        ),
    ] = False,
    lift: Annotated[
        bool,
        typer.Option("--lift", help="Also watch the position while you lift the vehicle by hand."),
    ] = False,
    prop_test: Annotated[
        bool,
        typer.Option(
            "--prop-test", help="Also turn each propeller for a moment, and load the battery; asks."
        ),
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Do not ask before --prop-test.")
    ] = False,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="A list of name, verdict, found and advice on stdout."),
    ] = False,
) -> None:
    """Look at vehicle, camera, computer and profile on the ground, and say what is not fit to fly.

    A row passes, warns, fails, or is skipped where it could not be known. Nothing is armed, and
    no motor turns but with --prop-test, which asks first. Exits with 0 when nothing fails, with
    10 when the vehicle does not answer, 20 when the camera gives no picture, 52 for any other
    failing row.
    """
    with reported(as_json):
        from perchctl.commands.check import CheckRequest, run

        request = CheckRequest(
            profile=profile,
            uri=uri,
            source=source,
            seed=seed,
            log_dir=log_dir,
            scan=scan,
            cameras=cameras,
            lift=lift,
            prop_test=prop_test,
            yes=yes,
            as_json=as_json,
        )
        perform(run, request)


app = new_app()
app.command(cls=Command)(check)
