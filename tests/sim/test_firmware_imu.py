"""What an IMU's errors do to the estimate of a vehicle without a deck, flying and standing."""

from __future__ import annotations

import math

import pytest

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim import Scenario
from perchctl.sim.firmware.imu import IMU_EVERY, Imu
from tests.helpers.firmware_rig import Rig
from tests.sim.test_firmware_outside import (
    HERE,
    error_m,
    fed,
    hovering,
    outside_rig,
    place,
    reset,
)

G = GRAVITY_MPS2
SEVERAL = range(400)


def errors(rig: Rig) -> tuple[float, float, float]:
    log = rig.firmware.log_value
    x, y, z = place(rig)
    return log("stateEstimate.x") - x, log("stateEstimate.y") - y, log("stateEstimate.z") - z


def wrong_heading_deg(rig: Rig) -> float:
    w, x, y, z = rig.world.quaternion
    true = math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    return rig.firmware.log_value("stateEstimate.yaw") - math.degrees(true)


def wrong_pitch_deg(rig: Rig) -> float:
    w, x, y, z = rig.world.quaternion
    true = -math.asin(2 * (w * y - x * z))  # the firmware's is nose up
    return rig.firmware.log_value("stateEstimate.pitch") - math.degrees(true)


def readings(imu: Imu) -> list[tuple[float, ...]]:
    found = []
    for _ in SEVERAL:
        due = [imu.feel((0.0, 0.0, G), (0.0, 0.0, 0.0)) for _ in range(IMU_EVERY)]
        assert due == [False] * (IMU_EVERY - 1) + [True]
        found.append(tuple(imu.read(pressed=False)))
    return found


def test_a_reading_has_the_noise_of_the_facts_and_the_bias_of_the_scenario() -> None:
    """0.01 g and 0.1 deg/s of each sample at 1 kHz."""
    bias = (0.002, -0.001, 0.003)
    columns = list(zip(*readings(Imu(Scenario(gyro_bias_radps=bias))), strict=True))
    for column, sigma in zip(columns, 3 * [0.01 * G] + 3 * [math.radians(0.1)], strict=True):
        mean = math.fsum(column) / len(column)
        spread = math.sqrt(math.fsum((v - mean) ** 2 for v in column) / len(column))
        assert spread == pytest.approx(sigma / math.sqrt(10.0), rel=0.1)
    turned = [math.fsum(column) / len(column) for column in columns[3:]]
    assert turned == pytest.approx(bias, abs=6e-4)


@pytest.mark.parametrize("bias_g", [(0.0, 0.0, 0.05), (0.02, -0.02, 0.0), (0.0, 0.0, -0.05)])
def test_the_accelerometer_is_scaled_to_one_g_on_the_ground(
    bias_g: tuple[float, float, float],
) -> None:
    x, y, z = (G * part for part in bias_g)
    told = readings(Imu(Scenario(acc_bias_mps2=(x, y, z))))
    mean = [math.fsum(column) / len(told) for column in zip(*told, strict=True)]
    assert math.hypot(*mean[:3]) == pytest.approx(G, abs=0.01)


def test_a_bias_along_the_thrust_is_scaled_away() -> None:
    """Row "a constant bias of it hurts little": unscaled, 0.05 g are 2.2 m in 3 s."""
    rig = hovering(outside_rig(acc_bias_mps2=(0.0, 0.0, 0.05 * G)))
    rig.run(3.0, HERE)
    assert abs(errors(rig)[2]) < 0.08


def test_a_bias_across_it_counts_on_the_ground_alone() -> None:
    """Row "in flight along the thrust axis only"."""
    bias = (0.02 * G, 0.0, 0.0)
    rested = outside_rig(acc_bias_mps2=bias)
    reset(rested)
    rested.run(1.0)
    assert errors(rested)[0] == pytest.approx(0.1, abs=0.02)  # 0.02 g x t^2 / 2
    flown = hovering(outside_rig(acc_bias_mps2=bias))
    assert wrong_pitch_deg(flown) == pytest.approx(0.0, abs=0.3)  # and not 1.1
    flown.run(2.0, HERE)
    assert abs(errors(flown)[0]) < 0.05


def test_a_tilt_that_is_wrong_slides() -> None:
    """Row "errors of tilt hurt more": a gyroscope's bias grows with the third power of the time."""
    rig = hovering(outside_rig(gyro_bias_radps=(0.0, math.radians(0.2), 0.0)))
    assert error_m(rig) < 0.02
    rig.run(2.0, HERE)
    two_m = abs(errors(rig)[0])
    rig.run(2.0, HERE)
    four_m = abs(errors(rig)[0])
    assert 0.2 < four_m < 0.6  # the bias alone: 0.36 m
    assert four_m > 4.0 * two_m


def test_the_heading_goes_with_the_gyroscope_until_a_pose_comes() -> None:
    rig = hovering(outside_rig(gyro_bias_radps=(0.0, 0.0, math.radians(0.5))))
    before_deg = wrong_heading_deg(rig)
    fed(rig, 4.0, stream=HERE)
    assert wrong_heading_deg(rig) - before_deg == pytest.approx(2.0, abs=0.3)

    def pose(rig: Rig) -> None:
        w, x, y, z = rig.world.quaternion
        rig.firmware.external_pose(place(rig), (x, y, z, w))

    fed(rig, 1.0, pose, HERE)
    assert abs(wrong_heading_deg(rig)) < 0.3


def test_drag_is_not_felt() -> None:
    """A draught's push has no place in the model: a tilt is believed instead."""
    rig = hovering(outside_rig(draught_mps=(0.3, 0.0, 0.0)))
    fed(rig, 2.0, stream=HERE)
    assert error_m(rig) < 0.03
    assert abs(wrong_pitch_deg(rig)) > 0.1


def test_standing_it_is_drawn_back_to_level_and_to_its_first_heading() -> None:
    """By 0.001 at each prediction (source): within 5 s 3.9 deg are left of the 5 turned."""
    rig = outside_rig(gyro_bias_radps=(0.0, 0.0, math.radians(1.0)))
    reset(rig)
    fed(rig, 5.0)
    assert wrong_heading_deg(rig) == pytest.approx(3.9, abs=0.3)
