"""Four motors and the battery cell that feeds them, from duty cycles to thrust.

- A motor's voltage is its duty cycle times the battery voltage. The motor's speed follows that
  voltage with a lag, and its thrust is the value of the thrust curve at the voltage that
  corresponds to the speed (`thrust_n`).
- The faster the motor turns, the shorter the lag. To keep a motor at speed w, the voltage must be
  a w + b w^2 (back EMF and aerodynamic torque), so 1 / lag is proportional to a + 2 b w, and its
  square rises linearly with that voltage. At hover, the lag is the 0.05 s of docs/firmware.md,
  "Catching a slip". At standstill it is `STANDING_LAG_S`, with which simulated slips lose
  as much height as the slips measured in docs/firmware.md.
- Nothing brakes a brushed motor without a voltage: at duty 0 it runs down with the time constant
  `MOTOR_COAST_S`, the value that best fits the falls, landings and take-offs measured in
  docs/firmware.md. At any other duty, recorded flights show the same lag in both directions
  (`Scenario.motors_brake`).
- Motors of the same kind differ (`Scenario.motor_strength`), and the thrust of each fluctuates
  (`Scenario.thrust_noise`): a first-order Gauss-Markov process, independent for each motor.
- The cell (`Cell`) supplies 4.4 A at full thrust. Current and voltage sag are proportional to
  thrust: the voltages that docs/firmware.md lists with the duty cycles lie within 0.06 V of a
  straight line, with a sag of 0.63 V at full thrust.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from math import cbrt, sqrt

import numpy as np

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.airframe import CRAZYFLIE_21, ThrustCurve
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

# --- One motor's thrust as a function of its voltage, and the inverse that the firmware uses ---
# The curves are in `perchctl.sim.airframe`. Below the voltage at which the thrust is 0, the cubic
# is negative: the motor does not turn (docs/firmware.md, "Thrust to PWM").


FULL_COMMAND = 65535.0
"""Full scale of both the thrust command and the duty cycle (PWM)."""
MOTOR_FORCE_N = CRAZYFLIE_21.thrust.most_n
"""Thrust of one motor at `FULL_COMMAND`, with any battery that can still supply it."""

VoltageFunction = Callable[[float], float]


def inverse_thrust(curve: ThrustCurve) -> VoltageFunction:
    """Return the function that converts one motor's thrust, N, to its voltage."""
    # The cubic has one real root for every thrust (Cardano). All constant terms are computed in
    # advance; q is linear in the thrust.
    c0, c1, c2, c3 = curve.coefficients
    p = -c2 / (3.0 * c3)
    q0 = p**3 + (c2 * c1 - 3.0 * c3 * c0) / (6.0 * c3 * c3)
    q_per_n = 1.0 / (2.0 * c3)
    d = (c1 / (3.0 * c3) - p * p) ** 3

    def motor_voltage(thrust_n: float) -> float:
        q = q0 + q_per_n * thrust_n
        s = sqrt(q * q + d)
        return cbrt(q + s) + cbrt(q - s) + p

    return motor_voltage


def steady_thrust(curve: ThrustCurve) -> VoltageFunction:
    """Return the function that converts a motor voltage to one motor's steady thrust, N."""
    c0, c1, c2, c3 = curve.coefficients
    standstill_v = inverse_thrust(curve)(0.0)

    def thrust_n(volts: float) -> float:
        """Return one motor's steady thrust, N, at a motor voltage."""
        if volts <= standstill_v:
            return 0.0
        return c0 + volts * (c1 + volts * (c2 + volts * c3))

    return thrust_n


motor_voltage, thrust_n = inverse_thrust(CRAZYFLIE_21.thrust), steady_thrust(CRAZYFLIE_21.thrust)
"""The thrust functions for the motors of a Crazyflie 2.1."""
STANDSTILL_V = motor_voltage(0.0)
"""Voltage up to which the motor does not turn (its dead band): 0.45 V."""


# --- The cell that feeds the motors: charge, resting voltage, resistance, age ---
# - Resting voltage by charge: the voltages from which the firmware derives the battery level in
#   tenths (source: power management) are a discharge curve of the Crazyflie's own cell.
# - Under load, the cell's resistance makes the voltage fall at once. In an old or cold cell, it
#   falls further, with the time constant `ION_DIFFUSION_S`, because ions have to diffuse over a
#   longer distance.
# - An old cell holds less charge and has more resistance; `knee` is the share of the charge at
#   which the steep end of the curve begins.


