"""The options of `perchctl simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.command_line import (
    Command,
    ForceOption,
    JsonOption,
    PositioningOption,
    ProfileOption,
    complete_profile,
    new_app,
    perform,
    reported,
)


def simulate(
    flights: Annotated[
        int | None,
        typer.Option("-n", "--flights", min=1, help="How many; 10 by default."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="Of the first flight; 0 by default."),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option("--jobs", "-j", min=1, help="Flights at a time; 1 by default."),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            "--cluster",
            metavar="ADDRESS|local:N",
            help="Fly on the workers of this dask scheduler, as tcp://10.0.0.5:8786, or of one "
            "here with N workers.",
        ),
    ] = None,
    only: Annotated[
        int | None,
        typer.Option("--only", min=0, help="One flight, of this seed, told in full and logged."),
    ] = None,
    profile: ProfileOption = "sim",
    positioning: PositioningOption = None,
    faults: Annotated[
        str | None,
        typer.Option(
            "--faults",
            metavar="all|list|NAME,NAME",
            help="Lay a fault into each flight, and judge by the world's truth.",
        ),
    ] = None,
    log_dir: Annotated[
        Path | None, typer.Option("--log-dir", help="Log the flights, into this folder.")
    ] = None,
    record: Annotated[
        bool, typer.Option("--record", help="Keep the pictures, in an MCAP file beside each log.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="JSONL file; each flight's result, as it ends."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with --out: fly the seeds that it lacks.")
    ] = False,
    keep: Annotated[
        str | None,
        typer.Option(
            "--keep", metavar="all|failed|worst:N", help="Of the logs in --log-dir; all by default."
        ),
    ] = None,
    compare: Annotated[
        str | None,
        typer.Option(
            "--compare",
            metavar="OTHER_PROFILE",
            help="Fly each seed by this profile (B), too: what differs, and what of it is proven.",
            autocompletion=complete_profile,
        ),
    ] = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep",
            metavar="KEY=VALUE,VALUE",
            help="A key of the profile at several values, each over the same seeds; twice: each "
            "with each.",
        ),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fly many seeded scenarios in lockstep, faster than real time, and count."""
    with reported(as_json):
        from perchctl.commands.simulate import SimulateRequest, run

        request = SimulateRequest(
            profile=profile,
            positioning=positioning,
            flights=flights,
            seed=seed,
            jobs=jobs,
            cluster=cluster,
            only=only,
            log_dir=log_dir,
            record=record,
            as_json=as_json,
            faults=faults,
            force=force,
            out=out,
            resume=resume,
            keep=keep,
            compare=compare,
            sweep=tuple(sweep or ()),
        )
        perform(run, request)


app = new_app()
app.command(cls=Command)(simulate)
