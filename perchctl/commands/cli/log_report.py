"""The options of `perchctl log report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.cli.app import (
    ForceOption,
    JsonOption,
    LogDirOption,
    LogProfileOption,
    perform,
    reported,
)
from perchctl.commands.cli.complete import complete_log


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
        from perchctl.commands.log_report import ReportRequest, run

        perform(run, ReportRequest(tuple(files or ()), output, force, profile, log_dir, as_json))
