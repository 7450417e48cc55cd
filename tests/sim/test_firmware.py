"""What the firmware model does beyond the rows that tests/sim/test_crtp_*.py show through cflib."""

from __future__ import annotations

import math

import numpy as np
import pytest

from perchctl.sim.firmware import Firmware
from perchctl.vehicle import CRASHED
from tests.helpers.firmware_rig import PERFECT, Rig, at_height, make_rig, raw_thrust

HERE = at_height(0.8)
FULL_RAW = raw_thrust(60000)


def flying(**conditions: float) -> Rig:
    """Holding 0.8 m on low-level position setpoints."""
    rig = make_rig(**conditions)
    rig.take_off()
    rig.hold()
    return rig


def test_a_landing_of_a_landing_and_a_take_off_in_flight_are_refused() -> None:
    rig = make_rig()
    rig.take_off()
    planner, t_s = rig.firmware.planner, rig.firmware.t_s
    assert not planner.take_off(1.0, 1.0, None, t_s)
    assert [planner.land(0.0, duration_s, None, t_s) for duration_s in (3.0, 1.0)] == [True, False]


@pytest.mark.parametrize(("roll_rad", "after_s"), [(1.2, 1.0), (2.5, 0.1)])
def test_tumble_rule(roll_rad: float, after_s: float) -> None:
    """Row "acc.z < 0.5 g for 1 s or < -0.2 g for 0.1 s"."""
    rig = flying()
    rig.world.set_pose((0.0, 0.0, 0.8), (roll_rad, 0.0, 0.0), hold=True)
    seen_s = 0.0
    while not rig.info & CRASHED and seen_s < 2.0:
        rig.run(0.02, HERE)
        seen_s += 0.02
    assert seen_s == pytest.approx(after_s + 0.05, abs=0.07)


# --- Log variables and parameters ----------------------------------------------------------------


def test_log_units() -> None:
    rig = make_rig(**PERFECT)
    rig.world.set_pose((0.1, -0.2, 0.5), (0.1, 0.2, 0.3), hold=True)
    rig.firmware.reboot()  # a boot begins with the true attitude
    rig.run(0.5)
    log = rig.firmware.log_value
    turn = [log(f"stateEstimate.{angle}") for angle in ("roll", "pitch", "yaw")]
    assert turn == pytest.approx(np.degrees([0.1, -0.2, 0.3]), abs=1e-6)
    assert math.hypot(log("acc.x"), log("acc.y"), log("acc.z")) == pytest.approx(1.0, abs=0.02)
    assert all(math.isfinite(log(name)) for name in Firmware.LOG_VARIABLES)
    with pytest.raises(KeyError):
        log("stateEstimate.w")


def test_a_reboot_keeps_no_parameter_and_no_unlock() -> None:
    rig = make_rig()
    firmware = rig.firmware
    firmware.set_parameter("posCtlPid.thrustBase", 52000)
    firmware.low_level(raw_thrust(0))  # unlocks the thrust
    firmware.reboot()
    assert firmware.t_s == 0.0
    assert firmware.get_parameter("posCtlPid.thrustBase") == 36000
    rig.run(0.3)
    rig.run(0.1, FULL_RAW)
    assert rig.motors_off


# --- The state estimate of a deck ----------------------------------------------------------------


def test_attitude_is_what_the_gyroscope_integrates_to() -> None:
    rig = make_rig(**PERFECT)
    log = rig.firmware.log_value
    rig.world.set_pose((0.0, 0.0, 0.5), (0.5, 0.0, 0.0), hold=True)  # turned by no rate
    rig.run(0.05)
    assert log("stateEstimate.roll") == pytest.approx(0.0, abs=1.5)
    rig.run(12.0)  # other measurements show the tilt in the end
    assert log("stateEstimate.roll") == pytest.approx(math.degrees(0.5), abs=0.3)


def test_drift_runs_from_the_first_take_off_and_moves_the_vehicle() -> None:
    rig = make_rig(drift_mps=(0.02, -0.01, 0.0), **PERFECT)
    rig.run(5.0)
    assert rig.firmware.log_value("stateEstimate.x") == pytest.approx(0.0, abs=1e-3)
    rig.take_off()
    flown_s = 5.0
    rig.hold(5.0)
    error_m = rig.firmware.log_value("stateEstimate.x") - rig.world.x_m
    assert error_m == pytest.approx(0.02 * (flown_s + 5.0), abs=0.005)
    # It holds its estimate, so the body wanders the other way.
    assert rig.firmware.log_value("stateEstimate.x") == pytest.approx(0.0, abs=0.03)
    assert rig.world.x_m < -0.15
    assert rig.world.y_m > 0.07


def test_variance_falls_after_a_reset_and_outside_positions_count_for_nothing() -> None:
    rig = make_rig()
    rig.run(2.0)
    assert rig.firmware.log_value("kalman.varPX") < 1e-3
    rig.firmware.set_parameter("kalman.resetEstimation", 1)
    assert rig.firmware.log_value("kalman.varPX") > 1.0
    rig.firmware.set_parameter("kalman.resetEstimation", 0)
    rig.firmware.external((5.0, 5.0, 5.0), (1.0, 0.0, 0.0, 0.0))
    rig.run(2.0)
    assert rig.firmware.log_value("kalman.varPX") < 1e-3
    assert abs(rig.firmware.log_value("stateEstimate.x")) < 0.02
