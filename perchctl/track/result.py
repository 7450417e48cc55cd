"""What one frame gave without a vehicle: the value, its JSON record, CSV row and text line.

Poses are in the OpenCV camera frame with cv2.aruco's marker axes
(``X_cam = R(rvec) X_marker + tvec``). The marker's yaw is ``atan2(R[1, 0], R[0, 0])``: the
heading of its x axis in the picture's plane, from right towards down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, rot_z, yaw_of
from perchctl.vision import (
    MARKERS,
    Detection,
    Frame,
    MarkerName,
    MarkerPose,
    PipelineOutput,
    Stage,
    better_conditioned,
)


@dataclass(frozen=True, eq=False)
class Seen:
    """A marker that was found; `pose` is None where its corners gave none."""

    corners_px: Array
    pose: MarkerPose | None


@dataclass(frozen=True, eq=False)
class CameraPose:
    """The target's pose in the camera frame; `sigma_m` (3,) along the camera's axes."""

    rvec_rad: Array
    tvec_m: Array
    yaw_rad: float
    sigma_m: Array
    sigma_yaw_rad: float


@dataclass(frozen=True, eq=False)
class Tracked:
    """One frame. `frame` is the file's name, or the index where there is none.

    `stage` is what this frame showed; a `target` at stage ``none`` is the filter's
    prediction. `image` is the picture, grey (h, w) uint8; `output` what the pipeline found in it,
    None where it was not searched; `notes` the sentences that it deserves.
    """

    frame: str | int
    t_s: float
    image: NDArray[np.uint8]
    stage: str = Stage.NONE.value
    large: Seen | None = None
    small: Seen | None = None
    target: CameraPose | None = None
    output: PipelineOutput | None = None
    notes: tuple[str, ...] = ()

    def get(self, marker: MarkerName) -> Seen | None:
        return self.large if marker == "large" else self.small


def tracked_of(
    frame: str | int,
    picture: Frame,
    output: PipelineOutput,
    filtered: bool,
    before: CameraPose | None = None,
    notes: tuple[str, ...] = (),
) -> Tracked:
    """The frame's result from a pipeline whose body, gear and camera are one.

    `filtered` false takes the pose as measured. `before` is the last target: its tilt is
    kept while the filter coasts.
    """
    return Tracked(
        frame=frame,
        t_s=picture.t_s,
        image=picture.image,
        stage=output.stage.value,
        large=_seen(output.detections.large, output),
        small=_seen(output.detections.small, output),
        target=_target(output, filtered, before),
        output=output,
        notes=notes,
    )


def _seen(detection: Detection | None, output: PipelineOutput) -> Seen | None:
    if detection is None:
        return None
    return Seen(detection.corners_px, output.poses.get(detection.marker))


def _target(output: PipelineOutput, filtered: bool, before: CameraPose | None) -> CameraPose | None:
    target = output.target
    if target is None:
        return None
    pose, alone = _behind(output, target.stage)
    if pose is not None and alone and not filtered:
        R = _rotation(pose.rvec_rad)
        return CameraPose(pose.rvec_rad, pose.tvec_m, yaw_of(R), pose.sigma_m, pose.sigma_yaw_rad)
    known = pose.rvec_rad if pose is not None else None if before is None else before.rvec_rad
    if known is None:
        return None
    # The filter holds position and yaw; the tilt is the picture's own.
    R = _rotation(known)
    R = rot_z(target.e_yaw_rad - yaw_of(R)) @ R
    rvec = np.asarray(cv2.Rodrigues(R)[0], dtype=np.float64).ravel()
    return CameraPose(rvec, target.e_m, target.e_yaw_rad, target.sigma_m, target.sigma_yaw_rad)


def _behind(output: PipelineOutput, stage: Stage) -> tuple[MarkerPose | None, bool]:
    """The pose that the target rests on, and whether it is the whole of it."""
    poses = output.poses
    if stage is not Stage.BOTH:
        return poses.get(stage.value), True
    if "joint" in poses:
        return poses["joint"], True
    return better_conditioned(poses["large"], poses["small"]), False


def _rotation(rvec: Array) -> Array:
    return np.asarray(cv2.Rodrigues(rvec)[0], dtype=np.float64)


def track_record(tracked: Tracked) -> dict[str, Any]:
    """The line of `track --json`; what is not finite becomes null."""
    target = tracked.target
    return {
        "frame": tracked.frame,
        "t_s": _number(tracked.t_s),
        "stage": tracked.stage,
        "large": _marker_record(tracked.large),
        "small": _marker_record(tracked.small),
        "target": None
        if target is None
        else {
            "rvec_rad": _numbers(target.rvec_rad),
            "tvec_m": _numbers(target.tvec_m),
            "yaw_rad": _number(target.yaw_rad),
            "sigma_m": _numbers(target.sigma_m),
            "sigma_yaw_rad": _number(target.sigma_yaw_rad),
        },
    }


def _marker_record(seen: Seen | None) -> dict[str, Any] | None:
    if seen is None:
        return None
    pose = seen.pose
    return {
        "corners_px": [_numbers(corner) for corner in seen.corners_px],
        "rvec_rad": None if pose is None else _numbers(pose.rvec_rad),
        "tvec_m": None if pose is None else _numbers(pose.tvec_m),
        "reprojection_px": None if pose is None else _number(pose.reprojection_px),
    }


def _number(value: Any) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None


def _numbers(values: Any) -> list[float | None]:
    return [_number(v) for v in values]


_AXES = ("x", "y", "z")
_POSE = (*(f"{a}_m" for a in _AXES), *(f"r{a}_rad" for a in _AXES))
_CORNERS = tuple(f"{corner}_{a}_px" for corner in ("tl", "tr", "br", "bl") for a in ("x", "y"))
_SIGMAS = (*(f"sigma_{a}_m" for a in _AXES), "sigma_yaw_rad")
CSV_COLUMNS: tuple[str, ...] = (
    "t_s",
    "frame",
    "stage",
    *_POSE,
    "yaw_rad",
    *_SIGMAS,
    *(f"{marker}_{name}" for marker in MARKERS for name in (*_POSE, "reprojection_px", *_CORNERS)),
)


def csv_record(tracked: Tracked) -> dict[str, str | int | float | None]:
    """Values by `CSV_COLUMNS`, without those of what was not found."""
    record: dict[str, str | int | float | None] = {
        "t_s": tracked.t_s,
        "frame": tracked.frame,
        "stage": tracked.stage,
    }
    target = tracked.target
    if target is not None:
        record |= zip(_POSE, _numbers([*target.tvec_m, *target.rvec_rad]), strict=True)
        record["yaw_rad"] = _number(target.yaw_rad)
        sigmas = [*target.sigma_m[:3], target.sigma_yaw_rad]
        record |= zip(_SIGMAS, _numbers(sigmas), strict=True)
    for marker in MARKERS:
        seen = tracked.get(marker)
        if seen is None:
            continue
        corners = zip(_CORNERS, _numbers(seen.corners_px.ravel()), strict=True)
        record |= {f"{marker}_{name}": value for name, value in corners}
        if seen.pose is not None:
            pose = zip(_POSE, _numbers([*seen.pose.tvec_m, *seen.pose.rvec_rad]), strict=True)
            record |= {f"{marker}_{name}": value for name, value in pose}
            record[f"{marker}_reprojection_px"] = _number(seen.pose.reprojection_px)
    return record


def text_rows(tracked: Tracked) -> list[tuple[str, str]]:
    """Name and text of what a person reads, in centimetres and degrees."""
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
    for marker in MARKERS:
        seen = tracked.get(marker)
        if seen is not None:
            fit = "no pose" if seen.pose is None else f"fits to {seen.pose.reprojection_px:.2f} px"
            rows.append((marker, f"side {_side_px(seen.corners_px):.0f} px   {fit}"))
    return rows


def text_line(tracked: Tracked) -> str:
    """One line for a terminal, at most 100 columns but for long file names."""
    head = f"{tracked.frame!s:>6}  {tracked.t_s:9.3f} s  {tracked.stage:<5}"
    target = tracked.target
    if target is None:
        return f"{head}  target not seen"
    x, y, z = (f"{100.0 * v:+7.2f}" for v in target.tvec_m)
    return f"{head}  x {x}  y {y}  z {z} cm  yaw {math.degrees(target.yaw_rad):+7.2f} deg"


def _side_px(corners_px: Array) -> float:
    sides = np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1)
    return float(sides.mean())
