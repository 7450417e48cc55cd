"""Where the target should be in the next picture.

It stands still, so the vehicle's own motion says where its picture goes. The state estimate tells
that twice: by the step from place to place, and by its speed times the time. Places step with each
fix from outside, by millimetres that are many pixels near to the target; a speed's noise becomes
a way. Which of them is worth more hangs on what the estimate rests on, so it is learned from
the target's own pictures: each counts by how little it was off of late.
"""

from __future__ import annotations

import numpy as np

from perchctl.geometry import Array, finite
from perchctl.vision.camera_model import project
from perchctl.vision.filter import MAX_TRACK_GAP_S
from perchctl.vision.markers.overview import lattice_of
from perchctl.vision.pose import PoseSetup, rotation_matrix, rotation_vector
from perchctl.vision.solve import PoseCandidate
from perchctl.vision.types import Attitude, MarkerName, MarkerPose, Sighting

_FORGOTTEN = 0.1  # of what was learned, with each picture


def expected_corners(
    sight: Sighting | None, t_s: float, attitude: Attitude | None, setup: PoseSetup
) -> tuple[dict[MarkerName, Array] | None, PoseCandidate | None]:
    """Where both markers' corners should be, (4, 2) px each: the last sighting of the target,
    moved by the vehicle's own motion since; and that pose.

    Without an attitude at both times there are no corners and the pose is unmoved. Both
    are None where the sighting is too old or the target has gone behind the camera.
    """
    if sight is None or not 0.0 < t_s - sight.pose.t_s <= MAX_TRACK_GAP_S:
        return None, None
    pose, then = sight.pose, sight.attitude
    if attitude is None or then is None:
        return None, PoseCandidate(pose.rvec_rad, pose.tvec_m)
    R_then, R_now = _R_world_cam(then, setup), _R_world_cam(attitude, setup)
    by_place, by_speed = sight.off_rad2
    share = by_place / (by_place + by_speed) if by_place + by_speed > 0.0 else 0.5
    stepped_m, flown_m = _moves(then, attitude, setup)
    moved_m = stepped_m + share * (flown_m - stepped_m)
    R = R_now.T.dot(R_then)
    tvec = R.dot(pose.tvec_m) - R_now.T.dot(moved_m)
    if tvec[2] <= 0.0:
        return None, None
    rvec = rotation_vector(R.dot(rotation_matrix(pose.rvec_rad)))
    corners = project(setup.all_points, rvec, tvec, setup.camera)
    moved = PoseCandidate(rvec, tvec)
    if not finite(corners):
        return None, moved
    return {"large": corners[:4], "small": corners[4:]}, moved


def update_sight(
    before: Sighting | None, pose: MarkerPose, attitude: Attitude | None, setup: PoseSetup
) -> Sighting:
    """The target seen once more; with what that says of the vehicle's own account of its way."""
    if before is None:
        return Sighting(pose, attitude)
    then, passed_s = before.attitude, pose.t_s - before.pose.t_s
    if attitude is None or then is None or not 0.0 < passed_s <= MAX_TRACK_GAP_S:
        return Sighting(pose, attitude, before.off_rad2)
    R = _R_world_cam(attitude, setup)
    seen_m = _R_world_cam(then, setup).dot(before.pose.tvec_m) - R.dot(pose.tvec_m)
    # Across the view: along it a far target's own distance is vague.
    off = [R.T.dot(way_m - seen_m)[:2] / pose.tvec_m[2] for way_m in _moves(then, attitude, setup)]
    by_place, by_speed = (
        old + _FORGOTTEN * (float(new.dot(new)) - old)
        for old, new in zip(before.off_rad2, off, strict=True)
    )
    return Sighting(pose, attitude, (by_place, by_speed))


def is_in_view(place_m: Array, attitude: Attitude, setup: PoseSetup) -> bool:
    """Whether a place (3,) in the world of the state estimate lies in the picture."""
    R = _R_world_cam(attitude, setup)
    way_m = R.T @ (place_m - attitude.position_m - _ahead_m(attitude, setup))
    # Farther off the axis a lens model may fold back into the picture.
    if way_m[2] <= 0.0 or np.hypot(*way_m[:2]) > lattice_of(setup.camera).reach * way_m[2]:
        return False
    (at_px,) = project(np.zeros((1, 3)), np.zeros(3), way_m, setup.camera)
    return bool((at_px > 0.0).all() and (at_px < np.subtract(setup.camera.size_px, 1)).all())


def _moves(then: Attitude, now: Attitude, setup: PoseSetup) -> tuple[Array, Array]:
    """The camera's way in the world (3,) m, by the state estimate's places and by its speeds."""
    turned_m = _ahead_m(now, setup) - _ahead_m(then, setup)
    stepped_m = turned_m + np.subtract(now.position_m, then.position_m)
    if now.velocity_mps is None or then.velocity_mps is None:
        return stepped_m, stepped_m
    half_s = 0.5 * (now.t_s - then.t_s)
    return stepped_m, turned_m + half_s * np.add(now.velocity_mps, then.velocity_mps)


def _R_world_cam(attitude: Attitude, setup: PoseSetup) -> Array:
    R_world_cam: Array = attitude.R_world_body.dot(setup.T_body_cam[:3, :3])
    return R_world_cam


def _ahead_m(attitude: Attitude, setup: PoseSetup) -> Array:
    """From the vehicle's place to the camera, in the world (3,)."""
    ahead_m: Array = attitude.R_world_body.dot(setup.T_body_cam[:3, 3])
    return ahead_m
