"""`perchctl track`: run the vision pipeline on any source, without a vehicle."""

from __future__ import annotations

import contextlib
import json
import math
import re
import socket
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import urlsplit

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import calibration as calibrations
from perchctl import camera as cameras
from perchctl import display as displays
from perchctl import profile as profiles
from perchctl import vision as visions
from perchctl.commands.command_line import (
    JsonOption,
    ProfileOption,
    SourceArgument,
    ViewOption,
    command,
    new_app,
)
from perchctl.commands.interrupt import Stopper
from perchctl.commands.output import say, say_on_terminal
from perchctl.errors import ConnectionFailed, Interrupted, InvalidValue, NotFound

if TYPE_CHECKING:
    from perchctl.geometry import Array
    from perchctl.sighting import Sighting

app = new_app()


@command(
    app,
    "perchctl track camera:0 --view",
    "perchctl track video:flight.mp4 --json > poses.jsonl",
    "perchctl track camera:0 --udp 127.0.0.1:9870",
)
def track(
    source: SourceArgument,
    profile: ProfileOption = "sim",
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            help="Camera calibration (ROS, OpenCV or Kalibr). Default: the one in the profile.",
        ),
    ] = None,
    as_json: JsonOption = False,
    udp: Annotated[
        str | None,
        typer.Option(
            "--udp",
            metavar="HOST:PORT",
            help="Also send the JSON object of each image to this address, as a UDP datagram.",
        ),
    ] = None,
    frame_id: Annotated[
        str,
        typer.Option("--frame-id", help="Name of the camera frame in JSON, as in your tf tree."),
    ] = "camera_optical_frame",
    view: ViewOption = False,
) -> None:
    """Find the target in a camera stream, a video or images, without a vehicle.

    Poses are in the OpenCV camera frame, with the marker axes of cv2.aruco:
    X_cam = R(rvec) X_marker + tvec. With --json, each line is an object with these fields:

    \b
    frame         file name of the image, or index of the frame
    t_s           time of exposure on the monotonic clock; for a video, the
                  timestamp in the file; for image files, their index / 30 Hz
    unix_s        time of exposure as Unix time, or null for a recording
    stage         detected markers: large, both, small or none
    large, small  null, or corners_px (TL TR BR BL), rvec_rad, tvec_m and
                  reprojection_px
    target        null, or rvec_rad, tvec_m, yaw_rad, sigma_m and sigma_yaw_rad
    pose          null, or frame_id, child_frame_id, position_m, quaternion_xyzw
                  and covariance
    note          what is wrong with the image, or why a pose is not the
                  target's; otherwise empty

    If both markers are in view, target is their joint pose. Except for still images, target is
    filtered, and is predicted for a few more frames after stage becomes none. yaw_rad is
    atan2(R[1,0], R[0,0]), the marker's heading in the image plane. sigma_m is along the camera's
    x, y and z axes.

    pose is the target's pose as measured in this image, not filtered, for ROS 2 and your own
    filters. Its axes are the marker's, turned by 180 deg about x, so that z points away from the
    camera. covariance has 36 numbers, row by row: x, y, z (m), then small rotations about the
    camera's x, y, z (rad).

    If a live source is lost for good, the exit code is 10.
    """
    check_frame_id(frame_id)
    say_on_terminal(f"reading profile {profile}")
    from perchctl.commands.progress import count_bar
    from perchctl.places import is_shipped_example
    from perchctl.sighting import Tracker

    flown = profiles.load_profile(profile)
    source = cameras.parse_source(source).spec
    file = profiles.find_calibration(str(calibration or flown.camera.calibration))
    lines = as_json or not view
    start_s = time.monotonic()
    stop, summary = Stopper(), TrackSummary()
    with contextlib.ExitStack() as stack:
        sender = None if udp is None else stack.enter_context(DatagramSender(udp))
        camera = calibrations.load_calibration(file)
        opened = cameras.open_camera(source, time.monotonic, flown.camera, size_px=camera.size_px)
        stack.callback(opened.close)
        recording = opened.inner if isinstance(opened, cameras.WrappedSource) else opened
        paths: Sequence[Path] = ()
        count = None
        if isinstance(recording, cameras.RecordedSource):
            paths, count = recording.paths, recording.count
        advice = ", the shipped example: name your own camera's file with --calibration"
        say(f"calibration: {file.name}{advice if is_shipped_example(file) else ''}")
        # Image files may be unrelated, so each one is searched independently, as a still image.
        tracker = Tracker(flown, camera, live=opened.live, stills=source.startswith("images:"))
        target: TargetInCamera | None = None
        stack.enter_context(stop.as_handler())  # up to this point, Ctrl-C ends the command at once
        title = f"perchctl track {cameras.without_password(source)}"
        page = stack.enter_context(displays.live_page(camera, title, view, say))
        has_bar = not opened.live and not (lines and sys.stdout.isatty())
        advance = stack.enter_context(count_bar("frames", count, has_bar))
        for frame in poll_until_stopped(opened, time.monotonic, stop):
            place = str(paths[frame.index]) if paths else opened.describe()
            cameras.check_size((frame.image.shape[1], frame.image.shape[0]), camera, place)
            name = paths[frame.index].name if paths else frame.index
            for picture, output, notes in tracker.process(frame):
                tracked = TrackResult(name, picture, notes=notes)
                if output is not None:
                    target = target_in_camera(output, target)
                    seen = tracker.make_sighting(picture, output, notes)
                    tracked = TrackResult(name, picture, output, target, notes, seen)
                summary.add(tracked)
                if as_json or sender is not None:
                    epoch_s = time.time() - time.monotonic() if opened.live else None
                    record = json.dumps(track_record(tracked, frame_id, epoch_s))
                if sender is not None:
                    sender.send(record)
                if lines:
                    # A live result must be printed at once.
                    print(record if as_json else text_line(tracked), flush=opened.live)
                if page is not None:
                    sketch = displays.make_sketch(
                        tracked.picture, tracked.output, flown.target.large.side_m
                    )
                    page.show(sketch)
                    page.set_state(partial(track_state, tracked))
            advance()
        took_s = time.monotonic() - start_s
        lost = opened.problem(-math.inf)
        if summary.frames == 0 and lost is None and not stop.requested.is_set():
            raise NotFound(f"{opened.describe()} delivered no frame")
    say(summary.text(took_s))
    if stop.requested.is_set():
        raise Interrupted("stopped by Ctrl-C; everything printed so far is complete")
    if lost is not None:
        raise ConnectionFailed(lost)


