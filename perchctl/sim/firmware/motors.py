"""Power distribution: four thrust requests in, four duty cycles (PWM) out.

In the firmware's order (source: power distribution, motor driver and stabiliser of
release 2026.08): the battery's voltage is compensated by the inverted thrust curve
first, then what exceeds the full duty cycle is taken off all four. More than 0.12 N may
so be requested of one motor, and is given while the battery suffices: a yaw step at hover
costs no height (docs/firmware.md, "Yaw step").
"""

from __future__ import annotations

from perchctl.sim.powertrain import FULL_COMMAND, MOTOR_FORCE_N, THRUST_MIN_N, motor_v
from perchctl.sim.scenario import CONTROL_PERIOD_S

Motors = tuple[float, float, float, float]
MOTORS_OFF: Motors = (0.0, 0.0, 0.0, 0.0)

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
        m1, m2, m3, m4 = requests
        p1 = scale * motor_v(_N_PER_COMMAND * m1) if m1 >= THRUST_MIN else 0.0
        p2 = scale * motor_v(_N_PER_COMMAND * m2) if m2 >= THRUST_MIN else 0.0
        p3 = scale * motor_v(_N_PER_COMMAND * m3) if m3 >= THRUST_MIN else 0.0
        p4 = scale * motor_v(_N_PER_COMMAND * m4) if m4 >= THRUST_MIN else 0.0
        self.requested = pwm = (p1, p2, p3, p4)
        most = max(pwm)
        if most == 0.0:
            return MOTORS_OFF
        if most > FULL_COMMAND:
            # Attitude comes before thrust: all four give way together.
            excess = most - FULL_COMMAND
            return (
                max(0.0, p1 - excess),
                max(0.0, p2 - excess),
                max(0.0, p3 - excess),
                max(0.0, p4 - excess),
            )
        return pwm
