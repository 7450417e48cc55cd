"""Faults of the world: each is laid into a simulated vehicle at its moment, and seen there."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import load_calibration
from perchctl.faults import effects as e
from perchctl.faults.inject import (
    CAPTURE_FAULTS,
    LIGHTHOUSE,
    Disk,
    Edges,
    Injector,
    changed_scenario,
)
from perchctl.faults.truth import WatchedVehicle, sample_of
from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import Phase, PlannerState
from perchctl.profile import TargetConfig
from perchctl.sim import CaptureSettings, Neighbour, Scenario
from perchctl.sim.firmware.controller import Setpoint

CAMERA = load_calibration("example_640x480.yaml")
SCENARIO = Scenario(seed=2, camera_rate_hz=0.01, target_xy_m=(0.1, 0.2))


@dataclass
class Rig:
    """A vehicle on the floor and an injector whose edges count."""

    effects: tuple[e.Effect, ...]
    scenario: Scenario = SCENARIO
    moment_s: float = 0.0
    presses: int = 0
    hang_ups: int = 0
    capture: CaptureSettings | None = None
    begun: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.vehicle = WatchedVehicle(self.scenario, CAMERA, TargetConfig(), self.capture)
        self.disk = Disk()
        edge: Any = self
        edges = Edges(self.vehicle, edge, edge, edge, self.press, self.hang_up, self.disk)
        self.injector = Injector(edges, self.effects, Phase.SEARCH, self.moment_s)
        self.vehicle.each = self.injector.each

    def press(self) -> None:
        self.presses += 1

    def hang_up(self) -> None:
        self.hang_ups += 1

    def begin(self, effect: e.Effect, now_s: float) -> None:
        self.begun.append(effect)

    def wait(self, for_s: float) -> None:
        self.vehicle.advance_to(self.vehicle.t_s + for_s)

    def turn(self, phase: Phase) -> None:
        tick: Any = type("Turn", (), {})()
        tick.t_s, tick.state = self.vehicle.t_s, PlannerState(phase=phase)
        self.injector.tick(tick)


def begun(*effects: e.Effect, **changes: Any) -> Rig:
    rig = Rig(effects, **changes)
    rig.wait(0.1)
    rig.injector.begin_now()
    return rig


@pytest.mark.parametrize(
    ("moment_s", "phases", "begin_s"),
    [
        (0.5, (Phase.APPROACH, Phase.SEARCH, Phase.SEARCH), 0.9),
        (5.0, (Phase.APPROACH, Phase.SEARCH, Phase.ESTIMATE), 0.8),  # the phase is left before
        (0.0, (Phase.APPROACH, Phase.LANDING), None),
    ],
)
def test_it_begins_at_its_moment_in_its_phase(
    moment_s: float, phases: tuple[Phase, ...], begin_s: float | None
) -> None:
    rig = Rig((e.Push((0.1, 0.0, 0.0), 0.2),), moment_s=moment_s)
    for phase in phases:
        rig.turn(phase)
        rig.wait(0.4)
    expected = None if begin_s is None else pytest.approx(begin_s, abs=0.011)
    assert rig.injector.begin_s == expected


@pytest.mark.parametrize(
    "effect",
    [
        e.Silence(1.0, True, True), e.PacketLost("land", 1), e.PacketTwice("land"),
        e.BlockDead("state", 1.0), e.TelemetryDelayed(0.1, 1.0), e.CameraFault("snow", 1.0),
        e.Killed(), e.Suspended(1.0), e.Hung(1.0), e.Slow(0.1, 1.0), e.Raises(),
    ],
)  # fmt: skip
def test_what_the_edges_are_handed(effect: e.Effect) -> None:
    assert begun(effect).begun == [effect]


def test_the_estimate_steps_turns_and_slides() -> None:
    rig = begun(
        e.EstimateError((0.5, 0.0, -0.2), 90.0, (0.0, 0.1, 0.0), for_s=1.0),
        scenario=replace(SCENARIO, estimate_noise_m=0.0),
    )
    now = rig.vehicle.firmware.estimator.now
    rig.wait(0.5)
    assert now.x_m == pytest.approx(0.5, abs=0.01)
    assert now.y_m == pytest.approx(0.05, abs=0.01)
    assert now.vy_mps == pytest.approx(0.1, abs=0.01)
    assert now.yaw_deg == pytest.approx(90.0, abs=1.0)
    rig.wait(0.7)
    assert now.x_m == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("how", sorted({*CAPTURE_FAULTS} - {"mirrored"}))
def test_the_motion_capture_goes_wrong_for_its_time(how: str) -> None:
    effect = e.ExternalPositions(how, 1.0, 0.1 if how == "late" else 0.0)
    scenario = changed_scenario(replace(SCENARIO, acc_bias_mps2=(0.1, 0.0, 0.0)), (effect,))
    assert scenario.extra["external_position"] == 1.0
    rig = Rig((effect,), scenario, capture=CaptureSettings())
    capture = rig.vehicle.capture
    assert capture is not None
    rig.wait(0.5)
    capture.take()
    rig.injector.begin_now()
    rig.wait(0.9)
    frames = [frame for frame in capture.take() if frame.t_s > 0.52]
    bodies = [frame.bodies["crazyflie"] for frame in frames if "crazyflie" in frame.bodies]
    far_m = [math.hypot(*pose.position_m) for pose in bodies]
    match how:
        case "silent":
            assert not frames
        case "occluded":
            assert frames
            assert not bodies
        case "frozen":
            assert len(set(bodies)) == 1
        case "late":
            assert min(frame.t_s for frame in frames) > 0.6
        case _:
            assert min(far_m) > 1.0
    rig.wait(0.5)
    healed = capture.take()[-1].bodies["crazyflie"]
    assert math.hypot(*healed.position_m) < 0.05
    now, world = rig.vehicle.firmware.estimator.now, rig.vehicle.world
    assert math.hypot(now.x_m - world.x_m, now.y_m - world.y_m) > 0.02  # nobody sends it one here


def test_positions_come_mirrored() -> None:
    effect = e.ExternalPositions("mirrored", 5.0)
    rig = Rig((effect,), changed_scenario(SCENARIO, (effect,)), capture=CaptureSettings())
    capture, world = rig.vehicle.capture, rig.vehicle.world
    assert capture is not None
    for y_m in (0.3, -0.3):
        world.set_pose((0.1, 0.3, 0.02), hold=True)
        rig.wait(0.1)
        x_m, found_y_m, _ = capture.take()[-1].bodies["crazyflie"].position_m
        assert (x_m, found_y_m) == pytest.approx((0.1, y_m), abs=0.01)
        rig.injector.begin_now()


def test_a_deck_s_positions_end_for_their_time() -> None:
    """The estimate runs away, its variance grows as docs/firmware.md has it, and both come back."""
    effect = e.DeckSilent(4.0, -0.06)
    rig = Rig((effect,), changed_scenario(SCENARIO, (effect,)))
    firmware, world = rig.vehicle.firmware, rig.vehicle.world
    assert firmware.get_parameter(LIGHTHOUSE) == 1.0
    rig.turn(Phase.APPROACH)
    rig.wait(1.0)
    steady = firmware.log_value("kalman.varPZ")
    assert steady == pytest.approx(2.5e-4, rel=0.3)
    rig.injector.begin_now()
    rig.wait(3.9)
    assert firmware.estimator.now.z_m - world.z_m == pytest.approx(-0.5 * 0.06 * 3.9**2, abs=0.1)
    assert firmware.log_value("kalman.varPZ") == pytest.approx(steady + 3.9e-3, rel=0.3)
    rig.wait(0.6)
    assert firmware.estimator.now.z_m == pytest.approx(world.z_m, abs=0.05)
    assert firmware.log_value("kalman.varPZ") == pytest.approx(steady, rel=0.3)


def test_log_variables_read_wrongly_or_stand_still_for_a_time() -> None:
    rig = begun(
        e.LogReads(("stateEstimate.x",), math.nan, 0.5),
        e.LogReads(("pm.vbat",), None, 0.5),
        e.BatterySags(0.1, 0.5),
    )
    firmware = rig.vehicle.firmware
    before_v = firmware.log_value("pm.vbat")
    rig.wait(0.4)
    assert math.isnan(firmware.log_value("stateEstimate.x"))
    assert firmware.log_value("pm.vbat") == before_v
    rig.wait(0.5)
    assert abs(firmware.log_value("stateEstimate.x")) < 0.1
    assert firmware.log_value("pm.vbat") != before_v
    low = begun(e.LogReads(("pm.vbat",), 2.8, 0.5))
    assert low.vehicle.firmware.log_value("pm.vbat") == 2.8


def test_the_battery_sags_by_so_much() -> None:
    rig = begun(e.BatterySags(0.1, 0.3))
    before_v = rig.vehicle.world.battery_rest_v
    for wait_s, sagged_v in ((1.0, 0.1), (4.0, 0.3)):
        rig.wait(wait_s)
        found_v = before_v - rig.vehicle.world.battery_rest_v
        assert found_v == pytest.approx(sagged_v, abs=0.002)


def test_a_motor_is_weak() -> None:
    rig = begun(e.MotorWeak(2, 0.85))
    world = rig.vehicle.world
    world.set_pose((0.0, 0.0, 1.0), hold=True)
    for _ in range(500):
        world.step((40000.0,) * 4)
    f1, f2, f3, f4 = world.powertrain.forces_n
    assert f1 == f3 == f4
    assert f2 == pytest.approx(0.85 * f1)
    all_more = begun(e.MotorWeak(2, 0.85), e.ThrustChanged(1.08)).vehicle.world.powertrain
    assert all_more.strength == pytest.approx((1.08, 0.918, 1.08, 1.08))


def test_a_push_ends() -> None:
    rig = begun(e.Push((0.1, 0.0, 0.0), 0.2))
    assert rig.vehicle.world.external_force_n == (0.1, 0.0, 0.0)
    rig.wait(0.3)
    assert rig.vehicle.world.external_force_n == (0.0, 0.0, 0.0)


def test_a_vehicle_that_starts_again_stops_its_motors_and_time_goes_on() -> None:
    """The world's clock is not the firmware's."""
    rig = Rig((e.Reboots(0.5),))
    firmware, times_s = rig.vehicle.firmware, []
    rig.vehicle.each = times_s.append
    rig.wait(0.1)
    for thrust in (0, 30000, 30000):
        firmware.low_level(Setpoint.raw(0.0, 0.0, 0.0, thrust))
        rig.wait(0.3)
    assert max(firmware.motors) > 0.0
    rig.injector.begin_now()
    assert rig.begun == [e.Reboots(0.5)]
    rig.wait(0.1)
    assert max(firmware.motors) == 0.0
    assert firmware.t_s == pytest.approx(0.1)
    assert rig.vehicle.t_s == pytest.approx(1.1)
    assert times_s == sorted(times_s)
    assert len(times_s) == pytest.approx(110, abs=2)


def test_the_magnet_lets_go_after_the_contact() -> None:
    rig = begun(e.MagnetLetsGo(0.5))
    vehicle, scenario = rig.vehicle, rig.scenario
    top_m = scenario.ceiling_z_m - scenario.gear_body_m[2]
    rig.wait(1.0)
    vehicle.world.set_pose((*scenario.target_xy_m, top_m))
    rig.wait(0.4)
    assert sample_of(vehicle).hanging
    rig.wait(0.5)
    assert not sample_of(vehicle).hanging
    assert vehicle.world.z_m < top_m - 0.05


def test_the_target_moves_with_its_magnet() -> None:
    rig = begun(e.TargetMoves((0.3, 0.0)))
    assert rig.vehicle.world.magnet.target_xy_m == pytest.approx((0.4, 0.2))
    assert rig.vehicle.camera is not None
    assert rig.vehicle.camera.renderer.T_world_target[0, 3] == pytest.approx(0.4)


def test_the_operator_presses_and_the_disk_is_full_for_a_while() -> None:
    rig = begun(e.Operator((0.0, 0.5)), e.Operator((0.0,), hang_up=True), e.DiskFull(0.5))
    rig.wait(0.3)
    assert (rig.presses, rig.hang_ups) == (1, 1)
    assert rig.disk.problem
    rig.wait(0.5)
    assert (rig.presses, rig.hang_ups) == (2, 1)
    assert rig.disk.problem is None


def test_what_is_so_from_the_start() -> None:
    weight_n = SCENARIO.mass_kg * GRAVITY_MPS2
    weak = changed_scenario(replace(SCENARIO, first_contact_force_n=0.1), (e.MagnetHolds(0.5),))
    assert weak.magnet_force_n == pytest.approx(0.5 * weight_n)
    assert weak.first_contact_force_n is None
    room = e.Room(1.2, True, 0.1, (0.4, 0.0), 90.0)
    other = changed_scenario(SCENARIO, (room,))
    assert (other.ceiling_z_m, other.no_target) == (1.2, True)
    assert (other.target_above_ceiling_m, other.neighbours) == (0.1, (Neighbour((0.4, 0.0)),))
    turned = np.array(other.T_body_cam_true)[:3, :3] @ (1.0, 0.0, 0.0)
    assert turned == pytest.approx((0.0, 1.0, 0.0), abs=1e-12)
    assert changed_scenario(SCENARIO, (e.Killed(),)) == SCENARIO
