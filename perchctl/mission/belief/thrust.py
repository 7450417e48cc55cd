"""A scalar Kalman filter for hover thrust; `perchctl.mission.belief.hover` supplies measurements.

Hover thrust T is the thrust, 0..65535, at which the vehicle neither rises nor sinks. With the
relative variance P (of the error divided by T) and a measurement z, the mean over a time dt,

    P += d^2 dt                       d: random walk of T, from battery and wind
    K = P / (P + r^2 / dt)            r: standard deviation of a measurement over one second
    T += K (z - T),  P = (1 - K) P
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.values import replace

MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE = 20000
"""Smallest thrust of the firmware's position mode, 0..65535 (docs/firmware.md)."""
ONE_SECOND_HOVER_THRUST_MEASUREMENT_SIGMA_FRACTION = 0.02
"""Standard deviation of a hover-thrust measurement averaged over one second, as a fraction of the
thrust; position control varies the thrust by 1 to 2 % for half a second. Larger: the filter adapts
too slowly to a sagging battery. Smaller: the filter learns these variations."""
HOVER_THRUST_RANDOM_WALK_FRACTION_PER_SQRT_S_IN_QUIET_FLIGHT = 0.01
"""Random walk of the hover thrust in quiet flight, as a fraction of the thrust per square root of a
second. Larger: the filter learns a lasting push. Smaller: the filter adapts too slowly to a sagging
battery."""
INITIAL_HOVER_THRUST_SIGMA_FRACTION_FROM_ACCELEROMETER = 0.03
"""Relative standard deviation of a hover thrust estimated from the accelerometer in flight, due to
the accelerometer's scale error. Larger: quiet flight just after take-off has more weight. Smaller:
quiet flight just after take-off has less weight."""
MAX_HOVER_THRUST_SIGMA_FRACTION_TO_COUNT_AS_PRECISE = 0.05
"""Relative standard deviation above which the hover thrust is too rough for a descent without
telemetry. Larger: the vehicle descends too fast. Smaller: the vehicle waits in the air for
longer."""


@dataclass(frozen=True)
class HoverThrustEstimate:
    """An estimate of hover thrust with its standard deviation.

    Attributes:
        raw_thrust: 0..65535; 0 while unknown.
        sigma_fraction: standard deviation, as a fraction of `raw_thrust`.
        estimate_before_descent: the estimate at the start of a descent by raw thrust; None before
            one.
    """

    raw_thrust: float = 0.0
    sigma_fraction: float = math.inf
    estimate_before_descent: HoverThrustEstimate | None = None

    @property
    def is_imprecise(self) -> bool:
        """True if the relative standard deviation of the hover thrust exceeds
        `MAX_HOVER_THRUST_SIGMA_FRACTION_TO_COUNT_AS_PRECISE`: neither quiet flight nor a descent
        has measured the hover thrust well enough. Also true while the hover thrust is unknown."""
        return self.sigma_fraction > MAX_HOVER_THRUST_SIGMA_FRACTION_TO_COUNT_AS_PRECISE

    def propagate(self, dt_s: float, random_walk_fraction_per_sqrt_s: float) -> HoverThrustEstimate:
        """Return the estimate `dt_s` later; its standard deviation has grown by a random walk of
        `random_walk_fraction_per_sqrt_s`, a fraction of the thrust per square root of a second."""
        return replace(
            self,
            sigma_fraction=math.sqrt(
                self.sigma_fraction**2 + random_walk_fraction_per_sqrt_s**2 * dt_s
            ),
        )

    def propagate_with_bounded_sigma(self, dt_s: float) -> HoverThrustEstimate:
        """Return the estimate `dt_s` later without a measurement. Its standard deviation grows as
        in quiet flight, but not beyond `INITIAL_HOVER_THRUST_SIGMA_FRACTION_FROM_ACCELEROMETER`,
        because the accelerometer always gives an estimate of that precision in flight. A larger
        standard deviation does not change."""
        sigma = self.propagate(
            dt_s, HOVER_THRUST_RANDOM_WALK_FRACTION_PER_SQRT_S_IN_QUIET_FLIGHT
        ).sigma_fraction
        return replace(
            self,
            sigma_fraction=min(
                sigma,
                max(self.sigma_fraction, INITIAL_HOVER_THRUST_SIGMA_FRACTION_FROM_ACCELEROMETER),
            ),
        )

    def with_measurement(self, mean_thrust: float, averaging_time_s: float) -> HoverThrustEstimate:
        """Return the estimate after a Kalman update with `mean_thrust`, 0..65535, the hover thrust
        measured as a mean over `averaging_time_s`. A longer time gives the measurement more weight;
        if it is 0, nothing changes. An estimate whose `sigma_fraction` is inf is replaced by the
        measurement."""
        if averaging_time_s <= 0.0:
            return self
        if math.isinf(self.sigma_fraction):
            return replace(
                self,
                raw_thrust=mean_thrust,
                sigma_fraction=ONE_SECOND_HOVER_THRUST_MEASUREMENT_SIGMA_FRACTION
                / math.sqrt(averaging_time_s),
            )
        variance = self.sigma_fraction**2
        gain = variance / (
            variance + ONE_SECOND_HOVER_THRUST_MEASUREMENT_SIGMA_FRACTION**2 / averaging_time_s
        )
        corrected = self.raw_thrust + gain * (mean_thrust - self.raw_thrust)
        return replace(
            self, raw_thrust=corrected, sigma_fraction=math.sqrt((1.0 - gain) * variance)
        )
