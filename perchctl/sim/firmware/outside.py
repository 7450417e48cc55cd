"""The state estimate of a vehicle without a positioning deck: its accelerometer, and positions
or poses from outside.

A Kalman filter of position, velocity and tilt in the form of its error: the estimate is the
truth and what is carried here. Its structure is the firmware's (source: `kalman_core`): in flight
the accelerometer counts along the thrust's axis alone, so that drag and draught go unfelt; the
attitude is the gyroscope's sum, and a tilt that is wrong shows as a speed that is; what a position
is off by corrects position, velocity and tilt, by their covariance. On the ground all three
axes of the accelerometer count. What leads it astray is what does so in a real one: the sensors'
errors (docs/firmware.md, "The target as the only positioning system"), and whatever is sent:
late, false or in millimetres, it is believed as `locSrv.extPosStdDev` and
`locSrv.extQuatStdDev` say. There is no gate (source).
"""

from __future__ import annotations

import math

import numpy as np

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.scenario import CONTROL_PERIOD_S

_STREAM = 12
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z

_TILT_DENSITY = 1e-5
"""Of the tilt's variance, rad^2 a second: `kalman.mNGyro_rollpitch`, 0.1 rad/s at 1 kHz (source)."""
_ACCELERATION_DENSITY, _DAMPING_PER_S = 2e-3, 0.8
"""Of the velocity's variance, (m/s)^2 a second, and of the velocity in the covariances: blind, the
position's variance passes 0.05 m^2 after 4 s and 0.2 after 7 s. Without the damping it would grow
with the fifth power of the time."""
_TURN_DENSITY = 1e-4
"""Of the attitude's variance, rad^2 a second: `kalman.mNGyro_*`, 0.1 rad/s at 100 Hz (source)."""
_START_POSITION_M2, _START_VELOCITY_M2PS2, _START_ATTITUDE_RAD2 = 100.0, 1e-4, 1e-4
_MORE_VARIANCE_M2 = 2.4e-4
"""Of what the model lacks: with ideal positions at 100 Hz a real one reports 2.5e-4 m^2."""
_LEAST_SIGMA = 1e-4
_GYRO_BIAS_RADPS, _BIAS_UP_MPS2 = 3.5e-4, 0.005
"""What is left of them at best: blind for 12 s of flight, a vehicle touches down 0.9 m aside."""
_BIAS_PRESSED_MPS2 = 0.03
"""Pressed against a ceiling and blind, the height runs away by 0.1 to 0.2 m/s."""
_ACC_NOISE_MPS2, _ACC_VIBRATION_MPS2 = 0.03, 0.14
_BATCH = 1536
_TURN_EVERY = 5  # the gyroscope's bias is summed up at 100 Hz
_TURN_S = _TURN_EVERY * CONTROL_PERIOD_S
_REVERSION = 1e-3
"""On the ground the attitude is drawn to level by so much a turn (source: `attitudeReversion`)."""

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

    def __init__(
        self,
        seed: int,
        gyro_bias_radps: Vector = (0.0, 0.0, 0.0),
        acc_bias_mps2: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        self._acc_bias_mps2 = acc_bias_mps2
        self.position_sigma_m, self.attitude_sigma_rad = 0.01, 0.0045
        self.initial_x_m = self.initial_y_m = self.initial_z_m = self.initial_yaw_rad = 0.0
        self.most_m, self.most_mps = 100.0, 10.0
        self._rng = np.random.default_rng([seed, _STREAM])
        self._white: list[float] = []
        angle = float(self._rng.uniform(-math.pi, math.pi))
        up = 1.0 if self._rng.uniform() < 0.5 else -1.0
        p, q, r = gyro_bias_radps
        self._gyro_bias_radps = (
            p + _GYRO_BIAS_RADPS * math.cos(angle), q + _GYRO_BIAS_RADPS * math.sin(angle), r,
        )  # fmt: skip
        self._bias_up_mps2 = _BIAS_UP_MPS2 * up
        self._pressed_mps2 = _BIAS_PRESSED_MPS2 * up
        self.position_error_m: Vector = (0.0, 0.0, 0.0)
        self.velocity_error_mps: Vector = (0.0, 0.0, 0.0)
        self.turn: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._felt_wrongly: tuple[Vector, Vector, Vector] | None = None
        self._last_mps: Vector | None = None
        self._steps = 0
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
        self,
        position_m: Vector,
        velocity_mps: Vector,
        gyro: Quaternion,
        level_mps2: tuple[float, float],
        *,
        spinning: bool,
        pressed: bool,
    ) -> bool:
        """One control period. False when the estimate has left its bounds: it has to be reset.

        `level_mps2`: the specific force along body x and y, which is not looked at in flight.
        """
        dt = CONTROL_PERIOD_S
        white = self._white
        if len(white) < 3:
            white = self._white = self._rng.standard_normal(_BATCH).tolist()
        shake = dt * (_ACC_VIBRATION_MPS2 if spinning else _ACC_NOISE_MPS2)
        bz = self._bias_up_mps2
        ex, ey, ez = self.velocity_error_mps
        w, x, y, z = gyro
        c, s = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)  # of the heading, near level
        fx, fy = (-level_mps2[0], -level_mps2[1]) if spinning else self._acc_bias_mps2[:2]
        aside = 0.0 if spinning else shake
        ex += (c * fx - s * fy) * dt + aside * white.pop()
        ey += (s * fx + c * fy) * dt + aside * white.pop()
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
        self._grow(dt)
        self._steps += 1
        if self._steps % _TURN_EVERY == 0:
            self._turn_on(gyro, spinning)
        x, y, z = position_m
        vx, vy, vz = velocity_mps
        most_m = max(abs(x + px), abs(y + py), abs(z + pz))
        most_mps = max(abs(vx + ex), abs(vy + ey), abs(vz + ez))
        return most_m <= self.most_m and most_mps <= self.most_mps

    def position(self, measured_m: Vector, true_m: Vector) -> None:
        """A position from outside, taken for the one of now."""
        if not all(map(math.isfinite, measured_m)):
            return
        noise = max(self.position_sigma_m, _LEAST_SIGMA) ** 2
        spread = self._pp + noise
        kp, kv, kd = self._pp / spread, self._pv / spread, self._pd / spread
        kz, kw = self._zz / (self._zz + noise), self._zw / (self._zz + noise)
        (mx, my, mz), (x, y, z) = measured_m, true_m
        px, py, pz = self.position_error_m
        ex, ey, ez = self.velocity_error_mps
        ix, iy, iz = mx - x - px, my - y - py, mz - z - pz
        self.position_error_m = (px + kp * ix, py + kp * iy, pz + kz * iz)
        self.velocity_error_mps = (ex + kv * ix, ey + kv * iy, ez + kw * iz)
        self._tilt_by(-kd * iy, kd * ix)
        self._vv -= kv * self._pv
        self._vd -= kv * self._pd
        self._dd -= kd * self._pd
        self._pv -= kp * self._pv
        self._pd -= kp * self._pd
        self._pp -= kp * self._pp
        self._ww -= kw * self._zw
        self._zw -= kz * self._zw
        self._zz -= kz * self._zz

    def attitude(self, measured: Quaternion, gyro: Quaternion) -> None:
        """An attitude from outside, body to world; `gyro` as in `reset`."""
        norm = math.sqrt(sum(v * v for v in measured))
        if not math.isfinite(norm) or norm < 0.5:
            return
        noise = max(self.attitude_sigma_rad, _LEAST_SIGMA) ** 2
        gain = self._aa / (self._aa + noise)
        self._aa -= gain * self._aa
        spread = self._dd + noise
        self._pp -= self._pd * self._pd / spread
        self._pv -= self._pd * self._vd / spread
        self._vv -= self._vd * self._vd / spread
        self._pd -= self._pd * self._dd / spread
        self._vd -= self._vd * self._dd / spread
        self._dd -= self._dd * self._dd / spread
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
        # Covariances, the same for x and y: position, velocity, tilt. z has no tilt.
        self._pp, self._pv, self._vv = _START_POSITION_M2, 0.0, _START_VELOCITY_M2PS2
        self._pd, self._vd, self._dd = 0.0, 0.0, _START_ATTITUDE_RAD2
        self._zz, self._zw, self._ww = _START_POSITION_M2, 0.0, _START_VELOCITY_M2PS2
        self._aa = _START_ATTITUDE_RAD2

    def _grow(self, dt: float) -> None:
        """The covariances after one control period: tilt becomes speed, speed becomes place."""
        g, b = GRAVITY_MPS2, _DAMPING_PER_S
        self._pp += dt * 2.0 * self._pv
        self._pv += dt * (self._vv + g * self._pd - b * self._pv)
        self._vv += dt * (2.0 * (g * self._vd - b * self._vv) + _ACCELERATION_DENSITY)
        self._pd += dt * self._vd
        self._vd += dt * (g * self._dd - b * self._vd)
        self._dd += dt * _TILT_DENSITY
        self._zz += dt * 2.0 * self._zw
        self._zw += dt * (self._ww - b * self._zw)
        self._ww += dt * (_ACCELERATION_DENSITY - 2.0 * b * self._ww)
        self._aa += dt * _TURN_DENSITY

    def _turn_on(self, gyro: Quaternion, spinning: bool) -> None:
        """What the gyroscope's bias has summed up to since the last time."""
        bias = self._gyro_bias_radps
        if not spinning:
            w, x, y, z = self.turn
            if abs(x) + abs(y) > 1e-9:
                keep = 1.0 - _REVERSION
                self._turn_by((w, keep * x, keep * y, z))
        half = 0.5 * _TURN_S
        w, x, y, z = gyro
        body = multiplied(gyro, (0.0, half * bias[0], half * bias[1], half * bias[2]))
        turned = multiplied(body, (w, -x, -y, -z))
        self._turn_by(multiplied(self.turn, (1.0, *turned[1:])))

    def _tilt_by(self, about_x_rad: float, about_y_rad: float) -> None:
        """The estimated attitude, turned about the world's level axes."""
        if about_x_rad or about_y_rad:
            turn = (1.0, 0.5 * about_x_rad, 0.5 * about_y_rad, 0.0)
            self._turn_by(multiplied(turn, self.turn))

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
