"""What the oracle is told of the true vehicle, and the facts that are kept of it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import load_calibration
from perchctl.faults import catalogue, truth
from perchctl.faults.effects import Effect, reboots
from perchctl.faults.oracle import Sample
from perchctl.faults.truth import CUT_S, FactsRecorder, WatchedVehicle, true_sample
from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import phase
from perchctl.profile import Profile, TargetConfig, load_profile
from perchctl.sim import Scenario
from tests.faults.test_oracle import HANGING

CAMERA = load_calibration("example_640x480.yaml")
SCENARIO = Scenario(seed=2, camera_rate_hz=0.01, no_target=True)
PROFILE: Profile = load_profile("sim")
DT_S = 0.01


def test_the_faults_know_the_same_phases_as_the_mission() -> None:
    """They keep sets of their own, so that a judge asks nothing of what it judges; a new phase has
    to be put into each."""
    hover = {phase.Phase.HOVER}  # not in the phases from which a campaign draws
    assert set(catalogue.CAMERA_GUIDED) | hover == phase.CAMERA_GUIDED_PHASES
    assert truth.GUIDED_BY_CAMERA == phase.CAMERA_GUIDED_PHASES
    assert truth.FREE_AIR == phase.FREE_AIR_PHASES
    assert set(catalogue.AIR) | hover == phase.AIRBORNE_PHASES == set(catalogue.USUAL_S)
    assert truth.STEERED_BY_TARGET | {phase.Phase.SEARCH, phase.Phase.APPROACH} == {
        *phase.PUBLISHED_METHOD_PHASES,
        *hover,
    }


@pytest.fixture
def vehicle() -> WatchedVehicle:
    return WatchedVehicle(SCENARIO, CAMERA, TargetConfig())


@pytest.mark.parametrize(
    ("order", "mass_kg", "pressing"),
    [
        (60000.0, 0.030, True), (60000.0, 0.038, True), (60000.0, 0.042, True),
        (50000.0, 0.042, False), (0.0, 0.042, False),
    ],
)  # fmt: skip
def test_the_largest_raw_thrust_presses_at_any_mass(
    order: float, mass_kg: float, pressing: bool
) -> None:
    """At a ceiling without a magnet. At 42 g 60,000 of 65,535 lift 7 % more than the weight
    (docs/firmware.md, "Thrust budget")."""
    heavy = WatchedVehicle(replace(SCENARIO, mass_kg=mass_kg), CAMERA, TargetConfig())
    world, scenario, firmware = heavy.world, heavy.scenario, heavy.firmware
    world.set_pose((0.0, 0.0, scenario.ceiling_z_m - scenario.gear_body_m[2]), hold=True)
    for step in range(700):
        if step == 500:  # the motors are up to speed
            world.let_go()
        firmware.motors = firmware.driver.pwm((order,) * 4, world.battery_v)
        world.step(firmware.motors)
    assert true_sample(heavy).pressing is pressing


@pytest.mark.parametrize(
    ("scenario", "reserve"),
    [
        (SCENARIO, 0.165),  # USUAL_THRUST_RESERVE
        (replace(SCENARIO, motor_strength=(0.94, 1.0, 1.0, 1.1)), 1.165 * 0.94 - 1.0),
    ],
)
def test_a_sample_tells_the_thrust_reserve_of_the_weakest_motor(
    scenario: Scenario, reserve: float
) -> None:
    sample = true_sample(WatchedVehicle(replace(scenario, mass_kg=0.042), CAMERA, TargetConfig()))
    assert sample.thrust_reserve == pytest.approx(reserve, abs=0.002)


def test_a_fluctuating_thrust_at_the_weight_does_not_press() -> None:
    """Held at the ceiling by 1 % more than its weight: a sample above 2 % is the fluctuation's."""
    noisy = WatchedVehicle(
        replace(SCENARIO, mass_kg=0.042, thrust_noise=0.05), CAMERA, TargetConfig()
    )
    world, scenario, firmware = noisy.world, noisy.scenario, noisy.firmware
    world.set_pose((0.0, 0.0, scenario.ceiling_z_m - scenario.gear_body_m[2]), hold=True)
    weight_n, pressed, lifts = scenario.mass_kg * GRAVITY_MPS2, [], []
    for step in range(700):
        if step == 500:
            world.let_go()
        firmware.motors = firmware.driver.pwm((56_900.0,) * 4, world.battery_v)
        world.step(firmware.motors)
        if step >= 500 and world.push_n_and_on_floor()[0] > 0.0:
            pressed.append(true_sample(noisy).pressing)
            lifts.append(sum(world.powertrain.forces_n) / weight_n)
    assert max(lifts) > 1.02
    assert not any(pressed)


