"""Laws of the simulated physics: each against a hand calculation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from perchctl.geometry import GRAVITY_MPS2, rotation_from_quaternion, rotation_from_rpy
from perchctl.sim import CONTROL_PERIOD_S, Scenario
from perchctl.sim.world import DRAG_VERTICAL_NSPM, SUCTION_LENGTH_M, World
from tests.helpers.carried import Hand, lifted_and_turned
from tests.helpers.firmware_rig import make_rig

OFF = (0.0, 0.0, 0.0, 0.0)
GEAR_Z_M = 0.03
CEILING_M = 2.2


def make(**conditions: Any) -> World:
    return World(Scenario(**({"battery_rest_v": 4.2} | conditions)))


def run(world: World, seconds: float, motors: tuple[float, float, float, float] = OFF) -> None:
    for _ in range(round(seconds / CONTROL_PERIOD_S)):
        world.step(motors)


def place(world: World) -> tuple[float, float, float]:
    return world.x_m, world.y_m, world.z_m


def felt_mps2(world: World) -> tuple[float, float, float]:
    return world.fx_mps2, world.fy_mps2, world.fz_mps2


def hang(world: World, offset_m: tuple[float, float] = (0.0, 0.0)) -> None:
    """Put the gear's tip against the ceiling."""
    world.set_pose((offset_m[0], offset_m[1], CEILING_M - GEAR_Z_M))
    run(world, 0.1)


def test_free_fall_is_the_closed_form_with_linear_drag() -> None:
    world = make(ceiling_z_m=4.0)
    world.set_pose((0.0, 0.0, 3.0))
    run(world, 0.4)
    memory_s = 0.042 / DRAG_VERTICAL_NSPM
    gone = 1.0 - math.exp(-0.4 / memory_s)
    fallen_m = GRAVITY_MPS2 * memory_s * (0.4 - memory_s * gone)
    assert world.vz_mps == pytest.approx(-GRAVITY_MPS2 * memory_s * gone, rel=1e-3)
    # One Euler step of 2 ms at this speed is 8 mm.
    assert 3.0 - world.z_m == pytest.approx(fallen_m, abs=0.008)
    assert np.linalg.norm(felt_mps2(world)) < 1.2


def test_draught_pushes_to_its_own_side_and_gusts_repeat_with_the_seed() -> None:
    def drifted(seed: int, wind: tuple[float, float, float]) -> Any:
        world = make(seed=seed, draught_mps=wind)
        world.set_pose((0.0, 0.0, 1.5))
        run(world, 0.4)
        return world.vx_mps, world.vy_mps, world.vz_mps

    still = drifted(1, (0.0, 0.0, 0.0))
    assert still[:2] == pytest.approx([0, 0], abs=1e-9)
    windy = drifted(1, (1.0, 0.0, 0.0))
    assert windy[0] > 0.02
    assert windy == pytest.approx(drifted(1, (1.0, 0.0, 0.0)), abs=0.0)
    assert windy[1] != drifted(2, (1.0, 0.0, 0.0))[1]


@pytest.mark.long
def test_hangs_level_in_its_place_for_a_minute() -> None:
    world = make()
    hang(world, (0.004, 0.003))
    run(world, 1.0)
    before = world.gear_miss_m()
    assert before == pytest.approx(0.005, abs=2e-4)
    run(world, 60.0)
    assert world.magnet_engaged
    assert world.gear_miss_m() == pytest.approx(before, abs=1e-4)
    assert rotation_from_quaternion(world.quaternion)[2, 2] > math.cos(math.radians(0.5))
    # What the ceiling pushes back is the pull less the weight.
    assert world.push_n_and_on_floor()[0] == pytest.approx(1.2 - 0.042 * GRAVITY_MPS2, rel=0.1)
    assert world.fz_mps2 == pytest.approx(GRAVITY_MPS2, abs=0.05)


@pytest.mark.parametrize(
    ("aside_m", "below_m", "pull_n", "conditions", "holds"),
    [
        (0.020, 0.0, 0.0, {}, True),
        (0.030, 0.0, 0.0, {}, False),
        (0.0, 0.004, 0.0, {}, False),
        (0.0, 0.0, 0.0, {"no_target": True}, False),
        (0.0, 0.0, 0.70, {}, True),  # 1.2 N, of which the weight takes 0.41
        (0.0, 0.0, 0.90, {}, False),
    ],
)
def test_the_magnet_holds_near_the_target_and_up_to_its_force(
    aside_m: float, below_m: float, pull_n: float, conditions: dict[str, Any], holds: bool
) -> None:
    """Within 25 mm aside and 3 mm below; a bare ceiling holds nothing."""
    world = make(target_xy_m=(0.5, -0.2), **conditions)
    world.set_pose((0.5 + aside_m, -0.2, CEILING_M - GEAR_Z_M - below_m))
    run(world, 0.1)
    world.external_force_n = (0.0, 0.0, -pull_n)
    run(world, 0.3)
    assert world.magnet_engaged is holds
    assert (world.z_m > 2.1) is holds


def test_a_weak_first_contact_breaks_and_the_second_holds() -> None:
    world = make(first_contact_force_n=0.3)  # less than the weight
    for holds in (False, True):
        hang(world)
        run(world, 0.5)
        assert world.magnet_engaged is holds
        assert (world.z_m > 2.1) is holds


# The air ------------------------------------------------------------------------------


@pytest.mark.parametrize("height_m", [0.03, 0.035, 0.04, 0.05, 0.07, 0.1, 0.15])
def test_the_ceilings_pull_is_that_of_momentum_theory(height_m: float) -> None:
    """A rotor of radius R at D below a ceiling has its wake's power divided by
    g = (1 + sqrt(1 + (R / D)^2 / 8)) / 2 (Hsiao and Chirarattananon, arXiv 1905.04632, who
    measured it with rotors of this radius); at the same power the thrust grows by g^(2/3)."""
    gap_m = height_m - 0.01
    g = 0.5 + 0.5 * math.sqrt(1.0 + (0.023 / gap_m) ** 2 / 8.0)
    gained = Scenario().ceiling_suction * math.exp(-height_m / SUCTION_LENGTH_M)
    assert gained == pytest.approx(g ** (2.0 / 3.0) - 1.0, abs=0.006)


# In a hand ------------------------------------------------------------------------------


HOME = (0.0, 0.0, 0.012)


def test_the_attitude_estimate_follows_a_hand_all_the_way() -> None:
    """By the gyroscope: what is put somewhere at once is followed in seconds only."""
    rig = make_rig()
    world, estimator = rig.world, rig.firmware.estimator
    world.move_by_hand(Hand(lifted_and_turned(HOME)))
    turned, felt = [], []
    for _ in range(round(8.0 / CONTROL_PERIOD_S)):
        rig.firmware.step()
        now = estimator.now
        own = rotation_from_rpy(
            *(math.radians(a) for a in (now.roll_deg, -now.pitch_deg, now.yaw_deg))
        )
        off = own.T @ rotation_from_quaternion(world.quaternion)
        turned.append(math.degrees(math.acos(min(1.0, (float(np.trace(off)) - 1.0) / 2.0))))
        felt.append(estimator.acc_g[2])
    assert max(turned) < 2.0
    assert max(felt) > 1.08, "lifted"
    assert min(felt) < 0.9, "tilted"
    assert place(world) == pytest.approx(HOME, abs=1e-6)
