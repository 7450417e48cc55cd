"""The battery as the power management reports it: voltage, level, and the low-power state."""

from __future__ import annotations

from collections.abc import Mapping

BATTERY, LOW_POWER = 0, 3
LOW_DELAY_S = 5.0
_FILTER = 0.2  # at 25 Hz
# Voltages at which the level leaves 0, 10, ... 90 per cent.
_LEVELS_V = (3.00, 3.78, 3.83, 3.87, 3.89, 3.92, 3.96, 4.00, 4.04, 4.10)


class PowerMonitor:
    """`update` at 25 Hz. Low below `pm.lowVoltage` for 5 s (docs/firmware.md, "Link")."""

    def __init__(self, battery_v: float) -> None:
        self.battery_v = battery_v
        self.state = BATTERY
        self._fine_s = 0.0

    @property
    def level_percent(self) -> int:
        return 10 * max(0, sum(self.battery_v >= v for v in _LEVELS_V) - 1)

    def update(self, t_s: float, battery_v: float, parameters: Mapping[str, float]) -> None:
        self.battery_v += _FILTER * (battery_v - self.battery_v)
        if self.battery_v >= parameters["pm.lowVoltage"]:
            self._fine_s = t_s
        self.state = LOW_POWER if t_s - self._fine_s > LOW_DELAY_S else BATTERY
