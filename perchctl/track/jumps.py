"""Whether the pictures of a recording belong to one movement."""

from __future__ import annotations

import math

import cv2
import numpy as np

from perchctl.geometry import wrap_rad, yaw_of
from perchctl.vision import MarkerPose, PipelineOutput

JUMPS = (
    "the target jumps from one picture to the next: pictures that do not belong together need "
    "--stills"
)
# No hand moves or turns a camera faster.
_FASTEST_MPS, _FASTEST_RADPS = 2.0, 7.0
_SAME_SIGMAS = 3.0
_JUDGED_WITHIN_S = 0.5


def pose_in(output: PipelineOutput) -> MarkerPose | None:
    """What the picture alone says."""
    poses = output.poses
    return next((poses[name] for name in ("joint", "large", "small") if name in poses), None)


def jumped(before: MarkerPose | None, after: MarkerPose | None) -> bool:
    """Whether the target moved or turned in the camera's frame as no movement can have it."""
    if before is None or after is None or not 0.0 < after.t_s - before.t_s < _JUDGED_WITHIN_S:
        return False
    dt_s = after.t_s - before.t_s
    range_m = max(float(np.linalg.norm(pose.tvec_m)) for pose in (before, after))
    moved_m = float(np.linalg.norm(after.tvec_m - before.tvec_m))
    turned_rad = abs(wrap_rad(_yaw_rad(after) - _yaw_rad(before)))
    noise_m = _SAME_SIGMAS * float(np.linalg.norm([before.sigma_m, after.sigma_m]))
    noise_rad = _SAME_SIGMAS * math.hypot(before.sigma_yaw_rad, after.sigma_yaw_rad)
    return (
        moved_m > (_FASTEST_MPS + _FASTEST_RADPS * range_m) * dt_s + noise_m
        or turned_rad > _FASTEST_RADPS * dt_s + noise_rad
    )


def _yaw_rad(pose: MarkerPose) -> float:
    return yaw_of(np.asarray(cv2.Rodrigues(pose.rvec_rad)[0], dtype=np.float64))
