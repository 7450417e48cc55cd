"""Where the target is in the vehicle's world, in its level frame, and what of that a filter
is fed with."""

from __future__ import annotations

import numpy as np

from perchctl.geometry import Array, rot_z, wrap_rad
from perchctl.vision.filter import PRINT, TILTS, FilterSetup, Measurement, pose_noise, tilted
from perchctl.vision.pose import PoseSetup, level_rotation
from perchctl.vision.types import Attitude, MarkerPose


def to_world(
    e_m: Array, e_yaw_rad: float, attitude: Attitude, setup: PoseSetup
) -> tuple[Array, float]:
    """Place (3,) and heading in the world of the state estimate, from those relative to the
    gear in the level frame."""
    gear_level = level_rotation(attitude) @ setup.gear_body_m
    position = np.asarray(attitude.position_m) + rot_z(attitude.yaw_rad) @ (e_m + gear_level)
    return position, wrap_rad(e_yaw_rad + attitude.yaw_rad)


def to_level(
    position_m: Array, yaw_rad: float, attitude: Attitude, setup: PoseSetup
) -> tuple[Array, float]:
    """Inverse of `to_world`."""
    gear_level = level_rotation(attitude) @ setup.gear_body_m
    way = rot_z(-attitude.yaw_rad) @ (position_m - np.asarray(attitude.position_m))
    return way - gear_level, wrap_rad(yaw_rad - attitude.yaw_rad)


def measurement(
    pose: MarkerPose,
    attitude: Attitude | None,
    in_world: bool,
    constants: FilterSetup,
    setup: PoseSetup,
) -> Measurement:
    """What a pose tells a track in the world (with an attitude), or in the level frame."""
    turn, way = np.eye(3), pose.e_m
    z = np.array([pose.e_yaw_rad, *pose.e_m])
    if in_world:
        assert attitude is not None
        position, yaw = to_world(pose.e_m, pose.e_yaw_rad, attitude, setup)
        turn, way = rot_z(attitude.yaw_rad), pose.e_m + level_rotation(attitude) @ setup.gear_body_m
        z = np.array([yaw, *position])
    if constants.process is None or pose.cov is None:
        return Measurement(z)
    turned, noise = np.eye(4), pose.cov.copy()
    turned[:3, :3] = turn
    noise[:3, :3] -= pose.print_m @ pose.print_m.T
    bias = np.zeros((4, 4))
    bias[1:, PRINT] = turn @ pose.print_m
    if attitude is not None:
        bias[1:, TILTS] = turn @ tilted(way) * constants.tilt_sigma_rad
    return Measurement(z, pose_noise(turned @ noise @ turned.T), bias)


def seen_from(bias_m: Array, attitude: Attitude, constants: FilterSetup, setup: PoseSetup) -> Array:
    """What constant errors make of the way from the gear to a target in the world, level axes
    (3, 4): of `bias_m` (3, 4), by which they have moved the target, less what roll and pitch
    make of the gear's place."""
    gear_level = level_rotation(attitude) @ setup.gear_body_m
    moved = rot_z(-attitude.yaw_rad) @ bias_m
    moved[:, TILTS] -= tilted(gear_level) * constants.tilt_sigma_rad
    return np.asarray(moved)
