"""Where the target is in the vehicle's world, in its level frame, and what of that a filter
is fed with."""

from __future__ import annotations

import numpy as np

from perchctl.geometry import Array, wrap_rad
from perchctl.vision.filter import PRINT, TILTS, FilterSetup, Measurement, pose_noise, tilted
from perchctl.vision.pose import PoseSetup, level_rotation
from perchctl.vision.types import Attitude, MarkerPose

_STILL = np.eye(4)


def to_world(
    e_m: Array, e_yaw_rad: float, attitude: Attitude, setup: PoseSetup
) -> tuple[Array, float]:
    """Place (3,) and heading in the world of the state estimate, from those relative to the
    gear in the level frame."""
    way_m = e_m + level_rotation(attitude).dot(setup.gear_body_m)
    position_m = np.asarray(attitude.position_m) + attitude.R_world_level.dot(way_m)
    return position_m, wrap_rad(e_yaw_rad + attitude.yaw_rad)


def to_level(
    position_m: Array, yaw_rad: float, attitude: Attitude, setup: PoseSetup
) -> tuple[Array, float]:
    """Inverse of `to_world`."""
    gear_level = level_rotation(attitude).dot(setup.gear_body_m)
    way = (position_m - np.asarray(attitude.position_m)).dot(attitude.R_world_level)
    return way - gear_level, wrap_rad(yaw_rad - attitude.yaw_rad)


def measurement(
    pose: MarkerPose,
    attitude: Attitude | None,
    in_world: bool,
    constants: FilterSetup,
    setup: PoseSetup,
) -> Measurement:
    """What a pose tells a track in the world (with an attitude), or in the level frame."""
    z, way_m = np.empty(4), pose.e_m
    z[0], z[1:] = pose.e_yaw_rad, pose.e_m
    if in_world:
        assert attitude is not None
        way_m = pose.e_m + attitude.R_level_body.dot(setup.gear_body_m)
        z[0] = wrap_rad(pose.e_yaw_rad + attitude.yaw_rad)
        z[1:] = attitude.R_world_level.dot(way_m) + attitude.position_m
    if constants.process is None or pose.cov is None:
        return Measurement(z)
    noise = pose.cov.copy()
    noise[:3, :3] -= pose.print_m.dot(pose.print_m.T)
    bias = np.zeros((4, 4))
    bias[1:, PRINT] = pose.print_m
    if attitude is not None:
        bias[1:, TILTS] = tilted(way_m) * constants.tilt_sigma_rad
    if in_world and attitude is not None:
        turn = _STILL.copy()
        turn[:3, :3] = attitude.R_world_level
        noise = turn.dot(noise).dot(turn.T)
        bias[1:] = attitude.R_world_level.dot(bias[1:])
    return Measurement(z, pose_noise(noise), bias)


def seen_from(bias_m: Array, attitude: Attitude, constants: FilterSetup, setup: PoseSetup) -> Array:
    """What constant errors make of the way from the gear to a target in the world, level axes
    (3, 4): of `bias_m` (3, 4), by which they have moved the target, less what roll and pitch
    make of the gear's place."""
    gear_level = level_rotation(attitude).dot(setup.gear_body_m)
    moved = attitude.R_world_level.T.dot(bias_m)
    moved[:, TILTS] -= tilted(gear_level) * constants.tilt_sigma_rad
    return np.asarray(moved)
