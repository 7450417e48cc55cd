"""Log variables, parameters, battery and the state estimate's errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim import Firmware
from perchctl.sim.firmware.controller import Setpoint
from perchctl.sim.firmware.planner import AxisState, HlGoTo, Polynomial
from tests.helpers.firmware_rig import PERFECT, Rig, make_rig

HERE = Setpoint.position(0.0, 0.0, 0.8, 0.0)
CTYPES = {"uint8_t", "uint16_t", "uint32_t", "int8_t", "int16_t", "int32_t", "float"}


def test_tables_have_the_measured_sizes_and_fit_their_packets() -> None:
    assert len(Firmware.LOG_VARIABLES) == 385
    assert len(Firmware.PARAMETERS) == 257
    ctypes = {*Firmware.LOG_VARIABLES.values(), *(p.ctype for p in Firmware.PARAMETERS.values())}
    assert ctypes <= CTYPES
    for name in (*Firmware.LOG_VARIABLES, *Firmware.PARAMETERS):
        assert all(name.split("."))
        assert name.count(".") == 1  # cflib splits at the dots
        assert len(name) <= 26  # with its two zero bytes, within one packet


def test_every_log_variable_has_a_value_and_unknown_names_none() -> None:
    rig = make_rig()
    for name in Firmware.LOG_VARIABLES:
        assert math.isfinite(rig.firmware.log_value(name))
    with pytest.raises(KeyError):
        rig.firmware.log_value("stateEstimate.w")


def test_log_units() -> None:
    rig = make_rig(**PERFECT)
    rig.world.set_pose((0.1, -0.2, 0.5), (0.1, 0.2, 0.3), hold=True)
    rig.firmware.reboot()  # a boot begins with the true attitude
    rig.run(0.5)
    log = rig.firmware.log_value
    assert log("stateEstimate.roll") == pytest.approx(math.degrees(0.1), abs=1e-6)
    assert log("stateEstimate.pitch") == pytest.approx(-math.degrees(0.2), abs=1e-6)
    assert log("stateEstimate.yaw") == pytest.approx(math.degrees(0.3), abs=1e-6)
    assert [log(f"stateEstimate.{a}") for a in "xyz"] == pytest.approx([0.1, -0.2, 0.5])
    assert log("stateEstimateZ.x") == pytest.approx(100.0)
    assert math.hypot(log("acc.x"), log("acc.y"), log("acc.z")) == pytest.approx(1.0, abs=0.02)
    assert log("supervisor.info") == rig.info


def test_accelerometer_and_gyro_are_noisy_but_true() -> None:
    rig = make_rig()
    samples = []
    for _ in range(200):
        rig.run(0.01)
        samples.append([rig.firmware.log_value(n) for n in ("acc.z", "gyro.x")])
    mean, spread = np.mean(samples, axis=0), np.std(samples, axis=0)
    assert mean == pytest.approx([1.0, 0.0], abs=0.02)
    assert (spread > 1e-4).all()
    assert spread[0] < 0.02


def test_parameters_read_write_and_refuse() -> None:
    firmware = make_rig().firmware
    assert firmware.get_parameter("posCtlPid.thrustBase") == 36000
    firmware.set_parameter("posCtlPid.thrustBase", 52000)
    assert firmware.get_parameter("posCtlPid.thrustBase") == 52000
    assert firmware.controller.thrust_base == 52000
    firmware.set_parameter("velCtlPid.vzKp", 20)
    assert firmware.controller.vz.kp == 20
    firmware.set_parameter("pid_rate.yaw_ki", 3)
    assert firmware.controller.yaw_rate.ki == 3
    with pytest.raises(KeyError):
        firmware.set_parameter("posCtlPid.none", 1)
    with pytest.raises(PermissionError):
        firmware.set_parameter("deck.bcFlow2", 0)


def test_a_reboot_keeps_only_persistent_parameters() -> None:
    firmware = make_rig().firmware
    firmware.set_parameter("posCtlPid.thrustBase", 52000)
    firmware.set_parameter("supervisor.infdmp", 1)
    firmware.reboot()
    assert firmware.t_s == 0.0
    assert firmware.controller.thrust_base == 52000
    assert firmware.get_parameter("supervisor.infdmp") == 0


def test_attitude_is_what_the_gyroscope_integrates_to() -> None:
    rig = make_rig(**PERFECT)
    log = rig.firmware.log_value
    rig.world.set_pose((0.0, 0.0, 0.5), (0.5, 0.0, 0.0), hold=True)  # turned by no rate
    rig.run(0.05)
    assert log("stateEstimate.roll") == pytest.approx(0.0, abs=1.5)
    rig.run(12.0)  # other measurements show the tilt in the end
    assert log("stateEstimate.roll") == pytest.approx(math.degrees(0.5), abs=0.3)


def test_attitude_follows_a_flown_turn() -> None:
    rig = make_rig(mass_kg=0.030, **PERFECT)
    rig.take_off()
    rig.firmware.high_level(HlGoTo(0.3, -0.2, 1.0, 2.5, 1.5, False))
    errors = []
    for _ in range(200):
        rig.run(0.02)
        R = rig.world.state().R_world_body
        yaw_deg = math.degrees(math.atan2(R[1, 0], R[0, 0]))
        errors.append(abs(rig.firmware.log_value("stateEstimate.yaw") - yaw_deg))
    assert yaw_deg > 120.0
    assert max(errors) < 0.5


# State estimate ---------------------------------------------------------------------


def test_estimate_noise_has_the_scenarios_size() -> None:
    rig = make_rig(estimate_noise_m=0.005)
    errors = []
    for _ in range(600):
        rig.run(0.1)
        errors.append(rig.firmware.log_value("stateEstimate.x") - rig.world.x_m)
    assert np.std(errors) == pytest.approx(0.005, rel=0.35)


def test_the_estimated_velocity_is_as_old_as_the_filter_makes_it() -> None:
    """The accelerometer's filter takes 8 ms, and the estimate is new every 10 ms (source)."""
    rig = make_rig(**PERFECT, ceiling_z_m=4.0)
    rig.world.set_pose((0.0, 0.0, 3.5))
    rig.run(0.1)
    ages_s = []
    for _ in range(25):
        rig.run(0.002)
        newer_mps = rig.firmware.log_value("stateEstimate.vz") - rig.world.vz_mps
        ages_s.append(newer_mps / GRAVITY_MPS2)
    assert 0.007 < min(ages_s) < max(ages_s) < 0.021
    assert sum(ages_s) / 25 == pytest.approx(0.014, abs=0.002)


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


