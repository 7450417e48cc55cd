"""A target that is the vehicle's positioning system stands still in the estimate's world, by
definition: what steers is the way from the estimate to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perchctl.geometry import Array, rot_z, rotation_from_rpy, wrap_rad
from perchctl.vehicle import Telemetry
from perchctl.vision.types import TargetEstimate


@dataclass(frozen=True, eq=False)
class TargetPlace:
    """The target in the estimate's world: (3,) and its heading."""

    position_m: Array
    yaw_rad: float


def held_at(
    target: TargetEstimate, place: TargetPlace, newest: Telemetry, gear_body_m: Array,
    off_m: Array, off_yaw_rad: float,
) -> TargetEstimate:
    """The same target where it stands, as seen from the estimate."""
    R_level_body = rotation_from_rpy(newest.roll_rad, newest.pitch_rad, 0.0)
    R_level_world = rot_z(newest.yaw_rad).T
    way_m = place.position_m - np.asarray(newest.position_m) - off_m
    return replace(
        target,
        e_m=R_level_world @ way_m - R_level_body @ gear_body_m,
        e_yaw_rad=wrap_rad(place.yaw_rad - newest.yaw_rad - off_yaw_rad),
        velocity_mps=-(R_level_world @ np.asarray(newest.velocity_mps)),
        world_m=place.position_m - off_m,
        world_yaw_rad=wrap_rad(place.yaw_rad - off_yaw_rad),
        world_velocity_mps=None if target.world_velocity_mps is None else np.zeros(3),
    )
