"""A vehicle without a deck: what its estimate makes of positions from outside, and of none."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.firmware.controller import Setpoint
from tests.helpers.firmware_rig import Rig, make_rig

Place = tuple[float, float, float]
Sender = Callable[[Rig], None]
HERE = Setpoint.position(0.0, 0.0, 0.8, 0.0)
PERIOD_S = 0.01


def outside_rig(**conditions: Any) -> Rig:
    return make_rig(extra={"external_position": 1.0}, **conditions)


def place(rig: Rig) -> Place:
    return rig.world.x_m, rig.world.y_m, rig.world.z_m


def send_truth(rig: Rig) -> None:
    rig.firmware.external_position(place(rig))


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
        fed(rig, 0.25, send, Setpoint.position(0.0, 0.0, 0.08 * (tenth + 1), 0.0))
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


def test_a_wrong_initial_heading_cannot_be_flown() -> None:
    """In the firmware's axes the position is then off in the wrong direction."""
    rig = outside_rig()
    rig.firmware.set_parameter("kalman.initialYaw", math.radians(110.0))
    hovering(rig)
    assert math.hypot(rig.world.x_m, rig.world.y_m) > 0.5


def test_millimetres_reset_the_estimate_for_ever() -> None:
    """Out of its bounds (`kalman.maxPos`) it begins again at its initial place."""
    rig = outside_rig()
    rig.world.set_pose((0.3, 0.0, 0.4), hold=True)

    def millimetres(rig: Rig) -> None:
        x, y, z = place(rig)
        rig.firmware.external_position((1000.0 * x, 1000.0 * y, 1000.0 * z))

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
    rig.firmware.external_position((number, 0.0, 0.0))
    rig.firmware.external_pose((0.0, 0.0, number), (number, 0.0, 0.0, 0.0))
    fed(rig, 0.1)
    assert error_m(rig) < 0.01


# --- What the IMU's errors do, flying and standing --------------------------------------------


G = GRAVITY_MPS2


def wrong_heading_deg(rig: Rig) -> float:
    w, x, y, z = rig.world.quaternion
    true = math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
    return rig.firmware.log_value("stateEstimate.yaw") - math.degrees(true)


def wrong_pitch_deg(rig: Rig) -> float:
    w, x, y, z = rig.world.quaternion
    true = -math.asin(2 * (w * y - x * z))  # the firmware's is nose up
    return rig.firmware.log_value("stateEstimate.pitch") - math.degrees(true)


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