def test_tilt_bias_shows_in_the_estimate_and_is_flown_out() -> None:
    rig = make_rig(estimate_tilt_bias_rad=(0.02, -0.03), **PERFECT)
    assert rig.firmware.log_value("stateEstimate.roll") == pytest.approx(math.degrees(0.02))
    assert rig.firmware.log_value("stateEstimate.pitch") == pytest.approx(math.degrees(0.03))
    rig.take_off()
    rig.hold(8.0)
    assert rig.firmware.log_value("stateEstimate.roll") == pytest.approx(
        math.degrees(0.02), abs=0.4
    )
    assert math.hypot(rig.world.x_m, rig.world.y_m) < 0.15


def test_variance_falls_after_a_reset() -> None:
    rig = make_rig()
    rig.run(2.0)
    assert rig.firmware.log_value("kalman.varPX") < 1e-3
    rig.firmware.set_parameter("kalman.resetEstimation", 1)
    assert rig.firmware.log_value("kalman.varPX") > 1.0
    rig.firmware.set_parameter("kalman.resetEstimation", 0)
    rig.run(2.0)
    assert rig.firmware.log_value("kalman.varPX") < 1e-3


def test_outside_positions_are_only_counted_on_a_flow_deck() -> None:
    rig = make_rig()
    rig.firmware.external_pose((5.0, 5.0, 5.0), (0.0, 0.0, 0.0, 1.0))
    rig.run(0.1)
    assert abs(rig.firmware.log_value("stateEstimate.x")) < 0.02


# Trajectories -----------------------------------------------------------------------


