"""What a flow deck's estimate is off by, as an estimate minus the truth.

A Kalman filter of position, velocity and the acceleration that an attitude which is off by a
little would feign, the same for x and y, in the form of its error. Its gains are those of the
firmware's own numbers (`stdDev` of a flow reading, `procNoiseAcc_xy`, `measNoiseGyro`; source),
so it averages flow as long as a real one does: for a second or two. What leads it astray:

- The sensor counts motion in tenths of a pixel of 0.717 / 35 rad, each 10 ms (source): rounding
  alone is 0.06 rad/s, of which a part is made up for by the next count. The firmware takes two
  counts, 0.41 rad/s, for what a reading is off by. An angular speed is made a speed by the
  height, so the position walks the more the higher it is.
- The vehicle's own turning is taken out by the gyroscope: what that is off by is taken for flow.
  Times the height it is a drift.
- It needs texture. Where all that it sees (42 deg) is bare floor it sees nothing, and above
  `Scenario.flow_reach_m`. Then the attitude's error alone is summed up, twice, as in
  docs/firmware.md, "The target as the only positioning system".
- The height is measured by a laser. Its error is that which the firmware counts on: 2.5 mm, and
  from 2.5 m on more by a factor of 80 within 1.5 m (source).

A flow sensor measures speeds only: when it sees again, the speed is right within seconds, and
the position comes back no farther than the filter can tell from that.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

if TYPE_CHECKING:
    from perchctl.sim.world import World

_STREAM = 15
_EVERY = 5  # control periods between two readings: 100 Hz
_DT_S = _EVERY * CONTROL_PERIOD_S
_BATCH = 1024
_LEAST_HEIGHT_M = 0.1
"""The firmware takes no height for less (source)."""
_VIEW_PER_M = math.tan(math.radians(21.0))
"""Half the width of what the sensor sees, a metre of height."""
_BIAS_MPS2 = 0.0125
"""What an attitude that is a little off feigns. Level accelerations are not looked at in flight:
vibration is nothing to the speed in x and y (source)."""
_SIGMA_RADPS = 2 * 0.1 * (0.71674 / 35) / _DT_S
_SPEED_DENSITY = 0.5**2 * 1e-3
_TURN_DENSITY = (GRAVITY_MPS2 * 0.1) ** 2 * 1e-3
"""What the filter counts on: of a reading of flow; of `procNoiseAcc_xy` and
`measNoiseGyro_rollpitch` at 1 kHz, the variance's growth in a second."""
_RANGE_SIGMA_M, _RANGE_FROM_M, _RANGE_RATE_PER_M = 0.0025, 2.5, math.log(80.0) / 1.5
_RANGE_MEMORY_S = 0.1
_START_VV, _START_AA = 1e-4, (GRAVITY_MPS2 * 0.01) ** 2


def has_flow_errors(scenario: Scenario) -> bool:
    """Whether the scenario's deck is any worse than the plain noise and drift."""
    return bool(
        scenario.flow_noise_radps
        or any(scenario.flow_bias_radps)
        or scenario.flow_reach_m is not None
        or scenario.bare_floors
    )


class FlowDeck:
    """`position_error_m` (3) and `velocity_error_mps` (2), world axes."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._rng = np.random.default_rng([scenario.seed, _STREAM])
        angle = float(self._rng.uniform(-math.pi, math.pi))
        self._bias_mps2 = (_BIAS_MPS2 * math.cos(angle), _BIAS_MPS2 * math.sin(angle))
        self._white: list[float] = []
        self._range_keep = math.exp(-_DT_S / _RANGE_MEMORY_S)
        self.reset()

    def reset(self) -> None:
        """The estimate is the truth again, but for the attitude."""
        self.position_error_m = (0.0, 0.0, 0.0)
        self.velocity_error_mps = (0.0, 0.0)
        self._felt_mps2 = self._bias_mps2
        self._pv = self._pa = self._va = 0.0
        self._vv, self._aa = _START_VV, _START_AA
        self._range_noise = 0.0
        self._steps = 0

    @property
    def variance(self) -> float:
        """Of the speed in x or y, (m/s)^2: that is what `kalman.varPX` holds (source)."""
        return self._vv

    def sees(self, world: World) -> bool:
        """Whether there is anything in view whose motion can be measured."""
        scenario = self._scenario
        if scenario.flow_reach_m is not None and world.z_m > scenario.flow_reach_m:
            return False
        view_m = world.z_m * _VIEW_PER_M
        return not any(
            math.hypot(world.x_m - x_m, world.y_m - y_m) + view_m < radius_m
            for x_m, y_m, radius_m in scenario.bare_floors
        )

    def step(self, world: World) -> None:
        """One control period of flight."""
        self._steps += 1
        if self._steps % _EVERY:
            return
        if len(self._white) < 3:
            self._white = self._rng.standard_normal(_BATCH).tolist()
        take = self._white.pop
        self._predict()
        if self.sees(world):
            self._measure(world.z_m, take(), take())
        self._range(world.z_m, take())

    def _predict(self) -> None:
        (px, py, pz), (ex, ey) = self.position_error_m, self.velocity_error_mps
        ax, ay = self._felt_mps2
        ex, ey = ex + ax * _DT_S, ey + ay * _DT_S
        self.position_error_m = (px + ex * _DT_S, py + ey * _DT_S, pz)
        self.velocity_error_mps = (ex, ey)
        self._pv += _DT_S * (self._vv + self._pa)
        self._pa += _DT_S * self._va
        self._vv += _DT_S * (2.0 * self._va + _DT_S * self._aa + _SPEED_DENSITY)
        self._va += _DT_S * self._aa
        self._aa += _DT_S * _TURN_DENSITY

    def _measure(self, z_m: float, white_x: float, white_y: float) -> None:
        height_m, sigma = max(z_m, _LEAST_HEIGHT_M), self._scenario.flow_noise_radps
        spread = self._vv + (height_m * _SIGMA_RADPS) ** 2
        kp, kv, ka = self._pv / spread, self._vv / spread, self._va / spread
        (px, py, pz), (ex, ey), (ax, ay) = (
            self.position_error_m, self.velocity_error_mps, self._felt_mps2,
        )  # fmt: skip
        bx, by = self._scenario.flow_bias_radps
        ix = height_m * (bx + sigma * white_x) - ex
        iy = height_m * (by + sigma * white_y) - ey
        self.position_error_m = (px + kp * ix, py + kp * iy, pz)
        self.velocity_error_mps = (ex + kv * ix, ey + kv * iy)
        self._felt_mps2 = (ax + ka * ix, ay + ka * iy)
        self._aa -= ka * self._va
        self._pa -= ka * self._pv
        self._pv -= kv * self._pv
        self._va -= kv * self._va
        self._vv -= kv * self._vv

    def _range(self, z_m: float, white: float) -> None:
        """More than the plain noise has: the part that grows with the distance."""
        sigma_m = _RANGE_SIGMA_M * math.exp(_RANGE_RATE_PER_M * (min(z_m, 5.0) - _RANGE_FROM_M))
        keep = self._range_keep
        self._range_noise = keep * self._range_noise + math.sqrt(1.0 - keep * keep) * white
        x_m, y_m, _ = self.position_error_m
        self.position_error_m = (x_m, y_m, sigma_m * self._range_noise)
