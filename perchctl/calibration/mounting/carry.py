"""The carry: find the camera's rotation and latency while the vehicle is turned by hand.

The following chain of rotations holds at each image's exposure: ``R_cam_target = R_body_cam^T
R_world_body(t - latency)^T R_world_target``. Integrating the gyroscope's rates gives R_world_body,
where the world frame is the body frame at the first sample. The solution contains the rotations of
camera and target, the latency, the bias and scale error of the gyroscope, and a random walk of the
integrated rotation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from perchctl.calibration.board.adjust import jackknife_covariance
from perchctl.calibration.mounting.recording import (
    HOW_TO_RECORD,
    MountingRecording,
    PoseArrays,
    check_recording,
    pose_arrays,
)
from perchctl.errors import InvalidValue
from perchctl.geometry import Array, rpy_from_rotation

MOST_TURN_SIGMA_DEG = 0.5
MOST_LATENCY_SIGMA_S = 0.01
MOST_MISFIT_RAD = math.radians(3.0)
BIAS_SIGMA_RADPS = math.radians(3.0)  # bias of an uncalibrated BMI088
SCALE_SIGMA = 0.005
KNOT_S = 2.0
GYRO_WALK_RAD = math.radians(0.03)
"""Random walk of the integrated rotation in the first second, rad; it grows with the square root of
time."""
FLOOR_RAD = math.radians(0.02)  # smallest error of a pose, due to lens, print and paper
_CARRY_ITERATIONS = 15

TURN, TARGET, BIAS, SCALE = (slice(3 * k, 3 * k + 3) for k in range(4))
LATENCY, KNOTS = 12, 13


@dataclass(frozen=True, eq=False)
class RotationSolution:
    """Camera rotation and latency from a carry recording; value +- 1.96 sigma is a 95 % interval.

    Attributes:
        rotation_cov_rad2: covariance (3, 3) of a small rotation of R_body_cam in body axes.
        latency_s: time from the exposure to the image's timestamp; positive if images are late.
    """

    R_body_cam: Array
    rotation_cov_rad2: Array
    latency_s: float
    latency_sigma_s: float

    @property
    def rpy_deg(self) -> tuple[float, float, float]:
        """The camera's rotation in degrees, as in `camera.mount.rpy_deg`."""
        x, y, z = np.degrees(rpy_from_rotation(self.R_body_cam)).tolist()
        return x, y, z

    @property
    def rpy_sigma_deg(self) -> tuple[float, float, float]:
        """Standard deviations of `rpy_deg`."""
        step = 1e-6
        small = Rotation.from_rotvec(step * np.eye(3)).as_matrix()
        here = np.array(rpy_from_rotation(self.R_body_cam))
        J = np.stack([np.array(rpy_from_rotation(R @ self.R_body_cam)) - here for R in small], 1)
        J = ((J + np.pi) % (2.0 * np.pi) - np.pi) / step
        x, y, z = np.degrees(np.sqrt(np.diagonal(J @ self.rotation_cov_rad2 @ J.T))).tolist()
        return x, y, z


