"""Positions from outside through the real cflib: parameters, `extpos`, `extpose`, decks."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from tests.helpers.crtp_rig import Pilot, kept, read

NO_DECK = {"external_position": 1.0}
PARAMETERS = {
    "stabilizer.estimator": 2.0,
    "locSrv.extPosStdDev": 0.02,
    "locSrv.extQuatStdDev": 0.05,
    "kalman.initialX": 0.4,
    "kalman.initialY": -0.3,
    "kalman.initialZ": 0.1,
    "kalman.initialYaw": 0.5,
}


def send_truth(pilot: Pilot) -> None:
    x, y, z = pilot.sim.truth()["position_m"]
    pilot.cf.extpos.send_extpos(x, y, z)


def fed(pilot: Pilot, seconds: float, send: Callable[[], None]) -> None:
    """At 50 Hz, so that the test takes no minutes."""
    pilot.stream(seconds, send)


def test_parameters_are_kept_and_the_estimate_begins_where_they_say(pilot: Pilot) -> None:
    pilot.fresh(extra=NO_DECK)
    assert read(pilot, "deck.bcFlow2") == 0.0
    before = {name: read(pilot, name) for name in PARAMETERS}
    try:
        for name, value in PARAMETERS.items():
            pilot.cf.param.set_value(name, f"{value:g}")
            kept(pilot, name, value)
        for value in (1, 0):
            pilot.cf.param.set_value("kalman.resetEstimation", str(value))
            kept(pilot, "kalman.resetEstimation", value)
        pilot.advance(0.05)
        start = [pilot.now(f"stateEstimate.{axis}") for axis in "xyz"]
        assert start == pytest.approx((0.4, -0.3, 0.1), abs=0.01)
        assert pilot.now("stateEstimate.yaw") == pytest.approx(math.degrees(0.5), abs=1.0)
    finally:
        for name, value in before.items():
            pilot.cf.param.set_value(name, f"{value:g}")
    assert read(pilot.fresh(), "deck.bcFlow2") == 1.0


def test_it_takes_off_by_positions_and_falls_for_false_ones(pilot: Pilot) -> None:
    pilot.fresh(extra=NO_DECK)
    fed(pilot, 0.5, lambda: send_truth(pilot))
    pilot.unlock()

    def hold() -> None:
        send_truth(pilot)
        pilot.hold(0.5)

    fed(pilot, 3.0, hold)
    x, y, z = pilot.sim.truth()["position_m"]
    assert z == pytest.approx(0.5, abs=0.15)
    assert math.hypot(x, y) < 0.05
    for axis, value in zip("xyz", (x, y, z), strict=True):
        assert pilot.now(f"stateEstimate.{axis}") == pytest.approx(value, abs=0.02)

    def lie() -> None:
        x, y, z = pilot.sim.truth()["position_m"]
        pilot.cf.extpos.send_extpos(x + 0.5, y, z)
        pilot.hold(0.5)

    fed(pilot, 3.0, lie)
    assert pilot.sim.truth()["position_m"][0] == pytest.approx(-0.5, abs=0.1)


def test_a_pose_turns_the_heading(pilot: Pilot) -> None:
    pilot.fresh(extra=NO_DECK)
    half = math.radians(20.0)

    def send() -> None:
        x, y, z = pilot.sim.truth()["position_m"]
        pilot.cf.extpos.send_extpose(x, y, z, 0.0, 0.0, math.sin(half), math.cos(half))

    fed(pilot, 1.5, send)
    assert pilot.now("stateEstimate.yaw") == pytest.approx(40.0, abs=1.5)
