"""The state estimate: the true state plus the errors of a Flow deck or of motion capture.

The drift starts when the motors first turn. A vehicle without a deck (scenario
`extra["external_position"]`) uses external positions instead, if the parameter
`stabilizer.estimator` is 2 (`perchctl.sim.firmware.outside`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.firmware.controller import Estimate, wrap_deg
from perchctl.sim.firmware.outside import (
    POSITION_STATE,
    VELOCITY_STATE,
    ExternalFilter,
    Imu,
    Quaternion,
    Vector,
    first_covariance,
)
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.vehicle import FLOW_DECKS

if TYPE_CHECKING:
    from perchctl.sim.world import World

KALMAN = 2
_ESTIMATOR_STREAM = 2
_DEG_PER_RAD = 180.0 / math.pi
_NOISE_BATCH = 2048
_NOISE_EVERY = 5  # coloured noise advances at 100 Hz
_POSITION_KEEP = math.exp(-_NOISE_EVERY * CONTROL_PERIOD_S / 0.3)  # time constant 0.3 s
_VELOCITY_KEEP = math.exp(-_NOISE_EVERY * CONTROL_PERIOD_S / 0.1)
_VELOCITY_LATE = 4  # control periods: the group delay of two poles at 30 Hz, 7.5 ms
_VELOCITY_NOISE_PER_S = 2.5  # m/s of noise per metre of position noise
_GYRO_NOISE_DPS = 0.08
_ACC_NOISE_G = 0.004
_ACC_LAG = 1.0 - math.exp(-2 * math.pi * 30.0 * CONTROL_PERIOD_S)  # cutoff at 30 Hz
_NO_BIAS = (0.0, 0.0, 0.0)
_ATTITUDE_GAIN = CONTROL_PERIOD_S / 2.0  # time constant 2 s

# Variances that the firmware's filter reports with a deck in steady state, according to its noise
# parameters.
_FIRST_DECK_S = 0.03
"""Time from a reset to the deck's first measurement, s; ranges come every 25 ms."""
_RANGED_M2, _CLIMB_M2PS2 = 2.4e-6, 1.8e-4
"""Variances of height and vertical speed with the range sensor of a Flow deck, sigma 2.5 mm."""
_FLOW_M2PS2, _FLOW_LEAST_M = 2.15e-3, 0.1
"""Variance of the horizontal velocity from optical flow, sigma 0.2 px, at 1 m above the ground. The
variance grows with the height to the power of 1.5; below the height given by the second value, m,
it stays constant."""
_ABSOLUTE_M2, _ABSOLUTE_M2PS2 = 1e-6, 2.5e-4
"""Variances of position and velocity with a Lighthouse deck."""


