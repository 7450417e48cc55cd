"""One motor's thrust against its voltage: what the rotor gives, and what the firmware inverts.

The curve is the firmware's own for the propellers of the Crazyflie 2.1+ (its platform
defaults, release 2026.08, from a thrust stand): a cubic in the motor's mean voltage,
which is the duty cycle times the battery's voltage. Below `STANDSTILL_V` the cubic is
negative: the motor stands still. The duty cycles of docs/firmware.md, "Thrust to PWM",
for seven thrust commands follow from it within half a per cent.
"""

from __future__ import annotations

from math import cbrt, sqrt

FULL_COMMAND = 65535.0
"""Both of the thrust command and of the duty cycle (PWM)."""
MOTOR_FORCE_N = 0.12
"""Thrust of one motor at `FULL_COMMAND`, any battery that can still give it."""
THRUST_MIN_N = 0.012817578393224994
"""A command below this is no thrust at all: PWM 0 (a command of 7000)."""

C0, C1, C2, C3 = (
    -0.02476537915958403,
    0.06523793527519485,
    -0.026792504967750107,
    0.006776789303971145,
)

# The cubic has one real root for every thrust: Cardano, with all that is constant
# taken out. q is linear in the thrust.
_P = -C2 / (3.0 * C3)
_Q = _P**3 + (C2 * C1 - 3.0 * C3 * C0) / (6.0 * C3 * C3)
_Q_PER_N = 1.0 / (2.0 * C3)
_D = (C1 / (3.0 * C3) - _P * _P) ** 3


def motor_v(thrust_n: float) -> float:
    """The motor voltage at which one motor gives `thrust_n`."""
    q = _Q + _Q_PER_N * thrust_n
    s = sqrt(q * q + _D)
    return cbrt(q + s) + cbrt(q - s) + _P


STANDSTILL_V = motor_v(0.0)
"""0.45 V: the dead band."""


def thrust_n(volts: float) -> float:
    """The steady thrust of one motor at a motor voltage."""
    if volts <= STANDSTILL_V:
        return 0.0
    return C0 + volts * (C1 + volts * (C2 + volts * C3))
