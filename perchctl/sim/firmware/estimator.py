"""The state estimate: the truth with the errors of a flow deck or of motion capture.

Drift runs from the moment the motors first turn. With outside positions (scenario
`extra["external_position"]` and parameter `stabilizer.estimator` = 2) the estimate
follows those instead, and slides away once they stop coming.

The attitude is what the gyroscope integrates to, drawn to the truth only as slowly as
the filter's other measurements can: a vehicle that is put on its back by hand, faster
than any gyroscope measures, is still estimated as level.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.firmware.controller import Estimate, cap_deg
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

_STREAM = 2
_BATCH = 2048
_NOISE_EVERY = 5  # coloured noise advances at 100 Hz
_POSITION_MEMORY_S = 0.3
_VELOCITY_MEMORY_S = 0.1
_VELOCITY_NOISE_PER_S = 2.5  # m/s of noise a metre of position noise
_GYRO_NOISE_DPS = 0.08
_ATTITUDE_MEMORY_S = 2.0
_ACC_NOISE_G = 0.004
_ACC_VIBRATION_G = 0.04  # added by turning motors
_ACC_CUTOFF_HZ = 30.0
_ATTITUDE_GAIN = CONTROL_PERIOD_S / _ATTITUDE_MEMORY_S
_EXTERNAL_GAIN = 0.3
_EXTERNAL_STALE_S = 0.2
_EXTERNAL_SLIDE_MPS2 = 0.04
_VARIANCE_START, _VARIANCE_FALL_S, _VARIANCE_FLOOR = 100.0, 0.1, 2e-5


class Sensed(Protocol):
    """The part of `World` that an estimator may read."""

    x_m: float
    y_m: float
    z_m: float
    vx_mps: float
    vy_mps: float
    vz_mps: float
    p_radps: float
    q_radps: float
    r_radps: float
    fx_mps2: float
    fy_mps2: float
    fz_mps2: float
    quaternion: tuple[float, float, float, float]


class Estimator:
    """Writes `now` (an `Estimate`) and `acc_g` once a control period."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._rng = np.random.default_rng([scenario.seed, _STREAM])
        self._white: list[float] = []
        self.now = Estimate()
        self.quaternion: tuple[float, float, float, float] | None = None
        self.acc_g = (0.0, 0.0, 1.0)
        self._steps = 0
        self._drift = (0.0, 0.0, 0.0)
        self._drift_s = 0.0
        self._position_noise = (0.0, 0.0, 0.0)
        self._velocity_noise = (0.0, 0.0, 0.0)
        self._position_keep = math.exp(-_NOISE_EVERY * CONTROL_PERIOD_S / _POSITION_MEMORY_S)
        self._velocity_keep = math.exp(-_NOISE_EVERY * CONTROL_PERIOD_S / _VELOCITY_MEMORY_S)
        self._acc_lag = 1.0 - math.exp(-2 * math.pi * _ACC_CUTOFF_HZ * CONTROL_PERIOD_S)
        self._has_external = bool(scenario.extra.get("external_position"))
        self._external_error = (0.0, 0.0, 0.0)
        self._external_s: float | None = None
        self._reset_s = 0.0
        heading = float(self._rng.uniform(-math.pi, math.pi))
        self._slide = (math.cos(heading), math.sin(heading))
        self.external_count = 0
        self.spoil: Callable[[Estimate], None] | None = None  # a fault's, upon each estimate

    def reset(self, t_s: float) -> None:
        """`kalman.resetEstimation`: drift and outside corrections are forgotten."""
        self._reset_s = t_s
        self._drift_s = 0.0
        self._external_error = (0.0, 0.0, 0.0)

    def external_position(self, position_m: tuple[float, float, float], t_s: float) -> None:
        """One measurement from outside; counted always, used when configured."""
        self.external_count += 1
        now = self.now
        ex, ey, ez = self._external_error
        self._external_error = (
            ex + _EXTERNAL_GAIN * (position_m[0] - now.x_m),
            ey + _EXTERNAL_GAIN * (position_m[1] - now.y_m),
            ez + _EXTERNAL_GAIN * (position_m[2] - now.z_m),
        )
        self._external_s = t_s

    def variance(self, t_s: float) -> float:
        """Position variance in m^2: falls after a reset, grows while blind."""
        value = _VARIANCE_FLOOR + _VARIANCE_START * math.exp(
            -(t_s - self._reset_s) / _VARIANCE_FALL_S
        )
        if self._has_external:
            since_s = t_s - (self._reset_s if self._external_s is None else self._external_s)
            value += 1e-3 * max(0.0, since_s - _EXTERNAL_STALE_S) ** 2
        return value

    def update(
        self, world: Sensed, t_s: float, *, flown: bool, spinning: bool, external: bool
    ) -> None:
        if self._steps % _NOISE_EVERY == 0:
            self._walk()
        self._steps += 1
        drift = self._scenario.drift_mps
        if external and self._has_external:
            bx, by, bz = self._slid(t_s)
            dx = dy = dz = 0.0
        else:
            if flown:
                self._drift_s += CONTROL_PERIOD_S
                dx, dy, dz = drift
            else:
                dx = dy = dz = 0.0
            s = self._drift_s
            bx, by, bz = drift[0] * s, drift[1] * s, drift[2] * s
        now = self.now
        nx, ny, nz = self._position_noise
        now.x_m, now.y_m, now.z_m = world.x_m + bx + nx, world.y_m + by + ny, world.z_m + bz + nz
        nx, ny, nz = self._velocity_noise
        now.vx_mps = world.vx_mps + dx + nx
        now.vy_mps = world.vy_mps + dy + ny
        now.vz_mps = world.vz_mps + dz + nz
        w, x, y, z = self._integrate(world)
        bias = self._scenario.estimate_tilt_bias_rad
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - x * z))))
        now.roll_deg = cap_deg(math.degrees(roll + bias[0]))
        now.pitch_deg = -math.degrees(pitch + bias[1])  # the firmware's pitch is nose up
        now.yaw_deg = math.degrees(math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
        white = self._white
        if len(white) < 12:
            white = self._white = self._rng.standard_normal(_BATCH).tolist()
        take = white.pop
        now.gyro_x_dps = math.degrees(world.p_radps) + _GYRO_NOISE_DPS * take()
        now.gyro_y_dps = math.degrees(world.q_radps) + _GYRO_NOISE_DPS * take()
        now.gyro_z_dps = math.degrees(world.r_radps) + _GYRO_NOISE_DPS * take()
        if self.spoil is not None:
            self.spoil(now)
        ax, ay, az = self.acc_g
        lag, unit = self._acc_lag, 1.0 / GRAVITY_MPS2
        shake = _ACC_NOISE_G + _ACC_VIBRATION_G if spinning else _ACC_NOISE_G
        self.acc_g = (
            ax + lag * (world.fx_mps2 * unit + shake * take() - ax),
            ay + lag * (world.fy_mps2 * unit + shake * take() - ay),
            az + lag * (world.fz_mps2 * unit + shake * take() - az),
        )

    def _integrate(self, world: Sensed) -> tuple[float, float, float, float]:
        """The attitude after one more control period of turning."""
        truth = world.quaternion
        if self.quaternion is None:
            self.quaternion = truth
            return truth
        w, x, y, z = self.quaternion
        tw, tx, ty, tz = truth
        half = 0.5 * CONTROL_PERIOD_S
        p, q, r = half * world.p_radps, half * world.q_radps, half * world.r_radps
        # The tangent's step, then towards the truth, then back on the unit sphere.
        gain = _ATTITUDE_GAIN if w * tw + x * tx + y * ty + z * tz >= 0.0 else -_ATTITUDE_GAIN
        keep = 1.0 - _ATTITUDE_GAIN
        nw = keep * (w - x * p - y * q - z * r) + gain * tw
        nx = keep * (x + w * p + y * r - z * q) + gain * tx
        ny = keep * (y + w * q + z * p - x * r) + gain * ty
        nz = keep * (z + w * r + x * q - y * p) + gain * tz
        scale = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
        self.quaternion = turned = (scale * nw, scale * nx, scale * ny, scale * nz)
        return turned

    def _walk(self) -> None:
        sigma = self._scenario.estimate_noise_m
        if len(self._white) < 12:
            self._white = self._rng.standard_normal(_BATCH).tolist()
        take = self._white.pop
        keep = self._position_keep
        kick = sigma * math.sqrt(1.0 - keep * keep)
        x, y, z = self._position_noise
        self._position_noise = (
            keep * x + kick * take(),
            keep * y + kick * take(),
            keep * z + kick * take(),
        )
        keep = self._velocity_keep
        kick = _VELOCITY_NOISE_PER_S * sigma * math.sqrt(1.0 - keep * keep)
        x, y, z = self._velocity_noise
        self._velocity_noise = (
            keep * x + kick * take(),
            keep * y + kick * take(),
            keep * z + kick * take(),
        )

    def _slid(self, t_s: float) -> tuple[float, float, float]:
        """The estimate's error while it follows outside positions."""
        x, y, z = self._external_error
        last_s = self._reset_s if self._external_s is None else self._external_s
        blind_s = t_s - last_s - _EXTERNAL_STALE_S
        if blind_s <= 0.0:
            return x, y, z
        # Integrated accelerometer error: half a t squared.
        metres = 0.5 * _EXTERNAL_SLIDE_MPS2 * blind_s * blind_s
        return x + self._slide[0] * metres, y + self._slide[1] * metres, z
