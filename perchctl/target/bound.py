"""The least pose error that corners of a given spread allow (Cramer-Rao bound)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array
from perchctl.target.drawing import marker_corners_m


@dataclass(frozen=True)
class PoseBound:
    """Standard deviations of the target's position in the camera frame and of its turn."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


def pose_bound(sides_m: list[float], z_m: float, focal_px: float, sigma_px: float) -> PoseBound:
    """The bound for centred, concentric markers of these sides, seen straight on from
    `z_m`, all corners solved together; every corner has `sigma_px` in x and in y.

    The pose has all six degrees of freedom. Perturbed by a turn w and a shift t, a corner
    X moves by w x X + t.
    """
    X = np.concatenate([marker_corners_m(side) for side in sides_m])
    X = X * (1.0, -1.0, -1.0)  # facing the camera
    x, y = X[:, 0], X[:, 1]
    zero, one = np.zeros_like(x), np.ones_like(x)
    dx = np.stack([zero, zero, -y, one, zero, zero], axis=1)
    dy = np.stack([zero, zero, x, zero, one, zero], axis=1)
    dz = np.stack([y, -x, zero, zero, zero, one], axis=1)
    du = focal_px * (dx / z_m - x[:, None] * dz / z_m**2)
    dv = focal_px * (dy / z_m - y[:, None] * dz / z_m**2)
    J: Array = np.concatenate([du, dv])
    covariance = np.linalg.inv(J.T @ J) * sigma_px**2
    sigma = np.sqrt(np.diag(covariance))
    return PoseBound(float(sigma[3]), float(sigma[4]), float(sigma[5]), float(sigma[2]))


def degrees(bound: PoseBound) -> float:
    return math.degrees(bound.yaw_rad)
