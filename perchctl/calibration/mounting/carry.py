"""The carry: camera's turn and latency from the vehicle's turning and the target's in its pictures.

One rotation chain holds at each picture's exposure:
``R_cam_target = R_body_cam^T R_world_body(t - latency)^T R_world_target``. What is solved for
together: the camera's turn, the latency, the target's turn in the world, the gyroscope's constant
error and scale, a random walk of the summed-up turn, and the constant error of the vehicle's
attitude. The attitude only says where the world's axes are: the camera's turn rests on large turns,
felt and seen, so that an accelerometer that is off does not move it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from perchctl.calibration.mounting.felt import Felt, Turned, sum_up, turned_at
from perchctl.calibration.mounting.result import Left, covariance
from perchctl.calibration.mounting.spread import (
    inverses,
    likeliest,
    robust_shares,
    squared_distance,
    weights,
)
from perchctl.calibration.mounting.turns import rotation_matrices, rotation_vectors
from perchctl.geometry import Array

KNOT_S = 2.0
BLOCKS = 15
WALK_RAD = math.radians(0.03)  # of the summed-up turn in the first second; grows as its root
BIAS_SIGMA_RADPS = math.radians(3.0)  # of a BMI088 that nobody has calibrated
SCALE_SIGMA = 0.005
ATTITUDE_BIAS_SIGMA_RAD = np.radians([1.0, 1.0, 0.1])
"""What is off about the vertical is the target's heading instead."""
ATTITUDE_SIGMA_RAD = np.radians([0.4, 0.4, 1.0])  # of the mean over `ATTITUDE_S`
ATTITUDE_S = 1.0
_ESTIMATES_APART = 10  # samples; between them it is the same error
FLOOR_RAD = math.radians(0.02)  # of a pose: lens, print and paper
BARE_SIGMA_RAD = math.radians(0.3)  # of a pose that does not say
_ROUNDS, _MOST_STEPS = 4, 10
_LEAST_HELD = 1e-9  # of a turn that the motion leaves open: its sigma says so in the end

TURN, TARGET, BIAS, SCALE, OFF = (slice(3 * k, 3 * k + 3) for k in range(5))
LATENCY = 15
KNOTS = 16


@dataclass(frozen=True, eq=False)
class Seen:
    """The poses as arrays: t_s (n,), R_cam_target (n, 3, 3), cov_rad2 (n, 3, 3)."""

    t_s: Array
    R_cam_target: Array
    cov_rad2: Array


@dataclass(frozen=True, eq=False)
class State:
    """What is solved for; `walk` (j, 3) in world axes at the knots' times `knots_s` (j,)."""

    R_body_cam: Array
    R_world_target: Array
    bias_radps: Array
    scale: Array
    off_rad: Array
    latency_s: float
    knots_s: Array
    walk: Array


@dataclass(frozen=True, eq=False)
class Solved:
    """The minimum: `misfit` (n, 3) in camera axes, `counted` (n,), `rate_radps` (n, 3) of the
    body, `cov` (16, 16) of all but the walk, in the order of the slices of this module."""

    state: State
    misfit: Array
    counted: Array
    body: Turned
    cov: Array
    factor: float
    jitter_s: float


def solve(felt: Felt, seen: Seen, R_body_cam: Array, latency_s: float) -> Solved:
    """From a start within some ten degrees and some hundredths of a second."""
    state = _begin(felt, seen, R_body_cam, latency_s)
    factor, jitter_s = 3.0, 0.005
    for k in range(_ROUNDS):
        for _ in range(_MOST_STEPS):
            rows = _rows(state, felt, seen, factor, jitter_s)
            held = np.diag(_LEAST_HELD * np.diagonal(rows.information))
            step = np.asarray(np.linalg.solve(rows.information + held, rows.gradient))
            state = _moved(state, step)
            if np.abs(step[TURN]).max() < 1e-6 and abs(step[LATENCY]) < 1e-6:
                break
        rows = _rows(state, felt, seen, factor, jitter_s)
        if k < _ROUNDS - 1:
            factor, jitter_s = likeliest(
                rows.misfit[rows.within], seen.cov_rad2[rows.within], rows.along[rows.within]
            )
    blocks = rows.blocks()
    known = rows.information - np.sum([b.information for b in blocks], axis=0)
    d2 = squared_distance(rows.misfit, rows.inverse)[rows.within]
    cov = covariance(known, blocks, np.arange(KNOTS), robust_shares(d2, 3))
    return Solved(
        state, rows.misfit, np.minimum(rows.counted, 1.0), rows.body, cov, factor, jitter_s
    )


