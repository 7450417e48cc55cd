"""Laws of the simulated physics: each against a hand calculation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.errors import InvalidValue
from perchctl.geometry import GRAVITY_MPS2, rotation_from_rpy
from perchctl.sim import CONTROL_PERIOD_S, MOTOR_FORCE_N, REST_HEIGHT_M, Scenario
from perchctl.sim.firmware import Firmware
from perchctl.sim.powertrain import (
    FULL_COMMAND,
    MOTOR_COAST_S,
    MOTOR_LAG_S,
    STANDING_LAG_S,
    Powertrain,
    motor_v,
    thrust_n,
)
from perchctl.sim.world import (
    DRAG_VERTICAL_NSPM,
    SUCTION_LENGTH_M,
    Stop,
    Way,
    World,
)
from tests.helpers.carried import lifted_and_turned

OFF = (0.0, 0.0, 0.0, 0.0)
GEAR_Z_M = 0.03
CEILING_M = 2.2


def make(**conditions: Any) -> World:
    return World(Scenario(**({"battery_rest_v": 4.2} | conditions)))


def run(world: World, seconds: float, motors: tuple[float, float, float, float] = OFF) -> None:
    for _ in range(round(seconds / CONTROL_PERIOD_S)):
        world.step(motors)


def drive(world: World, seconds: float, command: float) -> None:
    """Four equal thrust commands, each turned into the duty cycle that gives its thrust."""
    volts = motor_v(command / FULL_COMMAND * MOTOR_FORCE_N)
    for _ in range(round(seconds / CONTROL_PERIOD_S)):
        world.step((min(FULL_COMMAND, FULL_COMMAND * volts / world.battery_v),) * 4)


def lift_n(world: World, mass_kg: float) -> float:
    return float(world.state().specific_force_mps2[2]) * mass_kg


def hang(world: World, offset_m: tuple[float, float] = (0.0, 0.0)) -> None:
    """Put the gear's tip against the ceiling."""
    world.set_pose((offset_m[0], offset_m[1], CEILING_M - GEAR_Z_M))
    run(world, 0.1)


def test_rests_on_the_floor_and_reads_one_g() -> None:
    world = make()
    run(world, 0.5)
    state = world.state()
    assert state.floor_contact
    assert state.position_m == pytest.approx([0, 0, REST_HEIGHT_M], abs=2e-4)
    assert state.specific_force_mps2 == pytest.approx([0, 0, GRAVITY_MPS2], abs=0.02)


def test_free_fall_is_the_closed_form_with_linear_drag() -> None:
    world = make(ceiling_z_m=4.0)
    world.set_pose((0.0, 0.0, 3.0))
    run(world, 0.4)
    state = world.state()
    memory_s = 0.042 / DRAG_VERTICAL_NSPM
    gone = 1.0 - math.exp(-0.4 / memory_s)
    fallen_m = GRAVITY_MPS2 * memory_s * (0.4 - memory_s * gone)
    assert state.velocity_mps[2] == pytest.approx(-GRAVITY_MPS2 * memory_s * gone, rel=1e-3)
    # One Euler step of 2 ms at this speed is 8 mm.
    assert 3.0 - state.position_m[2] == pytest.approx(fallen_m, abs=0.008)
    assert np.linalg.norm(state.specific_force_mps2) < 1.2


@pytest.mark.parametrize("mass_kg", [0.030, 0.042])
def test_hovers_at_the_weight_over_full_thrust(mass_kg: float) -> None:
    world = make(mass_kg=mass_kg)
    command = mass_kg * GRAVITY_MPS2 / (4 * MOTOR_FORCE_N) * FULL_COMMAND
    world.set_pose((0.0, 0.0, 1.0), hold=True)
    drive(world, 1.0, command)  # past the motors' lag
    world.let_go()
    drive(world, 0.5, command)
    assert world.vz_mps == pytest.approx(0.0, abs=0.005)


def test_motors_run_down_more_slowly_than_up() -> None:
    world = make(mass_kg=0.048, ceiling_z_m=9.0)
    world.set_pose((0.0, 0.0, 5.0), hold=True)
    drive(world, 1.0, 40000.0)
    steady_n = 40000.0 / FULL_COMMAND * MOTOR_FORCE_N
    world.let_go()
    run(world, MOTOR_COAST_S)
    left_n = 4 * thrust_n(motor_v(steady_n) * math.exp(-1.0))
    drag_n = -DRAG_VERTICAL_NSPM * world.vz_mps
    assert lift_n(world, 0.048) == pytest.approx(left_n + drag_n, abs=0.003)
    assert MOTOR_COAST_S > MOTOR_LAG_S