def test_a_sample_tells_how_far_the_gear_is_from_the_target(vehicle: WatchedVehicle) -> None:
    x_m, y_m = vehicle.world.magnet.target_xy_m
    vehicle.world.set_pose((x_m + 0.04, y_m, 1.0), velocity_mps=(0.3, -0.4, 9.0))
    gear_m = SCENARIO.gear_body_m
    sample = true_sample(vehicle)
    assert sample.horizontal_mps == pytest.approx(0.5)
    assert sample.miss_m == pytest.approx(math.hypot(0.04 + gear_m[0], gear_m[1]))
    assert sample.below_m == pytest.approx(SCENARIO.ceiling_z_m - gear_m[2] - 1.0)
    above = WatchedVehicle(replace(SCENARIO, target_above_ceiling_m=0.1), CAMERA, TargetConfig())
    above.world.set_pose((x_m, y_m, SCENARIO.ceiling_z_m - gear_m[2]))
    assert true_sample(above).below_m == pytest.approx(0.1)


# --- facts ------------------------------------------------------------------------------

HOVER = HANGING._replace(hanging=False, motors_on=True)


class Recorded:
    """A recorder beside a vehicle of which only the script is true."""

    def __init__(self, rest_v: float = 4.1, effects: tuple[Effect, ...] = ()) -> None:
        self.magnet = SimpleNamespace(let_go=False)
        self.planner = SimpleNamespace(active=False)
        self.supervisor = SimpleNamespace(emergency=False)
        self.world = SimpleNamespace(
            magnet=self.magnet,
            battery_v=rest_v - 0.5,
        )
        vehicle: Any = SimpleNamespace(
            world=self.world,
            firmware=SimpleNamespace(planner=self.planner, supervisor=self.supervisor),
            scenario=SimpleNamespace(mass_kg=0.04),
        )
        self.facts = FactsRecorder(vehicle, PROFILE, effects)
        self.t_s = 0.0

    def show(self, sample: Sample, for_s: float, *, begun: bool = True, **changes: Any) -> Recorded:
        for _ in range(round(for_s / DT_S)):
            if begun and self.facts.begin_s is None:
                self.facts.begin_s = self.t_s
            self.facts.update(sample._replace(t_s=self.t_s, **changes))
            self.t_s += DT_S
        return self


@pytest.mark.parametrize(("short_s", "watched"), [(0.0, True), (0.3, False)])
def test_the_magnet_is_watched_by_the_world_not_by_the_report(
    short_s: float, watched: bool
) -> None:
    """The whole weight, motors off, for as long as the planner puts it there and looks."""
    complete = PROFILE.planner.complete
    it = Recorded().show(HOVER, 1.0).show(HANGING, 9.0, motors_on=True)
    it.show(HANGING, complete.hang_s + complete.watch_s - short_s)
    it.magnet.let_go = True
    it.show(HANGING, DT_S)
    assert it.facts.magnet_failed_s == pytest.approx(it.t_s - DT_S)
    assert it.facts.hung_through_watch is watched


def test_silence_that_ends_in_a_cut() -> None:
    """By the vehicle's lock, not by how long nothing came."""
    it = Recorded().show(HOVER, 1.0).show(HOVER, CUT_S + 0.05, uplink=False).show(HOVER, 1.0)
    assert it.facts.silence_lock_s is None
    it.show(HOVER, 2.0, uplink=False).show(HOVER, 1.0, uplink=False, locked=True)
    assert it.facts.silence_lock_s == pytest.approx(4.0 + CUT_S + 0.05)
    assert not it.facts.was_landing_onboard


