"""What merged tracks say of the target, as a `TargetEstimate` has it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.vision.filter import FilterSetup
from perchctl.vision.places import seen_from, to_level, to_world
from perchctl.vision.pose import PoseSetup
from perchctl.vision.strategies import Merged
from perchctl.vision.types import Attitude


def estimate_in_level(
    merged: Merged, attitude: Attitude | None, setup: PoseSetup
) -> dict[str, Any]:
    """Place and motion of tracks in the level frame, as a `TargetEstimate` has them."""
    e_m, e_yaw_rad = merged.vector[:3], float(merged.vector[3])
    world_m, world_yaw_rad = None, None
    if attitude is not None:
        world_m, world_yaw_rad = to_world(e_m, e_yaw_rad, attitude, setup)
    return {
        "e_m": e_m,
        "e_yaw_rad": e_yaw_rad,
        "velocity_mps": merged.velocity_mps,
        "sigma_m": _sigma(merged.cov_m2, merged.bias_m),
        "sigma_yaw_rad": _sigma_yaw(merged),
        "world_m": world_m,
        "world_yaw_rad": world_yaw_rad,
    }


def estimate_in_world(merged: Merged, attitude: Attitude, setup: PoseSetup) -> dict[str, Any]:
    """The same of tracks in the world, as seen from the vehicle at `attitude`, but the spread."""
    world_m, world_yaw_rad = merged.vector[:3], float(merged.vector[3])
    e_m, e_yaw_rad = to_level(world_m, world_yaw_rad, attitude, setup)
    return {
        "e_m": e_m,
        "e_yaw_rad": e_yaw_rad,
        "velocity_mps": attitude.R_world_level.T.dot(merged.velocity_mps),
        "world_m": world_m,
        "world_yaw_rad": world_yaw_rad,
        "world_velocity_mps": merged.velocity_mps,
    }


def spread_in_world(
    merged: Merged, attitude: Attitude, constants: FilterSetup, setup: PoseSetup
) -> dict[str, Any]:
    """The spread of tracks in the world, as seen from the vehicle at `attitude`."""
    turn = attitude.R_world_level.T
    bias_m = seen_from(merged.bias_m, attitude, constants, setup)
    return {
        "sigma_m": _sigma(turn.dot(merged.cov_m2).dot(turn.T), bias_m),
        "sigma_yaw_rad": _sigma_yaw(merged),
    }


def _sigma_yaw(merged: Merged) -> float:
    return math.sqrt(max(merged.var_yaw_rad2, 0.0))


def _sigma(cov_m2: Array, bias_m: Array) -> Array:
    variance = cov_m2.diagonal() + (bias_m * bias_m).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
