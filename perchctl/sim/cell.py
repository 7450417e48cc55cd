"""The cell that feeds the motors: charge, resting voltage, resistance, age.

- Resting voltage by charge: the levels in tenths by which the firmware tells a battery's
  state (`perchctl.sim.firmware.power`) are a discharge curve of the Crazyflie's own cell.
  It is flat in the middle and falls ever faster below a tenth, where 24 s of hovering take
  0.7 V; what lies between 0 and 10 per cent is shaped as lithium polymer cells fall off.
- The voltage falls under load by the cell's resistance at once, and in an old or cold cell
  by some more within `SLOW_S`: ions that have to come from farther away.
- An old cell holds less charge and has more resistance; `knee` says at which part of the
  charge its steep end begins.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass

from perchctl.sim.scenario import CONTROL_PERIOD_S

CHARGE_C = 900.0
"""250 mAh."""
RESISTANCE_OHM = 0.143
SLOW_S = 15.0
KNEE = 0.1
_CURVE: tuple[tuple[float, float], ...] = (
    (-0.02, 2.5), (0.0, 3.0), (0.01, 3.3), (0.025, 3.52), (0.05, 3.67), (0.1, 3.78),
    (0.2, 3.83), (0.3, 3.87), (0.4, 3.89), (0.5, 3.92), (0.6, 3.96), (0.7, 4.0),
    (0.8, 4.04), (0.9, 4.1), (1.0, 4.2), (1.05, 4.3),
)  # fmt: skip
_ENDS = tuple(x for x, _ in _CURVE[1:])  # of its straight parts
_EMPTY_V, _FULL_V = _CURVE[0][1], _CURVE[-1][1]


@dataclass(frozen=True)
class CellKind:
    """Beside its resting voltage: the resistance that acts at once and the one that acts
    slowly, the charge that an old cell still holds as a share, and where the steep end begins."""

    resistance_ohm: float = RESISTANCE_OHM
    slow_ohm: float = 0.0
    charge: float = 1.0
    knee: float = KNEE


class Cell:
    """`rest_v` its resting voltage, `battery_v` under load."""

    def __init__(self, rest_v: float, kind: CellKind) -> None:
        self._kind = kind
        self._left = _charge_at(rest_v, kind.knee)
        self._offset_v = rest_v - _resting_v(self._left, kind.knee)
        self._slow_v = 0.0
        self._per_step = CONTROL_PERIOD_S / (CHARGE_C * kind.charge)
        self._slowly = 1.0 - math.exp(-CONTROL_PERIOD_S / SLOW_S)
        self._rest_v = self.battery_v = rest_v

    @property
    def rest_v(self) -> float:
        return self._rest_v

    @rest_v.setter
    def rest_v(self, rest_v: float) -> None:
        """Another voltage, and the charge as it was: it goes on to fall as it would have."""
        self._offset_v += rest_v - self._rest_v
        self._rest_v = rest_v

    def step(self, current_a: float) -> float:
        """The voltage under load after one control period of a current."""
        kind = self._kind
        self._left -= current_a * self._per_step
        self._slow_v += self._slowly * (kind.slow_ohm * current_a - self._slow_v)
        self._rest_v = rest_v = _resting_v(self._left, kind.knee) + self._offset_v
        self.battery_v = rest_v - kind.resistance_ohm * current_a - self._slow_v
        return self.battery_v


def _resting_v(left: float, knee: float) -> float:
    tenth = 0.1 * left / knee if left < knee else 0.1 + 0.9 * (left - knee) / (1.0 - knee)
    i = bisect_right(_ENDS, tenth)
    if i == len(_ENDS):
        return _FULL_V
    (x0, v0), (x1, v1) = _CURVE[i], _CURVE[i + 1]
    return max(_EMPTY_V, v0 + (tenth - x0) * (v1 - v0) / (x1 - x0))


def _charge_at(rest_v: float, knee: float) -> float:
    """The charge that belongs to a resting voltage; at the curve's ends where it is beyond."""
    low, high = 0.0, 1.05
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _resting_v(middle, knee) < rest_v else (low, middle)
    return low
