"""What the gyroscope and the accelerometer of a simulated vehicle read, as its estimator gets it:
means of 100 a second.

Their errors are those of the trial in docs/firmware.md, "Target as position": white noise, that
sums up to a random walk of attitude and velocity, and a bias. On the ground the firmware takes
the gyroscope's mean for its bias and scales the accelerometer to 1 g (source); what the scenario
gives as bias of the gyroscope is what that leaves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

IMU_EVERY = 5
"""Control periods from one mean to the next."""
IMU_PERIOD_S = IMU_EVERY * CONTROL_PERIOD_S

_STREAM = 12
_BATCH = 1536
_SAMPLES = 1000.0 * IMU_PERIOD_S  # of a real one, in each mean
_GYRO_NOISE_RADPS = math.radians(0.1) / math.sqrt(_SAMPLES)
_ACC_NOISE_MPS2 = 0.01 * GRAVITY_MPS2 / math.sqrt(_SAMPLES)
_GYRO_LEFT_RADPS = 5e-4
"""Bias about level axes that a real one has at its best: blind for 12 s of flight, a vehicle
touched down 0.9 m aside (docs/firmware.md, "Target covered")."""
_PRESSED_MPS2 = 0.03
"""Of the accelerometer along z while the vehicle is pressed against a ceiling: blind, the height
runs away by 0.1 to 0.2 m/s (docs/firmware.md, "Blind at the ceiling")."""


class Reading(NamedTuple):
    """Body axes."""

    ax_mps2: float
    ay_mps2: float
    az_mps2: float
    p_radps: float
    q_radps: float
    r_radps: float


class Imu:
    """`feel` takes a control period's truth; after `IMU_EVERY` of them `read` gives their mean.

    `gyro_bias_radps`, `acc_bias_mps2`: what is read too much, body axes; `acc_scale`: by how much
    the firmware divides.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._rng = np.random.default_rng([scenario.seed, _STREAM])
        self._white: list[float] = []
        angle = float(self._rng.uniform(-math.pi, math.pi))
        p, q, r = scenario.gyro_bias_radps
        self.gyro_bias_radps = (
            p + _GYRO_LEFT_RADPS * math.cos(angle), q + _GYRO_LEFT_RADPS * math.sin(angle), r,
        )  # fmt: skip
        self.acc_bias_mps2 = x, y, z = scenario.acc_bias_mps2
        self.acc_scale = math.hypot(x, y, GRAVITY_MPS2 + z) / GRAVITY_MPS2
        self._pressed_mps2 = _PRESSED_MPS2 if self._rng.uniform() < 0.5 else -_PRESSED_MPS2
        self._clear()

    def feel(
        self, force_mps2: tuple[float, float, float], rates_radps: tuple[float, float, float]
    ) -> bool:
        """The true specific force and rates, body axes. Whether a mean is due."""
        x, y, z = force_mps2
        p, q, r = rates_radps
        self._x += x
        self._y += y
        self._z += z
        self._p += p
        self._q += q
        self._r += r
        self._count += 1
        return self._count == IMU_EVERY

    def read(self, *, pressed: bool) -> Reading:
        """Their mean, with the errors."""
        white = self._white
        if len(white) < 6:
            white = self._white = self._rng.standard_normal(_BATCH).tolist()
        take = white.pop
        (bx, by, bz), (bp, bq, br) = self.acc_bias_mps2, self.gyro_bias_radps
        if pressed:
            bz += self._pressed_mps2
        share, unit = 1.0 / self._count, 1.0 / self.acc_scale
        noise, turn = _ACC_NOISE_MPS2, _GYRO_NOISE_RADPS
        mean = Reading(
            unit * (share * self._x + bx + noise * take()),
            unit * (share * self._y + by + noise * take()),
            unit * (share * self._z + bz + noise * take()),
            share * self._p + bp + turn * take(),
            share * self._q + bq + turn * take(),
            share * self._r + br + turn * take(),
        )
        self._clear()
        return mean

    def _clear(self) -> None:
        self._x = self._y = self._z = self._p = self._q = self._r = 0.0
        self._count = 0
