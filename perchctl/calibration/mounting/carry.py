"""The carry: the camera's turn and latency, from the rotations of vehicle and target.

One rotation chain holds at each picture's exposure:
``R_cam_target = R_body_cam^T R_world_body(t - latency)^T R_world_target``. What is solved for
together: the camera's turn, the latency, the target's turn in the world, the gyroscope's constant
error and scale, a random walk of the integrated rotation, and the constant error of the vehicle's
attitude. The attitude only says where the world's axes are: the camera's turn rests on large
rotations, measured by gyroscope and camera, so that an accelerometer that is off does not move it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from perchctl.calibration.mounting.recording import (
    HOW_TO_RECORD,
    AttitudeSample,
    MountingRecording,
    PoseArrays,
    check_recording,
    pose_arrays,
)
from perchctl.calibration.mounting.robust import (
    covariance,
    estimate_noise,
    inverses,
    normal_equations,
    squared_distance,
    student_weights,
)
from perchctl.errors import InvalidValue
from perchctl.geometry import Array, rpy_from_rotation

MOST_TURN_SIGMA_DEG = 0.5
MOST_LATENCY_SIGMA_S = 0.01
MOST_MISFIT_RAD = math.radians(3.0)
MOST_LEFT_OUT = 0.4
COUNTS_LITTLE = 0.2

KNOT_S = 2.0
WALK_RAD = math.radians(0.03)  # of the integrated rotation in the first second; grows as its root
BIAS_SIGMA_RADPS = math.radians(3.0)  # of a BMI088 that nobody has calibrated
SCALE_SIGMA = 0.005
ATTITUDE_BIAS_SIGMA_RAD = np.radians([1.0, 1.0, 0.1])
"""What is off about the vertical is the target's heading instead."""
ATTITUDE_SIGMA_RAD = np.radians([0.4, 0.4, 1.0])  # of the mean over `ATTITUDE_S`
ATTITUDE_S = 1.0
_ESTIMATES_APART = 10  # samples; between them it is the same error
FLOOR_RAD = math.radians(0.02)  # of a pose: lens, print and paper
_ROUNDS, _MOST_STEPS = 4, 10
_LEAST_HELD = 1e-9  # of a turn that the motion leaves open: its sigma says so in the end

TURN, TARGET, BIAS, SCALE, OFF = (slice(3 * k, 3 * k + 3) for k in range(5))
LATENCY = 15
KNOTS = 16


@dataclass(frozen=True, eq=False)
class CarrySolution:
    """The carry's solution. A sigma is such that the value +- 1.96 sigma is a 95 % interval.

    Attributes:
        R_body_cam: (3, 3); turn_cov_rad2 (3, 3) of a small turn of it in body axes.
        latency_s: from exposure to the picture's timestamp; positive is a late picture.
        attitude_bias_rad: of the vehicle's own estimate, (3,) in body axes; only roll and pitch
            are known.
    """

    R_body_cam: Array
    turn_cov_rad2: Array
    latency_s: float
    latency_sigma_s: float
    attitude_bias_rad: Array

    @property
    def rpy_deg(self) -> tuple[float, float, float]:
        """The camera's turn in degrees, as `camera.mount.rpy_deg` has it."""
        x, y, z = np.degrees(rpy_from_rotation(self.R_body_cam)).tolist()
        return x, y, z

    @property
    def rpy_sigma_deg(self) -> tuple[float, float, float]:
        """Sigma of the three angles, from the covariance of a small turn left of R_body_cam."""
        step = 1e-6
        small = Rotation.from_rotvec(step * np.eye(3)).as_matrix()
        here = np.array(rpy_from_rotation(self.R_body_cam))
        J = np.stack([np.array(rpy_from_rotation(R @ self.R_body_cam)) - here for R in small], 1)
        J = ((J + np.pi) % (2.0 * np.pi) - np.pi) / step
        x, y, z = np.degrees(np.sqrt(np.diagonal(J @ self.turn_cov_rad2 @ J.T))).tolist()
        return x, y, z


