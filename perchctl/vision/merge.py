"""Combine the two markers of a frame into one target pose, by one of two methods.

`weights` is the paper's method (section II-A): each marker has its own pose and Kalman filter,
which are merged with the weights W. `joint` solves for one pose from the corners of both markers
and filters this pose; if only one marker is visible, its pose updates the same filter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from perchctl.geometry import Array, circular_mean, wrap_rad
from perchctl.profile import MergeConfig, WeightsConfig
from perchctl.vision.filter import (
    POSITION_STATE_ELEMENTS,
    VELOCITY_STATE_ELEMENTS,
    X_STATE_INDEX,
    Y_STATE_INDEX,
    YAW_STATE_INDEX,
    Z_STATE_INDEX,
)
from perchctl.vision.pose import PoseCandidate, PoseSetup, R_level_body_of, estimate_pose
from perchctl.vision.types import (
    Detection,
    Detections,
    FrameMarkerPoses,
    MarkerFilterState,
    MarkerPose,
    VehicleState,
    VisibleMarkers,
)

MAX_JOINT_CHI2_PER_DOF_FOR_CONSISTENT_MARKERS = 4.0
"""If chi-squared per degree of freedom is below this value, the two markers do not contradict each
other."""
_XYZ_YAW_STATE_INDICES = [X_STATE_INDEX, Y_STATE_INDEX, Z_STATE_INDEX, YAW_STATE_INDEX]
_VISIBLE_MARKERS_BY_POSE_SOURCE = {
    "joint": VisibleMarkers.BOTH,
    "large": VisibleMarkers.LARGE,
    "small": VisibleMarkers.SMALL,
}


@dataclass(frozen=True, eq=False)
class TargetMergedFromTracks:
    """The target's position, yaw and velocity, merged from the tracks of its markers. All are in
    the frame of the tracks: relative to the gear in level axes, or in the world frame of the state
    estimate.

    Attributes:
        track_frame_xyz_yaw: position and yaw of the target (4,), m and rad.
        track_frame_velocity_mps: velocity of the target (3,).
        track_frame_position_cov_m2, yaw_var_rad2: covariance (3, 3) of the position, and variance
            of the yaw; the biases are not included.
        track_frame_position_shift_per_bias_sigma_m: change (3, 4) of the position for one standard
            deviation of each bias, in columns: the vehicle's roll and pitch, the print's size and
            curl.
        unseen_frames: number of frames since the last measurement.
        stage: markers measured in the newest frame.
    """

    track_frame_xyz_yaw: Array
    track_frame_velocity_mps: Array
    track_frame_position_cov_m2: Array
    track_frame_position_shift_per_bias_sigma_m: Array
    yaw_var_rad2: float
    unseen_frames: int
    stage: VisibleMarkers


def estimate_marker_poses(
    detections: Detections,
    attitude: VehicleState | None,
    start_pose: PoseCandidate | None,
    previous_target_normal_cam: Array | None,
    config: MergeConfig,
    setup: PoseSetup,
) -> FrameMarkerPoses:
    """Estimate the poses of the markers detected in one frame, and assign them to the tracks that
    they update: a single track ``joint``, or one track for each marker, depending on
    `config.method`. If the two markers contradict each other, only the more certain pose updates a
    track. Otherwise, if both are detected and `config.stages` is ``range``, the distance from the
    camera to the target's plane decides whether the large marker, the small one or both are used.
    If it is ``seen``, all detected markers are used.

    `attitude` is the vehicle's attitude at the time of the frame (None if unknown). `start_pose` is
    the last pose of the target in the camera frame, corrected for the vehicle's motion since then
    (None if unknown). `previous_target_normal_cam` (3,) is the unit normal of the target (out of
    the paper) in its last pose, in the axes of the camera at that time (None if unknown); it is
    only used without an attitude.
    """
    seen, t_s = correct_rolling_shutter(detections, setup), detections.t_s
    joint = None
    if config.method == "joint" and len(seen) == 2:
        joint = estimate_pose(seen, t_s, attitude, setup, previous_target_normal_cam, start_pose)
    clear = joint is not None and joint.chi2_per_dof < MAX_JOINT_CHI2_PER_DOF_FOR_CONSISTENT_MARKERS
    enough = clear and config.stages == "seen"
    poses: dict[str, MarkerPose] = {} if joint is None else {"joint": joint}
    singles: dict[str, MarkerPose] = {}
    if not enough or setup.config.each_marker:
        start = start_pose if joint is None else PoseCandidate(joint.rvec_rad, joint.tvec_m)
        for each in seen:
            pose = estimate_pose([each], t_s, attitude, setup, previous_target_normal_cam, start)
            if pose is not None:
                singles[each.marker] = pose
    poses |= singles
    if joint is not None and enough:
        return FrameMarkerPoses(poses, {"joint": joint})
    do_markers_contradict = False
    if not clear and len(singles) == 2:
        do_markers_contradict = are_marker_positions_inconsistent(
            singles["large"], singles["small"], config.disagreement_m
        )
    poses_by_updated_track, one = dict(singles), joint
    if len(singles) == 2:
        better = choose_more_certain_pose(singles["large"], singles["small"])
        one = joint or better
        if do_markers_contradict:
            poses_by_updated_track = {better.source: better}
        elif config.stages == "range":
            # Choose by the distance from the camera to the target's plane (equations 4, 6 and 11).
            offset = R_level_body_of(attitude) @ (setup.gear_body_m - setup.T_body_cam[:3, 3])
            z_m = float(better.e_m[2] + offset[2])
            if not config.z3_m < z_m <= config.z2_m:
                del poses_by_updated_track["small" if z_m > config.z2_m else "large"]
    if config.method == "joint":
        one = (
            next(iter(poses_by_updated_track.values())) if len(poses_by_updated_track) == 1 else one
        )
        poses_by_updated_track = {} if one is None else {"joint": one}
    return FrameMarkerPoses(poses, poses_by_updated_track, do_markers_contradict)


def merge_tracks(
    tracks: Mapping[str, MarkerFilterState],
    poses_by_updated_track: Mapping[str, MarkerPose],
    weights: WeightsConfig,
) -> TargetMergedFromTracks | None:
    """Return the target merged from its `tracks`, by name: ``joint``, or ``large`` and ``small``.
    Only the tracks that this frame's poses (`poses_by_updated_track`, with the same names) update
    are used or, if there are none, the tracks that were measured last. A single track is used as it
    is. Two are averaged, with `weights` for the large marker (`make_marker_weight_matrix`; equation
    8 of the paper). Returns None if there are no tracks."""
    if not tracks:
        return None
    least = min(track.unseen_frames for track in tracks.values())
    used = {name: track for name, track in tracks.items() if track.unseen_frames == least}
    used = {name: track for name, track in used.items() if name in poses_by_updated_track} or used
    if len(used) == 1:
        ((name, track),) = used.items()
        return TargetMergedFromTracks(
            track_frame_xyz_yaw=track.x[_XYZ_YAW_STATE_INDICES],
            track_frame_velocity_mps=track.x[VELOCITY_STATE_ELEMENTS],
            track_frame_position_cov_m2=track.P[POSITION_STATE_ELEMENTS, POSITION_STATE_ELEMENTS],
            track_frame_position_shift_per_bias_sigma_m=track.state_shift_per_bias_sigma[
                POSITION_STATE_ELEMENTS
            ],
            yaw_var_rad2=float(track.P[YAW_STATE_INDEX, YAW_STATE_INDEX]),
            unseen_frames=least,
            stage=_VISIBLE_MARKERS_BY_POSE_SOURCE[poses_by_updated_track[name].source]
            if name in poses_by_updated_track
            else VisibleMarkers.NONE,
        )
    large, small = used["large"], used["small"]
    order = _XYZ_YAW_STATE_INDICES
    W2 = make_marker_weight_matrix(weights) ** 2  # squared because the errors are independent
    pairs = np.stack([np.diag(large.P)[order], np.diag(small.P)[order]], axis=1)
    variance = W2 @ pairs.ravel()
    w = np.array([weights.x, weights.y, weights.z])
    return TargetMergedFromTracks(
        track_frame_xyz_yaw=merge_xyz_yaw(large.x[order], small.x[order], weights),
        track_frame_velocity_mps=w * large.x[VELOCITY_STATE_ELEMENTS]
        + (1.0 - w) * small.x[VELOCITY_STATE_ELEMENTS],
        track_frame_position_cov_m2=np.diag(variance[:3]),
        track_frame_position_shift_per_bias_sigma_m=w[:, None]
        * large.state_shift_per_bias_sigma[POSITION_STATE_ELEMENTS]
        + (1.0 - w[:, None]) * small.state_shift_per_bias_sigma[POSITION_STATE_ELEMENTS],
        yaw_var_rad2=float(variance[3]),
        unseen_frames=least,
        stage=VisibleMarkers.BOTH if poses_by_updated_track else VisibleMarkers.NONE,
    )


def widen_covariance_for_rival(
    merged: TargetMergedFromTracks, rival_state: Array
) -> TargetMergedFromTracks:
    """Increase the target's covariance so that it also covers the position of a rival: a
    target-like pattern, with the state `rival_state` (8,) in the frame of `merged`, whose position
    contradicts the target's track. If d is the difference between the two positions, the covariance
    grows by d d^T. The variance of the yaw grows by the squared difference of the yaws."""
    off = rival_state[_XYZ_YAW_STATE_INDICES] - merged.track_frame_xyz_yaw
    off_m, off_rad = off[:3], wrap_rad(float(off[3]))
    return replace(
        merged,
        track_frame_position_cov_m2=merged.track_frame_position_cov_m2 + np.outer(off_m, off_m),
        yaw_var_rad2=merged.yaw_var_rad2 + off_rad * off_rad,
    )


# --- Undo the rolling shutter ---
# A rolling shutter exposes the image rows one after the other within the readout time. Each corner
# is moved along its own image motion to where it was when the middle row was exposed, which is the
# frame's time.


ROLLING_SHUTTER_READOUT_TIME_SIGMA_IF_UNKNOWN_S = 0.012
"""Standard deviation of a camera's rolling-shutter readout time, s, if the profile does not specify
it."""
CORNER_FLOW_SIGMA_FRACTION_ALONG_FLOW, CORNER_FLOW_SIGMA_FRACTION_ACROSS_FLOW = 0.05, 0.015
"""Errors of a corner's motion along and across its direction, as fractions of the motion. They
arise because the motion was measured one frame earlier."""


def correct_rolling_shutter(detections: Detections, setup: PoseSetup) -> list[Detection]:
    """Return the detections with their corners moved to where they were at the frame's time, when
    the middle row was exposed. Each corner is moved back by its image velocity
    (`Detections.corner_flow_pxps`) times the delay of its row relative to the middle row. Markers
    without a known image velocity stay unchanged.

    If the readout time `setup.rolling_shutter_readout_s` is None (unknown), the corners are not
    moved, and `corner_shift_per_readout_time_sigma_px` is their possible shift for a readout time
    of 12 ms (`ROLLING_SHUTTER_READOUT_TIME_SIGMA_IF_UNKNOWN_S`). If it is 0, the detections are
    returned unchanged. Otherwise the corners are moved, and
    `corner_shift_per_readout_time_sigma_px`, `sigma_px` and `cov_px2` include the error of this
    correction.
    """
    readout_s, height_px = setup.rolling_shutter_readout_s, setup.camera.size_px[1]
    if readout_s == 0.0:
        return detections.markers
    late = ROLLING_SHUTTER_READOUT_TIME_SIGMA_IF_UNKNOWN_S if readout_s is None else readout_s
    out = []
    for d in detections.markers:
        flow = detections.corner_flow_pxps.get(d.marker)
        if flow is None:
            out.append(d)
            continue
        # A corner that moves down from frame to frame is exposed later in each frame.
        flow = flow / (1.0 + flow[..., 1:] * late / (height_px - 1.0))
        # Time from the exposure of the middle row to the exposure of each corner.
        late_s = (d.corners_px[:, 1:] / (height_px - 1.0) - 0.5) * late
        moved_px = flow * late_s
        if readout_s is None:
            out.append(replace(d, corner_shift_per_readout_time_sigma_px=moved_px))
        else:
            turned_px = CORNER_FLOW_SIGMA_FRACTION_ACROSS_FLOW * float(np.abs(moved_px).max())
            cov_px2 = None if d.cov_px2 is None else d.cov_px2 + turned_px**2 * np.eye(8)
            out.append(
                replace(
                    d,
                    corners_px=d.corners_px - moved_px,
                    sigma_px=float(np.hypot(d.sigma_px, turned_px)),
                    cov_px2=cov_px2,
                    corner_shift_per_readout_time_sigma_px=CORNER_FLOW_SIGMA_FRACTION_ALONG_FLOW
                    * moved_px,
                )
            )
    return out


# --- Merge the two markers into one target pose (paper, section II-A.2) ---


def classify_visible_markers(is_large_detected: bool, is_small_detected: bool) -> VisibleMarkers:
    """Return which of the two markers were detected as one `VisibleMarkers` value, which is the
    stage in the paper (section II-A.2)."""
    if is_large_detected:
        return VisibleMarkers.BOTH if is_small_detected else VisibleMarkers.LARGE
    return VisibleMarkers.SMALL if is_small_detected else VisibleMarkers.NONE


def make_marker_weight_matrix(weights: WeightsConfig) -> Array:
    """Return the weight matrix W (4, 8) of the paper's equation 9, with one row for each of x, y, z
    and yaw. The columns are x of the large and of the small marker, then y, z and yaw likewise. A
    row contains the weight w of the large marker (`weights`) and 1 - w for the small one."""
    W = np.zeros((4, 8))
    for row, w in enumerate((weights.x, weights.y, weights.z, weights.yaw)):
        W[row, 2 * row : 2 * row + 2] = w, 1.0 - w
    return W


def merge_xyz_yaw(large: Array, small: Array, weights: WeightsConfig) -> Array:
    """Return the weighted mean of (x, y, z, yaw) of the two markers, each (4,), m and rad, by
    equation 8 of the paper. The yaw angles are averaged on the circle. `weights` contains the
    weights of the large marker, 0 to 1."""
    W = make_marker_weight_matrix(weights)
    merged = W @ np.stack([large, small], axis=1).ravel()
    merged[3] = circular_mean(W[3, 6:8], np.array([large[3], small[3]]))
    return np.asarray(merged)


def are_marker_positions_inconsistent(
    large: MarkerPose, small: MarkerPose, max_position_difference_m: float
) -> bool:
    """True if the positions from the two markers differ on any axis of the level frame by more than
    `max_position_difference_m` and by more than four standard deviations of the difference. Print
    errors shift both markers alike, so they do not increase the tolerance."""
    gap = np.abs(large.e_m - small.e_m)
    variance = [
        np.maximum(p.sigma_m**2 - (p.position_shift_per_print_error_sigma_m**2).sum(axis=1), 0.0)
        for p in (large, small)
    ]
    vague = 4.0 * np.sqrt(variance[0] + variance[1])
    return bool((gap > np.maximum(max_position_difference_m, vague)).any())


def choose_more_certain_pose(large: MarkerPose, small: MarkerPose) -> MarkerPose:
    """Return the pose whose position has the smaller standard deviation (norm of `sigma_m`), or the
    large marker's if they are equal."""
    spread_large, spread_small = (float(np.linalg.norm(p.sigma_m)) for p in (large, small))
    return small if spread_small < spread_large else large