def solve_rotation(recording: MountingRecording) -> RotationSolution:
    """Solve for the camera's rotation in the body and its latency.

    Raises InvalidValue, with advice, for too little motion or a mirrored image, or if the rotations
    of vehicle and camera do not agree.
    """
    check_recording(recording, "carry")
    t_s, first = np.unique([a.t_s for a in recording.attitudes], return_index=True)
    gyro = np.array([recording.attitudes[k].gyro_radps for k in first])
    poses = pose_arrays(recording)
    bias = np.zeros(3)
    scale = np.zeros(3)
    body = integrate_gyro(t_s, gyro, bias, scale)
    R_body_cam, latency_s = guess_rotation_and_latency(body, poses)
    R_world_target = _middle_target(body, poses, R_body_cam, latency_s)
    knots_s = np.linspace(t_s[0], t_s[-1], 1 + max(1, round((t_s[-1] - t_s[0]) / KNOT_S)))
    walk = np.zeros((len(knots_s) - 1, 3))
    known = _known(knots_s)
    cov_rad2 = poses.cov[:, :3, :3] + np.eye(3) * FLOOR_RAD**2
    for _ in range(_CARRY_ITERATIONS):
        at = interpolate_rotation(integrate_gyro(t_s, gyro, bias, scale), poses.t_s - latency_s)
        hats = np.stack([np.interp(at.t_s, knots_s, one) for one in np.eye(len(knots_s))[1:]], 1)
        R_cam_world = (_turns(hats @ walk) @ at.R_world_body @ R_body_cam).transpose(0, 2, 1)
        predicted = R_cam_world @ R_world_target
        misfit = _vectors(poses.R_cam_target @ predicted.transpose(0, 2, 1))
        late = -at.rate_radps @ R_body_cam
        turned = np.broadcast_to(R_body_cam.T, R_cam_world.shape)
        walked = np.einsum("nk,nij->nikj", hats, R_cam_world).reshape(len(hats), 3, -1)
        bias_jacobian = R_cam_world @ at.bias_jacobian
        scale_jacobian = R_cam_world @ at.scale_jacobian
        parts = (turned, -R_cam_world, bias_jacobian, scale_jacobian, late[:, :, None], walked)
        rows = weight_residuals(np.concatenate(parts, axis=2), misfit, cov_rad2, known, late)
        step = rows.step(np.concatenate([np.zeros(6), bias, scale, [0.0], walk.ravel()]))
        R_body_cam = _turns(step[TURN]) @ R_body_cam
        R_world_target = _turns(step[TARGET]) @ R_world_target
        bias = bias + step[BIAS]
        scale = scale + step[SCALE]
        latency_s = float(np.clip(latency_s + step[LATENCY], -0.5, 1.5))
        walk = walk + step[KNOTS:].reshape(-1, 3)
    cov = rows.parameter_covariance()
    _check(rows, latency_s, cov)
    return RotationSolution(
        R_body_cam, cov[TURN, TURN], latency_s, math.sqrt(cov[LATENCY, LATENCY])
    )


def _known(knots_s: Array) -> Array:
    """The prior information matrix (p, p) for the sensor's errors and the random walk of the
    knots."""
    steps = np.diff(np.eye(len(knots_s)), axis=0)[:, 1:]
    steps /= GYRO_WALK_RAD * np.sqrt(np.diff(knots_s))[:, None]
    p = KNOTS + 3 * (len(knots_s) - 1)
    known = np.zeros((p, p))
    known[BIAS, BIAS] = np.eye(3) / BIAS_SIGMA_RADPS**2
    known[SCALE, SCALE] = np.eye(3) / SCALE_SIGMA**2
    known[KNOTS:, KNOTS:] = np.kron(steps.T @ steps, np.eye(3))
    return known


