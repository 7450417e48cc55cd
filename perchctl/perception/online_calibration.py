"""Estimate the camera's latency and mounting image by image during the flight.

With `camera.latency_s: measured`, the estimated latency is also applied: once it is certain, it is
subtracted from the images' times, slowly and within bounds. The estimation itself uses the
uncorrected times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from perchctl.geometry import Array, is_finite, wrap_rad
from perchctl.perception.history import History, attitude_at, velocity_at
from perchctl.profile import USED_LATENCY_S
from perchctl.values import replace
from perchctl.vision import CameraCalibrationErrors, MarkerPose, PoseSetup, VehicleState

SOLVE_EVERY_S = 1.0
"""Time between solutions of the sums, s."""
LIKELY_S = 0.02
"""Once the standard deviation of the delay is below this value, s, the measurement rows of the next
images are computed with the estimated delay."""
USED_SIGMA_S = 0.008
"""Largest standard deviation of a delay that is applied, s: an error of 30 ms makes an alignment
oscillate."""
SLEW = 0.02
"""Rate at which the applied latency changes, s/s. If the vehicle flies at 0.4 m/s, the target then
appears to drift at 8 mm/s."""
FAST_SLEW = 0.5
"""Rate at which the applied latency changes, s/s, while images and accelerometer agree on a very
different latency. This rate is below 1 because the images' times would otherwise run backwards.
Smaller: a vehicle with late positions oscillates for longer."""
CHANGED_S = 0.05
"""If a correction differs by more than this value, s, from an estimate that was already certain,
the latency has changed in flight."""
UNKNOWN_SIGMA_S = (USED_LATENCY_S[1] - USED_LATENCY_S[0]) / math.sqrt(12.0)
"""Standard deviation of a latency that may be anywhere within `USED_LATENCY_S`, s."""
LONGEST_STEP_S = 0.1
"""Longest time step of the slew-rate limit, s."""


@dataclass(frozen=True, eq=False)
class OnlineCalibration:
    """Estimate of the camera's latency and mounting from images and telemetry.

    `newest` is the solution of `sums` at `solved_s`. All latencies are relative to the profile's
    latency. `applied_delay_s` is the latency that is subtracted from the images' times since the
    image at `last_picture_s`. `coarse_delay_s` is the goal of a correction in progress; None once
    it is reached. If a latency that was already certain has changed, `changed_s` contains its old
    and new values, s, at the newest change.
    """

    sums: ConsistencySums = field(default_factory=lambda: ConsistencySums())
    newest: CameraCalibrationErrors | None = None
    solved_s: float = -math.inf
    applied_delay_s: float = 0.0
    coarse_delay_s: float | None = None
    changed_s: tuple[float, float] | None = None
    last_picture_s: float = -math.inf

    @property
    def delay_sigma_s(self) -> float:
        """Standard deviation of a measured latency, s: the one in `newest`, but at most the
        standard deviation of an unknown latency."""
        if self.newest is None:
            return UNKNOWN_SIGMA_S
        return min(UNKNOWN_SIGMA_S, self.newest.latency_sigma_s)


def update_calibration(
    old: OnlineCalibration,
    t_s: float,
    pose: MarkerPose,
    history: History,
    setup: PoseSetup,
    attitude_sigma_rad: float,
) -> OnlineCalibration:
    """Return the estimate after adding one image to its sums and, once a second, solving them.

    `t_s` is the image's arrival time minus the profile's latency. A pose is ignored if it is not
    finite or too close, or if the attitude at its time is unknown.
    """
    new, likely = old, old.newest is not None and old.newest.latency_sigma_s < LIKELY_S
    delay_s = old.newest.latency_above_profile_s if old.newest is not None and likely else 0.0
    delay_s = max(-USED_LATENCY_S[1], min(USED_LATENCY_S[1], delay_s))
    before = attitude_at(history, t_s - delay_s - ATTITUDE_STEP_S)
    after = attitude_at(history, t_s - delay_s + ATTITUDE_STEP_S)
    is_measured = (
        pose.level_frame_xyz_yaw_cov is not None
        and is_finite(pose.level_frame_xyz_yaw_cov)
        and pose.tvec_m[2] >= LEAST_RANGE_M
    )
    if is_measured and before is not None and after is not None:
        velocity_mps = velocity_at(history, t_s - delay_s)
        moment = consistency_rows(pose, before, after, velocity_mps, delay_s, setup)
        new = replace(old, sums=add_rows(old.sums, t_s, *moment))
        if t_s - old.solved_s >= SOLVE_EVERY_S:
            newest = solve_consistency(new.sums, attitude_sigma_rad)
            new = replace(new, newest=newest, solved_s=t_s)
    return new


def apply_latency(
    old: OnlineCalibration, t_s: float, start_latency_s: float, correction_s: float | None
) -> OnlineCalibration:
    """Return the calibration with the latency that is to be subtracted from the next image's time
    if the profile has `camera.latency_s: measured`. `t_s` is as in `update_calibration`.

    If the accelerometer shows that the latency is far from the one in use,
    `VisualInertialWindow.correction_s` is set, and is applied within half a second. The sums would
    take several seconds to converge, and a vehicle whose only position source is the target would
    oscillate meanwhile. Once the solution of the sums is certain, it is more accurate, and the
    latency approaches it slowly. Sums that contradict the correction belong to an earlier latency,
    and are restarted.
    """
    new, coarse_s, found = old, old.coarse_delay_s, old.newest
    sure_s = (
        found.latency_above_profile_s
        if found is not None and found.latency_sigma_s <= USED_SIGMA_S
        else None
    )
    if correction_s is not None:
        coarse_s = correction_s
        if sure_s is not None and abs(sure_s - correction_s) > CHANGED_S:
            changed_s = (sure_s, correction_s)
            new = replace(new, sums=ConsistencySums(), newest=None, changed_s=changed_s)
    delay_s, slew = (sure_s, SLEW) if coarse_s is None else (coarse_s, FAST_SLEW)
    used_s = old.applied_delay_s
    if delay_s is not None:
        least_s, most_s = USED_LATENCY_S
        goal_s = max(least_s, min(most_s, start_latency_s + delay_s)) - start_latency_s
        step_s = slew * max(0.0, min(t_s - old.last_picture_s, LONGEST_STEP_S))
        used_s += max(-step_s, min(step_s, goal_s - used_s))
        coarse_s = None if used_s == goal_s else coarse_s
    return replace(new, last_picture_s=t_s, applied_delay_s=used_s, coarse_delay_s=coarse_s)


# --- Estimation of latency and mounting from a flight ---
# If the camera's latency exceeds the profile's by d, the target appears displaced by d times the
# speed at which the vehicle's translation and rotation sweep the line of sight. If the camera's
# mounting is rotated, the target appears displaced by the rotation times the vector to the target.
# The target's position in the estimate's world is therefore linear in the delay and the rotation,
# and one least-squares fit over a flight yields both.
#
# The remaining variation of the position is not white noise: the vehicle's estimate is a random
# walk with drift. A Kalman filter for a random-walk level therefore filters each row (`X`, `Y`,
# `HEADING`) together with its factors, and the sums contain the innovations (de Jong 1991, "The
# diffuse Kalman filter").


X, Y, HEADING = range(3)
"""Rows of a frame's measurement: x, y and heading of the target."""
PLACE, DELAY, TILT_X, TILT_Y, TURN, SCALE, DRIFT_X, DRIFT_Y = range(8)
"""Columns of a frame's measurement: the target's position (rad in the row `HEADING`), and the
possible causes of its apparent motion."""
_PRIOR = np.array([0.1, 0.1, 0.1, 1.0, 0.5, 0.02, 0.02])
"""Prior standard deviations of all columns but the first."""

