"""A vehicle without a deck: what its estimate makes of positions from outside, and of none."""

from __future__ import annotations

import math
import random
import statistics
from collections.abc import Callable
from typing import Any

import pytest

from perchctl.sim.firmware.commands import HlTakeoff, LowLevelCommand, PositionCommand
from tests.helpers.firmware_rig import Rig, make_rig

Place = tuple[float, float, float]
Sender = Callable[[Rig], None]
HERE = PositionCommand(0.0, 0.0, 0.8, 0.0)
PERIOD_S = 0.01


def outside_rig(**conditions: Any) -> Rig:
    return make_rig(extra={"external_position": 1.0}, **conditions)


def place(rig: Rig) -> Place:
    return rig.world.x_m, rig.world.y_m, rig.world.z_m


def send_truth(rig: Rig) -> None:
    rig.firmware.external_position(place(rig))


def fed(
    rig: Rig, seconds: float, send: Sender = send_truth, stream: LowLevelCommand | None = None
) -> list[Place]:
    """Positions at 100 Hz; estimate less truth after each."""
    errors = []
    for i in range(round(seconds / PERIOD_S)):
        if stream is not None and i % 2 == 0:
            rig.firmware.low_level(stream)
        send(rig)
        for _ in range(5):
            rig.firmware.step()
        log = rig.firmware.log_value
        x, y, z = place(rig)
        errors.append(
            (log("stateEstimate.x") - x, log("stateEstimate.y") - y, log("stateEstimate.z") - z)
        )
    return errors


def reset(rig: Rig) -> None:
    rig.firmware.set_parameter("kalman.resetEstimation", 1)
    rig.firmware.set_parameter("kalman.resetEstimation", 0)


def hovering(rig: Rig, send: Sender = send_truth) -> Rig:
    fed(rig, 0.5)
    reset(rig)
    fed(rig, 1.0)
    for tenth in range(10):
        fed(rig, 0.25, send, PositionCommand(0.0, 0.0, 0.08 * (tenth + 1), 0.0))
    fed(rig, 3.0, send, HERE)
    return rig


def told_variance(rig: Rig) -> float:
    return max(rig.firmware.log_value(f"kalman.varP{axis}") for axis in "XYZ")


def error_m(rig: Rig) -> float:
    log = rig.firmware.log_value
    x, y, z = place(rig)
    return math.dist(
        (log("stateEstimate.x"), log("stateEstimate.y"), log("stateEstimate.z")), (x, y, z)
    )


@pytest.fixture(scope="module")
def in_the_air() -> Rig:
    """Hovering by ideal positions; each test looks, and leaves it there."""
    return hovering(outside_rig())


def test_it_flies_by_ideal_positions_as_measured(in_the_air: Rig) -> None:
    """Row "ideal outside positioning: 2.5e-4 m^2"."""
    errors = fed(in_the_air, 1.0, stream=HERE)
    assert max(math.hypot(*error) for error in errors) < 0.01
    assert math.hypot(*place(in_the_air)[:2]) < 0.03
    assert place(in_the_air)[2] == pytest.approx(0.8, abs=0.12)  # the integral settles slowly
    assert told_variance(in_the_air) == pytest.approx(2.5e-4, rel=0.1)
    assert in_the_air.firmware.get_parameter("deck.bcFlow2") == 0.0
    assert in_the_air.firmware.log_value("range.zrange") == 0.0
    assert make_rig().firmware.get_parameter("deck.bcFlow2") == 1.0


def test_noise_is_filtered_and_the_parameter_says_how_much(in_the_air: Rig) -> None:
    numbers = [0.05 * math.sin(7919.0 * i) for i in range(1000)]

    def noisy(rig: Rig) -> None:
        x, y, z = place(rig)
        rig.firmware.external_position((x + numbers.pop(), y, z))

    spread = {}
    for sigma in (0.01, 0.1):
        in_the_air.firmware.set_parameter("locSrv.extPosStdDev", sigma)
        fed(in_the_air, 1.5, noisy, HERE)
        spread[sigma] = statistics.pstdev(e[0] for e in fed(in_the_air, 1.5, noisy, HERE))
    in_the_air.firmware.set_parameter("locSrv.extPosStdDev", 0.01)
    fed(in_the_air, 2.0, stream=HERE)
    assert spread[0.01] < 0.015  # of 35 mm that were sent
    assert spread[0.1] < 0.6 * spread[0.01]


