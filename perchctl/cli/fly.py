"""The options of `perchctl fly`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.cli.app import ProfileOption, ViewOption, ViewPortOption, perform, reported
from perchctl.cli.complete import complete_source


def fly(
    profile: ProfileOption = "sim",
    uri: Annotated[
        str | None,
        typer.Option(
            "--uri",
            "-u",
            envvar="CFLIB_URI",
            help="Vehicle: sim://, radio://0/80/2M/E7E7E7E7E7, usb://0, udp://HOST:PORT.",
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--source",
            help="Camera: camera:N, video:FILE, images:DIR, http://..., sim:.",
            autocompletion=complete_source,
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the simulated scenario.")] = 11,
    log_dir: Annotated[
        Path | None, typer.Option("--log-dir", help="Folder for the flight log and its plot.")
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
    a second cuts the motors.
    """
    with reported(as_json):
        from perchctl.commands.fly import FlyRequest, run

        request = FlyRequest(
            profile=profile,
            uri=uri,
            source=source,
            seed=seed,
            log_dir=log_dir,
            dry_run=dry_run,
            yes=yes,
            as_json=as_json,
            view=view,
            view_port=view_port,
        )
        perform(run, request)