def _middle_target(
    body: GyroRotation, poses: PoseArrays, R_body_cam: Array, latency_s: float
) -> Array:
    """Return the target's rotation in the world, taken from the image whose rotation has the
    smallest median distance to the rotations from the other images."""
    each = (
        interpolate_rotation(body, poses.t_s - latency_s).R_world_body
        @ R_body_cam
        @ poses.R_cam_target
    )
    distance = np.abs(each[:, None] - each[None, :: 1 + len(each) // 60]).sum(axis=(2, 3))
    return np.asarray(each[np.argmin(np.median(distance, axis=1))])


def _check(rows: PoseResiduals, latency_s: float, cov: Array) -> None:
    off_rad = float(np.median(np.linalg.norm(rows.misfit, axis=1)))
    if off_rad > MOST_MISFIT_RAD or rows.rejected_share > MOST_LEFT_OUT:
        raise InvalidValue(
            "the rotations from the gyroscope and from the camera differ by "
            f"{math.degrees(off_rad):.1f} deg ({100 * rows.rejected_share:.0f} % of the "
            "images do not fit at all): fix the target in the room and the camera on the "
            f"vehicle; then {HOW_TO_RECORD['carry']}"
        )
    sigma = np.sqrt(np.diagonal(cov))
    turn_deg = math.degrees(sigma[TURN].max())
    sigma_s = float(sigma[LATENCY])
    if not turn_deg <= MOST_TURN_SIGMA_DEG:
        raise InvalidValue(
            f"the camera's rotation is known only to {turn_deg:.1f} deg (at most "
            f"{MOST_TURN_SIGMA_DEG:g} is accepted): {HOW_TO_RECORD['carry']}, and turn it "
            "farther to each side"
        )
    if not sigma_s <= MOST_LATENCY_SIGMA_S:
        raise InvalidValue(
            f"the latency is known only to {1e3 * sigma_s:.0f} ms (at most "
            f"{1e3 * MOST_LATENCY_SIGMA_S:g} is accepted): turn the vehicle back and forth "
            "faster"
        )
    if latency_s < -2.0 * sigma_s:
        raise InvalidValue(
            f"the images' time stamps are {-1e3 * latency_s:.0f} ms too early, which is "
            "impossible: camera and telemetry must use the same clock"
        )


# --- The vehicle's rotation, from its gyroscope ---


@dataclass(frozen=True, eq=False)
class GyroRotation:
    """The vehicle's rotation (n, 3, 3) at n times, integrated from its corrected rates (n, 3).

    `bias_jacobian` and `scale_jacobian` (n, 3, 3): derivatives of the rotation vector, in world
    axes, with respect to the gyroscope's bias (rad/s) and scale error.
    """

    t_s: Array
    R_world_body: Array
    rate_radps: Array
    bias_jacobian: Array
    scale_jacobian: Array


def integrate_gyro(t_s: Array, gyro_radps: Array, bias_radps: Array, scale: Array) -> GyroRotation:
    """Integrate the gyroscope's rates (n, 3), corrected to rate = (gyro - bias) (1 + scale); bias
    and scale are (3,).

    The rate is assumed to be linear between samples; the method is of fourth order (Magnus).
    """
    unbiased = gyro_radps - bias_radps
    rate = unbiased * (1.0 + scale)
    dt = np.diff(t_s)[:, None]
    before, after = rate[:-1], rate[1:]
    steps = _turns(0.5 * dt * (before + after) + dt**2 / 12.0 * np.cross(before, after))
    R = np.array(list(accumulate(steps, np.matmul, initial=np.eye(3))))
    return GyroRotation(
        t_s=t_s,
        R_world_body=R,
        rate_radps=rate,
        bias_jacobian=_integral(-R * (1.0 + scale), dt),
        scale_jacobian=_integral(R * unbiased[:, None, :], dt),
    )


def _integral(values: Array, dt: Array) -> Array:
    """Return the integral (n, 3, 3) from the first sample to each sample, by the trapezoidal
    rule."""
    steps = 0.5 * dt[:, :, None] * (values[1:] + values[:-1])
    return np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])


def interpolate_rotation(gyro: GyroRotation, t_s: Array) -> GyroRotation:
    """Interpolate the rotation at the times `t_s` (m,), clipped to the recording."""
    grid = gyro.t_s
    t_s = np.clip(t_s, grid[0], grid[-1])
    k = np.clip(np.searchsorted(grid, t_s, side="right") - 1, 0, len(grid) - 2)
    into = (t_s - grid[k])[:, None]
    share = into / (grid[k + 1] - grid[k])[:, None]
    change = gyro.rate_radps[k + 1] - gyro.rate_radps[k]
    way = into * (gyro.rate_radps[k] + 0.5 * share * change)

    def between(values: Array) -> Array:
        return np.asarray(values[k] + share[..., None] * (values[k + 1] - values[k]))

    return GyroRotation(
        t_s=t_s,
        R_world_body=gyro.R_world_body[k] @ _turns(way),
        rate_radps=gyro.rate_radps[k] + share * change,
        bias_jacobian=between(gyro.bias_jacobian),
        scale_jacobian=between(gyro.scale_jacobian),
    )


