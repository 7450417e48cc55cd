"""Where the target should be in the next picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perchctl.geometry import Array, make_T, rotation_from_rpy
from perchctl.vision.camera_model import project
from perchctl.vision.filter import MAX_GAP_S
from perchctl.vision.pose import PoseSetup, rotation_matrix, rotation_vector
from perchctl.vision.types import MARKERS, Attitude, MarkerName, MarkerPose, Sighting


def expected_corners(
    sight: Sighting | None, t_s: float, attitude: Attitude | None, setup: PoseSetup
) -> tuple[dict[MarkerName, Array] | None, MarkerPose | None]:
    """Where both markers' corners should be, (4, 2) px each: the last sighting of the target,
    moved by the vehicle's own motion since; and that pose.

    Without an attitude at both times there are no corners and the pose is unmoved. Both
    are None where the sighting is too old or the target has gone behind the camera.
    """
    if sight is None or not 0.0 < t_s - sight.pose.t_s <= MAX_GAP_S:
        return None, None
    pose, then = sight.pose, sight.attitude
    if attitude is None or then is None:
        return None, pose
    T_body_cam = setup.T_body_cam
    T_then, T_now = (_world_body(a) @ T_body_cam for a in (then, attitude))
    R = T_now[:3, :3].T @ T_then[:3, :3]
    tvec = R @ pose.tvec_m + T_now[:3, :3].T @ (T_then[:3, 3] - T_now[:3, 3])
    if tvec[2] <= 0.0:
        return None, None
    rvec = rotation_vector(R @ rotation_matrix(pose.rvec_rad))
    points = np.concatenate([setup.object_points[name] for name in MARKERS])
    corners = project(points, rvec, tvec, setup.camera)
    moved = replace(pose, rvec_rad=rvec, tvec_m=tvec)
    if not np.isfinite(corners).all():
        return None, moved
    return {"large": corners[:4], "small": corners[4:]}, moved


def _world_body(attitude: Attitude) -> Array:
    R = rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    return make_T(R, np.asarray(attitude.position_m))
