"""What the firmware model does beyond the rows that tests/sim/test_crtp_*.py show through cflib."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perchctl.geometry import GRAVITY_MPS2, Array
from perchctl.sim.firmware import Firmware
from perchctl.sim.firmware.controller import Setpoint
from perchctl.sim.firmware.variables import LOG_VARIABLES
from perchctl.vehicle import CRASHED
from tests.helpers.firmware_rig import PERFECT, Rig, at_height, make_rig, raw_thrust

HERE = at_height(0.8)


@pytest.mark.parametrize(("roll_rad", "after_s"), [(1.2, 1.0), (2.5, 0.1)])
def test_tumble_rule(roll_rad: float, after_s: float) -> None:
    """Row "acc.z < 0.5 g for 1 s or < -0.2 g for 0.1 s"."""
    rig = make_rig()
    rig.take_off()
    rig.hold()
    rig.world.set_pose((0.0, 0.0, 0.8), (roll_rad, 0.0, 0.0), hold=True)
    seen_s = 0.0
    while not rig.info & CRASHED and seen_s < 2.0:
        rig.run(0.02, HERE)
        seen_s += 0.02
    assert seen_s == pytest.approx(after_s + 0.05, abs=0.07)


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
    firmware.fly_setpoint(raw_thrust(0))  # unlocks the thrust
    firmware.reboot()
    assert firmware.t_s == 0.0
    assert firmware.get_parameter("posCtlPid.thrustBase") == 36000
    rig.run(0.3)
    rig.run(0.1, raw_thrust(60000))
    assert rig.motors_off


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


def test_with_a_deck_external_positions_count_for_nothing() -> None:
    rig = make_rig()
    rig.firmware.take_external((5.0, 5.0, 5.0), (1.0, 0.0, 0.0, 0.0))
    rig.run(2.0)
    assert rig.firmware.log_value("kalman.varPX") < 1e-3
    assert abs(rig.firmware.log_value("stateEstimate.x")) < 0.02


def variances(rig: Rig) -> tuple[float, ...]:
    names = ("X", "Y", "Z", "PX", "PY", "PZ")
    return tuple(rig.firmware.log_value(f"kalman.var{name}") for name in names)


def test_a_flow_deck_s_filter_never_knows_where_it_is_level() -> None:
    """It measures height and speed over ground: the more roughly the higher it flies
    (docs/firmware.md, "Variances")."""
    rig = make_rig()
    rig.firmware.set_parameter("kalman.resetEstimation", 1)
    rig.run(0.02)
    assert variances(rig) == pytest.approx((100.0, 100.0, 1.0, 1e-4, 1e-4, 1e-4))
    rig.run(0.5)
    *level, height, vx, vy, climb = variances(rig)
    assert level == [100.0, 100.0]
    assert height < 1e-5
    assert max(vx, vy, climb) < 3e-4
    rig.world.set_pose((0.0, 0.0, 2.0), hold=True)
    rig.run(0.1)
    assert variances(rig)[3] == pytest.approx(6e-3, rel=0.1)


def test_with_a_lighthouse_deck_the_filter_knows_the_whole_position() -> None:
    rig = make_rig(parameters={"deck.bcFlow2": 0.0, "deck.bcLighthouse4": 1.0})
    rig.run(0.5)
    assert max(variances(rig)[:3]) < 1e-4


def test_the_variances_of_a_filter_that_does_not_run_are_zero() -> None:
    rig = make_rig(parameters={"stabilizer.estimator": 1.0})
    rig.run(0.5)
    assert variances(rig) == (0.0,) * 6


# --- Without a deck: external positions, and none -------------------------------------------------


def deckless(**conditions: Any) -> Rig:
    return make_rig(extra={"external_position": 1.0}, **conditions)


def errors_m(rig: Rig) -> Array:
    """The estimated position less the true one."""
    now, world = rig.firmware.estimator.now, rig.world
    return np.array((now.x_m - world.x_m, now.y_m - world.y_m, now.z_m - world.z_m))


def feed(rig: Rig, seconds: float, scale: float = 1.0, stream: Setpoint | None = None) -> None:
    """Send the true position, in units of `1 / scale` m, at 100 Hz."""
    for i in range(round(seconds / 0.01)):
        if stream is not None and i % 2 == 0:
            rig.firmware.fly_setpoint(stream)
        world = rig.world
        rig.firmware.take_external((scale * world.x_m, scale * world.y_m, scale * world.z_m))
        for _ in range(5):
            rig.firmware.step()


def hovering(**conditions: Any) -> Rig:
    rig = deckless(**conditions)
    feed(rig, 0.5)
    for value in (1, 0):
        rig.firmware.set_parameter("kalman.resetEstimation", value)
    feed(rig, 1.0)
    for tenth in range(10):
        feed(rig, 0.25, stream=at_height(0.08 * (tenth + 1)))
    feed(rig, 3.0, stream=HERE)
    return rig


def test_millimetres_reset_the_estimate_for_ever() -> None:
    """Out of its bounds (`kalman.maxPos`) it begins again at its initial place."""
    rig = deckless()
    rig.world.set_pose((0.3, 0.0, 0.4), hold=True)
    feed(rig, 1.0, scale=1000.0)
    assert np.linalg.norm(errors_m(rig)) == pytest.approx(0.5, abs=0.05)
    assert rig.firmware.log_value("kalman.varX") > 10.0
    rig.world.set_pose((0.03, 0.0, 0.06), hold=True)  # within them it is believed
    feed(rig, 1.0, scale=1000.0)
    assert np.linalg.norm(errors_m(rig)) == pytest.approx(999.0 * math.hypot(0.03, 0.06), rel=0.05)


def test_what_is_no_number_does_no_harm() -> None:
    rig = deckless()
    feed(rig, 0.5)
    for number in (math.nan, math.inf):
        rig.firmware.take_external((number, 0.0, 0.0))
        rig.firmware.take_external((0.0, 0.0, number), (0.0, number, 0.0, 0.0))
    feed(rig, 0.1)
    assert np.linalg.norm(errors_m(rig)) < 0.01


@pytest.mark.parametrize("axis", [0, pytest.param(2, marks=pytest.mark.long)])
def test_a_bias_of_the_accelerometer_hurts_little_in_flight(axis: int) -> None:
    """Row "the accelerometer along the thrust axis only, scaled to 1 g on the ground"."""
    rig = hovering(acc_bias_mps2=tuple(0.02 * GRAVITY_MPS2 * np.eye(3)[axis]))
    rig.run(2.0, HERE)
    assert abs(errors_m(rig)[axis]) < 0.05  # 0.4 m, if it counted


def test_a_tilt_that_is_wrong_slides() -> None:
    """Row "errors of tilt hurt more": a gyroscope's bias grows with the third power of the time."""
    rig = hovering(gyro_bias_radps=(0.0, math.radians(0.2), 0.0))
    assert np.linalg.norm(errors_m(rig)) < 0.02
    rig.run(2.0, HERE)
    two_m = abs(errors_m(rig)[0])
    rig.run(2.0, HERE)
    four_m = abs(errors_m(rig)[0])
    assert 0.2 < four_m < 0.6  # the bias alone: 0.36 m
    assert four_m > 4.0 * two_m


@pytest.mark.parametrize(("engaged", "thrust", "noisy"), [
    (True, 0.0, True), (True, 1000.0, True), (True, 20000.0, False), (False, 0.0, False),
])  # fmt: skip
def test_a_hanging_vehicle_s_attitude_never_repeats(
    engaged: bool, thrust: float, noisy: bool
) -> None:
    """perchctl takes readings that repeat for frozen ones, and landed a vehicle that hung still."""
    now = SimpleNamespace(roll_deg=1.0, gyro_x_dps=0.08)
    firmware = SimpleNamespace(
        estimator=SimpleNamespace(now=now),
        world=SimpleNamespace(magnet_engaged=engaged),
        controller=SimpleNamespace(thrust=thrust),
    )
    read = LOG_VARIABLES["stateEstimate.roll"].read(firmware)
    assert (read != 1.0) is noisy
    assert read == pytest.approx(1.0, abs=0.01)
