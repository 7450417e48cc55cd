"""A vehicle in a hand: what its sensors feel of the way is the way."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import InvalidValue
from perchctl.geometry import GRAVITY_MPS2, rotation_from_rpy
from perchctl.sim import CONTROL_PERIOD_S, Scenario
from perchctl.sim.carried import Stop, Way, lifted_and_turned
from perchctl.sim.firmware.vehicle import Firmware
from perchctl.sim.world import World

HOME = (0.0, 0.0, 0.012)


def test_the_attitude_estimate_follows_a_hand_all_the_way() -> None:
    """By the gyroscope: what is put somewhere at once is followed in seconds only."""
    scenario = Scenario()
    world = World(scenario)
    firmware = Firmware(world, scenario)
    world.carry(lifted_and_turned(HOME))
    turned, felt = [], []
    for _ in range(round(8.0 / CONTROL_PERIOD_S)):
        firmware.step()
        now = firmware.estimator.now
        own = rotation_from_rpy(
            *(math.radians(a) for a in (now.roll_deg, -now.pitch_deg, now.yaw_deg))
        )
        off = own.T @ world.state().R_world_body
        turned.append(math.degrees(math.acos(min(1.0, (float(np.trace(off)) - 1.0) / 2.0))))
        felt.append(firmware.estimator.acc_g[2])
    assert max(turned) < 2.0
    assert max(felt) > 1.08, "lifted"
    assert min(felt) < 0.9, "tilted"
    assert world.state().position_m == pytest.approx(HOME, abs=1e-6)
    assert world.state().rates_radps == pytest.approx(np.zeros(3), abs=1e-6)


def test_rates_and_accelerations_are_those_of_the_places() -> None:
    way = Way(Stop(0.0, HOME), lifted_and_turned(HOME))
    step_s = 0.002
    for t_s in np.linspace(0.3, 7.0, 25):
        before, now, after = (way.at(float(t_s) + k * step_s) for k in (-1, 0, 1))
        speed = (after.position_m - before.position_m) / (2.0 * step_s)
        turn = before.R.T @ after.R
        rates = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / (2.0 * step_s)
        assert now.velocity_mps == pytest.approx(speed, abs=1e-3)
        assert now.rates_radps == pytest.approx(rates, abs=0.01)
    assert abs(float(way.at(0.3).acceleration_mps2[2])) < 0.3 * GRAVITY_MPS2


def test_a_way_that_takes_no_time_is_refused() -> None:
    with pytest.raises(InvalidValue, match="needs time"):
        Way(Stop(0.0, HOME), [Stop(0.0, HOME)])
