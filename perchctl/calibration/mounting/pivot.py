"""The pivot: find the position of the gear's tip, which stays on one point while the vehicle is
tilted around it.

The point c in the target's frame and the tip in the camera's frame are the same in every image:
``tip = R_cam_target c + p_cam_target``. The point and the tip are found by linear least squares, in
which each image is weighted by its own covariance and outliers have little influence. Neither the
vehicle's attitude nor the images' timestamps are needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perchctl.calibration.mounting.carry import MOST_LEFT_OUT, PoseResiduals, weight_residuals
from perchctl.calibration.mounting.recording import (
    HOW_TO_RECORD,
    MountingRecording,
    PoseArrays,
    check_recording,
    pose_arrays,
)
from perchctl.errors import InvalidValue
from perchctl.geometry import Array

MOST_TIP_SIGMA_M = 1e-3
SLIPPED_M, SLIP_EXPLAINS = 4e-4, 0.1
"""Size of a jump, m, and the fraction of the misfit that it must explain to count as a slip. If the
tip stays in place, a jump explains 4 % at most."""
TIP_SIGMA_FLOOR_M = 5e-5  # smallest standard deviation of the tip's position on the pivot point
_PIVOT_ITERATIONS = 12  # iterations of the least squares for the tip; more: takes longer
_SPLITS = 19  # number of times at which a slip of the tip is tested; fewer: a slip may be missed
_SLIP_ITERATIONS = 4  # iterations of the least squares for each of these; more: takes longer


@dataclass(frozen=True, eq=False)
class PivotSolution:
    """Gear tip from a pivot recording; value +- 1.96 sigma is a 95 % interval.

    Attributes:
        gear_cam_m: tip of the gear in the camera frame, (3,), with covariance_m2 (3, 3).
        pivot_point_target_m: the fixed point on which the tip rested, in the target frame, (3,).
    """

    gear_cam_m: Array
    covariance_m2: Array
    pivot_point_target_m: Array

    @property
    def gear_cam_sigma_m(self) -> Array:
        """Sigma of the tip along the camera's axes, (3,) m."""
        return np.sqrt(np.diagonal(self.covariance_m2))


def solve_pivot(recording: MountingRecording, size_sigma: float = 0.005) -> PivotSolution:
    """Solve for the gear's tip in the camera's frame.

    Args:
        size_sigma: relative sigma of the printed sizes (`target.size_sigma`), which scale all
            distances.

    Raises InvalidValue for too few or too similar tilts, a tip that slipped, or a mirrored image.
    """
    check_recording(recording, "pivot")
    poses = pose_arrays(recording)
    n = len(poses.t_s)
    R = poses.R_cam_target
    p_m = poses.p_cam_target_m
    design = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), -R], axis=2)
    found = np.zeros(6)
    cov = np.broadcast_to(np.eye(3), (n, 3, 3))
    for _ in range(_PIVOT_ITERATIONS):
        rows = weight_residuals(design, design @ found - p_m, cov, np.zeros((6, 6)))
        found = found + rows.step()
        cov = _misfit_covariance(poses, found[3:])
    tip_m = found[:3]
    cov_m2 = rows.parameter_covariance()[:3, :3]
    _check_slip(poses, rows)
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(cov_m2)[-1]))
    if rows.rejected_share > MOST_LEFT_OUT or not sigma_m <= MOST_TIP_SIGMA_M:
        raise InvalidValue(
            f"the tip is known only to {1e3 * sigma_m:.1f} mm, at most "
            f"{1e3 * MOST_TIP_SIGMA_M:g} is accepted, and {100 * rows.rejected_share:.0f} % "
            f"of the images do not fit: {HOW_TO_RECORD['pivot']}"
        )
    return PivotSolution(
        gear_cam_m=tip_m,
        covariance_m2=cov_m2 + size_sigma**2 * np.outer(tip_m, tip_m),
        pivot_point_target_m=found[3:],
    )


def _misfit_covariance(poses: PoseArrays, point_m: Array) -> Array:
    """Return the covariance (n, 3, 3) of the tip's position due to the error of each pose."""
    way_m = poses.R_cam_target @ point_m
    across = np.cross(np.eye(3), way_m[:, None, :])  # [way]x
    J = np.concatenate([across, -np.broadcast_to(np.eye(3), across.shape)], axis=2)
    return np.asarray(J @ poses.cov @ J.transpose(0, 2, 1) + np.eye(3) * TIP_SIGMA_FLOOR_M**2)


def _check_slip(poses: PoseArrays, rows: PoseResiduals) -> None:
    """Raise InvalidValue if the tip slipped from one point to another during the recording.

    The recording is split at each of several times, and one point is fitted to the part before the
    split, another point to the part after it. The split with the smallest robust misfit is used.
    """
    n, alone = len(rows.misfit), _size(rows)
    explains, moved_m, at_s = 0.0, 0.0, 0.0
    for k in np.unique(np.linspace(0, n, _SPLITS + 2).astype(np.intp))[1:-1]:
        after = (np.arange(n) >= k)[:, None, None] * rows.jacobian[:, :, 3:]
        design = np.concatenate([rows.jacobian, after], axis=2)
        found = np.zeros(9)
        two = replace(rows, jacobian=design, prior=np.zeros((9, 9)))
        for _ in range(_SLIP_ITERATIONS):
            step = two.step()
            found = found + step
            two = two.after_step(step)
        share = 1.0 - _size(two) / alone
        if share > explains:
            explains = share
            moved_m = float(np.linalg.norm(found[6:]))
            at_s = float(poses.t_s[k] - poses.t_s[0])
    if moved_m > SLIPPED_M and explains > SLIP_EXPLAINS:
        raise InvalidValue(
            f"the tip slipped by {1e3 * moved_m:.1f} mm {at_s:.0f} s after the start: "
            f"{HOW_TO_RECORD['pivot']}; hold the tip in place with a dent or a ring of tape"
        )


def _size(rows: PoseResiduals) -> float:
    """Return the robust mean size of all misfits, on which single outliers have little
    influence."""
    return float(np.log1p(rows.chi2 / 3.0).mean())
