"""The options of `perchctl log replay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.cli.app import JsonOption, perform, reported
from perchctl.cli.complete import complete_log


def replay(
    file: Annotated[Path, typer.Argument(help="A flight log.", autocompletion=complete_log)],
    as_json: JsonOption = False,
) -> None:
    """Feed a flight's observations to the planner again, and demand the same commands."""
    with reported(as_json):
        from perchctl.commands.log_replay import ReplayRequest, run

        perform(run, ReplayRequest(file, as_json))
