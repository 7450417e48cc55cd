"""The options of `perchctl log export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.cli.app import (
    ForceOption,
    JsonOption,
    LogArgument,
    LogDirOption,
    LogProfileOption,
    perform,
    reported,
)


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
        from perchctl.commands.log_export import ExportRequest, run

        request = ExportRequest(
            file=file,
            csv=csv,
            parquet=parquet,
            mcap=mcap,
            output=output,
            force=force,
            profile=profile,
            log_dir=log_dir,
            as_json=as_json,
        )
        perform(run, request)
