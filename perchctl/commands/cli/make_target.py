"""The options of `perchctl make-target`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.command_line import (
    CamOption,
    Command,
    ForceOption,
    JsonOption,
    complete_profile,
    new_app,
    perform,
    reported,
)


def make_target(
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile",
            "-p",
            help="Profile with the target; sim if none is named.",
            autocompletion=complete_profile,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="PDF to write (target.pdf), or with --measured-* a new profile."
        ),
    ] = None,
    page: Annotated[
        str, typer.Option("--page", help="a4, letter, a3, or a size such as 220x240mm.")
    ] = "a4",
    large: Annotated[
        str | None, typer.Option("--large", help="Side of the large marker: 150mm, 15cm, 0.15m.")
    ] = None,
    large_id: Annotated[int | None, typer.Option("--large-id", min=0, help="Its id.")] = None,
    large_dict: Annotated[
        str | None, typer.Option("--large-dict", help="Its dictionary, such as DICT_4X4_1000.")
    ] = None,
    small: Annotated[
        str | None, typer.Option("--small", help="Side of the small marker, with its unit.")
    ] = None,
    small_id: Annotated[int | None, typer.Option("--small-id", min=0, help="Its id.")] = None,
    small_dict: Annotated[
        str | None, typer.Option("--small-dict", help="Its dictionary: DICT_ARUCO_ORIGINAL, ...")
    ] = None,
    magnet: Annotated[
        str, typer.Option("--magnet", help="Diameter of the magnet behind the sheet.")
    ] = "50mm",
    tile: Annotated[
        str | None,
        typer.Option(
            "--tile", help="Print it on several sheets of this size, to be glued: a4, a3."
        ),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            "--board",
            help="Print a calibration board instead: charuco:10x7:25mm:18mm:DICT_5X5_100 "
            "(squares), chessboard:9x6:25mm (inner corners), aprilgrid:6x6:22mm:0.3 (tags, gap "
            "as a share of a tag), or Kalibr's .yaml of a board.",
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option("--camera", help="Design: ranges of the target for this calibration file."),
    ] = None,
    cam: CamOption = None,
    ceiling: Annotated[
        float | None, typer.Option("--ceiling", help="Height of the ceiling over the floor, m.")
    ] = None,
    blur: Annotated[float, typer.Option("--blur", help="Sigma of the picture's blur, px.")] = 1.0,
    noise: Annotated[
        float, typer.Option("--noise", help="Sigma of the picture's noise, grey levels of 255.")
    ] = 5.0,
    plot: Annotated[
        Path | None,
        typer.Option("--plot", help="The design's picture (design.png or suggestion.png)."),
    ] = None,
    suggest: Annotated[
        bool, typer.Option("--suggest", help="Propose sizes and ids for --camera.")
    ] = False,
    measured_large: Annotated[
        str | None,
        typer.Option("--measured-large", help="Side of the large black square as printed, mm."),
    ] = None,
    measured_small: Annotated[
        str | None,
        typer.Option("--measured-small", help="Side of the small black square as printed, mm."),
    ] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Print the target (or a board), true to size; design it; write measured sizes.

    Without --camera, --board or --measured-*: a PDF of the profile's target, front and back,
    checked before it is written. With --camera: from where to where each marker is seen.
    """
    with reported(as_json):
        from perchctl.commands.make_target import TargetRequest, run

        request = TargetRequest(
            profile=profile,
            output=output,
            page=page,
            large=large,
            large_id=large_id,
            large_dict=large_dict,
            small=small,
            small_id=small_id,
            small_dict=small_dict,
            magnet=magnet,
            tile=tile,
            board=board,
            camera=camera,
            cam=cam,
            ceiling_m=ceiling,
            blur_px=blur,
            noise=noise,
            plot=plot,
            suggest=suggest,
            measured_large=measured_large,
            measured_small=measured_small,
            force=force,
            as_json=as_json,
        )
        perform(run, request)


app = new_app()
app.command(cls=Command)(make_target)
