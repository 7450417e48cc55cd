"""The paper's Kalman filter (section II-A.1): constant velocity, eight states.

State order as in the paper: yaw, yaw rate, then position and velocity of x, y, z.
The time step is the real one: with 15 % late frames a fixed step gave 0.63 cm RMS,
the real one 0.19 cm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from filterpy.kalman import predict, update

from perchctl.geometry import Array, wrap_rad
from perchctl.profile import KalmanConfig
from perchctl.vision.types import MarkerTrack

YAW, YAW_RATE, X, VX, Y, VY, Z, VZ = range(8)
MEASURED = [YAW, X, Y, Z]
RATES = [YAW_RATE, VX, VY, VZ]
POSITION = [X, Y, Z]
VELOCITY = [VX, VY, VZ]

MAX_GAP_S = 1.0
MAX_PREDICTION_S = 1.0
"""Beyond it the target is taken to stay where it was predicted."""

H: Array = np.zeros((4, 8))
H[range(4), MEASURED] = 1.0  # equation 2

_CM = 0.01
_DEG = math.radians(1.0)
_LEAST_NOISE = np.array([1e-4, 1e-4, 1e-4, 1e-4]) ** 2  # 0.1 mm, 0.006 deg: lens and print
_UNITS = np.array([_DEG, _DEG, _CM, _CM, _CM, _CM, _CM, _CM])  # of the paper, per state


@dataclass(frozen=True, eq=False)
class FilterSetup:
    """R (4, 4) and Q (8, 8) are ``k1 I`` and ``k2 I`` of the paper (cm^2, deg^2) in SI;
    P0 (8, 8) is the covariance after the first measurement."""

    R: Array
    Q: Array
    P0: Array
    alpha: float
    n_max: int
    attitude_sigma_rad: float | None = None  # None: R for every measurement
    drift_mps: float = math.inf  # most that the target moves while nothing is measured


def make_filter(config: KalmanConfig, in_world: bool = False) -> FilterSetup:
    """The filter's constants. At first sight, a target in the world stands nearly still
    (5 cm/s of drift); one in the level frame moves as the vehicle does (30 cm/s)."""
    first_rate = 5.0 if in_world else 30.0  # cm/s and deg/s
    first = np.full(8, config.k1)
    first[RATES] = first_rate**2
    squares = _UNITS**2
    return FilterSetup(
        R=np.diag(config.k1 * squares[MEASURED]),
        Q=np.diag(config.k2 * squares),
        P0=np.diag(first * squares),
        alpha=config.alpha,
        n_max=config.n_max,
        attitude_sigma_rad=(
            math.radians(config.attitude_sigma_deg) if config.noise == "measured" else None
        ),
        drift_mps=config.drift_mps if in_world else math.inf,
    )


def measured_noise(cov: Array, arm_m: Array, setup: FilterSetup) -> Array | None:
    """R (4, 4) of a measured (yaw, x, y, z) from the pose's covariance of (x, y, z, yaw)
    and the way from camera to target (3,), all in the same axes; None where R is fixed.

    An error of roll and pitch turns the way about level axes: heights change with the
    horizontal way, places with the height. The heading is the vehicle's own matter.
    """
    if setup.attitude_sigma_rad is None or not np.isfinite(cov).all():
        return None
    x, y, z = arm_m
    turned = np.array([[0.0, z], [-z, 0.0], [y, -x]]) * setup.attitude_sigma_rad
    R = np.empty((4, 4))
    order = [3, 0, 1, 2]
    R[:] = cov[np.ix_(order, order)]
    R[1:, 1:] += turned @ turned.T
    R[range(4), range(4)] += _LEAST_NOISE
    return R


def transition(dt_s: float) -> Array:
    """F of equation 1, (8, 8)."""
    F = np.eye(8)
    F[MEASURED, RATES] = dt_s
    return F


def start_track(z: Array, t_s: float, setup: FilterSetup, R: Array | None = None) -> MarkerTrack:
    """A track at its first measurement z = (yaw, x, y, z), SI."""
    x = np.zeros(8)
    x[MEASURED] = z
    x[YAW] = wrap_rad(float(z[0]))
    P = setup.P0.copy()
    if R is not None:
        P[np.ix_(MEASURED, MEASURED)] = R
    return MarkerTrack(t_s=t_s, x=x, P=P, unseen=0)


def step_track(
    track: MarkerTrack | None,
    z: Array | None,
    t_s: float,
    setup: FilterSetup,
    R: Array | None = None,
) -> MarkerTrack | None:
    """One frame's predict and, where the marker was seen, update.

    Args:
        track: the track so far, None before the first sight.
        z: measured (yaw, x, y, z) in SI, (4,), or None where nothing was seen. A
            measurement that is not finite counts as nothing seen.
        t_s: the frame's time.
        R: the measurement's covariance (4, 4); the setup's if None.

    Returns None when there is nothing (left) to track: never seen, or unseen for more
    than `n_max` frames (equation 3's k_n <= n_max). A frame that is not newer than the
    track changes nothing. A gap beyond `MAX_GAP_S` in either direction starts afresh.
    """
    if z is not None and not np.isfinite(z).all():
        z = None
    if not math.isfinite(t_s):
        return track
    if track is None:
        return None if z is None else start_track(z, t_s, setup, R)
    dt_s = t_s - track.t_s
    if abs(dt_s) > MAX_GAP_S or not np.isfinite(track.x).all():
        return None if z is None else start_track(z, t_s, setup, R)
    if dt_s <= 0.0:
        return track
    if z is None:
        return _coast(track, dt_s, t_s, setup)
    x, P = predict(track.x, track.P, F=transition(dt_s), Q=setup.Q)
    on_branch = np.array(z, dtype=np.float64)  # the yaw nearest to the prediction
    on_branch[0] = x[YAW] + wrap_rad(float(z[0]) - float(x[YAW]))
    x, P = update(x, P, on_branch, setup.R if R is None else R, H)
    x[YAW] = wrap_rad(float(x[YAW]))
    return MarkerTrack(t_s=t_s, x=x, P=P, unseen=0)


def predicted(track: MarkerTrack, t_s: float, setup: FilterSetup) -> MarkerTrack:
    """The track at a time after its frame, with no measurement in between."""
    dt_s = min(t_s - track.t_s, MAX_PREDICTION_S)
    if dt_s <= 0.0:
        return track
    x, P = _moved(track.x, track.P, dt_s, setup)
    return MarkerTrack(t_s=t_s, x=x, P=P, unseen=track.unseen)


def _coast(track: MarkerTrack, dt_s: float, t_s: float, setup: FilterSetup) -> MarkerTrack | None:
    if track.unseen >= setup.n_max:
        return None
    x = track.x.copy()
    x[RATES] *= setup.alpha  # equation 3
    x, P = _moved(x, track.P, dt_s, setup)
    return MarkerTrack(t_s=t_s, x=x, P=P, unseen=track.unseen + 1)


def _moved(x: Array, P: Array, dt_s: float, setup: FilterSetup) -> tuple[Array, Array]:
    """State and covariance after `dt_s` without a measurement."""
    speed_mps = float(np.linalg.norm(x[VELOCITY]))
    if speed_mps > setup.drift_mps:
        x = x.copy()
        x[VELOCITY] *= setup.drift_mps / speed_mps
    x, P = predict(x, P, F=transition(dt_s), Q=setup.Q)
    x[YAW] = wrap_rad(float(x[YAW]))
    return x, P
