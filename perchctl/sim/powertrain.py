"""Four motors and the cell that feeds them: duty cycles in, newtons out.

- A motor's voltage is its duty cycle times the battery's. Its speed follows that voltage
  with a first-order lag, and its thrust is the curve at the voltage that belongs to the
  speed (`perchctl.sim.thrust_curve`): a motor that stands still takes longer to give
  thrust than one that turns already. The lag of 0.05 s is that of the caught slips in
  docs/firmware.md, "Catching a slip".
- Nothing brakes a brushed motor, so it runs down more slowly than it runs up.
  `MOTOR_COAST_S` is the value with which the fall after a lone notify, the landing, the
  take-offs and the attitude steps of that page come out nearest to what was measured,
  all at once.
- The cell (`perchctl.sim.cell`) gives 4.4 A at full thrust. Current and sag are proportional
  to thrust: the voltages beside the duty cycles of that page lie on one line within 0.06 V,
  0.63 V from no thrust to full.
"""

from __future__ import annotations

import math

from perchctl.sim.cell import RESISTANCE_OHM, Cell, CellKind
from perchctl.sim.scenario import CONTROL_PERIOD_S
from perchctl.sim.thrust_curve import (
    C0,
    C1,
    C2,
    C3,
    FULL_COMMAND,
    MOTOR_FORCE_N,
    STANDSTILL_V,
    thrust_n,
)

MOTOR_LAG_S = 0.05
MOTOR_COAST_S = 0.12
MOTOR_CURRENT_A = 1.1
_AMPERES_PER_N = MOTOR_CURRENT_A / MOTOR_FORCE_N

Forces = tuple[float, float, float, float]


class Powertrain:
    """`forces_n` M1..M4; `battery_v` the cell's voltage under their load."""

    def __init__(self, rest_v: float, kind: CellKind | None = None) -> None:
        self.cell = Cell(rest_v, kind or CellKind())
        self.battery_v = rest_v
        self.forces_n = (0.0, 0.0, 0.0, 0.0)
        self.strength: Forces | None = None  # what is left of each motor's thrust; None: all
        self._speeds_v = (0.0, 0.0, 0.0, 0.0)  # each as the voltage that would keep it
        self._up = 1.0 - math.exp(-CONTROL_PERIOD_S / MOTOR_LAG_S)
        self._down = 1.0 - math.exp(-CONTROL_PERIOD_S / MOTOR_COAST_S)

    def step(self, pwm: Forces) -> Forces:
        """The forces after one control period under four duty cycles 0..65535."""
        scale = self.battery_v / FULL_COMMAND
        up, down = self._up, self._down
        v1, v2, v3, v4 = self._speeds_v
        d1, d2, d3, d4 = pwm
        d1, d2, d3, d4 = scale * d1 - v1, scale * d2 - v2, scale * d3 - v3, scale * d4 - v4
        v1 += up * d1 if d1 > 0.0 else down * d1
        v2 += up * d2 if d2 > 0.0 else down * d2
        v3 += up * d3 if d3 > 0.0 else down * d3
        v4 += up * d4 if d4 > 0.0 else down * d4
        self._speeds_v = (v1, v2, v3, v4)
        # `thrust_n`, four times: 500 calls a second each would cost more than the cubic.
        still = STANDSTILL_V
        f1 = C0 + v1 * (C1 + v1 * (C2 + v1 * C3)) if v1 > still else 0.0
        f2 = C0 + v2 * (C1 + v2 * (C2 + v2 * C3)) if v2 > still else 0.0
        f3 = C0 + v3 * (C1 + v3 * (C2 + v3 * C3)) if v3 > still else 0.0
        f4 = C0 + v4 * (C1 + v4 * (C2 + v4 * C3)) if v4 > still else 0.0
        if self.strength is not None:
            s1, s2, s3, s4 = self.strength
            f1, f2, f3, f4 = s1 * f1, s2 * f2, s3 * f3, s4 * f4
        self.forces_n = forces = (f1, f2, f3, f4)
        self.battery_v = self.cell.step(_AMPERES_PER_N * (f1 + f2 + f3 + f4))
        return forces


def most_thrust_n(rest_v: float) -> float:
    """Four motors' steady thrust at the full duty cycle, from a cell of that resting voltage."""
    battery_v = rest_v
    for _ in range(30):
        forces_n = 4.0 * thrust_n(battery_v)
        battery_v += 0.5 * (rest_v - RESISTANCE_OHM * _AMPERES_PER_N * forces_n - battery_v)
    return forces_n
