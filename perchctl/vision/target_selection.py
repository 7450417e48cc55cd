"""Select the vehicle's own target from several targets with identical markers.

The vehicle's own target is the one closest to the position in the profile, which is in the world
frame of the state estimate. Without such a position, it is the one closest to the upward axis
through the gear. The target is chosen once; afterwards, the lock (`perchctl.vision.tracks`) follows
it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array, is_finite, wrap_rad
from perchctl.vision.filter import (
    PRINT_SIZE_CURL_BIAS_COLUMNS,
    ROLL_PITCH_BIAS_COLUMNS,
    FilterSetup,
    TrackMeasurement,
    vector_jacobian_wrt_tilt,
)
from perchctl.vision.pose import PoseSetup, estimate_pose
from perchctl.vision.types import Detection, MarkerName, MarkerPose, VehicleState

_UNREFINED_CORNER_SIGMA_PX = 1.0  # for corners that a search has found, before refinement


@dataclass(frozen=True)
class ExpectedOwnTargetPosition:
    """Expected horizontal position of the vehicle's own target, `xy_world_m` (x, y), in the world
    frame of the state estimate. If it is None (unknown), the target closest to the vertical axis
    through the gear is selected. A target whose horizontal distance from a known position is more
    than `max_distance_to_accept_target_m` belongs to another vehicle."""

    xy_world_m: tuple[float, float] | None = None
    max_distance_to_accept_target_m: float = math.inf


MarkerToOwnTargetDistanceFunction = Callable[[MarkerName, Array], float]
"""Type of functions that return the horizontal distance, m, of a marker with corners (4, 2) px from
the position of the vehicle's own target, or infinity if the marker is too far away."""


_ASSUMED_MARKER_DISTANCE_WITHOUT_POSE_M = 1e9
"""Distance, m, that is assumed for corners that yield no pose yet, for example next to a highlight.
Such a marker is considered last, but not rejected unless
`own_target.max_distance_to_accept_target_m` applies."""


def marker_to_own_target_distance_m(
    own_target: ExpectedOwnTargetPosition,
    t_s: float,
    attitude: VehicleState | None,
    setup: PoseSetup,
    marker: MarkerName,
    corners_px: Array,
) -> float:
    """Return the horizontal distance, m, of a marker with corners (4, 2) px in the distorted image
    from the position of the vehicle's own target, or from the gear if this position or the attitude
    is unknown. `t_s` and `attitude` are those of the frame.

    The marker's position follows from a pose estimated from its corners. If they yield no pose, the
    distance is assumed to be 1e9 m (`_ASSUMED_MARKER_DISTANCE_WITHOUT_POSE_M`), so that a search
    chooses this marker last. If `attitude` is known, distances above
    `own_target.max_distance_to_accept_target_m`, including the assumed one, become infinite, so
    that a search rejects the marker.
    """
    seen = Detection(marker, corners_px, _UNREFINED_CORNER_SIGMA_PX, are_corners_fitted=False)
    pose = estimate_pose([seen], t_s, attitude, setup)
    distance_m = (
        _ASSUMED_MARKER_DISTANCE_WITHOUT_POSE_M
        if pose is None
        else horizontal_distance_to_own_target_m(pose, attitude, own_target, setup)
    )
    is_bounded = attitude is not None and math.isfinite(own_target.max_distance_to_accept_target_m)
    return (
        distance_m
        if not is_bounded or distance_m <= own_target.max_distance_to_accept_target_m
        else math.inf
    )


def horizontal_distance_to_own_target_m(
    pose: MarkerPose,
    attitude: VehicleState | None,
    own_target: ExpectedOwnTargetPosition,
    setup: PoseSetup,
) -> float:
    """Return the horizontal distance, m, of a detected target from the position of the vehicle's
    own target, or from the gear if this position or the vehicle's attitude is unknown."""
    if own_target.xy_world_m is None or attitude is None:
        return math.hypot(pose.e_m[0], pose.e_m[1])
    seen_m, _ = target_level_to_world(pose.e_m, pose.e_yaw_rad, attitude, setup)
    return math.hypot(seen_m[0] - own_target.xy_world_m[0], seen_m[1] - own_target.xy_world_m[1])


def other_vehicles_target_message(
    pose: MarkerPose,
    attitude: VehicleState | None,
    own_target: ExpectedOwnTargetPosition,
    setup: PoseSetup,
) -> str | None:
    """Return a message if the target with this pose is further than
    `own_target.max_distance_to_accept_target_m` from the known position of the vehicle's own
    target, so that it belongs to another vehicle. None if it may be the vehicle's own, or if that
    position or the vehicle's attitude is unknown."""
    if attitude is None or own_target.xy_world_m is None:
        return None
    distance_m = horizontal_distance_to_own_target_m(pose, attitude, own_target, setup)
    if distance_m <= own_target.max_distance_to_accept_target_m:
        return None
    return (
        f"a target {distance_m:.2f} m from target.expected_xy_m is ignored "
        f"(target.expected_within_m is "
        f"{own_target.max_distance_to_accept_target_m:g} m)"
    )


# --- The target in the world, in the level frame, and as a measurement for a filter ---


_IDENTITY_4 = np.eye(4)
# Errors of the lens and the print: 0.006 deg and 0.03 mm.
_MIN_YAW_XYZ_MEASUREMENT_COVARIANCE = np.diag([1e-4, 3e-5, 3e-5, 3e-5]) ** 2
_XYZ_YAW_TO_YAW_XYZ_INDICES = np.ix_([3, 0, 1, 2], [3, 0, 1, 2])