def solve_carry(recording: MountingRecording) -> CarrySolution:
    """Solve for the camera's turn in the body and its latency.

    Raises InvalidValue: too little motion, a mirrored picture, or vehicle and camera do not
    agree; with what to do.
    """
    check_recording(recording, "carry")
    imu, poses = imu_arrays(recording.attitudes), pose_arrays(recording)
    start = first_guess(integrate(imu, np.zeros(3), np.zeros(3)), poses)
    if start is None:
        raise InvalidValue(
            f"the target was not seen twice within half a second: {HOW_TO_RECORD['carry']}"
        )
    state, rows, cov = _solve(imu, poses, *start)
    _check(state, rows, cov)
    return CarrySolution(
        R_body_cam=state.R_body_cam,
        turn_cov_rad2=cov[TURN, TURN],
        latency_s=state.latency_s,
        latency_sigma_s=float(np.sqrt(cov[LATENCY, LATENCY])),
        attitude_bias_rad=state.off_rad,
    )


# --- The vehicle's rotation, from its gyroscope ------------------------------------------------
# Rates integrated over the whole recording drift by the sensor's constant error and by its noise's
# random walk only, some hundredths of a degree in half a minute. The attitude that the vehicle
# itself estimates rests on its accelerometers, whose constant error looks just like a camera that
# is tilted in the body: it says where down is, not how the camera is turned.


@dataclass(frozen=True, eq=False)
class ImuArrays:
    """Samples in the order of time, each time once: t_s (n,), estimate (n, 3, 3) R_world_body and
    gyro_radps (n, 3)."""

    t_s: Array
    estimate: Array
    gyro_radps: Array


def imu_arrays(samples: Sequence[AttitudeSample]) -> ImuArrays:
    """Return the samples as arrays, by time."""
    _, kept = np.unique([a.t_s for a in samples], return_index=True)
    ordered = [samples[k] for k in kept.tolist()]
    rpy = np.array([(a.roll_rad, a.pitch_rad, a.yaw_rad) for a in ordered])
    return ImuArrays(
        t_s=np.array([a.t_s for a in ordered]),
        estimate=Rotation.from_euler("ZYX", rpy[:, ::-1]).as_matrix(),
        gyro_radps=np.array([a.gyro_radps for a in ordered]),
    )


@dataclass(frozen=True, eq=False)
class Integrated:
    """The integrated rotation R_world_body (n, 3, 3) at t_s (n,), with its rates (n, 3).

    `of_bias` and `of_scale` (n, 3, 3): by how much a change of the gyroscope's constant error
    (rad/s) and of its scale (a share) turn the body, in world axes.
    """

    t_s: Array
    R_world_body: Array
    rate_radps: Array
    of_bias: Array
    of_scale: Array


def integrate(imu: ImuArrays, bias_radps: Array, scale: Array) -> Integrated:
    """Integrate the gyroscope, its errors taken off: rate = (gyro - bias) (1 + scale).

    Between two samples the rate goes straight from one to the other, to fourth order (Magnus).
    Where it begins in the world is chosen to agree with the estimate on the whole.
    """
    unbiased = imu.gyro_radps - bias_radps
    rate = unbiased * (1.0 + scale)
    dt = np.diff(imu.t_s)[:, None]
    before, after = rate[:-1], rate[1:]
    steps = _turns(0.5 * dt * (before + after) + dt**2 / 12.0 * np.cross(before, after))
    R = np.array(list(accumulate(steps, np.matmul, initial=np.eye(3))))
    R = Rotation.from_matrix(imu.estimate @ R.transpose(0, 2, 1)).mean().as_matrix() @ R
    return Integrated(
        t_s=imu.t_s,
        R_world_body=R,
        rate_radps=rate,
        of_bias=_integral(-R * (1.0 + scale), dt),
        of_scale=_integral(R * unbiased[:, None, :], dt),
    )


def _integral(values: Array, dt: Array) -> Array:
    """Return the integral (n, 3, 3) from the first sample on, by trapezia."""
    steps = 0.5 * dt[:, :, None] * (values[1:] + values[:-1])
    return np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])


