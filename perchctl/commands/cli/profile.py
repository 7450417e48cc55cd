"""The options of `perchctl profile`."""

from __future__ import annotations

from typing import Annotated

import typer

from perchctl.commands.command_line import (
    Command,
    JsonOption,
    complete_profile,
    new_app,
    perform,
    reported,
)


def profile(
    name: Annotated[
        str | None,
        typer.Option(
            "--profile",
            "-p",
            help="Profile by name or path; sim if none is named.",
            autocompletion=complete_profile,
        ),
    ] = None,
    schema: Annotated[
        bool, typer.Option("--schema", help="JSON schema of a profile's file, for editors.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show a profile as it is flown: every key with its value, unit, bounds and meaning."""
    with reported(as_json):
        from perchctl.commands.profile import run

        perform(run, name, schema, as_json)


app = new_app()
app.command(cls=Command)(profile)
