"""The options of `perchctl log compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.cli.app import ForceOption, JsonOption, perform, reported
from perchctl.commands.cli.complete import complete_log


def compare(
    one: Annotated[
        Path, typer.Argument(metavar="A", help="A flight log.", autocompletion=complete_log)
    ],
    other: Annotated[
        Path, typer.Argument(metavar="B", help="Another one.", autocompletion=complete_log)
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Draw both over each other, too: .png, .pdf or .svg."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compare two flights: what differs, and in which keys their profiles do."""
    with reported(as_json):
        from perchctl.commands.log_compare import CompareRequest, run

        perform(run, CompareRequest(one, other, output, force, as_json))
