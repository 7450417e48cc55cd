"""What the two parts give. A `sigma` is such that the value +- 1.96 sigma is a 95 % interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from perchctl.geometry import Array

IN_95 = 1.96
"""Standard deviations to each side."""
_LEAST_KNOWN = 1e-10
"""Share of a parameter's information that keeps one finite which nothing holds."""


@dataclass(frozen=True)
class Measured:
    """A mounting as far as it was measured; None where the part was not done.

    `rpy_deg`, the camera's turn as `camera.mount.rpy_deg` has it, and `latency_s` come from the
    carry; `gear_cam_m`, the gear's tip in the camera's frame, from the pivot.
    """

    rpy_deg: tuple[float, float, float] | None = None
    rpy_sigma_deg: tuple[float, float, float] | None = None
    latency_s: float | None = None
    latency_sigma_s: float | None = None
    gear_cam_m: tuple[float, float, float] | None = None
    gear_cam_sigma_m: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Carried:
    """The carry's solution.

    Attributes:
        R_body_cam: (3, 3); turn_cov_rad2 (3, 3) of a small turn of it in body axes.
        latency_s: from exposure to the picture's timestamp; positive is a late picture.
        jitter_s: spread of a single picture's latency.
        target_rpy_deg: the target's turn in the vehicle's world; its sigmas contain what the
            vehicle's attitude is off.
        gyro_bias_radps, attitude_bias_rad: (3,) in body axes; of the latter only roll and pitch
            are known.
        cam_body_m: place of the camera in body axes (3,), where a position was trusted.
        t_s, residual_rad, counted: of each pose used: its time, the misfit (n, 3) in camera
            axes, and how much it counted, 0 to 1.
        body_rpy_rad: the vehicle's turn at each pose, (n, 3), heading unwrapped.
        poses: how many there were.
    """

    R_body_cam: Array
    rpy_deg: tuple[float, float, float]
    rpy_sigma_deg: tuple[float, float, float]
    turn_cov_rad2: Array
    latency_s: float
    latency_sigma_s: float
    jitter_s: float
    target_rpy_deg: tuple[float, float, float]
    target_rpy_sigma_deg: tuple[float, float, float]
    gyro_bias_radps: Array
    attitude_bias_rad: Array
    cam_body_m: Array | None
    cam_body_sigma_m: Array | None
    t_s: Array
    residual_rad: Array
    counted: Array
    body_rpy_rad: Array
    poses: int


@dataclass(frozen=True, eq=False)
class Pivoted:
    """The pivot's solution.

    Attributes:
        gear_cam_m: tip of the gear in the camera's frame; its covariance (3, 3).
        point_target_m: where the tip stood, in the target's frame, (3,).
        t_s, residual_m, counted: of each pose: its time, the tip's way from where it should
            be (n, 3) in the target's axes, and how much it counted, 0 to 1.
        tilt_rad: (n, 2): of the camera's view to the target's x and y.
    """

    gear_cam_m: tuple[float, float, float]
    gear_cam_sigma_m: tuple[float, float, float]
    covariance_m2: Array
    point_target_m: Array
    t_s: Array
    residual_m: Array
    counted: Array
    tilt_rad: Array


def measured(carried: Carried | None, pivoted: Pivoted | None) -> Measured:
    """Both, or one, in the terms of a profile."""
    return Measured(
        rpy_deg=None if carried is None else carried.rpy_deg,
        rpy_sigma_deg=None if carried is None else carried.rpy_sigma_deg,
        latency_s=None if carried is None else carried.latency_s,
        latency_sigma_s=None if carried is None else carried.latency_sigma_s,
        gear_cam_m=None if pivoted is None else pivoted.gear_cam_m,
        gear_cam_sigma_m=None if pivoted is None else pivoted.gear_cam_sigma_m,
    )


@dataclass(frozen=True, eq=False)
class Left:
    """Normal equations of one block of the recording: information (p, p) and gradient (p,)."""

    information: Array
    gradient: Array


def covariance(
    known: Array,
    blocks: list[Left],
    wanted: NDArray[np.intp],
    robust: tuple[float, float] = (1.0, 1.0),
) -> Array:
    """Of the `wanted` parameters at a minimum, as `perchctl.calibration.solve` has it: the
    inverse information, or what leaving out each block in turn (the jackknife) shows where that
    is more, since the errors of neighbouring pictures go together.

    Args:
        known: information (p, p) beside the blocks'.
        robust: of the weights that the blocks are made with, see `spread.robust_shares`.
    """
    curved, sure = robust
    seen = curved * np.sum([b.information for b in blocks], axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(known + seen), 1e-300))
    both = np.outer(scale, scale)
    known = known + np.diag(_LEAST_KNOWN / scale**2)
    inverse = np.asarray(np.linalg.inv((known + sure * seen) * both))[np.ix_(wanted, wanted)]
    moves = np.array(
        [
            np.linalg.solve((known + seen - curved * b.information) * both, scale * b.gradient)[
                wanted
            ]
            for b in blocks
        ]
    )
    n = len(blocks)
    spread = (n - 1) / n * ((moves - moves.mean(axis=0)) ** 2).sum(axis=0)
    spread *= student_factor(n - 1) ** 2
    # Each parameter by itself: all together would be more than the blocks can tell.
    grown = np.sqrt(np.maximum(spread / np.diagonal(inverse), 1.0)) * scale[wanted]
    return np.asarray(inverse * np.outer(grown, grown))


def student_factor(freedom: int) -> float:
    """Half the width of a 95 % interval whose spread was estimated from so many values, over the
    normal distribution's; below 3 degrees of freedom that of 3."""
    return float(stdtrit(max(freedom, 3), 0.975)) / IN_95