@pytest.mark.parametrize(
    ("silent_s", "heard_s", "emergency", "cut"),
    [
        (2.0, 0.05, False, True), (2.0, 0.05, True, False), (2.0, 0.2, False, False),
        (1.8, 0.05, False, False),
    ],
)  # fmt: skip
def test_a_cut_shows_only_after_the_silence_that_brought_it(
    silent_s: float, heard_s: float, emergency: bool, cut: bool
) -> None:
    """A program that goes on as the firmware cuts is heard before the lock shows. What it
    orders itself then is no cut."""
    it = Recorded().show(HOVER, 1.0).show(HOVER, silent_s, uplink=False).show(HOVER, heard_s)
    it.supervisor.emergency = emergency
    it.show(HOVER, 1.0, locked=True)
    assert (it.facts.silence_lock_s is not None) is cut


@pytest.mark.parametrize(("silent_s", "released"), [(0.4, False), (0.6, True)])
def test_a_vehicle_that_the_firmware_releases_from_the_magnet_in_silence(
    silent_s: float, released: bool
) -> None:
    it = Recorded().show(HANGING, 1.0, motors_on=True)
    it.show(HANGING, silent_s, motors_on=True, uplink=False).show(HOVER, 0.5, uplink=False)
    off_s = pytest.approx(1.0 + silent_s) if released else None
    assert it.facts.released_in_silence_s == off_s
    for it, falls in (
        (Recorded().show(HANGING, 1.0, motors_on=True), {}),
        (Recorded().show(HANGING, 2.0, uplink=False), {"uplink": False, "motors_on": False}),
    ):
        assert it.show(HOVER, 2.0, **falls).facts.released_in_silence_s is None
    it = Recorded().show(HANGING, 1.0, motors_on=True)
    it.planner.active = True  # its own landing, which needs no packets, takes it off the magnet
    it.show(HANGING, 1.0, motors_on=True, uplink=False).show(HOVER, 0.5, uplink=False)
    assert it.facts.released_in_silence_s is None


def test_a_landing_of_the_vehicle_s_own_is_kept_that_began_before_the_silence() -> None:
    it = Recorded().show(HOVER, 1.0)
    it.planner.active = True
    it.show(HOVER, CUT_S - 0.1, uplink=False)
    assert not it.facts.was_landing_onboard
    assert it.show(HOVER, 0.2, uplink=False).facts.was_landing_onboard


@pytest.mark.parametrize(("before", "flew"), [(HOVER, True), (HANGING, False)])
def test_what_hangs_or_stands_loses_nothing_by_starting_again(before: Sample, flew: bool) -> None:
    it = Recorded(effects=(partial(reboots, boots_s=1.0),))
    it.show(before, 1.0, begun=False).show(HANGING, 1.0)
    assert it.facts.rebooted_s == (it.facts.begin_s if flew else None)


def test_a_slip_from_still_motors_is_kept_with_its_height() -> None:
    it = Recorded().show(HANGING, 1.0, motors_on=True).show(HOVER, 0.5)
    assert it.facts.slipped_s is None
    it.show(HANGING, 1.0, height_m=0.9).show(HOVER, 0.1, motors_on=False, height_m=0.89)
    assert it.facts.slipped_s == pytest.approx(2.5)
    assert it.facts.slip_height_m == 0.89


def test_when_nothing_lifts_it_any_more() -> None:
    it = Recorded().show(HOVER, 0.5)
    assert (it.facts.weak_s, it.facts.battery_low_s) == (None, None)
    it.world.battery_v = 2.9
    it.show(HOVER, 0.5, height_m=1.2, thrust_reserve=0.01)
    assert it.facts.weak_s == pytest.approx(0.5)
    assert (it.facts.battery_low_s, it.facts.battery_low_m) == (pytest.approx(0.5), 1.2)
