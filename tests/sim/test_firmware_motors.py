"""Thrust command to duty cycle: the curve, the battery, the cap.

docs/firmware.md, "Thrust to PWM".
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.sim import MOTOR_FORCE_N
from perchctl.sim.firmware.motors import MOTORS_OFF, THRUST_MIN, MotorDriver
from perchctl.sim.powertrain import FULL_COMMAND, STANDSTILL_V, motor_v, thrust_n

# Command, duty cycle, battery under that load.
MEASURED = [
    (65535, 58090, 3.47), (56200, 53150, 3.55), (40200, 43350, 3.70), (31900, 37450, 3.75),
    (20000, 25600, 3.92), (10000, 15300, 4.02),
]  # fmt: skip


def settled(battery_v: float) -> MotorDriver:
    driver = MotorDriver()
    for _ in range(1000):
        driver.pwm(MOTORS_OFF, battery_v)
    return driver


@given(st.floats(0.001, 0.3))
def test_the_inverse_undoes_the_curve(newtons: float) -> None:
    assert thrust_n(motor_v(newtons)) == pytest.approx(newtons, rel=1e-9)


@given(st.floats(0.0, 5.0), st.floats(0.0, 5.0))
def test_more_voltage_is_more_thrust(a: float, b: float) -> None:
    assert (a - b) * (thrust_n(a) - thrust_n(b)) >= 0.0


def test_the_dead_band() -> None:
    assert pytest.approx(0.455, abs=0.001) == STANDSTILL_V
    assert thrust_n(STANDSTILL_V) == thrust_n(0.1) == 0.0
    assert thrust_n(motor_v(MOTOR_FORCE_N)) == pytest.approx(MOTOR_FORCE_N)


@pytest.mark.parametrize(("command", "pwm", "battery_v"), MEASURED)
def test_duty_cycles_are_the_measured_ones(command: int, pwm: int, battery_v: float) -> None:
    """The voltages are given to 10 mV: 0.3 per cent."""
    given_pwm = settled(battery_v).pwm((float(command),) * 4, battery_v)
    assert given_pwm == pytest.approx((pwm,) * 4, rel=0.006)


@pytest.mark.parametrize("command", [0, 1000, 1500, 3000, 5000, 6999])
def test_little_thrust_is_none(command: int) -> None:
    assert settled(4.1).pwm((float(command),) * 4, 4.1) is MOTORS_OFF
    assert pytest.approx(7000, abs=1) == THRUST_MIN


def test_a_sagging_battery_is_met_late() -> None:
    driver = settled(4.0)
    at_once = driver.pwm((40000.0,) * 4, 3.6)[0]
    for _ in range(49):
        later = driver.pwm((40000.0,) * 4, 3.6)[0]
    for _ in range(500):
        settled_pwm = driver.pwm((40000.0,) * 4, 3.6)[0]
    assert settled_pwm / at_once == pytest.approx(4.0 / 3.6, rel=0.005)
    assert (settled_pwm - later) / (settled_pwm - at_once) == pytest.approx(0.37, abs=0.03)


def test_a_request_over_full_command_is_given_while_the_battery_suffices() -> None:
    """A yaw step at hover requests 89,000 of two motors, half as much again as full command."""
    low, high = 56200.0 - 32767.0, 56200.0 + 32767.0
    pwm = settled(3.7).pwm((low, high, low, high), 3.7)
    assert pwm[1] < FULL_COMMAND
    assert pwm[1] * 3.7 / FULL_COMMAND == pytest.approx(
        motor_v(high / FULL_COMMAND * MOTOR_FORCE_N)
    )


def test_the_cap_takes_the_excess_off_all_four_duty_cycles() -> None:
    driver = settled(3.2)
    pwm = driver.pwm((30000.0, 90000.0, 30000.0, 90000.0), 3.2)
    requested = driver.requested
    assert requested[1] > FULL_COMMAND
    assert pwm[1] == FULL_COMMAND
    assert requested[0] - pwm[0] == pytest.approx(requested[1] - pwm[1])
    assert driver.pwm((7001.0, 150000.0, 7001.0, 150000.0), 3.2)[0] == 0.0


def test_a_battery_that_cannot_be_read_gives_no_thrust() -> None:
    driver = settled(1.9)
    assert driver.pwm((40000.0,) * 4, 1.9) is MOTORS_OFF
