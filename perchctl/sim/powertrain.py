"""Four motors and the cell that feeds them: commands in, newtons out.

- 0.12 N a motor at full command with a fresh battery, thrust proportional to the
  command, because the firmware compensates for the battery (docs/firmware.md, "Thrust
  budget"). What compensation cannot give back is the loss of `THRUST_LOSS_PER_V`:
  100 % at 4.2 V at rest, 95 % at 3.7 V.
- Thrust follows its command with a first-order lag. `MOTOR_LAG_S` is the value with
  which the raw burst, the dips after a change of setpoint mode and the take-off of the
  firmware's page come out nearest to what was measured, all at once.
- A 250 mAh cell: about 4.4 A at full thrust, and what that does to its voltage.
"""

from __future__ import annotations

import math
from math import sqrt

from perchctl.sim.scenario import CONTROL_PERIOD_S

FULL_COMMAND = 65535.0
MOTOR_FORCE_N = 0.12
MOTOR_LAG_S = 0.08
FRESH_BATTERY_V = 4.2
THRUST_LOSS_PER_V = 0.10
MOTOR_CURRENT_A = 1.1
CELL_RESISTANCE_OHM = 0.11
CELL_CHARGE_C = 900.0
CELL_SLOPE_V = 0.8  # resting voltage lost over the whole charge
# Power goes with thrust to 3/2: current over that power of the force.
_AMPERES = MOTOR_CURRENT_A / MOTOR_FORCE_N**1.5

Forces = tuple[float, float, float, float]


class Powertrain:
    """`forces_n` M1..M4; `rest_v` the cell's resting voltage, `battery_v` under load."""

    def __init__(self, rest_v: float) -> None:
        self.rest_v = rest_v
        self.battery_v = rest_v
        self.forces_n = (0.0, 0.0, 0.0, 0.0)
        self._lag = 1.0 - math.exp(-CONTROL_PERIOD_S / MOTOR_LAG_S)

    def step(self, motors: Forces) -> Forces:
        """The forces after one control period under four commands 0..65535."""
        loss = THRUST_LOSS_PER_V * (FRESH_BATTERY_V - self.rest_v)
        lag = self._lag
        keep, gain = 1.0 - lag, lag * MOTOR_FORCE_N * (1.0 - loss) / FULL_COMMAND
        f1, f2, f3, f4 = self.forces_n
        m1, m2, m3, m4 = motors
        f1, f2 = keep * f1 + gain * m1, keep * f2 + gain * m2
        f3, f4 = keep * f3 + gain * m3, keep * f4 + gain * m4
        self.forces_n = forces = (f1, f2, f3, f4)
        current_a = _AMPERES * (f1 * sqrt(f1) + f2 * sqrt(f2) + f3 * sqrt(f3) + f4 * sqrt(f4))
        self.rest_v -= current_a * CONTROL_PERIOD_S / CELL_CHARGE_C * CELL_SLOPE_V
        self.battery_v = self.rest_v - CELL_RESISTANCE_OHM * current_a
        return forces