def test_a_late_position_is_a_lag() -> None:
    rig = outside_rig()
    path: list[Place] = []

    def late(rig: Rig) -> None:
        path.append(place(rig))
        rig.firmware.external_position(path[max(0, len(path) - 11)])

    rig.world.set_pose((0.0, 0.0, 0.5), hold=True)
    for step in range(200):  # carried at 0.5 m/s
        rig.world.set_pose((0.005 * step, 0.0, 0.5), velocity_mps=(0.5, 0.0, 0.0), hold=True)
        errors = fed(rig, PERIOD_S, late)
    assert errors[-1][0] == pytest.approx(-0.05, abs=0.01)


def test_silence_is_drift_and_a_position_ends_it() -> None:
    """How much of it, and the variance that is told: tests/sim/test_crtp_blind.py."""
    rig = hovering(outside_rig())
    rig.run(0.3, HERE)
    assert error_m(rig) < 0.02
    rig.run(6.7, HERE)
    assert 0.05 < error_m(rig) < 0.6
    assert rig.firmware.log_value("kalman.varX") > 1.0
    fed(rig, 2.0, stream=HERE)
    assert error_m(rig) < 0.02
    assert told_variance(rig) == pytest.approx(2.5e-4, rel=0.15)
    assert rig.firmware.log_value("kalman.varX") < 2e-5


def test_blind_for_twelve_seconds_it_slides_by_what_was_measured() -> None:
    """Row "touched down 0.9 m aside, at 28 g": seeds differ by where they slide to."""
    aside_m = []
    for seed in range(3):
        rig = outside_rig(seed=seed, mass_kg=0.028)
        numbers = random.Random(seed)
        noisy = lambda rig: rig.firmware.external_position(  # noqa: E731
            tuple(value + numbers.gauss(0.0, 0.005) for value in place(rig))  # noqa: B023
        )
        rig.firmware.high_level(HlTakeoff(0.8, 2.0))
        fed(rig, 5.0, noisy)
        rig.run(12.0)
        aside_m.append(math.hypot(*place(rig)[:2]))
    assert statistics.median(aside_m) == pytest.approx(0.9, abs=0.3)


def test_the_heading_is_the_initial_one_until_a_pose_comes() -> None:
    rig = outside_rig()
    yaw = lambda: rig.firmware.log_value("stateEstimate.yaw")  # noqa: E731
    turned = (0.0, 0.0, math.sin(math.radians(15.0)), math.cos(math.radians(15.0)))  # 30 deg
    fed(rig, 0.5)
    assert yaw() == pytest.approx(0.0, abs=1.0)
    rig.firmware.set_parameter("kalman.initialYaw", math.radians(30.0))
    fed(rig, 0.2)
    assert yaw() == pytest.approx(0.0, abs=1.0)  # it takes a reset
    reset(rig)
    fed(rig, 0.5)
    assert yaw() == pytest.approx(30.0, abs=1.0)
    rig.firmware.set_parameter("kalman.initialYaw", 0.0)
    reset(rig)
    fed(rig, 1.0, lambda r: r.firmware.external_pose(place(r), turned))
    assert yaw() == pytest.approx(30.0, abs=1.0)


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


def test_another_estimator_does_not_hear_them() -> None:
    rig = outside_rig()
    fed(rig, 0.5)
    rig.firmware.set_parameter("stabilizer.estimator", 1)
    fed(rig, 0.5, lambda r: r.firmware.external_position((1.0, 1.0, 1.0)))
    assert error_m(rig) < 0.05
    assert rig.firmware.estimator.external_count == 100


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_what_is_no_number_does_no_harm(number: float) -> None:
    rig = outside_rig()
    fed(rig, 0.5)
    rig.firmware.external_position((number, 0.0, 0.0))
    rig.firmware.external_pose((0.0, 0.0, number), (number, 0.0, 0.0, 0.0))
    fed(rig, 0.1)
    assert error_m(rig) < 0.01


def test_the_same_flight_has_the_same_estimate() -> None:
    def estimate(seed: int) -> float:
        rig = outside_rig(seed=seed)
        fed(rig, 0.3)
        rig.run(1.0)
        return rig.firmware.log_value("stateEstimate.x")

    assert estimate(3) == estimate(3)
    assert estimate(3) != estimate(4)
