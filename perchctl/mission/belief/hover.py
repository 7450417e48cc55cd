"""Measure hover thrust for the filter in `perchctl.mission.belief.thrust`.

Hover thrust is the reference for every proof of contact and for a descent by raw thrust. In quiet
flight, the measurement is the thrust itself (`learn_hover_thrust_in_quiet_flight`). In a descent by
raw thrust, the measurement is the thrust divided by the specific force
(`learn_hover_thrust_in_descent`). Before either has happened, `estimate_hover_thrust` falls back on
the accelerometer, with a larger standard deviation. The estimate is wrong while something
undetected supports part of the weight. After a long descent, the estimate contains the scale error
of the accelerometer.
"""

from __future__ import annotations

import math

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.thrust import (
    INITIAL_HOVER_THRUST_SIGMA_FRACTION_FROM_ACCELEROMETER,
    MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE,
    HoverThrustEstimate,
)
from perchctl.values import replace

HOVER_THRUST_RANDOM_WALK_FRACTION_PER_SQRT_S_IN_DESCENT = 0.067
"""Random walk of the hover thrust in a descent by raw thrust, as a fraction of the thrust per
square root of a second. Larger: vibration changes the thrust. Smaller: in wind, the vehicle sinks
too fast for a longer time."""
FALLBACK_HOVER_THRUST_SIGMA_FRACTION = 0.12
"""Relative standard deviation of a hover thrust estimated from the accelerometer alone, while the
vehicle may have been supported. Larger: a descent may correct the estimate further. Smaller: a
wrong estimate persists."""
MIN_HOVER_THRUST_SIGMA_FRACTION_AT_DESCENT_START = 0.04
"""Smallest relative standard deviation of the hover thrust at the start of a descent. Larger:
contact with an obstacle corrupts the estimate. Smaller: with a weak battery, the vehicle sinks too
fast."""
MAX_HOVER_THRUST_CORRECTION_IN_DESCENT_SIGMAS = 3.0
"""Largest correction of the hover thrust during a descent, in standard deviations at the start of
the descent. Larger: contact with an obstacle corrupts the estimate. Smaller: with a weak battery,
the vehicle sinks too fast."""
MAX_THRUST_DEVIATION_FRACTION_TO_LEARN_HOVER_THRUST = 0.2
"""Largest relative difference between the thrust in quiet flight and the estimated hover thrust; a
larger difference means that the ceiling or a hand holds the vehicle. Larger: a held vehicle
corrupts the estimate. Smaller: a real change is rejected."""
COMMAND_TO_ROTOR_THRUST_LAG_TIME_CONSTANT_S = 0.06
"""Time constant with which the rotors follow a commanded thrust, s (docs/firmware.md; 50 to 80 ms
in real flights). Larger or smaller: a step in the thrust corrupts the estimated hover thrust."""
MAX_TELEMETRY_AGE_TO_LEARN_HOVER_THRUST_S = 1.0
"""Age beyond which telemetry says nothing about the present thrust, s."""
MIN_SPECIFIC_FORCE_TO_LEARN_HOVER_THRUST_G = 0.7
"""Smallest specific force at which thrust divided by specific force measures hover thrust, g.
Smaller: a fall corrupts the estimate."""
MAX_SPECIFIC_FORCE_TO_LEARN_HOVER_THRUST_G = 1.3
"""Largest specific force at which thrust divided by specific force measures hover thrust, g.
Larger: an impact corrupts the estimate."""
MIN_DESCENT_TO_HOVER_THRUST_RATIO_TO_LEARN_HOVER_THRUST = 0.5
"""Fraction of the hover thrust at the start of the descent below which thrust is not proportional
to force, so nothing is learned from such a thrust."""
SPECIFIC_FORCE_LOWER_CLAMP_FOR_HOVER_THRUST_G = 0.75
"""Smallest specific force by which the thrust of a single sample is divided, g; a lower one is
raised to this value."""
SPECIFIC_FORCE_UPPER_CLAMP_FOR_HOVER_THRUST_G = 1.5
"""Largest specific force by which the thrust of a single sample is divided, g; a higher one is
lowered to this value."""


def estimate_hover_thrust(b: Belief) -> HoverThrustEstimate:
    """Return the hover thrust measured by the filter (`HoverThrustEstimate`). Before the first
    measurement, return the mean ratio of thrust (0..65535) to specific force (g) in flight or, if
    there is none, the ratio in the newest sample. Both fallbacks have the standard deviation
    `FALLBACK_HOVER_THRUST_SIGMA_FRACTION`."""
    if b.hover_thrust_estimate.raw_thrust > 0.0:
        return b.hover_thrust_estimate
    tel = b.telemetry
    divisor_g = min(
        SPECIFIC_FORCE_UPPER_CLAMP_FOR_HOVER_THRUST_G,
        max(SPECIFIC_FORCE_LOWER_CLAMP_FOR_HOVER_THRUST_G, tel.acc_z_g),
    )
    sample = max(MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE, tel.thrust / divisor_g)
    return HoverThrustEstimate(
        b.imu.mean_raw_thrust_per_g or sample, FALLBACK_HOVER_THRUST_SIGMA_FRACTION
    )


