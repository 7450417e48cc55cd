"""The simulated vehicle against numbers from recorded flights of real Crazyflies 2.1: NB is
nanobench-iros2026 (one vehicle, 104 flights), NS is neural-swarm (three vehicles). Ranges are the
10th to 90th percentile over the flights, medians before them (docs/real-flights.md)."""

from __future__ import annotations

import math
from statistics import median
from typing import Any

import numpy as np
import pytest

from perchctl.geometry import GRAVITY_MPS2
from perchctl.profile import load_profile
from perchctl.sim import CONTROL_PERIOD_S, Scenario, draw_scenario
from perchctl.sim.powertrain import FULL_COMMAND, Powertrain, motor_voltage
from perchctl.sim.world import World
from tests.helpers.firmware_rig import at_height, make_rig

MASS_KG = 0.042
AIR = {"drag_nspm": 0.016, "airspeed_moment_nmspm": 0.7e-3, "ground_effect": 0.15}
SEEDS = range(200)
DRAWN = [draw_scenario(load_profile("sim"), seed) for seed in SEEDS]


def world_at(height_m: float = 1.0, **conditions: Any) -> World:
    keys: dict[str, Any] = {"battery_rest_v": 4.2, "ceiling_z_m": 4.0, **AIR, **conditions}
    world = World(Scenario(mass_kg=MASS_KG, **keys))
    world.set_pose((0.0, 0.0, height_m))
    return world


def hover_duty(world: World, part: float = 1.0) -> float:
    """The duty cycle at which the motors carry that part of the weight, by the curve."""
    volts = motor_voltage(part * MASS_KG * GRAVITY_MPS2 / 4.0)
    return FULL_COMMAND * volts / world.battery_v


def hover(world: World, lasts_s: float) -> None:
    for _ in range(round(lasts_s / CONTROL_PERIOD_S)):
        duty = hover_duty(world)
        world.step((duty, duty, duty, duty))


# --- What is drawn --------------------------------------------------------------------------------


def test_motors_differ_as_recorded_ones_do() -> None:
    """Strongest less weakest over the mean: NB 16 % (7..40), NS 17 % (12..22)."""
    spreads = [(max(s) - min(s)) / np.mean(s) for s in (one.motor_strength for one in DRAWN)]
    assert 0.12 < median(spreads) < 0.18
    low, high = np.quantile(spreads, [0.1, 0.9])
    assert low > 0.05
    assert high < 0.40
    assert 0.95 < median([np.mean(one.motor_strength) for one in DRAWN]) < 1.1


def test_the_air_acts_as_on_recorded_vehicles() -> None:
    """The constants of this file are the middle of what is drawn."""
    for name, value in AIR.items():
        drawn = [getattr(one, name) for one in DRAWN]
        assert median(drawn) == pytest.approx(value, rel=0.1)
        assert min(drawn) < 0.95 * value
        assert max(drawn) > 1.05 * value


def test_packs_differ_as_recorded_ones_do() -> None:
    """NB 0.109..0.229 ohm, 19 % of the flights above 0.19."""
    ohms = [one.cell_resistance_ohm or 0.0 for one in DRAWN]
    assert min(ohms) >= 0.109
    assert max(ohms) <= 0.231
    assert 0.1 < np.mean(np.array(ohms) > 0.19) < 0.4


def test_another_range_moves_nothing_else() -> None:
    """Each part has a random stream of its own."""
    other = load_profile("sim").with_({"simulation.thrust_noise": (0.005, 0.01)})
    for seed in range(10):
        new, old = draw_scenario(other, seed), DRAWN[seed]
        assert new.thrust_noise != old.thrust_noise
        assert new.motor_strength == old.motor_strength
        assert new.acc_vibration_g == old.acc_vibration_g
        assert new.mass_kg == old.mass_kg


# --- What acts on the body ------------------------------------------------------------------------