ATTITUDE_STEP_S = 0.02
"""Half the time difference over which speeds are computed, s."""
NOISE_MPS, NOISE_RADPS = 0.01, math.radians(1.0)
"""Noise of the vehicle's speed and rotation rates; a motion that is not well above this noise
counts as rest."""
PICTURE_JITTER_S = 0.008
"""Jitter of each image's time, s."""
LEAST_SIGMA_M, LEAST_SIGMA_RAD = 5e-4, 1e-3
"""Lower bounds for the noise of the rows, as standard deviations."""
WALK_M, WALK_RAD = 5e-3, math.radians(0.1)
"""Random walk of the estimated position and attitude within one second, as standard deviations."""
MOST_GAP_S = 0.5
"""Longest gap between frames, s; after a longer one, the level restarts."""
GATE_SIGMAS = 5.0
"""Number of standard deviations beyond which a change of the target's position counts as a jump."""
_POSSIBLE = np.array([0.0, 0.2, 0.4, 0.4, 0.4, 0.0, 0.0, 0.0])
"""Largest delay (0.2 s) and mounting rotations (0.4 rad) that may explain a change of the target's
position that exceeds the noise; a larger change counts as a jump."""
LEAST_RANGE_M = 0.15
"""Minimum range of the target, m; at closer range, the line of sight hardly moves and the press
follows soon."""
STAMPS_S = 0.003
"""Errors in the time stamps of telemetry and exposures that averaging does not reduce, s."""
LARGE_TURN = 0.03
"""Relative error of the estimate if the rotation is large, because the speeds assume the profile's
mounting."""
LEAST_FRAMES = 30
"""Minimum number of frames for a solution."""


