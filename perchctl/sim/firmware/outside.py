"""The state estimate of a vehicle without a positioning deck, from its IMU and from external
positions or poses.

The firmware's Kalman filter (source: `kalman_core`, `estimator_kalman`). 100 times a second, the
gyroscope updates the attitude and the accelerometer updates the velocity. In flight, the velocity
is updated along the thrust axis only, so drag and draught have no effect on it. While the vehicle
is not flying, the velocity is updated along all three axes, and the attitude is pulled towards the
initial one. A position corrects position, velocity and attitude according to their covariance with
it. The filter never sees the true state: the sensor errors (`Imu`) and any wrong position corrupt
the estimate, because there is no gate (source).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from perchctl.geometry import GRAVITY_MPS2, Array
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

Vector = tuple[float, float, float]
Reading = tuple[float, float, float, float, float, float]
"""Acceleration, m/s^2, and rotation rates, rad/s, in body axes."""
Quaternion = tuple[float, float, float, float]  # w, x, y, z

# --- Gyroscope and accelerometer readings, as means at 100 Hz for the estimator ---
# The errors are those of the trial in docs/firmware.md, "Target as position": white noise, which
# accumulates to a random walk of attitude and velocity, and a bias. The gyroscope's bias is what
# remains after the firmware has subtracted the bias that it measured on the ground.


IMU_EVERY = 5
"""Number of control periods from one mean to the next."""
IMU_PERIOD_S = IMU_EVERY * CONTROL_PERIOD_S

_IMU_NOISE_STREAM = 12
_IMU_BATCH = 1536
_SAMPLES = 1000.0 * IMU_PERIOD_S  # samples of a real sensor in each mean
_GYRO_NOISE_RADPS = math.radians(0.1) / math.sqrt(_SAMPLES)
_ACC_NOISE_MPS2 = 0.01 * GRAVITY_MPS2 / math.sqrt(_SAMPLES)
_GYRO_LEFT_RADPS = 5e-4
"""Smallest remaining bias of a real gyroscope about the horizontal axes: after 12 s of blind
flight, a vehicle touched down 0.9 m away (docs/firmware.md, "Target covered")."""
_PRESSED_MPS2 = 0.03
"""Error of the accelerometer along z while the vehicle is pressed against a ceiling. Without
positions, the estimated height runs away at 0.1 to 0.2 m/s (docs/firmware.md, "Blind at the
ceiling")."""


class Imu:
    """`add` takes a control period's true motion; `read` returns the mean over `IMU_EVERY` periods.

    `gyro_bias_radps`, `acc_bias_mps2`: constant errors, body axes; `acc_scale`: the firmware's
    divisor of the acceleration.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._rng = np.random.default_rng([scenario.seed, _IMU_NOISE_STREAM])
        self._white: list[float] = []
        angle = float(self._rng.uniform(-math.pi, math.pi))
        p, q, r = scenario.gyro_bias_radps
        self.gyro_bias_radps = (
            p + _GYRO_LEFT_RADPS * math.cos(angle),
            q + _GYRO_LEFT_RADPS * math.sin(angle),
            r,
        )
        self.acc_bias_mps2 = x, y, z = scenario.acc_bias_mps2
        self.acc_scale = math.hypot(x, y, GRAVITY_MPS2 + z) / GRAVITY_MPS2
        self._pressed_mps2 = _PRESSED_MPS2 if self._rng.uniform() < 0.5 else -_PRESSED_MPS2
        self._sums = [0.0] * 6
        self._count = 0

    def add(self, force_mps2: Vector, rates_radps: Vector) -> bool:
        """Add the true specific force and rates, body axes; True if `read` is due."""
        values = (*force_mps2, *rates_radps)
        self._sums = [total + value for total, value in zip(self._sums, values, strict=True)]
        self._count += 1
        return self._count == IMU_EVERY

    def read(self, *, pressed: bool) -> Reading:
        """Return the mean since the last reading, with sensor errors; `pressed` means against the
        ceiling."""
        if len(self._white) < 6:
            self._white = self._rng.standard_normal(_IMU_BATCH).tolist()
        take = self._white.pop
        (bx, by, bz), (bp, bq, br) = self.acc_bias_mps2, self.gyro_bias_radps
        if pressed:
            bz += self._pressed_mps2
        share, unit = 1.0 / self._count, 1.0 / self.acc_scale
        x, y, z, p, q, r = (share * total for total in self._sums)
        self._sums, self._count = [0.0] * 6, 0
        return (
            unit * (x + bx + _ACC_NOISE_MPS2 * take()),
            unit * (y + by + _ACC_NOISE_MPS2 * take()),
            unit * (z + bz + _ACC_NOISE_MPS2 * take()),
            p + bp + _GYRO_NOISE_RADPS * take(),
            q + bq + _GYRO_NOISE_RADPS * take(),
            r + br + _GYRO_NOISE_RADPS * take(),
        )


# --- The filter ---


POSITION_STATE = 0
"""Index of the position's x component among the nine states; y and z follow."""
VELOCITY_STATE = 3
"""Index of the velocity's x component."""
ATTITUDE_STATE = 6
"""Index of the attitude error's x component."""

_FIRST_M, _FIRST_HEIGHT_M, _FIRST_MPS, _FIRST_RAD = 100.0, 1.0, 0.01, 0.01
"""Standard deviations after a reset (source: `stdDevInitial*`)."""
_MOST, _LEAST = 100.0, 1e-6
_FARTHEST_M, _FASTEST_MPS = 100.0, 10.0  # `kalman.maxPos`, `kalman.maxVel`
_NOISE_PER_S = (0.0, 0.0, 0.0, 2.5e-4, 2.5e-4, 1e-3, 1e-5, 1e-5, 1e-5)
"""(m/s)^2 and rad^2 a second: `kalman.pNAcc_xy` 0.5 m/s^2, `pNAcc_z` 1 m/s^2 and `mNGyro_*`
0.1 rad/s, each added as one of 1000 steps a second (source)."""
_LEAST_SIGMA = 1e-4
_REVERSION = 1e-3
"""Share of the difference from the initial attitude that each step removes while the vehicle is not
flying (source: `attitudeReversion`)."""


def first_covariance() -> Array:
    """The covariance (9, 9) after a reset."""
    m2, height_m2 = min(_FIRST_M**2, _MOST), _FIRST_HEIGHT_M**2
    return np.diag([m2, m2, height_m2] + [_FIRST_MPS**2] * 3 + [_FIRST_RAD**2] * 3)


class ExternalFilter:
    """`position_m`, `velocity_mps` in world axes, `quaternion` body to world: the estimate.

    `covariance` (9, 9) is the covariance of the errors of position, velocity and attitude; SI,
    world axes.
    """

    def __init__(self, parameters: Mapping[str, float]) -> None:
        self._parameters = parameters  # the firmware's parameters with their current values
        self.reset()

    def reset(self) -> None:
        """Restart at the position and heading of `kalman.initial*`, level and at rest."""
        self.covariance = first_covariance()
        names = ("X", "Y", "Z", "Yaw")
        x, y, z, yaw = (self._parameters[f"kalman.initial{name}"] for name in names)
        self.position_m: Vector = (x, y, z)
        self.velocity_mps: Vector = (0.0, 0.0, 0.0)
        half = 0.5 * yaw
        self._initial: Quaternion = (math.cos(half), 0.0, 0.0, math.sin(half))
        self.quaternion = self._initial

    def predict(self, reading: Reading, *, flying: bool) -> None:
        """Advance by `IMU_PERIOD_S`. An estimate that exceeds its bounds is reset."""
        t, half_s2 = IMU_PERIOD_S, 0.5 * IMU_PERIOD_S * IMU_PERIOD_S
        *acceleration, p, q, r = reading
        force = fx, fy, fz = self._force(acceleration, flying=flying)
        fz -= GRAVITY_MPS2
        x, y, z = self.position_m
        vx, vy, vz = self.velocity_mps
        self.position_m = (
            x + t * vx + half_s2 * fx,
            y + t * vy + half_s2 * fy,
            z + t * vz + half_s2 * fz,
        )
        self.velocity_mps = (vx + t * fx, vy + t * fy, vz + t * fz)
        half = 0.5 * t
        turn = (1.0, half * p, half * q, half * r)
        w, x, y, z = normalize_quaternion(multiply_quaternions(self.quaternion, turn))
        if not flying:
            keep, (a, _, _, d) = 1.0 - _REVERSION, self._initial
            share = _REVERSION if w * a + z * d >= 0.0 else -_REVERSION
            reverted = (keep * w + share * a, keep * x, keep * y, keep * z + share * d)
            w, x, y, z = normalize_quaternion(reverted)
        self.quaternion = (w, x, y, z)
        self._grow(force)
        far_m, fast_mps = max(map(abs, self.position_m)), max(map(abs, self.velocity_mps))
        if far_m > _FARTHEST_M or fast_mps > _FASTEST_MPS:
            self.reset()

    def update_position(self, measured_m: Vector) -> None:
        """Correct the estimate using an external position, which is treated as current."""
        if all(map(math.isfinite, measured_m)):
            (mx, my, mz), (x, y, z) = measured_m, self.position_m
            sigma_m = self._parameters["locSrv.extPosStdDev"]
            self._correct(POSITION_STATE, (mx - x, my - y, mz - z), sigma_m)

    def update_attitude(self, measured: Quaternion) -> None:
        """Correct the estimate using an external attitude (body to world)."""
        norm = math.sqrt(sum(v * v for v in measured))
        if not math.isfinite(norm) or norm < 0.5:
            return
        w, x, y, z = self.quaternion
        left = multiply_quaternions(measured, (w, -x, -y, -z))
        if abs(left[0]) < 1e-6 * norm:
            return  # a rotation by 180 degrees, whose direction is undefined
        twice = 2.0 / left[0]
        wrong = (twice * left[1], twice * left[2], twice * left[3])
        self._correct(ATTITUDE_STATE, wrong, self._parameters["locSrv.extQuatStdDev"])

    def _grow(self, force_mps2: Vector) -> None:
        sx, sy, sz = (IMU_PERIOD_S * part for part in force_mps2)
        for rows in (self.covariance, self.covariance.T):
            rows[POSITION_STATE:VELOCITY_STATE] += (
                IMU_PERIOD_S * rows[VELOCITY_STATE:ATTITUDE_STATE]
            )
            a, b, c = rows[ATTITUDE_STATE:]
            u, v, w = rows[VELOCITY_STATE:ATTITUDE_STATE]
            rows[VELOCITY_STATE:ATTITUDE_STATE] = (
                u + sz * b - sy * c,
                v + sx * c - sz * a,
                w + sy * a - sx * b,
            )
        self.covariance += IMU_PERIOD_S * np.diag(_NOISE_PER_S)
        self._bound()

    def _correct(self, first: int, wrong: Vector, sigma: float) -> None:
        variance = max(sigma, _LEAST_SIGMA) ** 2
        sums: Array = np.zeros(9)
        for state in range(first, first + 3):
            row = self.covariance[state]
            gains = row / (row[state] + variance)
            sums = sums + (wrong[state - first] - sums[state]) * gains
            self.covariance -= np.outer(gains, row)
            self._bound()
        dx, dy, dz, ex, ey, ez, a, b, c = sums.tolist()
        x, y, z = self.position_m
        self.position_m = (x + dx, y + dy, z + dz)
        x, y, z = self.velocity_mps
        self.velocity_mps = (x + ex, y + ey, z + ez)
        turn = (1.0, 0.5 * a, 0.5 * b, 0.5 * c)
        self.quaternion = normalize_quaternion(multiply_quaternions(turn, self.quaternion))

    def _bound(self) -> None:
        bounded = np.clip(np.diag(self.covariance), _LEAST, _MOST)
        np.fill_diagonal(self.covariance, bounded)

    def _force(self, acceleration_mps2: Sequence[float], *, flying: bool) -> Vector:
        """Return the assumed specific force, world axes."""
        w, x, y, z = self.quaternion
        ax, ay, az = acceleration_mps2
        ux, uy, uz = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
        if flying:
            return az * ux, az * uy, az * uz
        return (
            (1 - 2 * (y * y + z * z)) * ax + 2 * (x * y - w * z) * ay + az * ux,
            2 * (x * y + w * z) * ax + (1 - 2 * (x * x + z * z)) * ay + az * uy,
            2 * (x * z - w * y) * ax + 2 * (y * z + w * x) * ay + az * uz,
        )


def normalize_quaternion(quaternion: Quaternion) -> Quaternion:
    w, x, y, z = quaternion
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return scale * w, scale * x, scale * y, scale * z


def multiply_quaternions(first: Quaternion, second: Quaternion) -> Quaternion:
    """Return the rotation by `second` followed by `first`."""
    w, x, y, z = first
    a, b, c, d = second
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
