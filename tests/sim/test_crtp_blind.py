"""A vehicle that has nothing but its IMU and what it is sent, through the real cflib: the figures
of docs/firmware.md, "The target as the only positioning system", against where it truly is.

`varPX` to `varPZ` are the variances that those figures are ("Variances").
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator

import pytest

from tests.helpers.crtp_rig import Pilot, kept, read

NO_DECK = {"external_position": 1.0}
SIGHT_S = 0.034
"""30 Hz, in control periods."""
SIGHT_NOISE_M = 0.005
FLYING_M = 0.8
VARIANCES = {f"kalman.var{name}": "float" for name in ("X", "Y", "Z", "PX", "PY", "PZ")}


@pytest.fixture
def bare(pilot: Pilot) -> Iterator[Pilot]:
    """Without a deck; its variances are logged."""
    with pilot.logging(VARIANCES, period_ms=20):
        yield pilot.fresh(extra=NO_DECK)


def spread_m2(pilot: Pilot) -> float:
    """The largest of the variances of which the figures are."""
    return max(pilot.now(f"kalman.varP{axis}") for axis in "XYZ")


def sights(pilot: Pilot, then: Callable[[], None] | None = None) -> Callable[[], None]:
    """Where it is, as a target shows it."""
    draw = random.Random(1)

    def send() -> None:
        place = pilot.sim.truth()["position_m"]
        pilot.cf.extpos.send_extpos(*(value + draw.gauss(0.0, SIGHT_NOISE_M) for value in place))
        if then is not None:
            then()

    return send


def error_m(pilot: Pilot) -> tuple[float, float, float]:
    x, y, z = pilot.sim.truth()["position_m"]
    now = [pilot.now(f"stateEstimate.{axis}") for axis in "xyz"]
    return now[0] - x, now[1] - y, now[2] - z


def hovering(pilot: Pilot, height_m: float = FLYING_M) -> None:
    """By an HL order, which needs no setpoints that could run dry."""
    pilot.stream(0.5, sights(pilot), SIGHT_S)
    pilot.unlock()
    pilot.cf.high_level_commander.takeoff(height_m, 2.0)
    pilot.stream(5.0, sights(pilot), SIGHT_S)


def set_to(pilot: Pilot, name: str, value: float) -> None:
    pilot.cf.param.set_value(name, f"{value:g}")
    kept(pilot, name, value)


@pytest.mark.long
def test_covered_for_good_the_variance_grows_and_the_vehicle_slides(bare: Pilot) -> None:
    """Rows "3e-4 m^2 all the way", "0.05 m^2 4 s after the loss, 0.2 after 7 s" and "12 s, 0.9 m
    aside", at 28 g."""
    bare.fresh(extra=NO_DECK, mass_kg=0.028)
    hovering(bare)
    assert spread_m2(bare) == pytest.approx(3e-4, rel=0.3)
    assert max(map(abs, error_m(bare))) < 0.02
    bare.advance(3.6)
    assert spread_m2(bare) < 0.05
    bare.advance(1.2)
    assert spread_m2(bare) > 0.05
    bare.advance(1.6)
    assert spread_m2(bare) < 0.2
    bare.advance(1.6)
    assert spread_m2(bare) > 0.2
    bare.advance(4.0)
    x, y, z = bare.sim.truth()["position_m"]
    assert 0.3 < math.hypot(x, y) < 1.5
    assert z == pytest.approx(FLYING_M, abs=0.4)  # the thrust's axis is measured
    assert math.hypot(bare.now("stateEstimate.x"), bare.now("stateEstimate.y")) < 0.1


def test_covered_for_a_moment_it_stays_where_it_is(bare: Pilot) -> None:
    """Row "0.7 s: recovered"."""
    hovering(bare)
    bare.advance(0.7)
    assert spread_m2(bare) < 0.003
    assert max(map(abs, error_m(bare))) < 0.05
    bare.stream(0.5, sights(bare), SIGHT_S)
    assert spread_m2(bare) == pytest.approx(3e-4, rel=0.3)
    assert max(map(abs, error_m(bare))) < 0.02


@pytest.mark.long
def test_pressed_and_blind_the_height_runs_away(bare: Pilot) -> None:
    """Row "z 0.1 to 0.2 m/s, variance 0.04 after 5 s and 0.2 after 8 s"."""
    bare.fresh(extra=NO_DECK, ceiling_z_m=0.95, no_target=True)
    hovering(bare)

    def press() -> None:
        bare.hold(1.6)

    bare.stream(2.0, sights(bare, press), SIGHT_S)
    assert spread_m2(bare) < 5e-4
    assert bare.sim.truth()["position_m"][2] == pytest.approx(0.92, abs=0.005)
    bare.stream(4.0, press, 0.2)
    four_m = error_m(bare)[2]
    bare.stream(1.0, press, 0.2)
    assert 0.1 < abs(error_m(bare)[2] - four_m) < 0.2
    assert 0.03 < spread_m2(bare) < 0.08
    bare.stream(3.0, press, 0.2)
    assert spread_m2(bare) == pytest.approx(0.2, rel=0.2)
    assert bare.sim.truth()["position_m"][2] == pytest.approx(0.92, abs=0.005)


def test_after_a_reset_the_first_position_is_believed(bare: Pilot) -> None:
    """Variance 100 m^2 level and 1 m^2 in height, whatever `kalman.initial*` says (source)."""
    assert read(bare, "deck.bcFlow2") == 0.0
    bare.stream(1.0, sights(bare), SIGHT_S)
    set_to(bare, "kalman.initialX", 0.4)
    try:
        bare.advance(0.1)
        assert math.hypot(*error_m(bare)) < 0.02  # it takes a reset
        for value in (1, 0):
            set_to(bare, "kalman.resetEstimation", value)
        bare.advance(0.05)
        assert bare.now("stateEstimate.x") == pytest.approx(0.4, abs=0.002)
        now = [bare.now(f"kalman.var{name}") for name in ("X", "Y", "Z", "PX")]
        assert now == pytest.approx((100.0, 100.0, 1.0, 1e-4), rel=0.3)
        bare.cf.extpos.send_extpos(1.2, -0.7, 0.3)
        bare.advance(0.05)
        place_m = [bare.now(f"stateEstimate.{axis}") for axis in "xyz"]
        assert place_m == pytest.approx((1.2, -0.7, 0.3), abs=0.002)
        assert bare.now("kalman.varX") < 2e-4
    finally:
        set_to(bare, "kalman.initialX", 0.0)
    assert read(bare.fresh(), "deck.bcFlow2") == 1.0


# What is sent is believed -------------------------------------------------------------


def test_a_pose_turns_the_heading(bare: Pilot) -> None:
    half = math.radians(20.0)

    def send() -> None:
        x, y, z = bare.sim.truth()["position_m"]
        bare.cf.extpos.send_extpose(x, y, z, 0.0, 0.0, math.sin(half), math.cos(half))

    bare.stream(1.5, send)
    assert bare.now("stateEstimate.yaw") == pytest.approx(40.0, abs=1.5)
