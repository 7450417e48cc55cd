"""The state estimate of a vehicle without a positioning deck: its accelerometer, and positions
or poses from outside.

A Kalman filter of position and velocity, the same for each axis, in the form of its error:
the estimate is the truth and what is carried here. What leads it astray is what does so in a
real one: the accelerometer's errors, summed up twice (docs/firmware.md, "The target as the only
positioning system"), an attitude or heading that is wrong, by which the felt acceleration is
turned, and whatever is sent: late, false or in millimetres, it is believed as
`locSrv.extPosStdDev` and `locSrv.extQuatStdDev` say. There is no gate (source).
"""

from __future__ import annotations

import math

import numpy as np

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.scenario import CONTROL_PERIOD_S

_STREAM = 12
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z

_ACCELERATION_DENSITY = 1.9e-3
"""Of the velocity's variance, (m/s)^2 a second: blind, the position's passes 0.05 m^2 after
4 s and 0.2 after 7 s."""
_TURN_DENSITY = 1e-4
"""Of the attitude's variance, rad^2 a second: `kalman.mNGyro_*`, 0.1 rad/s at 100 Hz (source)."""
_START_POSITION_M2, _START_VELOCITY_M2PS2, _START_ATTITUDE_RAD2 = 100.0, 1e-4, 1e-4
_MORE_VARIANCE_M2 = 2.4e-4
"""Of what the model lacks: with ideal positions at 100 Hz a real one reports 2.5e-4 m^2."""
_LEAST_SIGMA = 1e-4
_BIAS_LEVEL_MPS2, _BIAS_UP_MPS2 = 0.0125, 0.005
"""Blind for 12 s of flight, a vehicle touches down 0.9 m aside."""
_BIAS_PRESSED_MPS2 = 0.03
"""Pressed against a ceiling and blind, the height runs away by 0.1 to 0.2 m/s."""
_ACC_NOISE_MPS2, _ACC_VIBRATION_MPS2 = 0.03, 0.3
_BATCH = 1536

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
    """`position_error_m`, `velocity_error_mps`: estimate minus truth, world axes; `turn`: from
    what the gyroscope sums up to the attitude that is believed."""

    def __init__(self, seed: int) -> None:
        self.position_sigma_m, self.attitude_sigma_rad = 0.01, 0.0045
        self.initial_x_m = self.initial_y_m = self.initial_z_m = self.initial_yaw_rad = 0.0
        self.most_m, self.most_mps = 100.0, 10.0
        self._rng = np.random.default_rng([seed, _STREAM])
        self._white: list[float] = []
        angle = float(self._rng.uniform(-math.pi, math.pi))
        up = 1.0 if self._rng.uniform() < 0.5 else -1.0
        self._bias_mps2 = (
            _BIAS_LEVEL_MPS2 * math.cos(angle), _BIAS_LEVEL_MPS2 * math.sin(angle),
            _BIAS_UP_MPS2 * up,
        )  # fmt: skip
        self._pressed_mps2 = _BIAS_PRESSED_MPS2 * up
        self.position_error_m: Vector = (0.0, 0.0, 0.0)
        self.velocity_error_mps: Vector = (0.0, 0.0, 0.0)
        self.turn: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._felt_wrongly: tuple[Vector, Vector, Vector] | None = None
        self._last_mps: Vector | None = None
        self._forget()

    @property
    def variance_m2(self) -> float:
        """As `kalman.varPX` reports it."""
        return self._pp + _MORE_VARIANCE_M2

    def reset(self, position_m: Vector, velocity_mps: Vector, gyro: Quaternion) -> None:
        """At the place and heading of `kalman.initial*`, at rest, whatever is true.

        `gyro`: the attitude that the gyroscope sums up to.
        """
        self._forget()
        x, y, z = position_m
        self.position_error_m = (
            self.initial_x_m - x, self.initial_y_m - y, self.initial_z_m - z,
        )  # fmt: skip
        vx, vy, vz = velocity_mps
        self.velocity_error_mps = (-vx, -vy, -vz)
        half = 0.5 * (self.initial_yaw_rad - yaw_of(gyro))
        self._turn_by((math.cos(half), 0.0, 0.0, math.sin(half)))

    def predict(
        self, position_m: Vector, velocity_mps: Vector, *, spinning: bool, pressed: bool
    ) -> bool:
        """One control period. False when the estimate has left its bounds: it has to be reset."""
        dt = CONTROL_PERIOD_S
        white = self._white
        if len(white) < 3:
            white = self._white = self._rng.standard_normal(_BATCH).tolist()
        shake = dt * (_ACC_VIBRATION_MPS2 if spinning else _ACC_NOISE_MPS2)
        bx, by, bz = self._bias_mps2
        ex, ey, ez = self.velocity_error_mps
        ex += bx * dt + shake * white.pop()
        ey += by * dt + shake * white.pop()
        ez += (bz + (self._pressed_mps2 if pressed else 0.0)) * dt + shake * white.pop()
        if self._felt_wrongly is not None and self._last_mps is not None:
            lx, ly, lz = self._last_mps
            vx, vy, vz = velocity_mps
            dx, dy, dz = vx - lx, vy - ly, vz - lz + GRAVITY_MPS2 * dt
            (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = self._felt_wrongly
            ex += m00 * dx + m01 * dy + m02 * dz
            ey += m10 * dx + m11 * dy + m12 * dz
            ez += m20 * dx + m21 * dy + m22 * dz
        self._last_mps = velocity_mps
        self.velocity_error_mps = (ex, ey, ez)
        px, py, pz = self.position_error_m
        self.position_error_m = px, py, pz = px + ex * dt, py + ey * dt, pz + ez * dt
        self._pp += dt * (2.0 * self._pv + dt * self._vv)
        self._pv += dt * self._vv
        self._vv += dt * _ACCELERATION_DENSITY
        self._aa += dt * _TURN_DENSITY
        x, y, z = position_m
        vx, vy, vz = velocity_mps
        most_m = max(abs(x + px), abs(y + py), abs(z + pz))
        most_mps = max(abs(vx + ex), abs(vy + ey), abs(vz + ez))
        return most_m <= self.most_m and most_mps <= self.most_mps

    def position(self, measured_m: Vector, true_m: Vector) -> None:
        """A position from outside, taken for the one of now."""
        if not all(map(math.isfinite, measured_m)):
            return
        spread = self._pp + max(self.position_sigma_m, _LEAST_SIGMA) ** 2
        kp, kv = self._pp / spread, self._pv / spread
        (mx, my, mz), (x, y, z) = measured_m, true_m
        px, py, pz = self.position_error_m
        ex, ey, ez = self.velocity_error_mps
        ix, iy, iz = mx - x - px, my - y - py, mz - z - pz
        self.position_error_m = (px + kp * ix, py + kp * iy, pz + kp * iz)
        self.velocity_error_mps = (ex + kv * ix, ey + kv * iy, ez + kv * iz)
        self._vv -= kv * self._pv
        self._pv -= kp * self._pv
        self._pp -= kp * self._pp

    def attitude(self, measured: Quaternion, gyro: Quaternion) -> None:
        """An attitude from outside, body to world; `gyro` as in `reset`."""
        norm = math.sqrt(sum(v * v for v in measured))
        if not math.isfinite(norm) or norm < 0.5:
            return
        gain = self._aa / (self._aa + max(self.attitude_sigma_rad, _LEAST_SIGMA) ** 2)
        self._aa -= gain * self._aa
        w, x, y, z = gyro
        wanted = multiplied(measured, (w, -x, -y, -z))
        if sum(a * b for a, b in zip(wanted, self.turn, strict=True)) < 0.0:
            gain = -gain
        a, b, c, d = (
            (1.0 - abs(gain)) * old + gain * new / norm
            for old, new in zip(self.turn, wanted, strict=True)
        )
        self._turn_by((a, b, c, d))

    def _forget(self) -> None:
        self._pp, self._pv, self._vv = _START_POSITION_M2, 0.0, _START_VELOCITY_M2PS2
        self._aa = _START_ATTITUDE_RAD2

    def _turn_by(self, turn: Quaternion) -> None:
        scale = 1.0 / math.sqrt(sum(v * v for v in turn))
        w, x, y, z = (scale * v for v in turn)
        self.turn = (w, x, y, z)
        if max(abs(x), abs(y), abs(z)) < 1e-9:
            self._felt_wrongly = None
            return
        self._felt_wrongly = (
            (-2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), -2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), -2 * (x * x + y * y)),
        )


def yaw_of(quaternion: Quaternion) -> float:
    w, x, y, z = quaternion
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


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