def seconds_to_63_percent(from_v: float, to_v: float) -> float:
    """How long a motor that turns at one voltage takes for 63 per cent of the way to another."""
    train = Powertrain(4.2)
    reached_n = thrust_n(to_v - math.exp(-1.0) * (to_v - from_v))
    for _ in range(500):
        train.step((FULL_COMMAND * from_v / train.battery_v,) * 4)
    for step in range(500):
        if train.forces_n[0] >= reached_n:
            return step * CONTROL_PERIOD_S
        train.step((FULL_COMMAND * to_v / train.battery_v,) * 4)
    raise AssertionError("it never came so far")


def test_a_motor_runs_up_faster_the_faster_it_turns() -> None:
    hover_v = motor_v(0.042 * GRAVITY_MPS2 / 4)
    near_s = seconds_to_63_percent(hover_v - 0.1, hover_v + 0.1)
    assert near_s == pytest.approx(MOTOR_LAG_S, abs=1.5 * CONTROL_PERIOD_S)
    assert 0.7 * STANDING_LAG_S < seconds_to_63_percent(0.0, 0.75) < STANDING_LAG_S
    assert 1.5 * MOTOR_LAG_S < seconds_to_63_percent(0.0, hover_v) < 2.0 * MOTOR_LAG_S


@pytest.mark.parametrize(("rest_v", "share"), [(4.2, 1.0), (3.8, 1.0), (3.5, 0.88)])
def test_full_thrust_is_the_same_until_the_battery_cannot_give_it(
    rest_v: float, share: float
) -> None:
    world = make(mass_kg=0.048, battery_rest_v=rest_v, ceiling_z_m=4.0)
    world.set_pose((0.0, 0.0, 1.0), hold=True)
    drive(world, 0.6, FULL_COMMAND)
    world.let_go()
    drive(world, 0.02, FULL_COMMAND)
    assert lift_n(world, 0.048) == pytest.approx(0.48 * share, rel=0.01)


@pytest.mark.parametrize(
    ("motors", "axis", "sign"),
    [
        ((0, 0, 1, 1), 0, 1),  # left motors up: roll to the right
        ((0, 1, 1, 0), 1, 1),  # back motors up: nose down
        ((0, 1, 0, 1), 2, 1),  # M2 and M4 turn clockwise: counter-clockwise reaction
    ],
)
def test_motor_pairs_turn_the_right_way(
    motors: tuple[int, int, int, int], axis: int, sign: int
) -> None:
    world = make()
    world.set_pose((0.0, 0.0, 1.0))
    a, b, c, d = (56000.0 + 2000.0 * m for m in motors)
    run(world, 0.05, (a, b, c, d))
    rates = world.state().rates_radps
    assert sign * rates[axis] > 0.01
    others = [i for i in range(3) if i != axis]
    assert np.abs(rates[others]).max() < 0.2 * abs(rates[axis])


@settings(max_examples=15, deadline=None)
@given(roll=st.floats(-3.0, 3.0), pitch=st.floats(-1.4, 1.4), yaw=st.floats(-3.0, 3.0))
def test_a_held_pose_is_kept_and_reads_gravity_in_body_axes(
    roll: float, pitch: float, yaw: float
) -> None:
    world = make()
    R = rotation_from_rpy(roll, pitch, yaw)
    world.set_pose((0.1, -0.2, 1.0), (roll, pitch, yaw), hold=True)
    run(world, 0.01, (50000.0,) * 4)
    state = world.state()
    assert state.R_world_body == pytest.approx(R, abs=1e-9)
    assert state.position_m == pytest.approx([0.1, -0.2, 1.0])
    assert state.specific_force_mps2 == pytest.approx(R.T @ [0, 0, GRAVITY_MPS2], abs=1e-9)


def test_draught_pushes_to_its_own_side_and_gusts_repeat_with_the_seed() -> None:
    def drifted(seed: int, wind: tuple[float, float, float]) -> Any:
        world = make(seed=seed, draught_mps=wind)
        world.set_pose((0.0, 0.0, 1.5))
        run(world, 0.4)
        return world.state().velocity_mps

    still = drifted(1, (0.0, 0.0, 0.0))
    assert still[:2] == pytest.approx([0, 0], abs=1e-9)
    windy = drifted(1, (1.0, 0.0, 0.0))
    assert windy[0] > 0.02
    assert windy == pytest.approx(drifted(1, (1.0, 0.0, 0.0)), abs=0.0)
    assert windy[1] != drifted(2, (1.0, 0.0, 0.0))[1]


def test_the_ceiling_sucks_within_a_few_centimetres() -> None:
    def climb(height_m: float) -> float:
        world = make(no_target=True)
        world.set_pose((0.0, 0.0, height_m), hold=True)
        run(world, 0.4, (56000.0,) * 4)
        world.let_go()
        run(world, 0.01, (56000.0,) * 4)
        return world.vz_mps

    far, near = climb(1.0), climb(CEILING_M - GEAR_Z_M - 0.005)
    assert 0.0 < (near - far) / 0.01 < 0.05 * GRAVITY_MPS2


