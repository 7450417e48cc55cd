"""The options of `perchctl log plot`."""

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
        from perchctl.commands.log_plot import PlotRequest, run

        perform(run, PlotRequest(file, output, force, profile, log_dir, as_json))
