"""The filter of the hover thrust; what teaches it is in `perchctl.mission.belief.hover`.

Hover thrust is what the motors give, 0..65535, when the vehicle neither rises nor sinks. A scalar
Kalman filter estimates it, all in shares of the thrust:

    P += d^2 dt                    d: how fast it changes, by battery and wind
    K = P / (P + r^2 / dt)         r: noise of a measurement that lasts one second
    T += K (z - T),  P = (1 - K) P
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.values import replace

LEAST_POSITION_THRUST = 20000
"""The least thrust of the firmware's position mode, 0..65535 (docs/firmware.md)."""
THRUST_NOISE = 0.02
"""Share by which the mean of one second's measurements is wrong: position control itself changes
the thrust by 1 to 2 % for half a second. Larger: a sagging battery is followed late."""
OPEN_DRIFT = 0.01
"""Share by which it changes in the root of a second in the open. Larger: a push that lasts is
learned. Smaller: a sagging battery is followed late."""
FELT_SIGMA = 0.03
"""Spread, as a share, of what was felt in flight, by the accelerometer's scale."""
ROUGH_SIGMA = 0.05
"""Spread from which it is rough: good enough to sink slowly, not to descend without telemetry."""


@dataclass(frozen=True)
class HoverThrust:
    """An estimate of the hover thrust, and of its spread.

    Attributes:
        thrust: 0..65535; 0 while unknown.
        sigma: standard deviation, as a share of it.
        first: as the descent began that corrects it, and with which spread; None before one.
    """

    thrust: float = 0.0
    sigma: float = math.inf
    first: tuple[float, float] | None = None

    @property
    def is_rough(self) -> bool:
        """True if it was never measured in quiet flight, nor lately in a descent."""
        return self.sigma > ROUGH_SIGMA

    def after(self, dt_s: float, drift: float) -> HoverThrust:
        """The estimate `dt_s` later."""
        return replace(self, sigma=math.sqrt(self.sigma**2 + drift**2 * dt_s))

    def aged(self, dt_s: float) -> HoverThrust:
        """The estimate `dt_s` later in the open; what was learned stays as sure as what is felt."""
        sigma = self.after(dt_s, OPEN_DRIFT).sigma
        return replace(self, sigma=min(sigma, max(self.sigma, FELT_SIGMA)))

    def with_measured(self, thrust: float, dt_s: float) -> HoverThrust:
        """The estimate after a measurement that stands for `dt_s`; unchanged for 0."""
        if dt_s <= 0.0:
            return self
        if math.isinf(self.sigma):
            return replace(self, thrust=thrust, sigma=THRUST_NOISE / math.sqrt(dt_s))
        variance = self.sigma**2
        gain = variance / (variance + THRUST_NOISE**2 / dt_s)
        corrected = self.thrust + gain * (thrust - self.thrust)
        return replace(self, thrust=corrected, sigma=math.sqrt((1.0 - gain) * variance))
