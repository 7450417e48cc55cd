"""Motors and battery as the firmware sees them: duty cycles, and the battery's state."""

from __future__ import annotations

from collections.abc import Mapping

from perchctl.sim.powertrain import FULL_COMMAND, MOTOR_FORCE_N, THRUST_MIN_N, motor_v
from perchctl.sim.scenario import CONTROL_PERIOD_S

Motors = tuple[float, float, float, float]
MOTORS_OFF: Motors = (0.0, 0.0, 0.0, 0.0)

# --- Power distribution: four thrust requests in, four duty cycles (PWM) out -------------------
# In the firmware's order (source: power distribution, motor driver and stabiliser of release
# 2026.08): the battery's voltage is compensated by the inverted thrust curve first, then what
# exceeds the full duty cycle is taken off all four. More than 0.12 N may so be requested of one
# motor, and is given while the battery suffices: a yaw step at hover costs no height
# (docs/firmware.md, "Yaw step").

SUPPLY_AT_BOOT_V = 4.2
SUPPLY_FILTER = 0.01  # of each sample, at `SUPPLY_RATE_HZ`
SUPPLY_RATE_HZ = 1000.0
SUPPLY_LEAST_V = 2.0  # below this the reading is taken for broken: no thrust
THRUST_MIN = FULL_COMMAND * THRUST_MIN_N / MOTOR_FORCE_N

_KEEP = (1.0 - SUPPLY_FILTER) ** (SUPPLY_RATE_HZ * CONTROL_PERIOD_S)
_N_PER_COMMAND = MOTOR_FORCE_N / FULL_COMMAND


class MotorDriver:
    """`requested`: the duty cycles before the cap (`motor.m1req`)."""

    def __init__(self) -> None:
        self.requested: Motors = MOTORS_OFF
        # Low-passed with 0.1 s: the compensation meets a sagging battery late.
        self._supply_v = SUPPLY_AT_BOOT_V

    def pwm(self, requests: Motors, battery_v: float) -> Motors:
        """Duty cycles 0..65535 for thrust requests; `MOTORS_OFF` itself when all are 0."""
        self._supply_v = supply_v = battery_v + _KEEP * (self._supply_v - battery_v)
        if requests is MOTORS_OFF or supply_v < SUPPLY_LEAST_V:
            self.requested = MOTORS_OFF
            return MOTORS_OFF
        scale = FULL_COMMAND / supply_v
        p1, p2, p3, p4 = (
            scale * motor_v(_N_PER_COMMAND * request) if request >= THRUST_MIN else 0.0
            for request in requests
        )
        self.requested = pwm = (p1, p2, p3, p4)
        if max(pwm) == 0.0:
            return MOTORS_OFF
        excess = max(pwm) - FULL_COMMAND
        if excess > 0.0:
            # Attitude comes before thrust: all four give way together.
            p1, p2, p3, p4 = (max(0.0, duty - excess) for duty in pwm)
        return (p1, p2, p3, p4)


# --- The battery as the power management reports it: voltage, level, low-power state -----------


ON_BATTERY, LOW_POWER = 0, 3
LOW_DELAY_S = 5.0
_BATTERY_FILTER = 0.2  # at 25 Hz
# Voltages at which the level leaves 0, 10, ... 90 per cent.
_LEVELS_V = (3.00, 3.78, 3.83, 3.87, 3.89, 3.92, 3.96, 4.00, 4.04, 4.10)


class PowerMonitor:
    """`update` at 25 Hz. Low below `pm.lowVoltage` for 5 s (docs/firmware.md, "Link")."""

    def __init__(self, battery_v: float) -> None:
        self.battery_v = battery_v
        self.state = ON_BATTERY
        self._fine_s = 0.0

    @property
    def level_percent(self) -> int:
        return 10 * max(0, sum(self.battery_v >= v for v in _LEVELS_V) - 1)

    def update(self, t_s: float, battery_v: float, parameters: Mapping[str, float]) -> None:
        self.battery_v += _BATTERY_FILTER * (battery_v - self.battery_v)
        if self.battery_v >= parameters["pm.lowVoltage"]:
            self._fine_s = t_s
        self.state = LOW_POWER if t_s - self._fine_s > LOW_DELAY_S else ON_BATTERY