def test_level_drag_takes_a_third_of_the_speed_each_second() -> None:
    """NB: 0.38 of the mass (0.36..0.41), linear in the speed."""
    slowed = []
    for speed_mps in (0.5, 1.0):
        world = world_at()
        hover(world, 0.5)
        world.set_pose((0.0, 0.0, 1.0), velocity_mps=(speed_mps, 0.0, 0.0))
        hover(world, 0.004)  # until it has tilted
        slowed.append(-world.fx_mps2 / world.vx_mps)
    assert slowed == pytest.approx([0.38, 0.38], abs=0.025)


@pytest.mark.parametrize("ahead", [True, False])
def test_airspeed_tilts_it_away_from_where_it_flies(ahead: bool) -> None:
    """NB: 0.8e-3 N.m for each m/s forward, 0.7e-3 sideways; in forward flight the nose goes up, in
    flight to the left the left side does."""
    world = world_at(authority=1.0)
    hover(world, 0.5)
    velocity = (1.0, 0.0, 0.0) if ahead else (0.0, 1.0, 0.0)
    world.set_pose((0.0, 0.0, 1.0), velocity_mps=velocity)
    hover(world, 0.01)
    rate_radps = -world.q_radps if ahead else world.p_radps
    inertia_kgm2 = (1.67e-5 if ahead else 1.66e-5) * MASS_KG / 0.027
    assert rate_radps / 0.01 * inertia_kgm2 == pytest.approx(0.75e-3, abs=0.1e-3)


@pytest.mark.parametrize(("clearance_m", "needs"), [(0.015, 0.91), (0.05, 0.965), (0.15, 1.0)])
def test_near_the_floor_it_needs_less_thrust(clearance_m: float, needs: float) -> None:
    """NS: 0.91 with 0 to 3 cm of clearance, 0.965 with 3 to 7, 1 above."""
    felt_g = []
    for above_m in (clearance_m, 2.0):
        world = world_at(above_m + 0.012)
        world.set_pose((0.0, 0.0, above_m + 0.012), hold=True)
        hover(world, 0.5)
        world.let_go()
        hover(world, 0.004)
        felt_g.append(world.fz_mps2 / GRAVITY_MPS2)
    assert felt_g[1] / felt_g[0] == pytest.approx(needs, abs=0.02)


def test_what_turns_sluggishly_does_so_by_its_authority() -> None:
    """NB: angular acceleration for a torque 0.54 (0.41..0.69) of the data sheet's."""
    rates = []
    for authority in (1.0, 0.55):
        world = world_at(authority=authority)
        hover(world, 0.5)
        duty = hover_duty(world)
        for _ in range(10):
            world.step((duty, duty, 1.05 * duty, 1.05 * duty))
        rates.append(world.p_radps)
    assert rates[1] / rates[0] == pytest.approx(0.55, rel=0.02)


def test_a_centre_of_mass_ahead_lets_the_nose_sink() -> None:
    world = world_at(centre_of_mass_m=(0.002, 0.0))
    hover(world, 0.1)
    assert world.q_radps > 0.05  # nose down
    assert abs(world.p_radps) < 1e-6


def test_a_hanging_gear_stays_where_it_is_under_a_steady_push() -> None:
    """Friction is dry: a draught of 1.5 m/s, 24 mN, moves nothing within ten seconds."""
    world = World(Scenario(mass_kg=MASS_KG, ceiling_z_m=2.2))
    world.set_pose((0.004, 0.003, 2.2 - 0.03))
    for _ in range(500):
        world.step((0.0,) * 4)
    before_m = world.gear_tip_m()
    world.external_force_n = (0.024, 0.0, 0.0)
    for _ in range(5000):
        world.step((0.0,) * 4)
    assert world.magnet_engaged
    assert math.dist(world.gear_tip_m(), before_m) < 1e-6


