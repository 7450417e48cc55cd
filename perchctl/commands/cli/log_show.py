"""The options of `perchctl log show`."""

from __future__ import annotations

from typing import Annotated

import typer

from perchctl.commands.cli.app import (
    JsonOption,
    LogArgument,
    LogDirOption,
    LogProfileOption,
    perform,
    reported,
)


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
        from perchctl.commands.log_show import ShowRequest, run

        perform(run, ShowRequest(file, listed, count, profile, log_dir, as_json))
