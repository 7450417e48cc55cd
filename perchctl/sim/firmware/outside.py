"""The state estimate of a vehicle without a positioning deck: its IMU, and positions or poses
from outside.

The firmware's Kalman filter (source: `kalman_core`, `estimator_kalman`). 100 times a second the
gyroscope turns the attitude and the accelerometer moves the velocity: in flight along the thrust's
axis alone, so that drag and draught go unfelt; otherwise along all three, and the attitude is
drawn to the initial one. A position corrects position, velocity and attitude, by what the
covariance says each has to do with it; so a tilt is learnt from the slide that it makes, and a
heading from manoeuvres, a little. Nothing here looks at the truth. What leads the estimate astray
are the sensors' errors (`perchctl.sim.firmware.imu`) and whatever is sent: late, false or in
millimetres, it is believed as `locSrv.extPosStdDev` and `locSrv.extQuatStdDev` say. There is no
gate (source).
"""

from __future__ import annotations

import math

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.firmware.covariance import ATTITUDE, POSITION, Covariance
from perchctl.sim.firmware.imu import IMU_PERIOD_S, Reading

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z

_LEAST_SIGMA = 1e-4
_REVERSION = 1e-3
"""Of the attitude towards the initial one, each time while not in flight (source:
`attitudeReversion`)."""

SETTINGS = {
    "locSrv.extPosStdDev": "position_sigma_m",
    "locSrv.extQuatStdDev": "attitude_sigma_rad",
    "kalman.initialX": "initial_x_m",
    "kalman.initialY": "initial_y_m",
    "kalman.initialZ": "initial_z_m",
    "kalman.initialYaw": "initial_yaw_rad",
    "kalman.maxPos": "most_m",
    "kalman.maxVel": "most_mps",
}
"""The firmware's parameters that reach in here."""


class OutsideFilter:
    """`position_m`, `velocity_mps` in world axes, `quaternion` body to world: the estimate."""

    def __init__(self) -> None:
        self.position_sigma_m, self.attitude_sigma_rad = 0.01, 0.0045
        self.initial_x_m = self.initial_y_m = self.initial_z_m = self.initial_yaw_rad = 0.0
        self.most_m, self.most_mps = 100.0, 10.0
        self._covariance = Covariance()
        self.reset()

    def variance(self, state: int) -> float:
        """Of a state: `perchctl.sim.firmware.covariance` says which it is, and its units."""
        return self._covariance.rows[state][state]

    def reset(self) -> None:
        """At the place and heading of `kalman.initial*`, level and at rest, whatever is true."""
        self._covariance.forget()
        self.position_m: Vector = (self.initial_x_m, self.initial_y_m, self.initial_z_m)
        self.velocity_mps: Vector = (0.0, 0.0, 0.0)
        half = 0.5 * self.initial_yaw_rad
        self._initial: Quaternion = (math.cos(half), 0.0, 0.0, math.sin(half))
        self.quaternion = self._initial

    def predict(self, felt: Reading, *, flying: bool) -> None:
        """`IMU_PERIOD_S` later. An estimate out of its bounds is reset."""
        t, half_s2 = IMU_PERIOD_S, 0.5 * IMU_PERIOD_S * IMU_PERIOD_S
        force = fx, fy, fz = self._force(felt, flying=flying)
        fz -= GRAVITY_MPS2
        x, y, z = self.position_m
        vx, vy, vz = self.velocity_mps
        self.position_m = (
            x + t * vx + half_s2 * fx, y + t * vy + half_s2 * fy, z + t * vz + half_s2 * fz,
        )  # fmt: skip
        self.velocity_mps = (vx + t * fx, vy + t * fy, vz + t * fz)
        half = 0.5 * t
        turn = (1.0, half * felt.p_radps, half * felt.q_radps, half * felt.r_radps)
        w, x, y, z = normalized(multiplied(self.quaternion, turn))
        if not flying:
            keep, (a, _, _, d) = 1.0 - _REVERSION, self._initial
            share = _REVERSION if w * a + z * d >= 0.0 else -_REVERSION
            reverted = (keep * w + share * a, keep * x, keep * y, keep * z + share * d)
            w, x, y, z = normalized(reverted)
        self.quaternion = (w, x, y, z)
        self._covariance.grow(t, force)
        far_m, fast_mps = max(map(abs, self.position_m)), max(map(abs, self.velocity_mps))
        if 0.0 < self.most_m < far_m or 0.0 < self.most_mps < fast_mps:
            self.reset()

    def position(self, measured_m: Vector) -> None:
        """A position from outside, taken for the one of now."""
        if all(map(math.isfinite, measured_m)):
            self._correct(POSITION, self._innovation(measured_m), self.position_sigma_m)

    def pose(self, measured_m: Vector, measured: Quaternion) -> None:
        """The same with an attitude, body to world."""
        self.position(measured_m)
        norm = math.sqrt(sum(v * v for v in measured))
        if not math.isfinite(norm) or norm < 0.5:
            return
        w, x, y, z = self.quaternion
        left = multiplied(measured, (w, -x, -y, -z))
        if abs(left[0]) < 1e-6 * norm:
            return  # half a turn, which has no direction
        twice = 2.0 / left[0]
        wrong = (twice * left[1], twice * left[2], twice * left[3])
        self._correct(ATTITUDE, wrong, self.attitude_sigma_rad)

    def _innovation(self, measured_m: Vector) -> Vector:
        (mx, my, mz), (x, y, z) = measured_m, self.position_m
        return mx - x, my - y, mz - z

    def _correct(self, first: int, wrong: Vector, sigma: float) -> None:
        """Three states from `first` on are so far off, one after the other."""
        variance = max(sigma, _LEAST_SIGMA) ** 2
        sums = [0.0] * 9
        for axis in range(3):
            state = first + axis
            left = wrong[axis] - sums[state]
            gains = self._covariance.measure(state, variance)
            sums = [s + left * gain for s, gain in zip(sums, gains, strict=True)]
        dx, dy, dz, ex, ey, ez, a, b, c = sums
        x, y, z = self.position_m
        self.position_m = (x + dx, y + dy, z + dz)
        x, y, z = self.velocity_mps
        self.velocity_mps = (x + ex, y + ey, z + ez)
        turn = (1.0, 0.5 * a, 0.5 * b, 0.5 * c)
        self.quaternion = normalized(multiplied(turn, self.quaternion))

    def _force(self, felt: Reading, *, flying: bool) -> Vector:
        """What is believed of the specific force, in world axes."""
        w, x, y, z = self.quaternion
        az = felt.az_mps2
        ux, uy, uz = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
        if flying:
            return az * ux, az * uy, az * uz
        ax, ay = felt.ax_mps2, felt.ay_mps2
        return (
            (1 - 2 * (y * y + z * z)) * ax + 2 * (x * y - w * z) * ay + az * ux,
            2 * (x * y + w * z) * ax + (1 - 2 * (x * x + z * z)) * ay + az * uy,
            2 * (x * z - w * y) * ax + 2 * (y * z + w * x) * ay + az * uz,
        )


def normalized(quaternion: Quaternion) -> Quaternion:
    w, x, y, z = quaternion
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return scale * w, scale * x, scale * y, scale * z


def multiplied(first: Quaternion, second: Quaternion) -> Quaternion:
    """The turn by `second` and then by `first`."""
    w, x, y, z = first
    a, b, c, d = second
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
