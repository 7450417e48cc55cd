"""What a flow deck's estimate is off by, as an estimate minus the truth.

A Kalman filter of position and velocity, the same for x and y, in the form of its error; for
positions from outside there is `perchctl.sim.firmware.outside`. What leads it astray:

- The sensor counts motion in tenths of a pixel of 0.717 / 35 rad, each 10 ms (source): rounding
  alone is 0.06 rad/s, of which a part is made up for by the next count. An angular speed is made
  a speed by the height, so velocity noise grows with it, and the position walks.
- The vehicle's own turning is taken out by the gyroscope: what that is off by is taken for flow.
  Times the height it is a drift.
- It needs texture. Where all that it sees (42 deg) is bare floor it sees nothing, and above
  `Scenario.flow_reach_m`. Then the accelerometer alone is summed up, twice, as in
  docs/firmware.md, "The target as the only positioning system".
- The height is measured by a laser. Its error is that which the firmware counts on: 2.5 mm, and
  from 2.5 m on more by a factor of 80 within 1.5 m (source).

A flow sensor measures speeds only: when it sees again, the speed is right within a moment, and
the position comes back no farther than the filter can tell from that.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

_STREAM = 15
_EVERY = 5  # control periods between two readings: 100 Hz
_DT_S = _EVERY * CONTROL_PERIOD_S
_BATCH = 1024
_LEAST_HEIGHT_M = 0.1
"""The firmware takes no height for less (source)."""
_VIEW_PER_M = math.tan(math.radians(21.0))
"""Half the width of what the sensor sees, a metre of height."""
_BIAS_MPS2 = 0.0125
_ACC_VIBRATION_MPS2 = 0.3  # white, each control period
_ACCELERATION_DENSITY = 1.9e-3
"""Of all three: what the estimate is truly off by where it is blind, and what the filter counts
on."""
_LEAST_SIGMA_RADPS = 0.06
_RANGE_SIGMA_M, _RANGE_FROM_M, _RANGE_RATE_PER_M = 0.0025, 2.5, math.log(80.0) / 1.5
_RANGE_MEMORY_S = 0.1
_START_VV = 1e-4


class Moving(Protocol):
    """The part of the world that the deck depends on."""

    x_m: float
    y_m: float
    z_m: float


def has_flow_errors(scenario: Scenario) -> bool:
    """Whether the scenario's deck is any worse than the plain noise and drift."""
    return bool(
        scenario.flow_noise_radps
        or any(scenario.flow_bias_radps)
        or scenario.flow_reach_m is not None
        or scenario.bare_floors
    )


class FlowDeck:
    """`position_error_m` (3) and `velocity_error_mps` (2), world axes; `variance_m2` of x or y,
    beyond what a good deck reports."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._rng = np.random.default_rng([scenario.seed, _STREAM])
        angle = float(self._rng.uniform(-math.pi, math.pi))
        self._bias_mps2 = (_BIAS_MPS2 * math.cos(angle), _BIAS_MPS2 * math.sin(angle))
        self._white: list[float] = []
        self._range_keep = math.exp(-_DT_S / _RANGE_MEMORY_S)
        self.reset()

    def reset(self) -> None:
        """The estimate is the truth again."""
        self.position_error_m = (0.0, 0.0, 0.0)
        self.velocity_error_mps = (0.0, 0.0)
        self._pp, self._pv, self._vv = 0.0, 0.0, _START_VV
        self._range_noise = 0.0
        self._steps = 0

    @property
    def variance_m2(self) -> float:
        return self._pp

    def sees(self, world: Moving) -> bool:
        """Whether there is anything in view whose motion can be measured."""
        scenario = self._scenario
        if scenario.flow_reach_m is not None and world.z_m > scenario.flow_reach_m:
            return False
        view_m = world.z_m * _VIEW_PER_M
        return not any(
            math.hypot(world.x_m - x_m, world.y_m - y_m) + view_m < radius_m
            for x_m, y_m, radius_m in scenario.bare_floors
        )

    def step(self, world: Moving) -> None:
        """One control period of flight."""
        self._steps += 1
        if self._steps % _EVERY:
            return
        if len(self._white) < 5:
            self._white = self._rng.standard_normal(_BATCH).tolist()
        take = self._white.pop
        self._predict(take(), take())
        if self.sees(world):
            self._measure(world.z_m, take(), take())
        self._range(world.z_m, take())

    def _predict(self, white_x: float, white_y: float) -> None:
        shake = _ACC_VIBRATION_MPS2 * CONTROL_PERIOD_S * math.sqrt(_EVERY)
        (px, py, pz), (ex, ey) = self.position_error_m, self.velocity_error_mps
        bx, by = self._bias_mps2
        ex, ey = ex + bx * _DT_S + shake * white_x, ey + by * _DT_S + shake * white_y
        self.position_error_m = (px + ex * _DT_S, py + ey * _DT_S, pz)
        self.velocity_error_mps = (ex, ey)
        self._pp += _DT_S * (2.0 * self._pv + _DT_S * self._vv)
        self._pv += _DT_S * self._vv
        self._vv += _DT_S * _ACCELERATION_DENSITY

    def _measure(self, z_m: float, white_x: float, white_y: float) -> None:
        scenario = self._scenario
        height_m = max(z_m, _LEAST_HEIGHT_M)
        sigma = scenario.flow_noise_radps
        spread = self._vv + (height_m * max(sigma, _LEAST_SIGMA_RADPS)) ** 2
        kp, kv = self._pv / spread, self._vv / spread
        (px, py, pz), (ex, ey) = self.position_error_m, self.velocity_error_mps
        bx, by = scenario.flow_bias_radps
        ix = height_m * (bx + sigma * white_x) - ex
        iy = height_m * (by + sigma * white_y) - ey
        self.position_error_m = (px + kp * ix, py + kp * iy, pz)
        self.velocity_error_mps = (ex + kv * ix, ey + kv * iy)
        self._pp -= kp * self._pv
        self._pv -= kp * self._vv
        self._vv -= kv * self._vv

    def _range(self, z_m: float, white: float) -> None:
        """More than the plain noise has: the part that grows with the distance."""
        sigma_m = _RANGE_SIGMA_M * math.exp(_RANGE_RATE_PER_M * (min(z_m, 5.0) - _RANGE_FROM_M))
        keep = self._range_keep
        self._range_noise = keep * self._range_noise + math.sqrt(1.0 - keep * keep) * white
        x_m, y_m, _ = self.position_error_m
        self.position_error_m = (x_m, y_m, sigma_m * self._range_noise)