@dataclass(frozen=True, eq=False)
class ConsistencySums:
    """Sums over the frames of a flight, for `solve_consistency`.

    `level` (3, 8) contains the filtered rows, and `variance` (3,) their variance after the newest
    frame; `level` is None before the first frame. `information` (8, 8) is the information matrix of
    the innovations, and `row_count` the number of rows in it.
    """

    t_s: float = -math.inf
    began_s: float = 0.0
    level: Array | None = None
    variance: Array = field(default_factory=lambda: np.zeros(3))
    information: Array = field(default_factory=lambda: np.zeros((8, 8)))
    row_count: int = 0


def consistency_rows(
    pose: MarkerPose,
    before: VehicleState,
    after: VehicleState,
    velocity_mps: tuple[float, float, float],
    delay_s: float,
    setup: PoseSetup,
) -> tuple[Array, Array, float]:
    """Return three values for a frame: its rows (3, 8) for x, y and heading, with the columns
    `PLACE` to `DRIFT_Y`; the variance (3,) of each row's noise; and the target's distance from the
    camera along the body's z axis, m.

    `before` and `after` are the vehicle's attitudes `ATTITUDE_STEP_S` before and after the frame's
    time minus `delay_s`, the probable delay. `velocity_mps` is the vehicle's velocity at that time,
    in world axes.
    """
    assert pose.level_frame_xyz_yaw_cov is not None
    T_body_cam = setup.T_body_cam
    R_body_cam = T_body_cam[:3, :3]
    x, y, z = (R_body_cam @ pose.tvec_m).tolist()  # vector from the camera, body axes
    place = (R_body_cam @ pose.tvec_m + T_body_cam[:3, 3]).tolist()
    axis = (R_body_cam @ np.asarray(cv2.Rodrigues(pose.rvec_rad)[0])[:, 0]).tolist()
    R0, R1 = _upper_rows(before), _upper_rows(after)
    heading0, heading1 = (math.atan2(_dot(R[1], axis), _dot(R[0], axis)) for R in (R0, R1))
    turned = wrap_rad(heading1 - heading0)
    rows, noise = [], []
    speeds = [
        (_dot(q, place) - _dot(p, place)) / (2.0 * ATTITUDE_STEP_S) + v
        for p, q, v in zip(R0, R1, velocity_mps, strict=False)
    ]
    moves = _above(math.hypot(*speeds), math.hypot(NOISE_MPS, NOISE_RADPS * z))
    aside_m2 = 0.5 * float(pose.level_frame_xyz_yaw_cov[0, 0] + pose.level_frame_xyz_yaw_cov[1, 1])
    for i in (X, Y):
        at = before.position_m[i] + after.position_m[i] + _dot(R0[i], place) + _dot(R1[i], place)
        speed = moves * speeds[i]
        u, v, w = (0.5 * (p + q) for p, q in zip(R0[i], R1[i], strict=True))
        # Negative cross products of the body's axes with the vector, and the vector itself.
        factors = [speed, v * z - w * y, w * x - u * z, u * y - v * x, u * x + v * y]
        rows.append([0.5 * at + delay_s * speed, *factors, 0.0, 0.0])
        noise.append(aside_m2 + LEAST_SIGMA_M**2 + (PICTURE_JITTER_S * speed) ** 2)
    rate = turned / (2.0 * ATTITUDE_STEP_S)
    rate *= _above(abs(rate), NOISE_RADPS)
    rows.append([heading0 + 0.5 * turned + delay_s * rate, rate] + 6 * [0.0])
    noise.append(
        float(pose.level_frame_xyz_yaw_cov[3, 3])
        + LEAST_SIGMA_RAD**2
        + (PICTURE_JITTER_S * rate) ** 2
    )
    return np.array(rows), np.array(noise), z


