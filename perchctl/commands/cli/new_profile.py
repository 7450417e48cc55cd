"""The options of `perchctl new-profile`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.command_line import (
    Command,
    ForceOption,
    JsonOption,
    complete_source,
    new_app,
    perform,
    reported,
)


def new_profile(
    output: Annotated[Path, typer.Option("--output", "-o", help="Profile to write.")] = Path(
        "my_vehicle.yaml"
    ),
    uri: Annotated[
        str | None,
        typer.Option("--uri", "-u", help="Vehicle: radio://0/80/2M/E7E7E7E7E7, usb://0, sim://."),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--source",
            help="Camera: camera:N, rtsp://..., http://..., aideck://HOST, sim:.",
            autocompletion=complete_source,
        ),
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(
            "--calibration",
            help="Its file, of `perchctl calibrate`; none: not yet, the example's until then.",
        ),
    ] = None,
    latency: Annotated[
        str | None, typer.Option("--latency", help="Of the picture, exposure to arrival, ms.")
    ] = None,
    front: Annotated[
        str | None,
        typer.Option(
            "--front-at",
            help="Edge of the picture at which the vehicle's front is: top, right, bottom, left.",
        ),
    ] = None,
    left: Annotated[
        str | None, typer.Option("--left-at", help="Edge at which its left side is.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option("--camera-at", help="Lens from the centre: 'forward left up', mm."),
    ] = None,
    gear: Annotated[
        str | None, typer.Option("--gear-at", help="Tip of the magnet gear, likewise, mm.")
    ] = None,
    large: Annotated[
        str | None, typer.Option("--large", help="Large black square as printed, mm.")
    ] = None,
    small: Annotated[
        str | None, typer.Option("--small", help="Small black square as printed, mm.")
    ] = None,
    ceiling: Annotated[
        str | None, typer.Option("--ceiling", help="Height of the ceiling over the floor, m.")
    ] = None,
    fence: Annotated[
        str | None, typer.Option("--fence", help="Radius of the free space to fly in, m.")
    ] = None,
    defaults: Annotated[
        bool, typer.Option("--defaults", help="Ask nothing: defaults for what is not given.")
    ] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a profile of your vehicle, every key commented, in a short dialogue.

    Options answer questions beforehand; with all of them, or --defaults, nothing is asked. The
    mounting is told in words: at which edge of the camera's picture a hand over the vehicle's
    front comes in, and one over its left side.
    """
    with reported(as_json):
        from perchctl.commands.new_profile import NewProfileRequest, run

        given = {
            "uri": uri,
            "source": source,
            "calibration": calibration,
            "latency": latency,
            "front": front,
            "left": left,
            "camera": camera,
            "gear": gear,
            "large": large,
            "small": small,
            "ceiling": ceiling,
            "fence": fence,
        }
        answers = {name: text for name, text in given.items() if text is not None}
        perform(run, NewProfileRequest(output, answers, defaults, force, as_json))


app = new_app()
app.command(cls=Command)(new_profile)