def test_hangs_level_in_its_place_for_a_minute() -> None:
    world = make()
    hang(world, (0.004, 0.003))
    run(world, 1.0)
    before = world.gear_miss_m()
    assert before == pytest.approx(0.005, abs=2e-4)
    run(world, 60.0)
    state = world.state()
    assert state.magnet_engaged
    assert world.gear_miss_m() == pytest.approx(before, abs=1e-4)
    assert state.R_world_body[2, 2] > math.cos(math.radians(0.5))
    # What the ceiling pushes back is the pull less the weight.
    assert state.ceiling_force_n == pytest.approx(1.2 - 0.042 * GRAVITY_MPS2, rel=0.1)
    assert state.specific_force_mps2[2] == pytest.approx(GRAVITY_MPS2, abs=0.05)


@pytest.mark.parametrize(("pull_n", "holds"), [(0.70, True), (0.90, False)])
def test_breaks_when_pulled_with_more_than_its_force(pull_n: float, holds: bool) -> None:
    world = make()  # 1.2 N, of which the weight takes 0.41
    hang(world)
    world.external_force_n = (0.0, 0.0, -pull_n)
    run(world, 0.3)
    assert world.magnet_engaged is holds
    assert (world.z_m > 2.1) is holds


@pytest.mark.parametrize(
    ("offset_m", "below_m", "no_target", "holds"),
    [
        (0.020, 0.0, False, True),
        (0.030, 0.0, False, False),
        (0.0, 0.004, False, False),
        (0.0, 0.0, True, False),
    ],
)
def test_holds_only_within_millimetres_of_a_target(
    offset_m: float, below_m: float, no_target: bool, holds: bool
) -> None:
    """25 mm aside, and 3 mm below; a bare ceiling holds nothing."""
    world = make(target_xy_m=(0.5, -0.2), no_target=no_target)
    world.set_pose((0.5 + offset_m, -0.2, CEILING_M - GEAR_Z_M - below_m))
    run(world, 0.4)
    assert world.magnet_engaged is holds
    assert (world.z_m > 2.1) is holds


def test_a_weak_first_contact_breaks_and_the_second_holds() -> None:
    world = make(first_contact_force_n=0.3)  # less than the weight
    hang(world)
    run(world, 0.3)
    assert not world.magnet_engaged
    assert world.z_m < 2.1
    hang(world)
    run(world, 0.5)
    assert world.magnet_engaged


def test_the_gear_touches_before_the_frame() -> None:
    world = make(no_target=True)
    world.set_pose((0.0, 0.0, 2.1), hold=True)
    drive(world, 0.5, 65000.0)  # past the motors' lag
    world.let_go()
    drive(world, 1.0, 65000.0)
    state = world.state()
    assert state.ceiling_force_n > 0.02
    assert world.gear_tip_m()[2] == pytest.approx(CEILING_M, abs=1e-3)


# The air ------------------------------------------------------------------------------


ROTOR_RADIUS_M = 0.023
ROTORS_OVER_CENTRE_M = 0.01


@pytest.mark.parametrize("height_m", [0.03, 0.035, 0.04, 0.05, 0.07, 0.1, 0.15])
def test_the_ceilings_pull_is_that_of_momentum_theory(height_m: float) -> None:
    """A rotor of radius R at D below a ceiling has its wake's power divided by
    g = (1 + sqrt(1 + (R / D)^2 / 8)) / 2 (Hsiao and Chirarattananon, arXiv 1905.04632, who
    measured it with rotors of this radius); at the same power the thrust grows by g^(2/3)."""
    gap_m = height_m - ROTORS_OVER_CENTRE_M
    g = 0.5 + 0.5 * math.sqrt(1.0 + (ROTOR_RADIUS_M / gap_m) ** 2 / 8.0)
    gained = Scenario().ceiling_suction * math.exp(-height_m / SUCTION_LENGTH_M)
    assert gained == pytest.approx(g ** (2.0 / 3.0) - 1.0, abs=0.006)


# In a hand ------------------------------------------------------------------------------


HOME = (0.0, 0.0, 0.012)


def test_the_attitude_estimate_follows_a_hand_all_the_way() -> None:
    """By the gyroscope: what is put somewhere at once is followed in seconds only."""
    scenario = Scenario()
    world = World(scenario)
    firmware = Firmware(world, scenario)
    world.move_by_hand(lifted_and_turned(HOME))
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


def test_a_way_that_takes_no_time_is_refused() -> None:
    with pytest.raises(InvalidValue, match="needs time"):
        Way(Stop(0.0, HOME), [Stop(0.0, HOME)])