# --- The motors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("to", "least_s", "most_s"), [(1.1, 0.03, 0.07), (0.9, 0.03, 0.07), (0.0, 0.1, 0.14)]
)
def test_motors_answer_as_fast_downwards_but_coast_without_a_voltage(
    to: float, least_s: float, most_s: float
) -> None:
    """NB: command to response 60 ms (50..80) in flight; NS: take-offs fit 30 to 50 ms up and down;
    at duty 0 nothing brakes a brushed motor. 63 % of the way of the speed."""
    motors = Powertrain(Scenario(battery_rest_v=4.2, cell_resistance_ohm=0.0, motors_brake=True))
    volts = motor_voltage(MASS_KG * GRAVITY_MPS2 / 4.0)
    duty = FULL_COMMAND * volts / motors.cell.battery_v
    for _ in range(1000):
        motors.step((duty,) * 4)
    begin_v = motor_voltage(motors.forces_n[0])
    took_s, gone = 0.0, 0.0
    while gone < 1.0 - math.exp(-1.0):
        motors.step((to * duty,) * 4)
        gone = (motor_voltage(motors.forces_n[0]) - begin_v) / ((to - 1.0) * begin_v)
        took_s += CONTROL_PERIOD_S
    assert least_s < took_s < most_s


def test_the_strength_is_that_of_each_motor() -> None:
    motors = Powertrain(Scenario(motor_strength=(1.0, 0.9, 1.1, 1.0)))
    for _ in range(500):
        motors.step((40_000.0,) * 4)
    first = motors.forces_n[0]
    assert motors.forces_n == pytest.approx((first, 0.9 * first, 1.1 * first, first))


def test_the_thrust_fluctuates_by_as_much_as_is_drawn() -> None:
    """And each motor for itself, with a memory of 20 ms."""
    motors = Powertrain(Scenario(thrust_noise=0.02))
    forces = []
    for _ in range(20_000):
        motors.step((40_000.0,) * 4)
        forces.append(motors.forces_n)
    m1, m2, *_ = np.array(forces[2000:]).T
    apart = (m1 - m2) / m1.mean() / math.sqrt(2.0)  # without the battery's sag, which both have
    assert apart.std() == pytest.approx(0.02, rel=0.1)
    kept = np.mean(apart[10:] * apart[:-10]) / apart.var()
    assert kept == pytest.approx(math.exp(-1.0), abs=0.08)


# --- Take-off, by the firmware's own controller ---------------------------------------------------


def take_off(**conditions: Any) -> tuple[float, float]:
    """How far a vehicle runs aside (mm) and turns (deg) within 1.5 s of its lift-off."""
    rig = make_rig(mass_kg=MASS_KG, **AIR, **conditions)
    world, aside_mm, turned_deg = rig.world, 0.0, 0.0
    goal_m, left = 0.0, round(1.5 / CONTROL_PERIOD_S)
    while left > 0 and rig.firmware.t_s < 8.0:
        goal_m = min(1.0, goal_m + 0.3 * 0.02)
        rig.run(0.02, at_height(goal_m))
        if world.height_m > 0.02:
            left -= round(0.02 / CONTROL_PERIOD_S)
        aside_mm = max(aside_mm, 1e3 * math.hypot(world.x_m, world.y_m))
        w, x, y, z = world.quaternion
        yaw_deg = math.degrees(math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
        turned_deg = max(turned_deg, abs(yaw_deg))
    return aside_mm, turned_deg


@pytest.mark.parametrize("share", [(1.03, 0.97, 1.085, 0.915), (1.08, 0.85, 1.25, 0.82)])
def test_unequal_motors_run_aside_and_turn_at_take_off(share: tuple[float, ...]) -> None:
    """The thrust asked of M1..M4 in two recorded flights; NB: 51 mm aside (26..99) and 3.5 deg
    (1.3..11) in 1.5 s, where equal motors run 4 mm and turn 0.006 deg."""
    aside_mm, turned_deg = take_off(motor_strength=tuple(1.0 / s for s in share))
    assert 10.0 < aside_mm < 99.0
    assert 1.3 < turned_deg < 20.0
    still_mm, level_deg = take_off()
    assert still_mm < 8.0
    assert level_deg < 0.1