def interpolate(whole: Integrated, t_s: Array) -> Integrated:
    """Return the rotation at other times (m,), which are clipped to the recording's."""
    grid = whole.t_s
    t_s = np.clip(t_s, grid[0], grid[-1])
    k = np.clip(np.searchsorted(grid, t_s, side="right") - 1, 0, len(grid) - 2)
    into = (t_s - grid[k])[:, None]
    share = into / (grid[k + 1] - grid[k])[:, None]
    change = whole.rate_radps[k + 1] - whole.rate_radps[k]
    way = into * (whole.rate_radps[k] + 0.5 * share * change)

    def between(values: Array) -> Array:
        return np.asarray(values[k] + share[..., None] * (values[k + 1] - values[k]))

    return Integrated(
        t_s=t_s,
        R_world_body=whole.R_world_body[k] @ _turns(way),
        rate_radps=whole.rate_radps[k] + share * change,
        of_bias=between(whole.of_bias),
        of_scale=between(whole.of_scale),
    )


def _turns(vectors: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of rotation vectors (n, 3)."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def _vectors(R: Array) -> Array:
    """Return rotation vectors (n, 3) of rotation matrices (n, 3, 3)."""
    return np.asarray(Rotation.from_matrix(R).as_rotvec())


# --- Turn of the camera and latency from nothing -------------------------------------------------
# No start is needed, whatever the camera's turn.
# Between two pictures the camera turns by the same rotation as the body, seen in its own axes:
# ``v_body = R_body_cam v_cam`` for the rotation vectors. For each latency of a grid the R_body_cam
# that fits best follows in closed form; the latency with the least misfit wins.


LATENCIES_S = np.arange(-0.2, 1.0, 0.02)
"""Also such as cannot be: a clock that is wrong is to be named, not hidden at the grid's end."""
_SPAN_S = (0.2, 0.5)
_MOST_PAIRS = 400
_FIT_ROUNDS = 3
_HALF_COUNTED_RAD = 0.02


def first_guess(whole: Integrated, poses: PoseArrays) -> tuple[Array, float] | None:
    """Return a guess of R_body_cam and the latency; None without pairs of pictures some tenths of
    a second apart."""
    first, second = _pairs(poses.t_s)
    if len(first) < 3:
        return None
    R = poses.R_cam_target
    seen = _vectors(R[first] @ R[second].transpose(0, 2, 1))
    guesses = []
    for latency_s in LATENCIES_S.tolist():
        a = interpolate(whole, poses.t_s[first] - latency_s).R_world_body
        b = interpolate(whole, poses.t_s[second] - latency_s).R_world_body
        R_body_cam, misfit = _fit_turn(_vectors(a.transpose(0, 2, 1) @ b), seen)
        guesses.append((misfit, latency_s, R_body_cam))
    _, latency_s, R_body_cam = min(guesses, key=lambda guess: guess[0])
    return R_body_cam, latency_s


def _pairs(t_s: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of pictures, and of the first one that is `_SPAN_S` later."""
    second = np.searchsorted(t_s, t_s + _SPAN_S[0])
    first = np.flatnonzero(second < len(t_s))
    second = second[first]
    near = t_s[second] - t_s[first] <= _SPAN_S[1]
    thinned = slice(None, None, 1 + int(near.sum()) // _MOST_PAIRS)
    return first[near][thinned], second[near][thinned]


def _fit_turn(body: Array, seen: Array) -> tuple[Array, float]:
    """Return R with body = R seen, by least squares in which what fits badly counts less, and the
    misfit."""
    weight = np.ones(len(body))
    R = np.eye(3)
    for _ in range(_FIT_ROUNDS):
        R = Rotation.align_vectors(body, seen, weight)[0].as_matrix()
        miss = ((body - seen @ R.T) ** 2).sum(axis=1) / _HALF_COUNTED_RAD**2
        weight = 1.0 / (1.0 + miss)
    return R, float((miss * weight).mean())


# --- All together: Gauss-Newton with weights by Student's t --------------------------------------


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

    def moved(self, step: Array) -> State:
        """Return the state after a step, small turns on the left of the rotations."""
        turn, target = _turns(np.stack([step[TURN], step[TARGET]]))
        return replace(
            self,
            R_body_cam=turn @ self.R_body_cam,
            R_world_target=target @ self.R_world_target,
            bias_radps=self.bias_radps + step[BIAS],
            scale=self.scale + step[SCALE],
            off_rad=self.off_rad + step[OFF],
            latency_s=float(np.clip(self.latency_s + step[LATENCY], -0.5, 1.5)),
            walk=self.walk + step[KNOTS:].reshape(-1, 3),
        )


@dataclass(frozen=True, eq=False)
class _Rows:
    """All rows at a state: the poses' design (n, 3, p), misfits (n, 3) in camera axes, inverse
    covariances and weights, what a second of latency does (n, 3), and the normal equations of
    all."""

    design: Array
    misfit: Array
    inverse: Array
    counted: Array
    along: Array
    information: Array
    gradient: Array


def _solve(
    imu: ImuArrays, poses: PoseArrays, R_body_cam: Array, latency_s: float
) -> tuple[State, _Rows, Array]:
    """Solve from a start within some ten degrees and some hundredths of a second. Return the
    minimum, its rows, and the covariance (16, 16) of all but the walk, in the order of this
    module's slices."""
    state = _first_state(imu, poses, R_body_cam, latency_s)
    cov_rad2 = poses.cov[:, :3, :3] + np.eye(3) * FLOOR_RAD**2
    factor, jitter_s = 3.0, 0.005
    for k in range(_ROUNDS):
        for _ in range(_MOST_STEPS):
            rows = _rows(state, imu, poses, cov_rad2, factor, jitter_s)
            held = np.diag(_LEAST_HELD * np.diagonal(rows.information))
            step = np.asarray(np.linalg.solve(rows.information + held, rows.gradient))
            state = state.moved(step)
            if np.abs(step[TURN]).max() < 1e-6 and abs(step[LATENCY]) < 1e-6:
                break
        rows = _rows(state, imu, poses, cov_rad2, factor, jitter_s)
        within = rows.counted > 0.0
        if k < _ROUNDS - 1:
            factor, jitter_s = estimate_noise(
                rows.misfit[within], cov_rad2[within], rows.along[within]
            )
    of_poses, _ = normal_equations(rows.design, rows.misfit, rows.inverse, rows.counted)
    known = rows.information - of_poses
    cov = covariance(rows.design, rows.misfit, rows.inverse, rows.counted, known, KNOTS)
    return state, rows, cov


def _first_state(imu: ImuArrays, poses: PoseArrays, R_body_cam: Array, latency_s: float) -> State:
    """Return the state to start from, its target's turn the middle one of all pictures'."""
    seconds = imu.t_s[-1] - imu.t_s[0]
    knots_s = np.linspace(imu.t_s[0], imu.t_s[-1], 1 + max(1, round(seconds / KNOT_S)))
    body = interpolate(integrate(imu, np.zeros(3), np.zeros(3)), poses.t_s - latency_s)
    each = body.R_world_body @ R_body_cam @ poses.R_cam_target
    distance = np.abs(each[:, None] - each[None, :: 1 + len(each) // 60]).sum(axis=(2, 3))
    middle = int(np.argmin(np.median(distance, axis=1)))
    none = np.zeros(3)
    walk = np.zeros((len(knots_s), 3))
    return State(R_body_cam, each[middle], none, none, none, latency_s, knots_s, walk)


def _rows(
    state: State,
    imu: ImuArrays,
    poses: PoseArrays,
    cov_rad2: Array,
    factor: float,
    jitter_s: float,
) -> _Rows:
    """Return all rows at a state; a Gauss-Newton step is information^-1 gradient."""
    whole = integrate(imu, state.bias_radps, state.scale)
    exposed_s = poses.t_s - state.latency_s
    within = (exposed_s >= imu.t_s[0]) & (exposed_s <= imu.t_s[-1])
    body = interpolate(whole, exposed_s)
    hats = _hats(state.knots_s, body.t_s)
    R_world_body = _turns(hats @ state.walk) @ body.R_world_body
    R_cam_world = state.R_body_cam.T @ R_world_body.transpose(0, 2, 1)
    predicted = R_cam_world @ state.R_world_target
    misfit = _vectors(poses.R_cam_target @ predicted.transpose(0, 2, 1))
    along = -body.rate_radps @ state.R_body_cam
    n = len(misfit)
    design = np.zeros((n, 3, KNOTS + state.walk.size))
    design[:, :, TURN] = state.R_body_cam.T
    design[:, :, TARGET] = -R_cam_world
    design[:, :, BIAS] = R_cam_world @ body.of_bias
    design[:, :, SCALE] = R_cam_world @ body.of_scale
    design[:, :, LATENCY] = along
    design[:, :, KNOTS:] = (hats[:, None, :, None] * R_cam_world[:, :, None, :]).reshape(n, 3, -1)
    inverse = inverses(cov_rad2, factor, along, jitter_s)
    counted = student_weights(squared_distance(misfit, inverse)) * within
    information, gradient = normal_equations(design, misfit, inverse, counted)
    for more in (_known(state), _estimated(state, imu, whole)):
        information, gradient = information + more[0], gradient + more[1]
    return _Rows(design, misfit, inverse, counted, along, information, gradient)


def _known(state: State) -> tuple[Array, Array]:
    """Return the normal equations of what is known before: how large the sensor's errors may be,
    and how far the walk goes."""
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


def _estimated(state: State, imu: ImuArrays, whole: Integrated) -> tuple[Array, Array]:
    """Return the normal equations of the vehicle's own attitude, by its mean over each second; it
    errs slowly."""
    some = slice(None, None, _ESTIMATES_APART)
    hats = _hats(state.knots_s, imu.t_s[some])
    R_world_body = _turns(hats @ state.walk) @ whole.R_world_body[some]
    off = _vectors(imu.estimate[some] @ R_world_body.transpose(0, 2, 1))
    misfit = off - R_world_body @ state.off_rad
    n = len(misfit)
    design = np.zeros((n, 3, KNOTS + state.walk.size))
    design[:, :, OFF] = -R_world_body
    design[:, :, BIAS], design[:, :, SCALE] = -whole.of_bias[some], -whole.of_scale[some]
    design[:, :, KNOTS:] = -(hats[:, None, :, None] * np.eye(3)[:, None, :]).reshape(n, 3, -1)
    count = max(1, round((imu.t_s[-1] - imu.t_s[0]) / ATTITUDE_S))
    parts = [k for k in np.array_split(np.arange(n), count) if len(k)]
    mean_design = np.array([design[k].mean(axis=0) for k in parts])
    mean_misfit = np.array([misfit[k].mean(axis=0) for k in parts])
    known = np.broadcast_to(np.diag(1.0 / ATTITUDE_SIGMA_RAD**2), (len(parts), 3, 3))
    counted = np.minimum(student_weights(squared_distance(mean_misfit, known)), 1.0)
    return normal_equations(mean_design, mean_misfit, known, counted)


def _hats(knots_s: Array, t_s: Array) -> Array:
    """Return the weights (n, j) of the knots in linear interpolation."""
    return np.stack([np.interp(t_s, knots_s, one) for one in np.eye(len(knots_s))], axis=1)


def _check(state: State, rows: _Rows, cov: Array) -> None:
    """Raises InvalidValue unless vehicle and camera agree, and well enough."""
    used = rows.counted > 0.0
    size = np.linalg.norm(rows.misfit[used], axis=1)
    left_out = float((rows.counted[used] < COUNTS_LITTLE).mean())
    if np.median(size) > MOST_MISFIT_RAD or left_out > MOST_LEFT_OUT:
        raise InvalidValue(
            f"the turns that the vehicle felt and those that the camera saw differ by "
            f"{math.degrees(np.median(size)):.1f} deg ({100 * left_out:.0f} % of the pictures do "
            f"not fit at all): target and camera must not move in the room or on the vehicle; "
            f"then {HOW_TO_RECORD['carry']}"
        )
    sigma = np.sqrt(np.diagonal(cov))
    turn_deg, latency_s = math.degrees(sigma[TURN].max()), float(sigma[LATENCY])
    if not turn_deg <= MOST_TURN_SIGMA_DEG:
        raise InvalidValue(
            f"the camera's turn is known to {turn_deg:.1f} deg only (at most "
            f"{MOST_TURN_SIGMA_DEG:g} is accepted): {HOW_TO_RECORD['carry']}, and farther to each "
            f"side"
        )
    if not latency_s <= MOST_LATENCY_SIGMA_S:
        raise InvalidValue(
            f"the latency is known to {1e3 * latency_s:.0f} ms only (at most "
            f"{1e3 * MOST_LATENCY_SIGMA_S:g} is accepted): turn faster to and fro"
        )
    if state.latency_s < -2.0 * latency_s:
        raise InvalidValue(
            f"the pictures are stamped {-1e3 * state.latency_s:.0f} ms before they can have "
            f"been taken: camera and telemetry must be on one clock"
        )