def filter_rotor_thrust(b: Belief, dt_s: float) -> float:
    """Return the thrust, 0..65535, that the rotors produce `dt_s` after the previous sample: the
    reported thrust through a first-order lag with the time constant
    `COMMAND_TO_ROTOR_THRUST_LAG_TIME_CONSTANT_S`. At first, it is the reported thrust itself."""
    before, read = b.lagged_rotor_raw_thrust, b.telemetry.thrust
    if before is None:
        return read
    return before + (1.0 - math.exp(-dt_s / COMMAND_TO_ROTOR_THRUST_LAG_TIME_CONSTANT_S)) * (
        read - before
    )


def learn_hover_thrust_in_quiet_flight(b: Belief, dt_s: float) -> HoverThrustEstimate:
    """Return the estimated hover thrust after a tick of quiet flight, in which the reported thrust,
    0..65535, measures hover thrust. `dt_s` is the time since the previous telemetry sample, 0 if
    this tick has no new sample.

    The first estimate is the recent mean of thrust per measured g
    (`ImuMotion.mean_raw_thrust_per_g`) or, if that is 0 (unknown), the reported thrust. Later, the
    estimate does not change in a tick whose thrust differs from it by more than
    `MAX_THRUST_DEVIATION_FRACTION_TO_LEARN_HOVER_THRUST`, because the ceiling or a hand then holds
    the vehicle.
    """
    thrust, old = b.telemetry.thrust, b.hover_thrust_estimate
    if old.raw_thrust == 0.0:
        return HoverThrustEstimate(
            b.imu.mean_raw_thrust_per_g or thrust,
            INITIAL_HOVER_THRUST_SIGMA_FRACTION_FROM_ACCELEROMETER,
        )
    if abs(thrust / old.raw_thrust - 1.0) > MAX_THRUST_DEVIATION_FRACTION_TO_LEARN_HOVER_THRUST:
        return old  # the ceiling or a hand holds the vehicle
    return old.with_measurement(thrust, dt_s)


def learn_hover_thrust_in_descent(b: Belief, dt_s: float) -> HoverThrustEstimate:
    """Return the hover thrust (0..65535) after a tick of a descent by raw thrust: a Kalman update
    with the thrust that the rotors produce, which lags the reported thrust, divided by the specific
    force along the body's z axis in g. `dt_s` is the time since the previous telemetry sample, 0
    if this tick has no new sample. The result is clamped to within
    `MAX_HOVER_THRUST_CORRECTION_IN_DESCENT_SIGMAS` standard deviations of the estimate from before
    the descent.

    The estimate does not change while the floor or a magnet may support part of the weight, or
    while the telemetry is too old or outside the range in which thrust is proportional to force.
    """
    tel, old = b.telemetry, estimate_hover_thrust(b)
    thrust = tel.thrust if b.lagged_rotor_raw_thrust is None else b.lagged_rotor_raw_thrust
    start = old.estimate_before_descent or HoverThrustEstimate(
        old.raw_thrust, max(MIN_HOVER_THRUST_SIGMA_FRACTION_AT_DESCENT_START, old.sigma_fraction)
    )
    first, sigma = start.raw_thrust, start.sigma_fraction
    old = replace(old, estimate_before_descent=start)
    shows = (
        MIN_SPECIFIC_FORCE_TO_LEARN_HOVER_THRUST_G
        <= tel.acc_z_g
        <= MAX_SPECIFIC_FORCE_TO_LEARN_HOVER_THRUST_G
        and thrust >= MIN_DESCENT_TO_HOVER_THRUST_RATIO_TO_LEARN_HOVER_THRUST * first
    )
    is_on_floor = b.command_history.floor_detected_at_s is not None
    if (
        b.attitude_age_s > MAX_TELEMETRY_AGE_TO_LEARN_HOVER_THRUST_S
        or not shows
        or b.is_possibly_in_magnet_reach
        or is_on_floor
    ):
        return old
    new = old.propagate(
        dt_s, HOVER_THRUST_RANDOM_WALK_FRACTION_PER_SQRT_S_IN_DESCENT
    ).with_measurement(thrust / tel.acc_z_g, dt_s)
    most = MAX_HOVER_THRUST_CORRECTION_IN_DESCENT_SIGMAS * sigma
    return replace(
        new, raw_thrust=min((1.0 + most) * first, max((1.0 - most) * first, new.raw_thrust))
    )