def _turns(vectors: Array) -> Array:
    """Convert rotation vectors (..., 3) to rotation matrices (..., 3, 3)."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def _vectors(R: Array) -> Array:
    """Convert rotation matrices (n, 3, 3) to rotation vectors (n, 3)."""
    return np.asarray(Rotation.from_matrix(R).as_rotvec())


# --- The camera's rotation and latency without an initial guess ---
# Between two images, camera and body undergo the same rotation, each expressed in its own axes:
# ``v_body = R_body_cam v_cam`` for the rotation vectors. For each latency on a grid, the best
# R_body_cam has a closed-form solution; the latency with the smallest misfit is used.


LATENCIES_S = np.arange(-0.2, 1.0, 0.02)
"""Latencies on the search grid, s. The grid contains impossible latencies too, so that a wrong
clock is recognised."""
_SPAN_S = (0.2, 0.5)
_MOST_PAIRS = 400
_FIT_ROUNDS = 3
_HALF_COUNTED_RAD = 0.02


def guess_rotation_and_latency(gyro: GyroRotation, poses: PoseArrays) -> tuple[Array, float]:
    """Return a first estimate of R_body_cam and of the latency in s. Raises InvalidValue if no two
    images are a few tenths of a second apart."""
    first, second = _pairs(poses.t_s)
    if len(first) < 3:
        raise InvalidValue(
            f"the target was never seen twice within half a second: {HOW_TO_RECORD['carry']}"
        )
    R = poses.R_cam_target
    seen = _vectors(R[first] @ R[second].transpose(0, 2, 1))
    guesses = []
    for latency_s in LATENCIES_S.tolist():
        a = interpolate_rotation(gyro, poses.t_s[first] - latency_s).R_world_body
        b = interpolate_rotation(gyro, poses.t_s[second] - latency_s).R_world_body
        R_body_cam, misfit = _fit_turn(_vectors(a.transpose(0, 2, 1) @ b), seen)
        guesses.append((misfit, latency_s, R_body_cam))
    _, latency_s, R_body_cam = min(guesses, key=lambda guess: guess[0])
    return R_body_cam, latency_s


def _pairs(t_s: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    second = np.searchsorted(t_s, t_s + _SPAN_S[0])
    first = np.flatnonzero(second < len(t_s))
    second = second[first]
    near = t_s[second] - t_s[first] <= _SPAN_S[1]
    thinned = slice(None, None, 1 + int(near.sum()) // _MOST_PAIRS)
    return first[near][thinned], second[near][thinned]


def _fit_turn(body: Array, seen: Array) -> tuple[Array, float]:
    weight = np.ones(len(body))
    R = np.eye(3)
    for _ in range(_FIT_ROUNDS):
        R = Rotation.align_vectors(body, seen, weight)[0].as_matrix()
        miss = ((body - seen @ R.T) ** 2).sum(axis=1) / _HALF_COUNTED_RAD**2
        weight = 1.0 / (1.0 + miss)
    return R, float((miss * weight).mean())


# --- Robust least squares of misfits (n, 3), and the remaining uncertainty ---
# The covariance of a pose is assumed to be correct up to a factor. A wrong timestamp adds an error
# along the vehicle's rotation: the rate times the jitter. The factor and the jitter are both
# estimated from the misfits, which are assumed to follow Student's t distribution with few degrees
# of freedom, so that wrong poses have little influence.


FREEDOM = 5.0
JACKKNIFE_BLOCKS = 15
MOST_LEFT_OUT = 0.4
_COUNTS_LITTLE = 0.2
_JITTERS_S = 1e-3 * np.concatenate([np.arange(0.0, 12.0), np.geomspace(13.0, 30.0, 4)])
_MEDIAN_OF_CHI2 = 2.366  # median of chi-squared with three degrees of freedom


@dataclass(frozen=True, eq=False)
class PoseResiduals:
    """Residuals `misfit` (n, 3) of n poses in time order, Jacobian (n, 3, p), inverse covariances
    (n, 3, 3), robust weights (n,), and prior information (p, p) of the p parameters."""

    jacobian: Array
    misfit: Array
    inverse_cov: Array
    robust_weights: Array
    prior: Array

    @property
    def chi2(self) -> Array:
        """Squared size of each misfit in standard deviations, (n,)."""
        return _distance2(self.misfit, self.inverse_cov)

    @property
    def rejected_share(self) -> float:
        """Return the share of poses whose robust weight is nearly 0."""
        return float((self.robust_weights < _COUNTS_LITTLE).mean())

    def normal_equations(
        self, poses: slice | NDArray[np.intp] = slice(None)
    ) -> tuple[Array, Array]:
        """Return the information matrix (p, p) and gradient (p,) for the poses with the indices
        `poses`."""
        p = self.jacobian.shape[2]
        jacobian = self.jacobian[poses]
        weights = self.robust_weights[poses, None, None]
        weighted = ((self.inverse_cov[poses] * weights) @ jacobian).reshape(-1, p)
        return jacobian.reshape(-1, p).T @ weighted, -weighted.T @ self.misfit[poses].ravel()

    def step(self, prior_offset: Array | float = 0.0) -> Array:
        """The Gauss-Newton step (p,); `prior_offset` (p,) is the parameters' offset from the
        prior's mean."""
        information, gradient = self.normal_equations()
        pull = self.prior @ np.broadcast_to(prior_offset, gradient.shape)
        return np.asarray(np.linalg.solve(information + self.prior, gradient - pull))

    def after_step(self, step: Array) -> PoseResiduals:
        """The residuals after the parameters change by `step` (p,), to first order."""
        misfit = self.misfit + self.jacobian @ step
        return replace(
            self, misfit=misfit, robust_weights=_weights(_distance2(misfit, self.inverse_cov))
        )

    def parameter_covariance(self) -> Array:
        """Return the parameters' covariance (p, p) by a block jackknife, since errors of successive
        images may be correlated."""
        blocks = [
            self.normal_equations(k)
            for k in np.array_split(np.arange(len(self.misfit)), JACKKNIFE_BLOCKS)
        ]
        return jackknife_covariance(blocks, self.prior, *_robust_shares(self.chi2))