def target_level_to_world(
    gear_to_target_level_m: Array,
    target_yaw_level_rad: float,
    attitude: VehicleState,
    setup: PoseSetup,
) -> tuple[Array, float]:
    """Convert a target's position (3,), m, relative to the gear, and its heading, rad, from the
    level frame to the world frame of the state estimate. `attitude` is the vehicle's attitude and
    position in the world frame. Returns the target's position, m, and heading, rad, in the
    world."""
    body_to_target_m = gear_to_target_level_m + attitude.R_level_body.dot(setup.gear_body_m)
    position_m = np.asarray(attitude.position_m) + attitude.R_world_level.dot(body_to_target_m)
    return position_m, wrap_rad(target_yaw_level_rad + attitude.yaw_rad)


def target_world_to_level(
    target_position_world_m: Array,
    target_yaw_world_rad: float,
    attitude: VehicleState,
    setup: PoseSetup,
) -> tuple[Array, float]:
    """Convert a target's position (3,), m, and heading, rad, from the world frame of the state
    estimate to the level frame, relative to the gear. `attitude` is the vehicle's attitude and
    position in the world frame. Returns the position, m, and the heading, rad. This is the inverse
    of `target_level_to_world`."""
    gear_level = attitude.R_level_body.dot(setup.gear_body_m)
    body_to_target_m = (target_position_world_m - np.asarray(attitude.position_m)).dot(
        attitude.R_world_level
    )
    return body_to_target_m - gear_level, wrap_rad(target_yaw_world_rad - attitude.yaw_rad)


def make_track_measurement(
    pose: MarkerPose,
    attitude: VehicleState | None,
    is_in_world_frame: bool,
    filter_setup: FilterSetup,
    setup: PoseSetup,
) -> TrackMeasurement:
    """Convert a pose to a filter measurement of (yaw, x, y, z), rad and m: in the world frame of
    the state estimate (if `is_in_world_frame`), or relative to the gear in the level frame.
    `attitude` is the vehicle's state at the time of the pose. It may be None (unknown) for the
    level frame, but not for the world frame.

    The measurement's covariance R does not include the errors that are the same in every frame: the
    biases of the vehicle's roll and pitch, and the errors of the print's size and curl. Their
    effects are in `yaw_xyz_shift_per_bias_sigma` instead. If the pose has no covariance or the
    filter uses fixed noise (no `filter_setup.acceleration_process_noise`), R and these effects are
    None. If the covariance is not finite, only R is None. Without R, the filter uses the fixed
    `filter_setup.R`.
    """
    z, lever_m = np.empty(4), pose.e_m  # an error of the vehicle's tilt rotates this lever arm
    z[0], z[1:] = pose.e_yaw_rad, pose.e_m
    if is_in_world_frame:
        assert attitude is not None
        lever_m = pose.e_m + attitude.R_level_body.dot(setup.gear_body_m)
        z[0] = wrap_rad(pose.e_yaw_rad + attitude.yaw_rad)
        z[1:] = attitude.R_world_level.dot(lever_m) + attitude.position_m
    if filter_setup.acceleration_process_noise is None or pose.level_frame_xyz_yaw_cov is None:
        return TrackMeasurement(z)
    noise = pose.level_frame_xyz_yaw_cov.copy()
    noise[:3, :3] -= pose.position_shift_per_print_error_sigma_m.dot(
        pose.position_shift_per_print_error_sigma_m.T
    )
    shift_per_bias_sigma = np.zeros((4, 4))
    shift_per_bias_sigma[1:, PRINT_SIZE_CURL_BIAS_COLUMNS] = (
        pose.position_shift_per_print_error_sigma_m
    )
    if attitude is not None:
        shift_per_bias_sigma[1:, ROLL_PITCH_BIAS_COLUMNS] = (
            vector_jacobian_wrt_tilt(lever_m) * filter_setup.roll_pitch_bias_sigma_rad
        )
    if is_in_world_frame and attitude is not None:
        turn = _IDENTITY_4.copy()
        turn[:3, :3] = attitude.R_world_level
        noise = turn.dot(noise).dot(turn.T)
        shift_per_bias_sigma[1:] = attitude.R_world_level.dot(shift_per_bias_sigma[1:])
    R = (
        np.asarray(noise[_XYZ_YAW_TO_YAW_XYZ_INDICES] + _MIN_YAW_XYZ_MEASUREMENT_COVARIANCE)
        if is_finite(noise)
        else None
    )
    return TrackMeasurement(z, R, shift_per_bias_sigma)


def gear_to_target_shift_per_bias_sigma_m(
    target_world_shift_per_bias_sigma_m: Array,
    attitude: VehicleState,
    filter_setup: FilterSetup,
    setup: PoseSetup,
) -> Array:
    """Return the change (3, 4) of the vector from the gear to the target, m, in level axes, for one
    standard deviation of each bias: the vehicle's roll and pitch, the print's size and curl. It is
    `target_world_shift_per_bias_sigma_m` (3, 4), the change of the target's position in the world,
    minus the effect of the roll and pitch biases on the gear."""
    gear_level = attitude.R_level_body.dot(setup.gear_body_m)
    moved = attitude.R_world_level.T.dot(target_world_shift_per_bias_sigma_m)
    moved[:, ROLL_PITCH_BIAS_COLUMNS] -= (
        vector_jacobian_wrt_tilt(gear_level) * filter_setup.roll_pitch_bias_sigma_rad
    )
    return np.asarray(moved)