def _begin(felt: Felt, seen: Seen, R_body_cam: Array, latency_s: float) -> State:
    knots_s = np.linspace(
        felt.t_s[0], felt.t_s[-1], 1 + max(1, round((felt.t_s[-1] - felt.t_s[0]) / KNOT_S))
    )
    body = turned_at(sum_up(felt, np.zeros(3), np.zeros(3)), seen.t_s - latency_s)
    # Of many targets in the world that with the least distance to all.
    each = body.R_world_body @ R_body_cam @ seen.R_cam_target
    distance = np.abs(each[:, None] - each[None, :: 1 + len(each) // 60]).sum(axis=(2, 3))
    middle = int(np.argmin(np.median(distance, axis=1)))
    return State(
        R_body_cam, each[middle], np.zeros(3), np.zeros(3), np.zeros(3), latency_s, knots_s,
        np.zeros((len(knots_s), 3)),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Rows:
    """All rows at a state: the poses' design (n, 3, p), inverse covariances and weights, ..."""

    design: Array
    misfit: Array
    inverse: Array
    counted: Array
    along: Array
    within: Array
    body: Turned
    information: Array
    gradient: Array

    def blocks(self) -> list[Left]:
        """Of the poses, by time."""
        return [
            Left(*_normal(self.design[k], self.misfit[k], self.inverse[k], self.counted[k]))
            for k in np.array_split(np.arange(len(self.misfit)), BLOCKS)
        ]


def _normal(design: Array, misfit: Array, inverse: Array, counted: Array) -> tuple[Array, Array]:
    weighted = np.einsum("nij,njp->nip", inverse * counted[:, None, None], design)
    p = design.shape[2]
    flat = weighted.reshape(-1, p)
    return design.reshape(-1, p).T @ flat, -flat.T @ misfit.ravel()


def _rows(state: State, felt: Felt, seen: Seen, factor: float, jitter_s: float) -> _Rows:
    """Gauss-Newton's normal equations; a step is information^-1 gradient."""
    whole = sum_up(felt, state.bias_radps, state.scale)
    exposed_s = seen.t_s - state.latency_s
    within = (exposed_s >= felt.t_s[0]) & (exposed_s <= felt.t_s[-1])
    body = turned_at(whole, exposed_s)
    hats = _hats(state.knots_s, body.t_s)
    R_world_body = rotation_matrices(hats @ state.walk) @ body.R_world_body
    R_cam_world = state.R_body_cam.T @ R_world_body.transpose(0, 2, 1)
    predicted = R_cam_world @ state.R_world_target
    misfit = rotation_vectors(seen.R_cam_target @ predicted.transpose(0, 2, 1))
    along = -body.rate_radps @ state.R_body_cam
    design = np.zeros((len(misfit), 3, KNOTS + 3 * len(state.knots_s)))
    design[:, :, TURN] = state.R_body_cam.T
    design[:, :, TARGET] = -R_cam_world
    design[:, :, BIAS] = R_cam_world @ body.of_bias
    design[:, :, SCALE] = R_cam_world @ body.of_scale
    design[:, :, LATENCY] = along
    design[:, :, KNOTS:] = (
        hats[:, None, :, None] * R_cam_world[:, :, None, :]
    ).reshape(len(misfit), 3, -1)  # fmt: skip
    inverse = inverses(seen.cov_rad2, factor, along, jitter_s)
    counted = weights(squared_distance(misfit, inverse), 3) * within
    information, gradient = _normal(design, misfit, inverse, counted)
    for more in (_known(state), _estimated(state, felt, whole)):
        information, gradient = information + more[0], gradient + more[1]
    body = replace(body, R_world_body=R_world_body)
    return _Rows(
        design, misfit, inverse, counted, along, within, body, information, gradient
    )  # fmt: skip


def _known(state: State) -> tuple[Array, Array]:
    """What is known before: how large the sensor's errors may be, and how the walk goes."""
    p = KNOTS + state.walk.size
    information, gradient = np.zeros((p, p)), np.zeros(p)
    for where, value, sigma in (
        (BIAS, state.bias_radps, BIAS_SIGMA_RADPS),
        (SCALE, state.scale, SCALE_SIGMA),
        (OFF, state.off_rad, ATTITUDE_BIAS_SIGMA_RAD),
    ):
        known = np.broadcast_to(1.0 / np.square(sigma), 3)
        information[where, where] = np.diag(known)
        gradient[where] = -known * value
    steps = np.diff(np.eye(len(state.knots_s)), axis=0)
    steps /= WALK_RAD * np.sqrt(np.diff(state.knots_s))[:, None]
    walk = np.kron(steps.T @ steps, np.eye(3))
    information[KNOTS:, KNOTS:] = walk
    gradient[KNOTS:] = -walk @ state.walk.ravel()
    return information, gradient


def _estimated(state: State, felt: Felt, whole: Turned) -> tuple[Array, Array]:
    """The vehicle's own attitude, by its mean over each second; it errs slowly."""
    some = slice(None, None, _ESTIMATES_APART)
    hats = _hats(state.knots_s, felt.t_s[some])
    R_world_body = rotation_matrices(hats @ state.walk) @ whole.R_world_body[some]
    off = rotation_vectors(felt.estimate[some] @ R_world_body.transpose(0, 2, 1))
    misfit = off - R_world_body @ state.off_rad
    n = len(misfit)
    design = np.zeros((n, 3, KNOTS + state.walk.size))
    design[:, :, OFF] = -R_world_body
    design[:, :, BIAS], design[:, :, SCALE] = -whole.of_bias[some], -whole.of_scale[some]
    design[:, :, KNOTS:] = -(hats[:, None, :, None] * np.eye(3)[:, None, :]).reshape(n, 3, -1)
    count = max(1, round((felt.t_s[-1] - felt.t_s[0]) / ATTITUDE_S))
    parts = [k for k in np.array_split(np.arange(n), count) if len(k)]
    mean_design = np.array([design[k].mean(axis=0) for k in parts])
    mean_misfit = np.array([misfit[k].mean(axis=0) for k in parts])
    known = np.broadcast_to(np.diag(1.0 / ATTITUDE_SIGMA_RAD**2), (len(parts), 3, 3))
    d2 = squared_distance(mean_misfit, known)
    return _normal(mean_design, mean_misfit, known, np.minimum(weights(d2, 3), 1.0))


def _moved(state: State, step: Array) -> State:
    return replace(
        state,
        R_body_cam=rotation_matrices(step[TURN]) @ state.R_body_cam,
        R_world_target=rotation_matrices(step[TARGET]) @ state.R_world_target,
        bias_radps=state.bias_radps + step[BIAS],
        scale=state.scale + step[SCALE],
        off_rad=state.off_rad + step[OFF],
        latency_s=float(np.clip(state.latency_s + step[LATENCY], -0.5, 1.5)),
        walk=state.walk + step[KNOTS:].reshape(-1, 3),
    )


def _hats(knots_s: Array, t_s: Array) -> Array:
    """Weights (n, j) of the knots in linear interpolation."""
    k = np.clip(np.searchsorted(knots_s, t_s, side="right") - 1, 0, len(knots_s) - 2)
    share = np.clip((t_s - knots_s[k]) / (knots_s[k + 1] - knots_s[k]), 0.0, 1.0)
    out = np.zeros((len(t_s), len(knots_s)))
    rows = np.arange(len(t_s))
    out[rows, k], out[rows, k + 1] = 1.0 - share, share
    return out
