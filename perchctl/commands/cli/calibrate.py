"""The options of `perchctl calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.command_line import (
    CamOption,
    Command,
    ForceOption,
    JsonOption,
    ViewOption,
    ViewPortOption,
    complete_profile,
    complete_source,
    new_app,
    perform,
    reported,
)


def calibrate(
    source: Annotated[
        list[str] | None,
        typer.Argument(
            help="images:DIR (or a pattern), video:FILE, camera:N or its name, rtsp://..., "
            "http://..., aideck://HOST, or a path; or many picture files.",
            autocompletion=complete_source,
        ),
    ] = None,
    board: Annotated[
        str,
        typer.Option(
            "--board",
            "-b",
            help="chessboard:9x6:25mm (inner corners), charuco:10x7:25mm:18mm:DICT_5X5_100 "
            "(squares; :legacy behind it for OpenCV's old layout), aprilgrid:6x6:22mm:0.3 (tags, "
            "gap as a share of a tag), or Kalibr's .yaml of a board.",
        ),
    ] = "charuco:10x7:25mm:18mm:DICT_5X5_100",
    measured_width: Annotated[
        str | None,
        typer.Option("--measured-width", help="Width of the board's black area as printed, mm."),
    ] = None,
    measured_height: Annotated[
        str | None, typer.Option("--measured-height", help="Its height as printed, mm.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Calibration file; the report goes beside it as .png. "
            "Default: calib/NAME_WIDTHxHEIGHT.yaml. With --mount the report, .png; the recording "
            "goes beside it.",
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option("--size", help="Asked of camera:N, as in 720x576; else its driver's own."),
    ] = None,
    name: Annotated[str, typer.Option("--name", help="The camera's name.")] = "camera",
    model: Annotated[
        str,
        typer.Option(
            "--model", help="auto (the recommended), plumb_bob, rational_polynomial or fisheye."
        ),
    ] = "auto",
    force: ForceOption = False,
    check: Annotated[
        Path | None,
        typer.Option("--check", help="Judge this calibration by the source's pictures instead."),
    ] = None,
    convert: Annotated[
        Path | None,
        typer.Option("--convert", help="Read an OpenCV, Kalibr or ROS file and write --output."),
    ] = None,
    cam: CamOption = None,
    mask: Annotated[
        Path | None,
        typer.Option(
            "--mask",
            help="Learn what the vehicle itself covers of the picture, while it is turned about, "
            "and write that PNG file (camera.mask) instead.",
        ),
    ] = None,
    reject: Annotated[
        bool, typer.Option("--reject/--no-reject", help="Leave out outlier views and corners.")
    ] = True,
    plain_corners: Annotated[
        bool, typer.Option("--plain-corners", help="OpenCV's corners, not the fitted ones.")
    ] = False,
    skip_broken: Annotated[
        bool, typer.Option("--skip-broken", help="Leave out pictures that cannot be read.")
    ] = False,
    keep_pictures: Annotated[
        Path | None,
        typer.Option(
            "--keep-pictures",
            help="Folder for a live camera's pictures. Default: beside the output.",
        ),
    ] = None,
    as_json: JsonOption = False,
    view: ViewOption = False,
    view_port: ViewPortOption = 0,
    mount: Annotated[
        bool,
        typer.Option(
            "--mount",
            help="Measure instead how the camera is mounted, how late it is, and where the gear's "
            "tip is, with the vehicle in your hand and its motors off. The options below go "
            "with it.",
        ),
    ] = False,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile", "-p", help="The vehicle's profile.", autocompletion=complete_profile
        ),
    ] = None,
    uri: Annotated[
        str | None,
        typer.Option(
            "--uri", "-u", help="Vehicle, only read from. Default: CFLIB_URI, the profile's."
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            "--source", help="Its camera; else the profile's.", autocompletion=complete_source
        ),
    ] = None,
    part: Annotated[
        str | None,
        typer.Option(
            "--part",
            metavar="carry|pivot|both",
            help="carry: turn and latency; pivot: the gear's tip, by the camera alone.",
        ),
    ] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option("--from", help="Measure from this recording of an earlier run."),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option("--truth", metavar="sim", help="A simulated vehicle in a simulated hand."),
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Of --truth sim.")] = None,
    write: Annotated[
        bool,
        typer.Option(
            "--write", help="Put the numbers into the profile; the old file is kept beside it."
        ),
    ] = False,
) -> None:
    """Calibrate the camera, and report what its error means in mm at the target.

    A view is rejected when its RMS is above 2.5 times the median view's, a corner when it is off
    by more than 5 times its view's spread; both are named. --check exits with 1 on a fail.

    --mount measures the mounting instead: the vehicle is turned in the hand in view of the target
    (carry), then tilted around the tip of its gear (pivot). Nothing arms.
    """
    with reported(as_json):
        from perchctl.commands.calibrate import CalibrateRequest, run
        from perchctl.commands.calibrate_mount_request import MountRequest

        request = CalibrateRequest(
            sources=tuple(source or ()),
            board=board,
            measured_width=measured_width,
            measured_height=measured_height,
            output=output,
            size=size,
            name=name,
            model=model,
            force=force,
            check=check,
            convert=convert,
            cam=cam,
            mask=mask,
            reject=reject,
            plain_corners=plain_corners,
            skip_broken=skip_broken,
            keep_pictures=keep_pictures,
            as_json=as_json,
            view=view,
            view_port=view_port,
            mount=mount,
            mounting=MountRequest(
                profile=profile,
                uri=uri,
                source=camera,
                part=part,
                logs=tuple(logs or ()),
                truth=truth,
                seed=seed,
                write=write,
            ),
        )
        perform(run, request)


app = new_app()
app.command(cls=Command)(calibrate)