@pytest.mark.parametrize("duration_s", [0.7, 3.0])
def test_polynomial_meets_both_ends(duration_s: float) -> None:
    curve = Polynomial(AxisState(0.3, -0.2, 0.5), 1.1, duration_s)
    start = curve.at(0.0)
    assert tuple(start) == pytest.approx((0.3, -0.2, 0.5))
    end = curve.at(duration_s * (1 - 1e-9))
    assert tuple(end) == pytest.approx((1.1, 0.0, 0.0), abs=1e-5)
    assert curve.at(duration_s + 5.0) == AxisState(1.1)


def test_polynomial_derivatives_are_its_own() -> None:
    curve = Polynomial(AxisState(0.0), 1.0, 2.0)
    h = 1e-5
    for t_s in (0.3, 1.0, 1.7):
        before, now, after = curve.at(t_s - h), curve.at(t_s), curve.at(t_s + h)
        assert now.rate == pytest.approx((after.value - before.value) / (2 * h), abs=1e-6)
        assert now.accel == pytest.approx((after.rate - before.rate) / (2 * h), abs=1e-6)
    assert curve.at(1.0).value == pytest.approx(0.5)


def test_a_plan_of_no_duration_is_its_goal() -> None:
    assert Polynomial(AxisState(0.0), 1.0, 0.0).at(0.0) == AxisState(1.0)


# --- Health tests ------------------------------------------------------------------------


def health(rig: Rig, test: str) -> None:
    rig.run(0.5)
    rig.firmware.set_parameter(f"health.{test}", 1)
    rig.run(4.5)


def variances(rig: Rig) -> list[float]:
    log = rig.firmware.log_value
    return [log(f"health.motorVarXM{m}") + log(f"health.motorVarYM{m}") for m in (1, 2, 3, 4)]


def test_the_propeller_test_tells_good_dead_and_unbalanced_apart() -> None:
    """docs/firmware.md, "Propeller test"."""
    rig = make_rig(motor_strength=(1, 0, 1, 1), propeller_shake_g=(0.05, 0.05, 0.3, 0.05))
    health(rig, "startPropTest")
    first, dead, unbalanced, fourth = variances(rig)
    assert dead < 0.01 < min(first, fourth)
    assert unbalanced > 10 * max(first, fourth)
    assert rig.firmware.log_value("health.motorPass") == 0x80
    assert rig.firmware.log_value("health.motorTestCount") == 1
    assert rig.firmware.get_parameter("health.startPropTest") == 0
    assert rig.info == 0x020E
    assert rig.world.z_m == pytest.approx(0.012, abs=0.002)


def test_a_threshold_sets_the_bits_of_the_motors_within() -> None:
    rig = make_rig(propeller_shake_g=(0.05, 0.05, 0.3, 0.05))
    rig.firmware.set_parameter("health.propTestThreshold", 0.5)
    health(rig, "startPropTest")
    assert rig.firmware.log_value("health.motorPass") == 0x80 | 0b1011


@pytest.mark.parametrize(("ohm", "good"), [(None, True), (2.5, False)])
def test_the_battery_test_sees_a_weak_cell(ohm: float | None, good: bool) -> None:
    """docs/firmware.md, "Battery test"."""
    rig = make_rig(cell_resistance_ohm=ohm)
    health(rig, "startBatTest")
    assert rig.firmware.log_value("health.batteryPass") == good
    assert (rig.firmware.log_value("health.batterySag") < 0.7) is good


def test_a_health_test_in_the_air_is_a_motor_cut() -> None:
    rig = make_rig()
    rig.take_off()
    rig.firmware.set_parameter("health.startPropTest", 1)
    rig.run(0.3)
    assert rig.world.vz_mps < -1.0


def test_parameters_and_radio_are_the_scenario_s() -> None:
    rig = make_rig(parameters={"deck.bcFlow2": 0, "system.selftestPassed": 0}, rssi_dbm=-88.0)
    assert rig.firmware.get_parameter("deck.bcFlow2") == 0
    assert rig.firmware.log_value("radio.rssi") == 88.0
