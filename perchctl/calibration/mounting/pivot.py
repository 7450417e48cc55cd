"""The pivot: the gear's tip stands on one point while the vehicle is tilted around it.

The point c in the target's frame and the tip in the camera's hold for every picture:
``tip = R_cam_target c + p_cam_target``. Both are found by linear least squares, each picture by
its own covariance, and wrong ones count little. No attitude and no time is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perchctl.calibration.mounting.result import Left, covariance
from perchctl.calibration.mounting.spread import likeliest, robust_shares, squared_distance, weights
from perchctl.calibration.mounting.turns import cross_matrix
from perchctl.geometry import Array

BLOCKS = 15
FLOOR_M = 5e-5  # of the tip on its point
BARE_SHARE = 0.005  # of its distance: the place of a pose that does not say
_START_SIGMA_M = 1e-3
_ROUNDS = 12
_SPLITS, _SLIP_ROUNDS = 19, 4
TIP, POINT = slice(0, 3), slice(3, 6)


@dataclass(frozen=True, eq=False)
class Seen:
    """The poses as arrays: t_s (n,), R_cam_target (n, 3, 3), p_cam_target_m (n, 3) and their
    covariances cov (n, 6, 6), turn first."""

    t_s: Array
    R_cam_target: Array
    p_cam_target_m: Array
    cov: Array

    def part(self, which: Array) -> Seen:
        return Seen(
            self.t_s[which], self.R_cam_target[which], self.p_cam_target_m[which], self.cov[which]
        )


@dataclass(frozen=True, eq=False)
class Solved:
    """tip_m and point_m (3,), the tip's covariance (3, 3), misfit (n, 3) in camera axes, counted
    (n,), and the inverse covariances (n, 3, 3) of the misfits."""

    tip_m: Array
    point_m: Array
    cov_m2: Array
    misfit: Array
    counted: Array
    inverse: Array


def solve(seen: Seen) -> Solved:
    """At least some pictures that are tilted differently; without tilts it is singular."""
    n = len(seen.t_s)
    design = _design(seen)
    inverse = np.broadcast_to(np.eye(3) / _START_SIGMA_M**2, (n, 3, 3))
    counted = np.ones(n)
    factor = 1.0
    for k in range(_ROUNDS):
        found, misfit = _least_squares(design, seen.p_cam_target_m, inverse, counted)
        cov = _of_misfit(seen, found[POINT])
        if k % 3 == 0:
            factor, _ = likeliest(misfit, cov)
        inverse = np.asarray(np.linalg.inv(cov)) / factor**2
        counted = weights(squared_distance(misfit, inverse), 3)
    blocks = [
        Left(*_normal(design[b], -misfit[b], inverse[b], counted[b]))
        for b in np.array_split(np.arange(n), BLOCKS)
    ]
    robust = robust_shares(squared_distance(misfit, inverse), 3)
    return Solved(
        tip_m=found[TIP],
        point_m=found[POINT],
        cov_m2=covariance(np.zeros((6, 6)), blocks, np.arange(3), robust),
        misfit=misfit,
        counted=np.minimum(counted, 1.0),
        inverse=inverse,
    )


def _design(seen: Seen) -> Array:
    design = np.zeros((len(seen.t_s), 3, 6))
    design[:, :, TIP] = np.eye(3)
    design[:, :, POINT] = -seen.R_cam_target
    return design


def _least_squares(
    design: Array, right: Array, inverse: Array, counted: Array
) -> tuple[Array, Array]:
    """What is found, (p,), and the misfits (n, 3)."""
    information, gradient = _normal(design, right, inverse, counted)
    found = np.asarray(np.linalg.solve(information, gradient), dtype=np.float64)
    return found, design @ found - right


def _of_misfit(seen: Seen, point_m: Array) -> Array:
    """Covariance (n, 3, 3) of what each pose's error does to the tip."""
    J = np.zeros((len(seen.t_s), 3, 6))
    J[:, :, :3] = cross_matrix(seen.R_cam_target @ point_m)
    J[:, :, 3:] = -np.eye(3)
    return np.asarray(J @ seen.cov @ J.transpose(0, 2, 1) + np.eye(3) * FLOOR_M**2)


def _normal(design: Array, right: Array, inverse: Array, counted: Array) -> tuple[Array, Array]:
    weighted = (inverse * counted[:, None, None]) @ design
    flat = weighted.reshape(-1, design.shape[2])
    return design.reshape(-1, design.shape[2]).T @ flat, flat.T @ right.ravel()


def in_target(seen: Seen, solved: Solved) -> Array:
    """The misfits in the target's axes, (n, 3): where the tip was, from its point."""
    return np.asarray(np.einsum("nji,nj->ni", seen.R_cam_target, solved.misfit))


@dataclass(frozen=True)
class Slip:
    """When the point changed, by how far, and which share of the misfit that explains."""

    t_s: float
    moved_m: float
    explains: float


def slip(seen: Seen, solved: Solved) -> Slip:
    """The likeliest moment at which the tip jumped from one point to another.

    For moments all over the recording, each with a point before and one after: that with the
    least misfit, counted robustly.
    """
    n, p = len(seen.t_s), seen.p_cam_target_m
    one = _design(seen)
    alone = _size(solved.misfit, solved.inverse)
    best = Slip(float(seen.t_s[0]), 0.0, 0.0)
    for k in np.unique(np.linspace(0, n, _SPLITS + 2).astype(np.intp))[1:-1]:
        two = np.zeros((n, 3, 9))
        two[:, :, :6] = one
        two[k:, :, 6:] = one[k:, :, POINT]
        counted = np.ones(n)
        for _ in range(_SLIP_ROUNDS):
            found, misfit = _least_squares(two, p, solved.inverse, counted)
            counted = weights(squared_distance(misfit, solved.inverse), 3)
        explains = 1.0 - _size(misfit, solved.inverse) / alone
        if explains > best.explains:
            best = Slip(float(seen.t_s[k]), float(np.linalg.norm(found[6:])), explains)
    return best


def _size(misfit: Array, inverse: Array) -> float:
    """Of the misfits on the whole; single wrong ones add little."""
    return float(np.log1p(squared_distance(misfit, inverse) / 3.0).mean())
