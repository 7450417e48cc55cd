"""What `perchctl track` gives for each picture, and its forms: JSON, CSV, text, live page, video.

Poses are in the OpenCV camera frame with cv2.aruco's marker axes
(``X_cam = R(rvec) X_marker + tvec``). The marker's yaw is ``atan2(R[1, 0], R[0, 0])``: the
heading of its x axis in the picture's plane, from right towards down.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.display import PageState, Sketch, draw_sketch
from perchctl.files import cannot_be_written, whole_file
from perchctl.geometry import Array, rot_z, yaw_of
from perchctl.vision import (
    MARKERS,
    CameraModel,
    MarkerPose,
    PipelineOutput,
)


@dataclass(frozen=True, eq=False)
class CameraPose:
    """The target's pose in the camera frame; `sigma_m` (3,) is along the camera's axes."""

    rvec_rad: Array
    tvec_m: Array
    yaw_rad: float
    sigma_m: Array
    sigma_yaw_rad: float


@dataclass(frozen=True, eq=False)
class Tracked:
    """The result of one picture.

    Attributes:
        frame: the picture's file name, or its index if it has none.
        image: grey (h, w) uint8.
        output: what the pipeline found; None if the picture was not searched.
        target: at stage ``none`` this is the filter's prediction.
        notes: the sentences that the picture deserves.
    """

    frame: str | int
    t_s: float
    image: NDArray[np.uint8]
    output: PipelineOutput | None = None
    target: CameraPose | None = None
    notes: tuple[str, ...] = ()

    @property
    def stage(self) -> str:
        """The markers that this picture shows."""
        return "none" if self.output is None else self.output.stage.value

    @property
    def markers(self) -> dict[str, Array]:
        """The corners (4, 2) px of the markers that were found, by name."""
        found = {} if self.output is None else {m: self.output.detections.get(m) for m in MARKERS}
        return {name: marker.corners_px for name, marker in found.items() if marker is not None}


def camera_pose(
    output: PipelineOutput, filtered: bool, before: CameraPose | None
) -> CameraPose | None:
    """Return the target's pose in the camera frame, from a pipeline whose body, gear and camera
    are one; None without a target.

    `filtered` False takes the pose as measured. `before` is the last target: its tilt is kept
    while the filter predicts.
    """
    target = output.target
    if target is None:
        return None
    pose, is_whole = _measured_pose(output, target.stage.value)
    if pose is not None and is_whole and not filtered:
        R = _rotation(pose.rvec_rad)
        return CameraPose(pose.rvec_rad, pose.tvec_m, yaw_of(R), pose.sigma_m, pose.sigma_yaw_rad)
    known = pose or before
    if known is None:
        return None
    # The filter holds position and yaw; the tilt is the picture's own.
    R = _rotation(known.rvec_rad)
    R = rot_z(target.e_yaw_rad - yaw_of(R)) @ R
    rvec = np.asarray(cv2.Rodrigues(R)[0], dtype=np.float64).ravel()
    return CameraPose(rvec, target.e_m, target.e_yaw_rad, target.sigma_m, target.sigma_yaw_rad)


def _measured_pose(output: PipelineOutput, stage: str) -> tuple[MarkerPose | None, bool]:
    """Return the pose that the target rests on, and whether it alone makes the target."""
    poses = output.poses
    if stage != "both":
        return poses.get(stage), True
    if "joint" in poses:
        return poses["joint"], True
    surest = min(poses.values(), key=lambda pose: float(np.linalg.norm(pose.sigma_m)))
    return surest, False


def _rotation(rvec: Array) -> Array:
    return np.asarray(cv2.Rodrigues(rvec)[0], dtype=np.float64)


# --- JSON and CSV ------------------------------------------------------------------------------


def track_record(tracked: Tracked) -> dict[str, Any]:
    """Return the line of `track --json`; what is not finite becomes None."""
    target = tracked.target
    return {
        "frame": tracked.frame,
        "t_s": _finite(tracked.t_s),
        "stage": tracked.stage,
        **{name: _marker_record(tracked, name) for name in MARKERS},
        "target": None
        if target is None
        else {
            "rvec_rad": _finite(target.rvec_rad),
            "tvec_m": _finite(target.tvec_m),
            "yaw_rad": _finite(target.yaw_rad),
            "sigma_m": _finite(target.sigma_m),
            "sigma_yaw_rad": _finite(target.sigma_yaw_rad),
        },
    }


def _marker_record(tracked: Tracked, name: str) -> dict[str, Any] | None:
    corners_px = tracked.markers.get(name)
    if corners_px is None or tracked.output is None:
        return None
    pose = tracked.output.poses.get(name)
    return {
        "corners_px": _finite(corners_px),
        "rvec_rad": None if pose is None else _finite(pose.rvec_rad),
        "tvec_m": None if pose is None else _finite(pose.tvec_m),
        "reprojection_px": None if pose is None else _finite(pose.reprojection_px),
    }


def _finite(value: Any) -> Any:
    """Return the number, or the nested lists of the array's numbers, as Python's; None for each
    that is not finite."""
    if np.ndim(value):
        return [_finite(part) for part in value]
    return float(value) if math.isfinite(value) else None


_COLUMNS_OF: dict[str, tuple[str, ...]] = {
    "tvec_m": ("x_m", "y_m", "z_m"),
    "rvec_rad": ("rx_rad", "ry_rad", "rz_rad"),
    "yaw_rad": ("yaw_rad",),
    "sigma_m": ("sigma_x_m", "sigma_y_m", "sigma_z_m"),
    "sigma_yaw_rad": ("sigma_yaw_rad",),
    "reprojection_px": ("reprojection_px",),
    "corners_px": tuple(f"{c}_{axis}_px" for c in ("tl", "tr", "br", "bl") for axis in "xy"),
}
"""The columns of each value of `track_record`'s objects, in the table's order."""
_OF_TARGET = ("tvec_m", "rvec_rad", "yaw_rad", "sigma_m", "sigma_yaw_rad")
_OF_MARKER = ("tvec_m", "rvec_rad", "reprojection_px", "corners_px")
CSV_COLUMNS: tuple[str, ...] = (
    "t_s",
    "frame",
    "stage",
    *(column for key in _OF_TARGET for column in _COLUMNS_OF[key]),
    *(f"{name}_{c}" for name in MARKERS for key in _OF_MARKER for c in _COLUMNS_OF[key]),
)


def csv_row(record: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a `track_record` by `CSV_COLUMNS`, without those of what was not
    found."""
    row = {key: record[key] for key in ("t_s", "frame", "stage")}
    for name in ("target", *MARKERS):
        prefix = "" if name == "target" else f"{name}_"
        for key, value in (record[name] or {}).items():
            if value is not None:
                values = np.ravel(value).tolist()
                row |= {f"{prefix}{c}": v for c, v in zip(_COLUMNS_OF[key], values, strict=True)}
    return row