def poll_until_stopped(
    source: cameras.FrameSource, now: Callable[[], float], stop: Stopper
) -> Iterator[visions.Frame]:
    """Yield every frame of a recording, or the newest frames of a live source, until the end, a
    permanent failure or Ctrl-C. A live source without frames is reported once per outage."""
    from perchctl.sighting import TRACK_POLL_S

    is_silent = False
    while not stop.requested.is_set():
        now_s = now()
        frame = source.poll(now_s)
        if frame is not None:
            is_silent = False
            yield frame
            continue
        if source.finished:
            return
        # At time -inf nothing can be late, so any problem reported then is permanent.
        if source.problem(-math.inf) is not None:
            return
        problem = source.problem(now_s)
        if problem is not None and not is_silent:
            say(f"{problem}; still waiting (Ctrl-C stops)")
            is_silent = True
        stop.requested.wait(TRACK_POLL_S)


# --- Results ---


@dataclass(frozen=True, eq=False)
class TargetInCamera:
    """The target's pose in the camera frame. `yaw_rad` is the heading in the image plane; `sigma_m`
    (3,) is along the camera's axes."""

    rvec_rad: Array
    tvec_m: Array
    yaw_rad: float
    sigma_m: Array
    sigma_yaw_rad: float


@dataclass(frozen=True, eq=False)
class TrackResult:
    """Tracking result of one image.

    Attributes:
        name: the image's file name, or else the frame's index.
        output: the pipeline's output; None if the image was not searched.
        target: the target's pose; if the stage is ``none``, it is predicted by the filter.
        notes: remarks on the image, one sentence each.
        sighting: the pose measured in this image; None if the image was not searched.
    """

    name: str | int
    picture: visions.Frame
    output: visions.PipelineOutput | None = None
    target: TargetInCamera | None = None
    notes: Sequence[str] = ()
    sighting: Sighting | None = None

    @property
    def stage(self) -> str:
        """The detected markers: large, small, both or none."""
        return "none" if self.output is None else self.output.stage.value