class Estimator:
    """Computes `now`, the state estimate, and `acc_g`, the accelerometer's reading."""

    def __init__(self, scenario: Scenario, parameters: Mapping[str, float]) -> None:
        self._scenario, self._parameters = scenario, parameters
        self._rng = np.random.default_rng([scenario.seed, _ESTIMATOR_STREAM])
        self._white: list[float] = []
        self.now = Estimate()
        self.gyro: Quaternion | None = None
        self.acc_g = (0.0, 0.0, 1.0)
        self._steps = 0
        self._drift = (0.0, 0.0, 0.0)
        self._drift_s = 0.0
        self._position_noise = (0.0, 0.0, 0.0)
        self._velocity_noise = (0.0, 0.0, 0.0)
        self._past: deque[Vector] = deque(maxlen=_VELOCITY_LATE + 1)
        self._velocity_mps: Vector = (0.0, 0.0, 0.0)
        self.outside: ExternalFilter | None = None
        self._imu: Imu | None = None
        if scenario.extra.get("external_position"):
            self.outside, self._imu = ExternalFilter(parameters), Imu(scenario)
        self._reset_s = 0.0
        self._rng.uniform()  # unused; without this draw, the flights of all seeds would change
        self.spoil: Callable[[Estimate], None] | None = None  # called by a fault on each estimate

    def reset(self, t_s: float) -> None:
        """Forget drift and external positions, as `kalman.resetEstimation` does."""
        self._reset_s = t_s
        self._drift_s = 0.0
        if self.outside is not None:
            self.outside.reset()

    def take_external(self, position_m: Vector, quaternion: Quaternion | None = None) -> None:
        """Correct the estimate with an external position or pose; no effect with a deck."""
        if self.outside is not None and self._parameters["stabilizer.estimator"] == KALMAN:
            self.outside.update_position(position_m)
            if quaternion is not None:
                self.outside.update_attitude(quaternion)

    def add_accelerometer_bias(self, z_mps2: float) -> None:
        """Add to the accelerometer's bias along z. No effect with a deck."""
        if self._imu is not None:
            x, y, z = self._imu.acc_bias_mps2
            self._imu.acc_bias_mps2 = (x, y, z + z_mps2)

    def variance(self, t_s: float, state: int = POSITION_STATE) -> float:
        """Return the variance of a position or velocity state, numbered as in `ExternalFilter`.

        While another estimator runs, the variance is zero, like memory that was never written. A
        Flow deck does not measure the horizontal position, so the variance of that position keeps
        the value set by a reset.
        """
        if self._parameters["stabilizer.estimator"] != KALMAN:
            return 0.0
        if self.outside is not None:
            return float(self.outside.covariance[state, state])
        if t_s - self._reset_s < _FIRST_DECK_S:
            return float(first_covariance()[state, state])
        is_level = state % VELOCITY_STATE < 2  # x or y component
        if not any(self._parameters[f"deck.{name}"] for name in FLOW_DECKS):
            return _ABSOLUTE_M2PS2 if state >= VELOCITY_STATE else _ABSOLUTE_M2
        if state < VELOCITY_STATE:
            return float(first_covariance()[state, state]) if is_level else _RANGED_M2
        return _FLOW_M2PS2 * max(self.now.z_m, _FLOW_LEAST_M) ** 1.5 if is_level else _CLIMB_M2PS2

    def update(
        self,
        world: World,
        *,
        has_flown: bool,
        spinning: bool,
        flying: bool = False,
        pressed: bool = False,
    ) -> None:
        """Advance by one control period.

        The estimate drifts once the vehicle `has_flown`. `spinning` motors shake the accelerometer,
        and a vehicle `pressed` against the ceiling biases it. `flying` is the supervisor's state.
        """
        if len(self._white) < 12:
            self._white = self._rng.standard_normal(_NOISE_BATCH).tolist()
        if self._steps % _NOISE_EVERY == 0:
            sigma = self._scenario.estimate_noise_m
            self._position_noise = self._walk(self._position_noise, _POSITION_KEEP, sigma)
            sigma *= _VELOCITY_NOISE_PER_S
            self._velocity_noise = self._walk(self._velocity_noise, _VELOCITY_KEEP, sigma)
        self._steps += 1
        gyro_bias, acc_bias, acc_unit = _NO_BIAS, _NO_BIAS, 1.0 / GRAVITY_MPS2
        if self.outside is not None and self._imu is not None:
            self._move_outside(self.outside, self._imu, world, flying=flying, pressed=pressed)
            w, x, y, z = self.outside.quaternion
            gyro_bias, acc_bias = self._imu.gyro_bias_radps, self._imu.acc_bias_mps2
            acc_unit /= self._imu.acc_scale
        else:
            self.gyro = w, x, y, z = self._integrate(world)
            self._move_by_deck(world, flown=has_flown)
        now = self.now
        bias = self._scenario.estimate_tilt_bias_rad
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        lift = 2 * (w * y - x * z)
        pitch = math.asin(lift if -1.0 <= lift <= 1.0 else math.copysign(1.0, lift))
        now.roll_deg = wrap_deg(_DEG_PER_RAD * (roll + bias[0]))
        now.pitch_deg = -_DEG_PER_RAD * (pitch + bias[1])  # the firmware's pitch is nose up
        now.yaw_deg = _DEG_PER_RAD * math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
        if len(self._white) < 12:
            self._white = self._rng.standard_normal(_NOISE_BATCH).tolist()
        n6, n5, n4, n3, n2, n1 = self._white[-6:]
        del self._white[-6:]
        now.gyro_x_dps = _DEG_PER_RAD * (world.p_radps + gyro_bias[0]) + _GYRO_NOISE_DPS * n1
        now.gyro_y_dps = _DEG_PER_RAD * (world.q_radps + gyro_bias[1]) + _GYRO_NOISE_DPS * n2
        now.gyro_z_dps = _DEG_PER_RAD * (world.r_radps + gyro_bias[2]) + _GYRO_NOISE_DPS * n3
        if self.spoil is not None:
            self.spoil(now)
        ax, ay, az = self.acc_g
        lag, unit = _ACC_LAG, acc_unit
        shake = _ACC_NOISE_G + self._scenario.acc_vibration_g if spinning else _ACC_NOISE_G
        self.acc_g = (
            ax + lag * ((world.fx_mps2 + acc_bias[0]) * unit + shake * n4 - ax),
            ay + lag * ((world.fy_mps2 + acc_bias[1]) * unit + shake * n5 - ay),
            az + lag * ((world.fz_mps2 + acc_bias[2]) * unit + shake * n6 - az),
        )

    def _integrate(self, world: World) -> tuple[float, float, float, float]:
        """Return the attitude one control period later."""
        truth = world.quaternion
        if self.gyro is None:
            return truth
        w, x, y, z = self.gyro
        tw, tx, ty, tz = truth
        half = 0.5 * CONTROL_PERIOD_S
        p, q, r = half * world.p_radps, half * world.q_radps, half * world.r_radps
        # Step along the tangent, then towards the truth, then back onto the unit sphere.
        gain = _ATTITUDE_GAIN if w * tw + x * tx + y * ty + z * tz >= 0.0 else -_ATTITUDE_GAIN
        keep = 1.0 - _ATTITUDE_GAIN
        nw = keep * (w - x * p - y * q - z * r) + gain * tw
        nx = keep * (x + w * p + y * r - z * q) + gain * tx
        ny = keep * (y + w * q + z * p - x * r) + gain * ty
        nz = keep * (z + w * r + x * q - y * p) + gain * tz
        scale = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
        return (scale * nw, scale * nx, scale * ny, scale * nz)

    def _walk(self, noise: Vector, keep: float, sigma: float) -> Vector:
        """Return coloured noise one step later."""
        take, kick = self._white.pop, sigma * math.sqrt(1.0 - keep * keep)
        x, y, z = noise
        return keep * x + kick * take(), keep * y + kick * take(), keep * z + kick * take()

    def _move_by_deck(self, world: World, *, flown: bool) -> None:
        drift = self._scenario.drift_mps
        dx = dy = dz = 0.0
        if flown:
            self._drift_s += CONTROL_PERIOD_S
            dx, dy, dz = drift
        s = self._drift_s
        bx, by, bz = drift[0] * s, drift[1] * s, drift[2] * s
        now = self.now
        nx, ny, nz = self._position_noise
        now.x_m, now.y_m, now.z_m = world.x_m + bx + nx, world.y_m + by + ny, world.z_m + bz + nz
        self._past.append((world.vx_mps, world.vy_mps, world.vz_mps))
        if self._steps % _NOISE_EVERY == 1:
            self._velocity_mps = self._past[0]
        nx, ny, nz = self._velocity_noise
        vx, vy, vz = self._velocity_mps
        now.vx_mps, now.vy_mps, now.vz_mps = vx + dx + nx, vy + dy + ny, vz + dz + nz

    def _move_outside(
        self, outside: ExternalFilter, imu: Imu, world: World, *, flying: bool, pressed: bool
    ) -> None:
        if imu.add(
            (world.fx_mps2, world.fy_mps2, world.fz_mps2),
            (world.p_radps, world.q_radps, world.r_radps),
        ):
            outside.predict(imu.read(pressed=pressed), flying=flying)
        now = self.now
        now.x_m, now.y_m, now.z_m = outside.position_m
        now.vx_mps, now.vy_mps, now.vz_mps = outside.velocity_mps
