"""The paper's Kalman filter (section II-A.1), a constant-velocity model with eight states.

The state order is the paper's: yaw, yaw rate, then position and velocity of x, y, z. The time step
is the actual time between frames: with 15 % of the frames late, the error was 0.63 cm RMS with a
fixed step and 0.19 cm with the actual one.

The biases (the vehicle's roll and pitch, the print's size and curl) are consider states: they
increase the reported covariance but do not change the gain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from perchctl.geometry import Array, is_finite, wrap_rad
from perchctl.profile import KalmanConfig
from perchctl.values import cached_property
from perchctl.vision.types import MarkerFilterState

(
    YAW_STATE_INDEX,
    YAW_RATE_STATE_INDEX,
    X_STATE_INDEX,
    VX_STATE_INDEX,
    Y_STATE_INDEX,
    VY_STATE_INDEX,
    Z_STATE_INDEX,
    VZ_STATE_INDEX,
) = 0, 1, 2, 3, 4, 5, 6, 7
"""Indices of the elements of the state."""
MEASURED_STATE_ELEMENTS, RATE_STATE_ELEMENTS = (
    slice(YAW_STATE_INDEX, None, 2),
    slice(YAW_RATE_STATE_INDEX, None, 2),
)
POSITION_STATE_ELEMENTS, VELOCITY_STATE_ELEMENTS = (
    slice(X_STATE_INDEX, None, 2),
    slice(VX_STATE_INDEX, None, 2),
)
# columns of the biases: the vehicle's roll and pitch, and the print's size and curl
ROLL_PITCH_BIAS_COLUMNS, PRINT_SIZE_CURL_BIAS_COLUMNS = slice(0, 2), slice(2, 4)

MAX_FRAME_GAP_TO_CONTINUE_TRACK_S = 1.0
"""Longest gap between two frames of a track, s; a longer gap ends the track."""
MAX_TRACK_PREDICTION_DURATION_S = 1.0
"""Longest prediction, s; after that, the target is assumed to stay where it was predicted to be at
this limit."""

_IDENTITY_3: Array = np.eye(3)
_IDENTITY_8: Array = np.eye(8)
_RATE_INTEGRATION_MATRIX: Array = np.eye(8, k=1)
_RATE_INTEGRATION_MATRIX[RATE_STATE_ELEMENTS] = 0.0

_M_PER_CM = 0.01
_RAD_PER_DEG = math.radians(1.0)
_CM_DEG_STATE_TO_SI = np.array(
    [_RAD_PER_DEG, _RAD_PER_DEG, _M_PER_CM, _M_PER_CM, _M_PER_CM, _M_PER_CM, _M_PER_CM, _M_PER_CM]
)  # SI value of the paper's unit for each element of the state

_ACCELERATION_CORRELATION_TIME_S = 0.1
"""Correlation time of an acceleration, s: the spectral density of the white noise, (m/s^2)^2 s, is
the variance of the acceleration times this time."""
_WORLD_FRAME_YAW_XYZ_DRIFT_COV_PER_S = np.diag([math.radians(0.1), 0.005, 0.005, 0.005]) ** 2
"""Variances (rad^2, m^2) of the random walk of the state estimate's yaw, x, y and z within one
second."""
_WORLD_FRAME_TARGET_HEADING_ACCELERATION_SIGMA_RADPS2 = 0.1
_MAX_NIS_TO_UPDATE_TRACK_WITHOUT_RESTART = 25.0
"""Limit of the normalized innovation squared (NIS) with four degrees of freedom; by chance, 5 in
100 000 updates exceed it. Larger: after a lost frame, the track of a camera without a vehicle
learns a wrong velocity. Smaller: noise restarts the track."""


@dataclass(frozen=True)
class ProcessNoise:
    """Process noise of the tracks, given as standard deviations of white-noise accelerations.

    Attributes:
        target_acceleration_sigma_mps2: acceleration of the target along each axis.
        target_heading_acceleration_sigma_radps2: angular acceleration of the target's heading.
        level_frame_angular_acceleration_sigma_radps2: angular acceleration of the level frame about
            its origin, the gear; it moves the target in proportion to the target's distance.
        is_world_frame_drifting: True if the tracks are in the world frame of the state estimate,
            which drifts relative to the room.
    """

    target_acceleration_sigma_mps2: float
    target_heading_acceleration_sigma_radps2: float
    level_frame_angular_acceleration_sigma_radps2: float = 0.0
    is_world_frame_drifting: bool = False

    @cached_property
    def yaw_xyz_rate_noise_cov_per_s(self) -> Array:
        """Covariance (4, 4) that white-noise acceleration of the target adds per second to the
        rates of (yaw, x, y, z): rad^2/s^2 for the yaw rate and m^2/s^2 for the velocities, each per
        second. It is the variance of the accelerations times their correlation time."""
        push = np.array(
            [
                self.target_heading_acceleration_sigma_radps2,
                *3 * [self.target_acceleration_sigma_mps2],
            ]
        )
        return np.diag(push * push) * _ACCELERATION_CORRELATION_TIME_S


@dataclass(frozen=True, eq=False)
class FilterSetup:
    """Parameters of a track's Kalman filter.

    Attributes:
        R, Q: covariance of the measurement noise (4, 4), in the order yaw, x, y, z, and of the
            process noise per step (8, 8), in the order of `MarkerFilterState.x`: ``k1 I`` and ``k2
            I`` of the paper (cm^2, deg^2), converted to SI.
        P0: covariance (8, 8) of `MarkerFilterState.x` after the first measurement.
        velocity_factor_per_unseen_frame: factor by which the velocity and the yaw rate are
            multiplied in each frame without a measurement, ``kalman.alpha`` of the profile
            (equation 3).
        max_unseen_frames_to_keep_track: frames without a measurement after which a track ends,
            ``kalman.n_max`` of the profile.
        acceleration_process_noise: process noise that replaces Q; the covariance of each pose then
            replaces R. If None, Q and R are used.
        roll_pitch_bias_sigma_rad: standard deviation of the bias of the vehicle's roll and pitch.
        max_predicted_target_speed_mps: upper limit of the target's speed, in the track's frame, in
            predictions without a measurement. In the world frame, where the target only moves
            because the state estimate drifts, it is the largest drift speed; in the level frame,
            it is infinite.
        max_nis_without_track_restart: largest normalized innovation squared (NIS) of a measurement
            that updates the track; with a larger one, the track restarts.

    With the innovation v = z - H x of a measurement z and its covariance S = H P H^T + R, NIS is
    v^T S^-1 v. The motion model cannot explain a larger NIS, for example after lost frames, and an
    update would turn the jump into a wrong velocity. The track therefore restarts at z with the
    covariance R + v v^T, which still covers the old position until another measurement decides.
    """

    R: Array
    Q: Array
    P0: Array
    velocity_factor_per_unseen_frame: float
    max_unseen_frames_to_keep_track: int
    acceleration_process_noise: ProcessNoise | None = None
    roll_pitch_bias_sigma_rad: float = 0.0
    max_predicted_target_speed_mps: float = math.inf
    max_nis_without_track_restart: float = math.inf


@dataclass(frozen=True, eq=False)
class TrackMeasurement:
    """A measurement of a target, `z` = (yaw, x, y, z), (4,), rad and m, in the track's frame (level
    or world), and its covariance `R` (4, 4). If `R` is None, the R of the filter setup is used.

    `yaw_xyz_shift_per_bias_sigma` (4, 4) has one row per element of z and one column per bias: the
    vehicle's roll and pitch, the print's size and curl. A column is the change of z for one
    standard deviation of that bias. If it is None, there are no biases.
    """

    z: Array
    R: Array | None = None
    yaw_xyz_shift_per_bias_sigma: Array | None = None


@cache
def _import_filterpy_predict() -> Callable[..., tuple[Array, Array]]:
    """Return filterpy's `predict` function, which is imported at the first call. The import loads
    much of scipy, which takes a second on a small computer and would delay the start of every
    command if it were at the top of the module."""
    from filterpy.kalman import predict

    loaded: Callable[..., tuple[Array, Array]] = predict
    return loaded


def make_filter_setup(config: KalmanConfig, is_world_frame: bool = False) -> FilterSetup:
    """Return the filter's parameters from the profile's `kalman` section, for tracks in the world
    frame (if `is_world_frame`) or in the level frame.

    With ``kalman.noise: measured``, the noise comes from accelerations and from the covariance of
    each pose; otherwise it is `k1` and `k2` of the paper. The initial standard deviation of the
    rates is 5 cm/s and 5 deg/s in the world frame. In the level frame, it is 30 cm/s and 30 deg/s,
    or 100 cm/s and 100 deg/s if ``kalman.noise`` is ``measured``.
    """
    _import_filterpy_predict()  # import it now so that no frame has to wait for the import
    measured = config.noise == "measured"
    level_rate = 100.0 if measured else 30.0
    first = np.full(8, config.k1)
    first[RATE_STATE_ELEMENTS] = (5.0 if is_world_frame else level_rate) ** 2  # cm/s and deg/s
    squares = _CM_DEG_STATE_TO_SI**2
    acceleration_process_noise = None
    if measured:
        acceleration_process_noise = (
            ProcessNoise(
                config.drift_mps2,
                _WORLD_FRAME_TARGET_HEADING_ACCELERATION_SIGMA_RADPS2,
                is_world_frame_drifting=True,
            )
            if is_world_frame
            else ProcessNoise(config.acceleration_mps2, config.turn_radps2, config.turn_radps2)
        )
    return FilterSetup(
        R=np.diag(config.k1 * squares[MEASURED_STATE_ELEMENTS]),
        Q=np.diag(config.k2 * squares),
        P0=np.diag(first * squares),
        velocity_factor_per_unseen_frame=config.alpha,
        max_unseen_frames_to_keep_track=config.n_max,
        acceleration_process_noise=acceleration_process_noise,
        roll_pitch_bias_sigma_rad=math.radians(config.attitude_sigma_deg) if measured else 0.0,
        max_predicted_target_speed_mps=config.drift_mps if is_world_frame else math.inf,
        # In flight, the gate in `perchctl.vision.tracks` detects jumps of the state estimate.
        max_nis_without_track_restart=_MAX_NIS_TO_UPDATE_TRACK_WITHOUT_RESTART
        if measured and not is_world_frame
        else math.inf,
    )


def vector_jacobian_wrt_tilt(vector_m: Array) -> Array:
    """Return the derivative (3, 2), m/rad, of `vector_m` (3,), a vector in level axes, with respect
    to small rotations about the level x and y axes."""
    x, y, z = vector_m
    return np.array([[0.0, z], [-z, 0.0], [y, -x]])


def transition_matrix(dt_s: float) -> Array:
    """Return the state transition matrix F (8, 8) of `MarkerFilterState.x` for a time step `dt_s`
    (paper, equation 1): yaw, x, y and z each change by their rate times `dt_s`, and the rates stay
    constant."""
    return _IDENTITY_8 + dt_s * _RATE_INTEGRATION_MATRIX


def process_noise_covariance(dt_s: float, target_position_m: Array, setup: FilterSetup) -> Array:
    """Return the process noise Q (8, 8) of `MarkerFilterState.x` over `dt_s` for a target at
    `target_position_m` (3,) in the track's frame: relative to the gear in level axes, or in the
    world.

    The noise is that of white-noise accelerations, plus the drift of the vehicle's state estimate
    if the track is in the world frame. In the level frame, it grows with the target's distance
    because rotations of the frame move a distant target further than a close one. Without
    `setup.acceleration_process_noise`, the result is `setup.Q`, which does not depend on `dt_s`.
    """
    noise = setup.acceleration_process_noise
    if noise is None:
        return setup.Q
    pushed = _yaw_xyz_rate_noise_cov_per_s(noise, target_position_m) * dt_s
    # In the state, each value is followed by its rate.
    pair = np.array([[dt_s * dt_s / 3.0, dt_s / 2.0], [dt_s / 2.0, 1.0]])
    Q: Array = (pushed[:, None, :, None] * pair[:, None, :]).reshape(8, 8)
    if noise.is_world_frame_drifting:
        Q[MEASURED_STATE_ELEMENTS, MEASURED_STATE_ELEMENTS] += (
            _WORLD_FRAME_YAW_XYZ_DRIFT_COV_PER_S * dt_s
        )
    return Q


def _yaw_xyz_rate_noise_cov_per_s(noise: ProcessNoise, target_position_m: Array) -> Array:
    """Return the covariance (4, 4) that process noise adds per second to the rates of (yaw, x, y,
    z): rad^2/s^2 for the yaw rate and m^2/s^2 for the velocities, each per second. The axes x, y
    and z are those of the track's frame, the level frame or the world frame.

    In a level frame with an angular acceleration, the result depends on `target_position_m` (3,),
    m, the vector r from the gear, the frame's origin, to the target in level axes: an angular
    acceleration a of the frame accelerates the target by the cross product of a and r. With the
    same spectral density w, rad^2/s^3, of a about each axis, this adds w (|r|^2 I - r r^T) to the
    covariance of the velocities. In the world frame, which does not turn with the vehicle, the
    target's position has no effect.
    """
    if noise.level_frame_angular_acceleration_sigma_radps2 == 0.0:
        return noise.yaw_xyz_rate_noise_cov_per_s
    turned2 = (
        noise.level_frame_angular_acceleration_sigma_radps2**2 * _ACCELERATION_CORRELATION_TIME_S
    )
    x, y, z = target_position_m.tolist()
    density = noise.yaw_xyz_rate_noise_cov_per_s.copy()
    density[1:, 1:] += turned2 * (
        (x * x + y * y + z * z) * _IDENTITY_3 - np.outer(target_position_m, target_position_m)
    )
    return density


def start_track(measurement: TrackMeasurement, t_s: float, setup: FilterSetup) -> MarkerFilterState:
    """Return a new track at `t_s` with the measured yaw and position as its state and zero rates.
    Its covariance is `setup.P0`, with the measurement's own covariance, if it has one, for yaw and
    position."""
    x = np.zeros(8)
    x[MEASURED_STATE_ELEMENTS] = measurement.z
    x[YAW_STATE_INDEX] = wrap_rad(float(measurement.z[0]))
    P = setup.P0.copy()
    if measurement.R is not None:
        P[MEASURED_STATE_ELEMENTS, MEASURED_STATE_ELEMENTS] = measurement.R
    shift_per_bias_sigma = np.zeros((8, 4))
    if measurement.yaw_xyz_shift_per_bias_sigma is not None:
        shift_per_bias_sigma[MEASURED_STATE_ELEMENTS] = measurement.yaw_xyz_shift_per_bias_sigma
    return MarkerFilterState(
        t_s=t_s, x=x, P=P, unseen_frames=0, state_shift_per_bias_sigma=shift_per_bias_sigma
    )


def step_track(
    track: MarkerFilterState | None,
    measurement: TrackMeasurement | None,
    t_s: float,
    setup: FilterSetup,
) -> MarkerFilterState | None:
    """Predict the track to a frame's time and, if the marker was measured, update it.

    Args:
        track: the track so far; None before the first measurement.
        measurement: the frame's measurement; None or not finite if the marker was not measured.
        t_s: the frame's time.

    The track ends after more than `setup.max_unseen_frames_to_keep_track` successive frames without
    a measurement (k_n <= n_max in equation 3), or if `t_s` differs from the track's time by more
    than `MAX_FRAME_GAP_TO_CONTINUE_TRACK_S` (1 s), earlier or later. A measurement starts a new
    track if there is none or if the gap has ended the old one, and restarts a track whose motion
    model does not explain the measurement (`setup.max_nis_without_track_restart`). Otherwise, a
    frame that is not newer than the track changes nothing. Returns None if there is no track.
    """
    if measurement is not None and not is_finite(measurement.z):
        measurement = None
    if not math.isfinite(t_s):
        return track
    if track is None:
        return None if measurement is None else start_track(measurement, t_s, setup)
    dt_s = t_s - track.t_s
    if abs(dt_s) > MAX_FRAME_GAP_TO_CONTINUE_TRACK_S or not is_finite(track.x):
        return None if measurement is None else start_track(measurement, t_s, setup)
    if dt_s <= 0.0:
        return track
    if measurement is None:
        if track.unseen_frames >= setup.max_unseen_frames_to_keep_track:
            return None
        x = track.x.copy()
        x[RATE_STATE_ELEMENTS] *= setup.velocity_factor_per_unseen_frame  # equation 3
        return _predict_from_state(track, x, dt_s, t_s, track.unseen_frames + 1, setup)
    F, Q = (
        transition_matrix(dt_s),
        process_noise_covariance(dt_s, track.x[POSITION_STATE_ELEMENTS], setup),
    )
    x, P = _import_filterpy_predict()(track.x, track.P, F=F, Q=Q)
    R = setup.R if measurement.R is None else measurement.R
    if setup.max_nis_without_track_restart < math.inf:
        off, S = (
            _innovation(x, measurement.z),
            P[MEASURED_STATE_ELEMENTS, MEASURED_STATE_ELEMENTS] + R,
        )
        regular, solved = cv2.solve(S, off[:, None], flags=cv2.DECOMP_CHOLESKY)
        if regular and off.dot(solved)[0] > setup.max_nis_without_track_restart:
            begun = start_track(measurement, t_s, setup)
            begun.P[MEASURED_STATE_ELEMENTS, MEASURED_STATE_ELEMENTS] += np.outer(off, off)
            return begun
    x, P, gain = _kalman_update(x, P, measurement.z, R)
    shift_per_bias_sigma = F.dot(track.state_shift_per_bias_sigma)
    if measurement.yaw_xyz_shift_per_bias_sigma is not None:
        shift_per_bias_sigma += gain.dot(
            measurement.yaw_xyz_shift_per_bias_sigma - shift_per_bias_sigma[MEASURED_STATE_ELEMENTS]
        )
    return MarkerFilterState(
        t_s=t_s, x=x, P=P, unseen_frames=0, state_shift_per_bias_sigma=shift_per_bias_sigma
    )


def _innovation(x: Array, z: Array) -> Array:
    """Return the innovation (4,) of (yaw, x, y, z), rad and m: the measurement `z` (4,) minus the
    prediction in the state `x` (8,), with the yaw difference wrapped."""
    off = z - x[MEASURED_STATE_ELEMENTS]
    off[0] = wrap_rad(float(off[0]))
    return off


def _kalman_update(x: Array, P: Array, z: Array, R: Array) -> tuple[Array, Array, Array]:
    """Return the updated state, its covariance in Joseph form, and the Kalman gain (8, 4), given
    the predicted state `x` (8,) with covariance `P` (8, 8) and the measurement `z` = (yaw, x, y,
    z), (4,), with covariance `R` (4, 4). If the innovation's covariance is not positive definite,
    the measurement is ignored and the gain is 0."""
    off = _innovation(x, z)
    regular, solved = cv2.solve(
        P[MEASURED_STATE_ELEMENTS, MEASURED_STATE_ELEMENTS] + R,
        P[MEASURED_STATE_ELEMENTS],
        flags=cv2.DECOMP_CHOLESKY,
    )
    if not regular:  # S is not positive definite, so the measurement is ignored
        return x, P, np.zeros((8, 4))
    gain = np.asarray(solved.T, dtype=np.float64)
    x = x + gain.dot(off)
    x[YAW_STATE_INDEX] = wrap_rad(float(x[YAW_STATE_INDEX]))
    left = _IDENTITY_8.copy()
    left[:, MEASURED_STATE_ELEMENTS] -= gain
    return x, left.dot(P).dot(left.T) + gain.dot(R).dot(gain.T), gain


def predict_track(track: MarkerFilterState, t_s: float, setup: FilterSetup) -> MarkerFilterState:
    """Return the track predicted to time `t_s`, without a measurement; unchanged if `t_s` is not
    after the track's time. More than `MAX_TRACK_PREDICTION_DURATION_S` after the track's time, the
    target stays where it was predicted to be at that limit."""
    dt_s = min(t_s - track.t_s, MAX_TRACK_PREDICTION_DURATION_S)
    if dt_s <= 0.0:
        return track
    return _predict_from_state(track, track.x, dt_s, t_s, track.unseen_frames, setup)


def _limit_target_speed(x: Array, setup: FilterSetup) -> Array:
    """Return the state `x` (8,), whose velocity (x, y, z) is scaled down if the speed exceeds
    `setup.max_predicted_target_speed_mps`. Positions, yaw and yaw rate stay unchanged."""
    speed_mps = math.hypot(*x[VELOCITY_STATE_ELEMENTS].tolist())
    if speed_mps <= setup.max_predicted_target_speed_mps:
        return x
    x = x.copy()
    x[VELOCITY_STATE_ELEMENTS] *= setup.max_predicted_target_speed_mps / speed_mps
    return x


def _predict_from_state(
    track: MarkerFilterState,
    x: Array,
    dt_s: float,
    t_s: float,
    unseen_frames: int,
    setup: FilterSetup,
) -> MarkerFilterState:
    """Return the track at `t_s` without a measurement: its covariance is predicted over `dt_s`, and
    its state is predicted over `dt_s` from `x` (8,) instead of the track's own state. If the speed
    in `x` exceeds `setup.max_predicted_target_speed_mps`, it is limited first. The caller has
    reduced the rates in `x` if the target was not seen. `unseen_frames` becomes the new track's
    number of frames since the last measurement."""
    x = _limit_target_speed(x, setup)
    F = transition_matrix(dt_s)
    x, P = _import_filterpy_predict()(
        x, track.P, F=F, Q=process_noise_covariance(dt_s, x[POSITION_STATE_ELEMENTS], setup)
    )
    x[YAW_STATE_INDEX] = wrap_rad(float(x[YAW_STATE_INDEX]))
    return MarkerFilterState(
        t_s=t_s,
        x=x,
        P=P,
        unseen_frames=unseen_frames,
        state_shift_per_bias_sigma=F @ track.state_shift_per_bias_sigma,
    )