def target_in_camera(
    output: visions.PipelineOutput, previous: TargetInCamera | None
) -> TargetInCamera | None:
    """Return the target's pose in the camera frame, from a pipeline whose body, gear and camera
    frames coincide; None without a target. `previous`: the last pose, whose tilt is used while the
    filter predicts."""
    import cv2
    import numpy as np

    from perchctl.geometry import rot_z, yaw_of

    target, poses = output.target, output.poses
    if target is None:
        return None
    stage = target.stage.value
    known: visions.MarkerPose | TargetInCamera | None = poses.get(
        "joint" if stage == "both" else stage, previous
    )
    if stage == "both" and "joint" not in poses:
        known = min(poses.values(), key=lambda pose: float(np.linalg.norm(pose.sigma_m)))
    if known is None:
        return None
    # The filter contains position and yaw; the tilt comes from the image.
    R = np.asarray(cv2.Rodrigues(known.rvec_rad)[0], dtype=np.float64)
    R = rot_z(target.e_yaw_rad - yaw_of(R)) @ R
    rvec = np.asarray(cv2.Rodrigues(R)[0], dtype=np.float64).ravel()
    return TargetInCamera(rvec, target.e_m, target.e_yaw_rad, target.sigma_m, target.sigma_yaw_rad)


# --- What is printed ---


TARGET_FRAME_ID = "target"
"""The target's frame in a `pose`, with the axes of docs/conventions.md, as in recordings."""


def check_frame_id(frame_id: str) -> None:
    """Raise InvalidValue for a name that tf2 does not accept as the parent of `TARGET_FRAME_ID`."""
    if not frame_id.strip() or frame_id.startswith("/") or frame_id == TARGET_FRAME_ID:
        raise InvalidValue(
            f"--frame-id takes the name of a frame in your tf tree, such as camera_optical_frame, "
            f"without a leading / and other than {TARGET_FRAME_ID}; found {frame_id!r}"
        )


def track_record(
    tracked: TrackResult, frame_id: str, epoch_s: float | None = None
) -> dict[str, Any]:
    """Return a result as the object for one line of `track --json`; values that are not finite
    become None.

    `epoch_s`: the Unix time at which the frames' clock was zero; None if that has no meaning.
    """
    target, output, t_s = tracked.target, tracked.output, tracked.picture.t_s
    return {
        "frame": tracked.name,
        "t_s": _finite(t_s),
        "unix_s": None if epoch_s is None else _finite(epoch_s + t_s),
        "stage": tracked.stage,
        **{
            name: None if output is None else _marker_record(output, name)
            for name in visions.MARKERS
        },
        "target": None
        if target is None
        else {key: _finite(value) for key, value in vars(target).items()},
        "pose": _pose_record(tracked.sighting, frame_id),
        "note": "; ".join(tracked.notes),
    }


_POSE_FIELD_OF_KEY = {
    "rvec_rad": "rvec_rad",
    "tvec_m": "tvec_m",
    "reprojection_px": "rms_reprojection_px",
}


def _marker_record(
    output: visions.PipelineOutput, name: Literal["large", "small"]
) -> dict[str, Any] | None:
    marker = output.detections.get(name)
    if marker is None:
        return None
    pose = output.poses.get(name)
    return {"corners_px": _finite(marker.corners_px)} | {
        key: None if pose is None else _finite(getattr(pose, name))
        for key, name in _POSE_FIELD_OF_KEY.items()
    }


def _pose_record(seen: Sighting | None, frame_id: str) -> dict[str, Any] | None:
    if seen is None or seen.T_cam_target is None or seen.covariance is None:
        return None
    from perchctl.geometry import quaternion_from_rotation

    w, x, y, z = quaternion_from_rotation(seen.T_cam_target[:3, :3])
    return {
        "frame_id": frame_id,
        "child_frame_id": TARGET_FRAME_ID,
        "position_m": _finite(seen.T_cam_target[:3, 3]),
        "quaternion_xyzw": [x, y, z, w],
        "covariance": _finite(seen.covariance.ravel()),
    }


