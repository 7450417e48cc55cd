"""Where the camera sits in the body, from a vehicle that knows its position.

``p_world_body + R_world_body (t_body_cam + R_body_cam p_cam_target) = p_world_target`` at each
picture's exposure, with a world that drifts evenly. The turns are those of the carry's solution.
"""

from __future__ import annotations

import numpy as np

from perchctl.calibration.mounting.carry import TURN, Solved
from perchctl.calibration.mounting.felt import Felt
from perchctl.calibration.mounting.result import Left, covariance
from perchctl.calibration.mounting.spread import robust_shares, weights
from perchctl.calibration.mounting.turns import rotation_matrices
from perchctl.geometry import Array

LEAST_POSES = 100
_DRIFT_SIGMA_MPS = 0.02
_BLOCKS, _ROUNDS = 15, 8
_CAMERA, _TARGET, _DRIFT = slice(0, 3), slice(3, 6), slice(6, 9)


def camera_place(
    felt: Felt, p_cam_target_m: Array, solved: Solved
) -> tuple[Array, Array] | tuple[None, None]:
    """t_body_cam (3,) m and its sigma; None where too few pictures have a trusted position."""
    trusted = np.isfinite(felt.position_sigma_m)
    t_s = solved.body.t_s
    if trusted.sum() < LEAST_POSES:
        return None, None
    known_s = felt.t_s[trusted]
    near = np.abs(known_s[np.clip(np.searchsorted(known_s, t_s), 0, len(known_s) - 1)] - t_s) < 0.1
    if near.sum() < LEAST_POSES:
        return None, None
    body_m = np.stack([np.interp(t_s, known_s, axis) for axis in felt.position_m[trusted].T], 1)
    sigma_m = np.interp(t_s, known_s, felt.position_sigma_m[trusted])[near]
    R = solved.body.R_world_body[near]
    place, known, blocks, robust = _least_squares(
        R, body_m[near], p_cam_target_m[near] @ solved.state.R_body_cam.T, sigma_m, t_s[near]
    )
    cov = covariance(known, blocks, np.arange(3), robust)
    # The camera's turn is not known exactly either.
    values, axes = np.linalg.eigh(solved.cov[TURN, TURN])
    for value, axis in zip(values, axes.T, strict=True):
        turned = rotation_matrices(axis * np.sqrt(max(value, 0.0))) @ solved.state.R_body_cam
        other, *_ = _least_squares(
            R, body_m[near], p_cam_target_m[near] @ turned.T, sigma_m, t_s[near]
        )
        cov += np.outer(other - place, other - place)
    return place, np.sqrt(np.diagonal(cov))


def _least_squares(
    R: Array, body_m: Array, way_m: Array, sigma_m: Array, t_s: Array
) -> tuple[Array, Array, list[Left], tuple[float, float]]:
    """The camera's place, and what `covariance` needs; `way_m` (n, 3): to the target, body axes."""
    n = len(R)
    design = np.zeros((n, 3, 9))
    design[:, :, _CAMERA] = R
    design[:, :, _TARGET] = -np.eye(3)
    design[:, :, _DRIFT] = (t_s - t_s.mean())[:, None, None] * np.eye(3)
    right = -(np.einsum("nij,nj->ni", R, way_m) + body_m)
    known = np.zeros((9, 9))
    known[_DRIFT, _DRIFT] = np.eye(3) / _DRIFT_SIGMA_MPS**2
    counted = np.ones(n)
    for _ in range(_ROUNDS):
        scaled = (counted / sigma_m**2)[:, None, None] * design
        parts = [
            np.einsum("nip,niq->pq", scaled[k], design[k])
            for k in np.array_split(np.arange(n), _BLOCKS)
        ]
        information = known + np.sum(parts, axis=0)
        found = np.linalg.solve(information, np.einsum("nip,ni->p", scaled, right))
        misfit = design @ found - right
        counted = weights((misfit**2).sum(axis=1) / sigma_m**2, 3)
    blocks = [
        Left(part, -np.einsum("nip,ni->p", scaled[k], misfit[k]))
        for part, k in zip(parts, np.array_split(np.arange(n), _BLOCKS), strict=True)
    ]
    d2 = (misfit**2).sum(axis=1) / sigma_m**2
    return found[_CAMERA], known, blocks, robust_shares(d2, 3)
