"""The motors and their battery: thrust command to duty cycle by the curve, the battery and the cap
(docs/firmware.md, "Thrust to PWM"); and a cell that is a real one: flat, then steep, weaker when
old, slow when cold."""

from __future__ import annotations

import statistics
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.sim import CONTROL_PERIOD_S, Scenario
from perchctl.sim.firmware.controller import MOTORS_OFF, MotorDriver
from perchctl.sim.powertrain import (
    MOTOR_FORCE_N,
    STANDSTILL_V,
    Cell,
    Powertrain,
    motor_voltage,
    thrust_n,
)

HOVER_A = 3.8
LEVELS_V = (3.78, 3.83, 3.87, 3.89, 3.92, 3.96, 4.00, 4.04, 4.10)
"""At which the firmware's battery level leaves 10, 20, ... 90 per cent (source)."""


@given(st.floats(0.001, 0.3))
def test_the_inverse_undoes_the_curve(newtons: float) -> None:
    assert thrust_n(motor_voltage(newtons)) == pytest.approx(newtons, rel=1e-9)


def test_the_dead_band() -> None:
    assert pytest.approx(0.455, abs=0.001) == STANDSTILL_V
    assert thrust_n(STANDSTILL_V) == thrust_n(0.1) == 0.0
    assert thrust_n(motor_voltage(MOTOR_FORCE_N)) == pytest.approx(MOTOR_FORCE_N)
    assert MotorDriver().pwm((6999.0,) * 4, 4.1) is MOTORS_OFF
    assert MotorDriver().thrust_min == pytest.approx(7000, abs=1)


def after(cell: Cell, seconds: float, current_a: float = HOVER_A) -> float:
    for _ in range(round(seconds / CONTROL_PERIOD_S)):
        cell.step(current_a)
    return cell.rest_v


def test_each_tenth_of_the_charge_ends_at_the_firmwares_level() -> None:
    cell = Cell(4.2)
    tenth_s = 90.0 / HOVER_A
    for level_v in reversed(LEVELS_V):
        assert after(cell, tenth_s) == pytest.approx(level_v, abs=0.002)
    assert after(cell, tenth_s) == pytest.approx(3.0, abs=0.02)


def test_an_old_cell_empties_faster_and_sags_more_at_last() -> None:
    new, old = Cell(4.1), Cell(4.1, ohm=0.2, slow_ohm=0.05, charge=0.5)
    after(old, 0.1)
    assert old.rest_v - old.battery_v == pytest.approx(0.2 * HOVER_A, abs=0.005)
    after(new, 120.0)
    after(old, 59.9)
    assert old.rest_v == pytest.approx(new.rest_v, abs=1e-6)
    assert new.rest_v - new.battery_v == pytest.approx(0.143 * HOVER_A)
    assert old.rest_v - old.battery_v == pytest.approx(0.25 * HOVER_A, abs=0.005)
    after(old, 60.0, 0.0)
    assert old.battery_v == pytest.approx(old.rest_v, abs=0.005)


@pytest.mark.parametrize("knee", [0.07, 0.1, 0.15])
def test_it_starts_at_the_resting_voltage_that_is_asked_for(knee: float) -> None:
    for rest_v in (3.3, 3.6, 3.85, 4.0, 4.2):
        cell = Cell(rest_v, knee=knee)
        assert after(cell, CONTROL_PERIOD_S) == pytest.approx(rest_v, abs=1e-3)


@given(
    st.floats(3.3, 4.2),
    st.floats(0.1, 0.3),
    st.floats(0.0, 0.1),
    st.tuples(*[st.floats(0.8, 1.2)] * 4),
)
def test_most_thrust_is_what_full_duty_gives(
    rest_v: float, ohm: float, slow_ohm: float, strength: tuple[float, float, float, float]
) -> None:
    """An old cell with a large resistance lifts less at the same resting voltage."""
    scenario = replace(
        Scenario(),
        battery_rest_v=rest_v,
        cell_resistance_ohm=ohm,
        cell_slow_ohm=slow_ohm,
        motor_strength=(min(strength),) * 4,
    )
    powertrain = Powertrain(scenario)
    for _ in range(500):
        powertrain.step((65535.0,) * 4)
    most_n = min(sum(powertrain.forces_n), 4.0 * min(strength) * MOTOR_FORCE_N)
    assert powertrain.max_balanced_thrust_n() == pytest.approx(most_n, rel=0.01)
    powertrain.strength = strength
    assert powertrain.max_balanced_thrust_n() == pytest.approx(most_n, rel=0.01)


def test_the_steady_lift_is_the_lift_without_its_fluctuation() -> None:
    powertrain = Powertrain(replace(Scenario(), thrust_noise=0.05))
    lifts_n = []
    for _ in range(2000):
        powertrain.step((40000.0,) * 4)
        lifts_n.append((sum(powertrain.forces_n), powertrain.steady_lift_n))
    noisy_n, steady_n = (list(lift_n) for lift_n in zip(*lifts_n[1000:], strict=True))
    assert statistics.fmean(noisy_n) == pytest.approx(statistics.fmean(steady_n), rel=0.01)
    assert statistics.pstdev(steady_n) < 0.1 * statistics.pstdev(noisy_n)