CHARGE_C = 900.0
"""Charge of the cell, C: 250 mAh."""
RESISTANCE_OHM = 0.143
ION_DIFFUSION_S = 15.0
_CELL_CURVE: tuple[tuple[float, float], ...] = (
    (-0.02, 2.5),
    (0.0, 3.0),
    (0.01, 3.3),
    (0.025, 3.52),
    (0.05, 3.67),
    (0.1, 3.78),
    (0.2, 3.83),
    (0.3, 3.87),
    (0.4, 3.89),
    (0.5, 3.92),
    (0.6, 3.96),
    (0.7, 4.0),
    (0.8, 4.04),
    (0.9, 4.1),
    (1.0, 4.2),
    (1.05, 4.3),
)
_CELL_ENDS = tuple(x for x, _ in _CELL_CURVE[1:])  # charges at which the curve's segments end
_EMPTY_V, _FULL_V = _CELL_CURVE[0][1], _CELL_CURVE[-1][1]


class Cell:
    """A battery cell: `rest_v` is its resting voltage, `battery_v` its voltage under load.

    Args:
        ohm, slow_ohm: the resistance that acts at once, and the one that acts slowly.
        charge: an old cell's capacity as a share of a new one's.
        knee: share of the charge below which the voltage falls steeply.
    """

    def __init__(
        self,
        rest_v: float,
        ohm: float = RESISTANCE_OHM,
        slow_ohm: float = 0.0,
        charge: float = 1.0,
        knee: float = 0.1,
    ) -> None:
        self._ohm, self._slow_ohm, self._knee = ohm, slow_ohm, knee
        self._left = _charge_at(rest_v, knee)
        self._offset_v = rest_v - _resting_v(self._left, knee)
        self._slow_v = 0.0
        self._per_step = CONTROL_PERIOD_S / (CHARGE_C * charge)
        self._slowly = 1.0 - math.exp(-CONTROL_PERIOD_S / ION_DIFFUSION_S)
        self.rest_v = self.battery_v = rest_v

    def set_rest_v(self, rest_v: float) -> None:
        """Set the resting voltage without changing the charge."""
        self._offset_v += rest_v - self.rest_v
        self.rest_v = rest_v

    def step(self, current_a: float) -> None:
        """Discharge the cell with a current for one control period."""
        self._left -= current_a * self._per_step
        self._slow_v += self._slowly * (self._slow_ohm * current_a - self._slow_v)
        self.rest_v = _resting_v(self._left, self._knee) + self._offset_v
        self.battery_v = self.voltage_at(current_a)

    def voltage_at(self, current_a: float) -> float:
        """Return the voltage under load, V, if the current changed to `current_a` now."""
        return self.rest_v - self._ohm * current_a - self._slow_v


def _resting_v(left: float, knee: float) -> float:
    tenth = 0.1 * left / knee if left < knee else 0.1 + 0.9 * (left - knee) / (1.0 - knee)
    i = bisect_right(_CELL_ENDS, tenth)
    if i == len(_CELL_ENDS):
        return _FULL_V
    (x0, v0), (x1, v1) = _CELL_CURVE[i], _CELL_CURVE[i + 1]
    return max(_EMPTY_V, v0 + (tenth - x0) * (v1 - v0) / (x1 - x0))


def _charge_at(rest_v: float, knee: float) -> float:
    low, high = 0.0, 1.05
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _resting_v(middle, knee) < rest_v else (low, middle)
    return low


# --- Four motors and the cell that feeds them: duty cycles in, thrusts out ---


MOTOR_LAG_S = 0.05
STANDING_LAG_S = 0.18
MOTOR_COAST_S = 0.12
FLUCTUATION_S = 0.02
"""Time constant of the fluctuation of a motor's thrust, s."""
MOTOR_CURRENT_A = 1.1
_AMPERES_PER_N = MOTOR_CURRENT_A / MOTOR_FORCE_N
# In one control period, the speed covers the share sqrt(_STANDING + per_v * v) of its distance to
# the goal.
_STANDING = (CONTROL_PERIOD_S / STANDING_LAG_S) ** 2