def _above(size: float, noise: float) -> float:
    """Return a weight, 0 to 1, for a motion of the magnitude `size` with the standard deviation
    `noise`, both in the same unit: 0 if noise alone may explain the motion, close to 1 if the
    motion is much larger than the noise."""
    return max(0.0, 1.0 - (2.0 * noise / max(size, 1e-9)) ** 2)


def _upper_rows(attitude: VehicleState) -> tuple[tuple[float, float, float], ...]:
    """Return the first two rows of ``R_world_body`` as plain tuples."""
    cr, sr = math.cos(attitude.roll_rad), math.sin(attitude.roll_rad)
    cp, sp = math.cos(attitude.pitch_rad), math.sin(attitude.pitch_rad)
    cy, sy = math.cos(attitude.yaw_rad), math.sin(attitude.yaw_rad)
    return (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
    )


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def add_rows(
    old: ConsistencySums, t_s: float, rows: Array, variance: Array, range_m: float
) -> ConsistencySums:
    """Return the sums with one more frame, given by its `consistency_rows`.

    After a gap or a jump, the filtered level restarts at the new rows; the information on delay and
    rotation is kept.
    """
    if old.level is None:
        return replace(old, t_s=t_s, began_s=t_s, level=rows, variance=variance)
    gap_s = t_s - old.t_s
    if gap_s <= 0.0:
        return old
    rows = rows.copy()
    rows[X, DRIFT_X] = rows[Y, DRIFT_Y] = t_s - old.began_s
    change = rows - old.level
    change[HEADING, PLACE] = wrap_rad(float(change[HEADING, PLACE]))
    walk_m2 = WALK_M**2 + (WALK_RAD * range_m) ** 2
    predicted = old.variance + np.array([walk_m2, walk_m2, WALK_RAD**2]) * gap_s
    spread = predicted + variance
    size = np.abs(change)
    beyond = size[:, PLACE] - GATE_SIGMAS * np.sqrt(spread) > size @ _POSSIBLE
    if gap_s > MOST_GAP_S or beyond.any():
        return replace(old, t_s=t_s, level=rows, variance=variance)
    gain = predicted / spread
    return ConsistencySums(
        t_s,
        old.began_s,
        old.level + gain[:, None] * change,
        (1.0 - gain) * predicted,
        old.information + change.T @ (change / spread[:, None]),
        old.row_count + 3,
    )


def solve_consistency(
    sums: ConsistencySums, attitude_sigma_rad: float
) -> CameraCalibrationErrors | None:
    """Return the errors of latency and mounting; None if the sums contain fewer than `LEAST_FRAMES`
    frames.

    `attitude_sigma_rad` is the standard deviation of the bias of the estimated roll and pitch.
    """
    if sums.row_count < 3 * LEAST_FRAMES:
        return None
    information = sums.information[1:, 1:] + np.diag(1.0 / _PRIOR**2)
    moved = sums.information[1:, PLACE]
    covariance = np.linalg.inv(information)
    found = covariance @ moved
    left = float(sums.information[PLACE, PLACE] - found @ moved)
    # More scatter than expected increases the covariance; less scatter does not reduce it.
    covariance *= max(1.0, left / sums.row_count)
    sigma = np.sqrt(np.diagonal(covariance))
    tilt_x, tilt_y = (
        math.hypot(sigma[column - 1], attitude_sigma_rad) for column in (TILT_X, TILT_Y)
    )
    turn = math.atan2(found[TURN - 1], 1.0 - found[SCALE - 1])
    return CameraCalibrationErrors(
        latency_above_profile_s=float(found[DELAY - 1]),
        latency_sigma_s=math.hypot(sigma[DELAY - 1], STAMPS_S),
        mount_rotation_from_profile_xyz_rad=(
            float(found[TILT_X - 1]),
            float(found[TILT_Y - 1]),
            turn,
        ),
        mount_rotation_sigma_xyz_rad=(
            tilt_x,
            tilt_y,
            math.hypot(sigma[TURN - 1], LARGE_TURN * turn),
        ),
    )