def _finite(value: Any) -> Any:
    import numpy as np

    if np.ndim(value):
        return [_finite(part) for part in value]
    return float(value) if math.isfinite(value) else None


def text_line(tracked: TrackResult) -> str:
    """Return a result as one line for a terminal, at most 100 columns wide unless the file name is
    long."""
    head = f"{tracked.name!s:>6}  {tracked.picture.t_s:9.3f} s  {tracked.stage:<5}"
    return f"{head}  {_target_text(tracked)}"


def _target_text(tracked: TrackResult) -> str:
    target = tracked.target
    if target is None:
        return "target not seen" if tracked.stage == "none" else "target withheld"
    x, y, z = (f"{100.0 * v:+7.2f}" for v in target.tvec_m)
    return f"x {x}  y {y}  z {z} cm  yaw {math.degrees(target.yaw_rad):+7.2f} deg"


def track_state(tracked: TrackResult) -> dict[str, Any]:
    """Return the state of the live page for a result: `rows` of name and text, and `note`."""
    rows = [
        ["frame", f"{tracked.name}   {tracked.picture.t_s:.3f} s"],
        ["markers", tracked.stage],
        ["target", _target_text(tracked)],
    ]
    return {"rows": rows, "note": "; ".join(tracked.notes)}


class DatagramSender:
    """Sends texts by UDP, each as one datagram. It cannot detect whether anyone receives them.

    An address that the operating system cannot reach is reported once per outage, and tracking
    continues. Raises InvalidValue for a text that is not an address, or for an unknown host.
    """

    def __init__(self, address: str) -> None:
        self._text = address
        try:
            place = urlsplit(f"//{address}")
            host, port = place.hostname, place.port
        except ValueError:
            host, port = None, None
        if not host or not port or place.netloc != address or "@" in address:
            raise InvalidValue(
                f"--udp takes HOST:PORT, such as 127.0.0.1:9870, with a port from 1 to 65535; "
                f"found {address!r}"
            )
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:  # UnicodeError: an invalid host name
            reason = getattr(error, "strerror", None) or "it is not a host name"
            raise InvalidValue(
                f"--udp {address}: {host} has no address ({reason}); check the name, or give its "
                "IP address"
            ) from None
        self._address = found[0][4]
        self._socket = socket.socket(found[0][0], socket.SOCK_DGRAM)
        self._socket.setblocking(False)  # a full buffer must not delay the next image
        self._is_failing = False

    def __enter__(self) -> DatagramSender:
        return self

    def __exit__(self, *failure: object) -> None:
        self._socket.close()

    def send(self, text: str) -> None:
        """Send a text. Never raises."""
        try:
            self._socket.sendto(text.encode(), self._address)
        except OSError as error:
            if not self._is_failing:
                say(f"nothing can be sent to {self._text}: {error.strerror}; still trying")
            self._is_failing = True
        else:
            self._is_failing = False


class TrackSummary:
    """Counts results, detections and notes; prints each kind of note once, when it first occurs."""

    def __init__(self) -> None:
        self.frames = 0
        self._found: Counter[str] = Counter()
        self._noted: Counter[str] = Counter()

    def add(self, tracked: TrackResult) -> None:
        """Count a result, and print its new kinds of notes."""
        self.frames += 1
        if tracked.output is not None:
            seen = tracked.output.detections
            self._found.update(name for name in visions.MARKERS if seen.get(name) is not None)
        for note in tracked.notes:
            kind = re.split("[:,]", note, maxsplit=1)[
                0
            ]  # notes without the parts that differ between frames
            if not self._noted[kind]:
                place = tracked.name if isinstance(tracked.name, str) else f"frame {tracked.name}"
                say(f"{place}: {note}")
            self._noted[kind] += 1

    def text(self, took_s: float) -> str:
        """Return the counts of all frames as a sentence; `took_s` is the total time."""
        frames, took_s = self.frames, max(took_s, 1e-6)
        large, small = (100.0 * self._found[name] / max(frames, 1) for name in ("large", "small"))
        counted = "".join(f"; {note} in {n}" for note, n in self._noted.items())
        return (
            f"{frames} {'frame' if frames == 1 else 'frames'} in {took_s:.1f} s "
            f"({frames / took_s:.0f} a second): large {large:.0f} %, small {small:.0f} %{counted}"
        )
