"""The firmware's own tests of propellers and battery (docs/firmware.md, "Health tests")."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from perchctl.sim.firmware.motors import MOTORS_OFF, Motors
from perchctl.sim.powertrain import FULL_COMMAND, MOTOR_FORCE_N
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

PROPELLERS, BATTERY = "startPropTest", "startBatTest"
REST_S, ON_S, PERIOD_S, SENSED_S = 0.1, 0.05, 1.0, 0.1
BATTERY_S = 0.05
PROPELLER_PWM, BATTERY_PWM = float(FULL_COMMAND), 40000.0
MOST_SAG_V = 0.70
FINISHED = 1 << 7
DEAD_G2 = 0.01  # `variance` of a motor that does not turn
SAMPLES = 100  # of the accelerometer; their squares are summed, not averaged
_STREAM = 9
_NOISE_G = 0.004


def _steps(seconds: float) -> int:
    return round(seconds / CONTROL_PERIOD_S)


class Health:
    """`testing` is the parameter that began what runs now, or empty.

    `variance` holds x and y of each motor, g^2 summed over `SAMPLES`.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._shake_g = scenario.propeller_shake_g
        self._rng = np.random.default_rng([scenario.seed, _STREAM])
        self._step = 0
        self._samples: list[tuple[float, float]] = []
        self._idle_v = self._least_v = 0.0
        self.testing = ""
        self.variance = [(0.0, 0.0)] * 4
        self.motor_pass = self.battery_pass = self.motor_tests = 0
        self.sag_v = 0.0

    def start(self, test: str) -> None:
        self.testing, self._step, self._samples = test, 0, []
        if test == PROPELLERS:
            self.motor_pass = 0
        else:
            self.battery_pass = 0

    def pwm(
        self, forces_n: Sequence[float], battery_v: float, parameters: Mapping[str, float]
    ) -> Motors:
        """The duty cycles of one control period, given what the motors do and the battery has."""
        if self._step == 0:
            self._idle_v = self._least_v = battery_v
        step = self._step
        self._step += 1
        if self.testing == BATTERY:
            return self._battery(step, battery_v)
        return self._propellers(step - _steps(REST_S), forces_n, parameters)

    def _battery(self, step: int, battery_v: float) -> Motors:
        self._least_v = min(self._least_v, battery_v)
        if step < _steps(BATTERY_S):
            return (BATTERY_PWM,) * 4
        self.sag_v = self._idle_v - self._least_v
        self.battery_pass = int(self.sag_v <= MOST_SAG_V)
        self.testing = ""
        return MOTORS_OFF

    def _propellers(
        self, step: int, forces_n: Sequence[float], parameters: Mapping[str, float]
    ) -> Motors:
        """`step` counts from the first motor's start; before it the noise is measured."""
        motor, within = divmod(step, _steps(PERIOD_S))
        if step < 0:
            return MOTORS_OFF
        if motor == 4:
            self._judge(parameters)
            return MOTORS_OFF
        if within < _steps(SENSED_S):
            shake_g = self._shake_g[motor] * forces_n[motor] / MOTOR_FORCE_N
            x_g, y_g = self._rng.normal(0.0, np.hypot(shake_g, _NOISE_G), 2).tolist()
            self._samples.append((x_g, y_g))
        elif self._samples:
            x, y = (SAMPLES * float(np.var(axis)) for axis in zip(*self._samples, strict=True))
            self.variance[motor] = (x, y)
            self._samples = []
        on = within < _steps(ON_S)
        one, two, three, four = (PROPELLER_PWM if on and m == motor else 0.0 for m in range(4))
        return (one, two, three, four) if on else MOTORS_OFF

    def _judge(self, parameters: Mapping[str, float]) -> None:
        """Without a threshold, as released, no motor's bit is set."""
        high = parameters["health.propTestThreshold"]
        for motor, (x, y) in enumerate(self.variance):
            if high and DEAD_G2 <= x + y <= high:
                self.motor_pass |= 1 << motor
        self.motor_pass |= FINISHED
        self.motor_tests += 1
        self.testing = ""
