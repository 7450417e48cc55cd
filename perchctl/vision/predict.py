"""Where the target should be in the next picture."""

from __future__ import annotations

import numpy as np

from perchctl.geometry import Array, finite
from perchctl.vision.camera_model import project
from perchctl.vision.filter import MAX_GAP_S
from perchctl.vision.markers.overview import lattice_of
from perchctl.vision.pose import PoseSetup, rotation_matrix, rotation_vector
from perchctl.vision.solve import Candidate
from perchctl.vision.types import Attitude, MarkerName, Sighting


def expected_corners(
    sight: Sighting | None, t_s: float, attitude: Attitude | None, setup: PoseSetup
) -> tuple[dict[MarkerName, Array] | None, Candidate | None]:
    """Where both markers' corners should be, (4, 2) px each: the last sighting of the target,
    moved by the vehicle's own motion since; and that pose.

    Without an attitude at both times there are no corners and the pose is unmoved. Both
    are None where the sighting is too old or the target has gone behind the camera.
    """
    if sight is None or not 0.0 < t_s - sight.pose.t_s <= MAX_GAP_S:
        return None, None
    pose, then = sight.pose, sight.attitude
    if attitude is None or then is None:
        return None, Candidate(pose.rvec_rad, pose.tvec_m)
    R_then, t_then = _world_cam(then, setup)
    R_now, t_now = _world_cam(attitude, setup)
    R = R_now.T.dot(R_then)
    tvec = R.dot(pose.tvec_m) + R_now.T.dot(t_then - t_now)
    if tvec[2] <= 0.0:
        return None, None
    rvec = rotation_vector(R.dot(rotation_matrix(pose.rvec_rad)))
    corners = project(setup.all_points, rvec, tvec, setup.camera)
    moved = Candidate(rvec, tvec)
    if not finite(corners):
        return None, moved
    return {"large": corners[:4], "small": corners[4:]}, moved


def is_in_view(place_m: Array, attitude: Attitude, setup: PoseSetup) -> bool:
    """Whether a place (3,) in the world of the state estimate lies in the picture."""
    R, t_m = _world_cam(attitude, setup)
    way_m = R.T @ (place_m - t_m)
    # Farther off the axis a lens model may fold back into the picture.
    if way_m[2] <= 0.0 or np.hypot(*way_m[:2]) > lattice_of(setup.camera).reach * way_m[2]:
        return False
    (at_px,) = project(np.zeros((1, 3)), np.zeros(3), way_m, setup.camera)
    return bool((at_px > 0.0).all() and (at_px < np.subtract(setup.camera.size_px, 1)).all())


def _world_cam(attitude: Attitude, setup: PoseSetup) -> tuple[Array, Array]:
    """Rotation (3, 3) and place (3,) of the camera in the world."""
    R, T_body_cam = attitude.R_world_body, setup.T_body_cam
    return R.dot(T_body_cam[:3, :3]), R.dot(T_body_cam[:3, 3]) + attitude.position_m