@contextmanager
def csv_file(path: Path) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Yield the function that adds a row for one `track_record`, `t_s` first.

    The file gets its place as the block ends, and is removed if something fails within it.
    Errors: InvalidValue if it cannot be written, also from adding.
    """
    with whole_file(path) as part:
        with _refused(path):
            stream = part.open("w", encoding="utf-8", newline="")
        table = csv.DictWriter(stream, CSV_COLUMNS, lineterminator="\n")

        def add(record: dict[str, Any]) -> None:
            with _refused(path):
                table.writerow(csv_row(record))

        try:
            with _refused(path):
                table.writeheader()
            yield add
        finally:
            with _refused(path):
                stream.close()


# --- For people --------------------------------------------------------------------------------


def text_rows(tracked: Tracked) -> list[tuple[str, str]]:
    """Return name and text of what a person reads, in centimetres and degrees."""
    rows = [("frame", f"{tracked.frame}   {tracked.t_s:.3f} s"), ("markers", tracked.stage)]
    target = tracked.target
    if target is None:
        rows.append(("target", "not seen"))
    else:
        x, y, z = (f"{100.0 * v:+.2f}" for v in target.tvec_m)
        spread = "/".join(f"{1000.0 * v:.2f}" for v in target.sigma_m)
        rows += [
            ("target", f"x {x}  y {y}  z {z} cm"),
            ("yaw", f"{math.degrees(target.yaw_rad):+.2f} deg"),
            ("sigma", f"{spread} mm   {math.degrees(target.sigma_yaw_rad):.2f} deg"),
        ]
    poses = {} if tracked.output is None else tracked.output.poses
    for name, corners in tracked.markers.items():
        side_px = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean()
        fit = f"fits to {poses[name].reprojection_px:.2f} px" if name in poses else "no pose"
        rows.append((name, f"side {side_px:.0f} px   {fit}"))
    return rows


def text_line(tracked: Tracked) -> str:
    """Return one line for a terminal, at most 100 columns but for long file names."""
    head = f"{tracked.frame!s:>6}  {tracked.t_s:9.3f} s  {tracked.stage:<5}"
    target = tracked.target
    if target is None:
        return f"{head}  target not seen"
    x, y, z = (f"{100.0 * v:+7.2f}" for v in target.tvec_m)
    return f"{head}  x {x}  y {y}  z {z} cm  yaw {math.degrees(target.yaw_rad):+7.2f} deg"


def track_state(tracked: Tracked) -> PageState:
    """Return what the live page shows of a frame, ready for JSON."""
    return {
        "rows": [list(row) for row in text_rows(tracked)],
        "note": "; ".join(tracked.notes),
        "track": track_record(tracked),
    }


def track_sketch(tracked: Tracked, axis_m: float) -> Sketch:
    """Return the picture with the outlines of its markers and, if there is a target, its axes,
    each `axis_m` long."""
    target = tracked.target
    return Sketch(
        tracked.image,
        tuple(tracked.markers.items()),
        None if target is None else (target.rvec_rad, target.tvec_m, axis_m),
    )


# --- The video ---------------------------------------------------------------------------------

_TICKS_HZ = 90_000  # of the video's times
_H264 = {"preset": "veryfast", "crf": "20", "bf": "0"}  # no frames out of order: times begin at 0


@contextmanager
def overlay_file(
    path: Path, camera: CameraModel, rate_hz: float
) -> Iterator[Callable[[float, Sketch], None]]:
    """Yield the function that adds a picture, drawn, at its time: H.264 in MP4, which browsers
    play.

    Each picture is shown from its own time on until the next one's, however irregular they are;
    the last one is shown for one period of `rate_hz`. The file gets its place as the block ends,
    and is removed if something fails within it. Errors: InvalidValue if it cannot be written,
    also from adding.
    """
    import av  # late: most runs write no video

    start_s, last = 0.0, -1
    # Players want even sizes: an odd one gets a line more.
    more_x, more_y = (n % 2 for n in camera.size_px)

    def add(t_s: float, sketch: Sketch) -> None:
        nonlocal start_s, last
        picture = draw_sketch(sketch, camera)
        picture = np.pad(picture, ((0, more_y), (0, more_x), (0, 0)), mode="edge")
        frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
        if last < 0:
            start_s = t_s
        # A time that does not rise, as of a clock that was set, counts as the next tick.
        last = max(round((t_s - start_s) * _TICKS_HZ), last + 1)
        frame.pts, frame.time_base = last, Fraction(1, _TICKS_HZ)
        with _refused(path):
            video.mux(stream.encode(frame))

    with whole_file(path) as part:
        with _refused(path):
            # The index in front, so that a browser plays it before it has all of it.
            video = av.open(str(part), "w", options={"movflags": "faststart"})
            rate = Fraction(rate_hz).limit_denominator(1001)
            stream = video.add_stream("libx264", rate, options=_H264)
            stream.width, stream.height = camera.size_px[0] + more_x, camera.size_px[1] + more_y
            stream.pix_fmt = "yuv420p"
            stream.codec_context.time_base = Fraction(1, _TICKS_HZ)
            video.start_encoding()
        try:
            yield add
            with _refused(path):
                video.mux(stream.encode(None))
        finally:
            with _refused(path):
                video.close()


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Turn what the system, or FFmpeg, refuses within the block into InvalidValue."""
    try:
        yield
    except Exception as error:
        why = getattr(error, "strerror", None)
        if why is None:
            raise
        raise cannot_be_written(path, OSError(getattr(error, "errno", 0), why)) from None
