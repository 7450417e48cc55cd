"""The options of `perchctl track`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from perchctl.commands.command_line import (
    CamOption,
    Command,
    ForceOption,
    ProfileOption,
    ViewOption,
    ViewPortOption,
    complete_source,
    new_app,
    perform,
    reported,
)


def track(
    source: Annotated[
        str,
        typer.Argument(
            help="camera:N or its name, rtsp://..., http://..., aideck://HOST, video:FILE, "
            "images:DIR (or a pattern), or a path.",
            autocompletion=complete_source,
        ),
    ],
    profile: ProfileOption = "sim",
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration", help="Camera calibration (ROS, OpenCV or Kalibr); else the profile's."
        ),
    ] = None,
    cam: CamOption = None,
    stills: Annotated[
        bool,
        typer.Option(
            "--stills", help="Each picture alone, no window, no filter: as files of pictures are."
        ),
    ] = False,
    video: Annotated[
        bool, typer.Option("--video", help="The files are one video's pictures, at 30 Hz.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON line a frame.")] = False,
    csv: Annotated[
        Path | None, typer.Option("--csv", help="Write the results as CSV, t_s first.")
    ] = None,
    overlay: Annotated[
        Path | None, typer.Option("--overlay", help="Write the pictures with results as .mp4.")
    ] = None,
    force: ForceOption = False,
    view: ViewOption = False,
    view_port: ViewPortOption = 0,
) -> None:
    """Find the target in a camera, video or pictures, without a vehicle.

    Poses are in the OpenCV camera frame with cv2.aruco's marker axes: X_cam = R(rvec) X_marker +
    tvec. A JSON line holds frame, t_s, stage (large, both, small, none), large and small (null,
    or corners_px TL TR BR BL, rvec_rad, tvec_m, reprojection_px) and target (null, or rvec_rad,
    tvec_m, yaw_rad, sigma_m, sigma_yaw_rad). With both markers in sight target is their joint
    pose; but for stills it is filtered, and goes on for a few frames after stage none.
    yaw_rad is atan2(R[1,0], R[0,0]): the marker's heading in the picture's plane. sigma_m is
    along the camera's x, y, z.
    """
    with reported(as_json):
        from perchctl.commands.track import TrackRequest, run

        request = TrackRequest(
            source=source,
            profile=profile,
            calibration=calibration,
            cam=cam,
            stills=stills,
            video=video,
            as_json=as_json,
            csv=csv,
            overlay=overlay,
            force=force,
            view=view,
            view_port=view_port,
        )
        perform(run, request)


app = new_app()
app.command(cls=Command)(track)