def weight_residuals(
    jacobian: Array,
    misfit: Array,
    cov: Array,
    prior: Array,
    delay_jacobian: Array | None = None,
) -> PoseResiduals:
    """Weight the residuals of poses by their covariances (n, 3, 3) times an estimated factor.

    With `delay_jacobian` (n, 3), misfit per second of delay, timestamp jitter is estimated and
    added.
    """
    best_cost, best, late = np.inf, cov, delay_jacobian
    for jitter_s in (0.0,) if late is None else _JITTERS_S:
        spread = cov
        if late is not None:
            spread = cov + jitter_s**2 * late[:, :, None] * late[:, None, :]
        inverse = np.asarray(np.linalg.inv(spread))
        distance2 = _distance2(misfit, inverse)
        factor2 = float(np.median(distance2)) / _MEDIAN_OF_CHI2
        size = np.linalg.slogdet(factor2 * spread)[1]
        tail = (FREEDOM + 3) * np.log1p(distance2 / factor2 / FREEDOM)
        cost = float((size + tail).sum())
        if cost < best_cost:
            best_cost = cost
            best = inverse / factor2
    weights = _weights(_distance2(misfit, best))
    return PoseResiduals(jacobian, misfit, best, weights, prior)


def _distance2(misfit: Array, inverse: Array) -> Array:
    return np.asarray(np.einsum("ni,nij,nj->n", misfit, inverse, misfit))


def _weights(distance2: Array) -> Array:
    return np.asarray((FREEDOM + 3) / (FREEDOM + distance2))


def _robust_shares(distance2: Array) -> tuple[float, float]:
    """Return the curvature factor and the information factor that `jackknife_covariance` needs for
    robust weights."""
    w = _weights(distance2)
    curved = float((w * (1.0 - 2.0 * distance2 / (3 * (FREEDOM + distance2)))).mean())
    pushed = float((w**2 * distance2).mean()) / 3
    return curved / float(w.mean()), curved / max(pushed, 1e-9)
