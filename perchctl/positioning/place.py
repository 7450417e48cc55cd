"""A target that is the vehicle's positioning system stands still in the estimate's world, by
definition: the place of the body follows from it, and what steers is the way to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array, rot_z, wrap_rad
from perchctl.values import replace
from perchctl.vision.places import to_level, to_world
from perchctl.vision.pose import PoseSetup, level_rotation
from perchctl.vision.types import Attitude, MarkerPose, TargetEstimate


@dataclass(frozen=True, eq=False)
class Place:
    """A position (3,) in the estimate's world, and a heading."""

    position_m: Array
    yaw_rad: float


NOWHERE = Place(np.zeros(3), 0.0)
"""No difference between two places."""


def target_place(pose: MarkerPose, attitude: Attitude, setup: PoseSetup) -> Place:
    """The target's, where the body is at `attitude`, which has its position."""
    return Place(*to_world(pose.e_m, pose.e_yaw_rad, attitude, setup))


def body_place(pose: MarkerPose, attitude: Attitude, target: Place, setup: PoseSetup) -> Place:
    """The body's, where the target stands still. Of `attitude` roll and pitch count alone."""
    yaw_rad = wrap_rad(target.yaw_rad - pose.e_yaw_rad)
    way_m = pose.e_m + level_rotation(attitude).dot(setup.gear_body_m)
    return Place(target.position_m - rot_z(yaw_rad).dot(way_m), yaw_rad)


def touching(target: Place, yaw_rad: float, gear_body_m: Array) -> tuple[float, float, float]:
    """The body's position with the gear in the target's centre, level, at a heading."""
    x, y, z = target.position_m - rot_z(yaw_rad).dot(gear_body_m)
    return float(x), float(y), float(z)


def steered(
    seen: TargetEstimate, target: Place, off: Place, now: Attitude, setup: PoseSetup
) -> TargetEstimate:
    """What is seen, with the place where the target stands. `off`: by how much the body was
    beside its estimate of late (`SightFeed.off`), which is taken for what it is beside it now."""
    world_m = target.position_m - off.position_m
    world_yaw_rad = wrap_rad(target.yaw_rad - off.yaw_rad)
    e_m, e_yaw_rad = to_level(world_m, world_yaw_rad, now, setup)
    return replace(seen, e_m=e_m, e_yaw_rad=e_yaw_rad, world_m=world_m, world_yaw_rad=world_yaw_rad)
