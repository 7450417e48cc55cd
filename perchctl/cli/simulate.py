"""The options of `perchctl simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.cli.app import JsonOption, ProfileOption, perform, reported


def simulate(
    flights: Annotated[int, typer.Option("-n", "--flights", min=1, help="How many.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first flight.")] = 0,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Flights at a time.")] = 1,
    only: Annotated[
        int | None, typer.Option("--only", min=0, help="Repeat the one flight of this seed.")
    ] = None,
    profile: ProfileOption = "sim",
    faults: Annotated[
        str | None,
        typer.Option(
            "--faults",
            metavar="all|list|NAME,NAME",
            help="Lay a fault into each flight, and judge by the world's truth.",
        ),
    ] = None,
    heat_map: Annotated[
        Path | None, typer.Option("--heat-map", help="PNG of faults against phases.")
    ] = None,
    log_dir: Annotated[
        Path | None, typer.Option("--log-dir", help="Folder for the flights' logs.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Fly many seeded scenarios in lockstep, faster than real time, and count."""
    with reported(as_json):
        from perchctl.commands.simulate import SimulateRequest, run

        request = SimulateRequest(
            profile=profile,
            flights=flights,
            seed=seed,
            jobs=jobs,
            only=only,
            log_dir=log_dir,
            as_json=as_json,
            faults=faults,
            heat_map=heat_map,
        )
        perform(run, request)