_FLUCTUATION_STREAM = 24
_FLUCTUATION_BATCH = 4096
ForcesN = tuple[float, float, float, float]


class Powertrain:
    """Four motors M1..M4, with thrusts `forces_n`, powered by the scenario's `cell`."""

    def __init__(self, scenario: Scenario) -> None:
        ohm = scenario.cell_resistance_ohm
        self.cell = Cell(
            scenario.battery_rest_v,
            RESISTANCE_OHM if ohm is None else ohm,
            scenario.cell_slow_ohm,
            scenario.cell_charge,
            scenario.cell_knee,
        )
        self.forces_n = (0.0, 0.0, 0.0, 0.0)
        self.steady_lift_n = 0.0  # sum of the thrusts without their fluctuation
        self.strength = scenario.motor_strength  # each motor's thrust relative to the curve
        self._fluctuation = Fluctuation(scenario) if scenario.thrust_noise else None
        self._speeds_v = [0.0] * 4  # each motor's speed, as the voltage that would sustain it
        self._brakes = scenario.motors_brake
        self._coasting = 1.0 - math.exp(-CONTROL_PERIOD_S / MOTOR_COAST_S)
        curve = scenario.airframe.thrust
        self._thrust_n, self._most_n = steady_thrust(curve), curve.most_n
        hover_v = inverse_thrust(curve)(0.042 * GRAVITY_MPS2 / 4.0)
        self._per_v = ((CONTROL_PERIOD_S / MOTOR_LAG_S) ** 2 - _STANDING) / hover_v

    def step(self, duty_cycles: tuple[float, float, float, float]) -> ForcesN:
        """Advance by a control period at duty cycles 0..65535; return the motors' thrusts, N."""
        scale, per_v = self.cell.battery_v / FULL_COMMAND, self._per_v
        for motor, duty in enumerate(duty_cycles):
            speed_v = self._speeds_v[motor]
            missing_v = scale * duty - speed_v
            driven = missing_v > 0.0 or (self._brakes and duty > 0.0)
            share = sqrt(_STANDING + per_v * speed_v) if driven else self._coasting
            self._speeds_v[motor] = speed_v + share * missing_v
        s1, s2, s3, s4 = self.strength
        f1, f2, f3, f4 = map(self._thrust_n, self._speeds_v)
        self.steady_lift_n = s1 * f1 + s2 * f2 + s3 * f3 + s4 * f4
        if self._fluctuation is not None:
            n1, n2, n3, n4 = self._fluctuation.step()
            s1, s2, s3, s4 = s1 + n1, s2 + n2, s3 + n3, s4 + n4
        self.forces_n = f1, f2, f3, f4 = s1 * f1, s2 * f2, s3 * f3, s4 * f4
        self.cell.step(_AMPERES_PER_N * (f1 + f2 + f3 + f4))
        return self.forces_n

    def max_balanced_thrust_n(self) -> float:
        """Return the steady thrust of four motors as strong as the weakest one, at full duty with
        the cell as it is now. Stronger motors cannot add to it, since the vehicle would tilt."""
        cell, weakest = self.cell, min(self.strength or (1.0,))
        battery_v = cell.battery_v
        for _ in range(30):
            forces_n = weakest * min(4.0 * self._thrust_n(battery_v), 4.0 * self._most_n)
            battery_v += 0.5 * (cell.voltage_at(_AMPERES_PER_N * forces_n) - battery_v)
        return forces_n


class Fluctuation:
    """Fluctuations of the thrust of four motors, relative to their thrust."""

    def __init__(self, scenario: Scenario) -> None:
        self._rng = np.random.default_rng([scenario.seed, _FLUCTUATION_STREAM])
        self._keep = math.exp(-CONTROL_PERIOD_S / FLUCTUATION_S)
        self._kick = scenario.thrust_noise * math.sqrt(1.0 - self._keep**2)
        self._white: list[float] = []
        self._now = (0.0, 0.0, 0.0, 0.0)

    def step(self) -> tuple[float, float, float, float]:
        """Return the fluctuation one control period later."""
        if not self._white:
            self._white = (self._kick * self._rng.standard_normal(_FLUCTUATION_BATCH)).tolist()
        keep, take, (a, b, c, d) = self._keep, self._white.pop, self._now
        self._now = keep * a + take(), keep * b + take(), keep * c + take(), keep * d + take()
        return self._now
