"""A vehicle without a deck: what its estimate makes of positions from outside, and of none."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.firmware.controller import Setpoint
from tests.helpers.firmware_rig import Rig, at_height, make_rig

Place = tuple[float, float, float]
Sender = Callable[[Rig], None]
HERE = at_height(0.8)
PERIOD_S = 0.01


def outside_rig(**conditions: Any) -> Rig:
    return make_rig(extra={"external_position": 1.0}, **conditions)


def place(rig: Rig) -> Place:
    return rig.world.x_m, rig.world.y_m, rig.world.z_m


def send_truth(rig: Rig) -> None:
    rig.firmware.external(place(rig))


def errors(rig: Rig) -> Place:
    """The estimate less the truth."""
    now = rig.firmware.estimator.now
    x, y, z = place(rig)
    return now.x_m - x, now.y_m - y, now.z_m - z


def error_m(rig: Rig) -> float:
    return math.hypot(*errors(rig))


def fed(
    rig: Rig, seconds: float, send: Sender = send_truth, stream: Setpoint | None = None
) -> list[Place]:
    """Positions at 100 Hz; estimate less truth after each."""
    found = []
    for i in range(round(seconds / PERIOD_S)):
        if stream is not None and i % 2 == 0:
            rig.firmware.low_level(stream)
        send(rig)
        for _ in range(5):
            rig.firmware.step()
        found.append(errors(rig))
    return found


def reset(rig: Rig) -> None:
    rig.firmware.set_parameter("kalman.resetEstimation", 1)
    rig.firmware.set_parameter("kalman.resetEstimation", 0)


def hovering(rig: Rig, send: Sender = send_truth) -> Rig:
    fed(rig, 0.5)
    reset(rig)
    fed(rig, 1.0)
    for tenth in range(10):
        fed(rig, 0.25, send, at_height(0.08 * (tenth + 1)))
    fed(rig, 3.0, send, HERE)
    return rig


def test_it_flies_by_ideal_positions_as_measured() -> None:
    """Row "ideal outside positioning: 2.5e-4 m^2"."""
    rig = hovering(outside_rig())
    found = fed(rig, 1.0, stream=HERE)
    assert max(math.hypot(*error) for error in found) < 0.01
    assert place(rig) == pytest.approx((0.0, 0.0, 0.8), abs=0.12)  # the integral settles slowly
    log = rig.firmware.log_value
    assert max(log(f"kalman.varP{axis}") for axis in "XYZ") == pytest.approx(2.5e-4, rel=0.1)


def test_millimetres_reset_the_estimate_for_ever() -> None:
    """Out of its bounds (`kalman.maxPos`) it begins again at its initial place."""
    rig = outside_rig()
    rig.world.set_pose((0.3, 0.0, 0.4), hold=True)

    def millimetres(rig: Rig) -> None:
        x, y, z = place(rig)
        rig.firmware.external((1000.0 * x, 1000.0 * y, 1000.0 * z))

    fed(rig, 1.0, millimetres)
    assert error_m(rig) == pytest.approx(0.5, abs=0.05)
    assert rig.firmware.log_value("kalman.varX") > 10.0
    rig.world.set_pose((0.03, 0.0, 0.06), hold=True)  # within them it is believed
    fed(rig, 1.0, millimetres)
    assert error_m(rig) == pytest.approx(999.0 * math.hypot(0.03, 0.06), rel=0.05)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_what_is_no_number_does_no_harm(number: float) -> None:
    rig = outside_rig()
    fed(rig, 0.5)
    rig.firmware.external((number, 0.0, 0.0))
    rig.firmware.external((0.0, 0.0, number), (0.0, number, 0.0, 0.0))
    fed(rig, 0.1)
    assert error_m(rig) < 0.01


# --- What the IMU's errors do, flying and standing --------------------------------------------


@pytest.mark.parametrize("axis", [0, 2])
def test_a_bias_of_the_accelerometer_hurts_little_in_flight(axis: int) -> None:
    """Row "the accelerometer along the thrust axis only, scaled to 1 g on the ground"."""
    bias = [0.0, 0.0, 0.0]
    bias[axis] = 0.02 * GRAVITY_MPS2
    rig = hovering(outside_rig(acc_bias_mps2=tuple(bias)))
    rig.run(2.0, HERE)
    assert abs(errors(rig)[axis]) < 0.05  # 0.4 m, if it counted


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
