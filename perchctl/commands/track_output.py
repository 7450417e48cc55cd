"""What `perchctl track` gives for each picture, and its forms: JSON, text, live page.

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

from perchctl.display import PageState, Sketch
from perchctl.geometry import Array, rot_z, yaw_of
from perchctl.vision import (
    MARKERS,
    Detection,
    MarkerPose,
    PipelineOutput,
    Stage,
    better_conditioned,
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
        return (Stage.NONE if self.output is None else self.output.stage).value

    @property
    def markers(self) -> dict[str, Detection]:
        """The markers that were found, by name."""
        found = {} if self.output is None else {m: self.output.detections.get(m) for m in MARKERS}
        return {name: marker for name, marker in found.items() if marker is not None}


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
    pose, is_whole = _measured_pose(output, target.stage)
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


def _measured_pose(output: PipelineOutput, stage: Stage) -> tuple[MarkerPose | None, bool]:
    """Return the pose that the target rests on, and whether it alone makes the target."""
    poses = output.poses
    if stage is not Stage.BOTH:
        return poses.get(stage.value), True
    if "joint" in poses:
        return poses["joint"], True
    return better_conditioned(poses["large"], poses["small"]), False


def _rotation(rvec: Array) -> Array:
    return np.asarray(cv2.Rodrigues(rvec)[0], dtype=np.float64)


# --- JSON ------------------------------------------------------------------------------


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
    marker = tracked.markers.get(name)
    if marker is None or tracked.output is None:
        return None
    pose = tracked.output.poses.get(name)
    return {
        "corners_px": _finite(marker.corners_px),
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
    for name, marker in tracked.markers.items():
        corners = marker.corners_px
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
        tuple((name, marker.corners_px) for name, marker in tracked.markers.items()),
        None if target is None else (target.rvec_rad, target.tvec_m, axis_m),
    )
