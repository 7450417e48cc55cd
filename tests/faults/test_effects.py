"""What each effect does to a simulated vehicle, its radio, its camera and the program."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.calibration import load_calibration
from perchctl.camera.health import picture_kind
from perchctl.faults import edges
from perchctl.faults import effects as e
from perchctl.faults.edges import (
    CameraFault,
    FaultRig,
    FaultyCamera,
    FaultyClock,
    FaultyRadio,
    ProgramKilled,
    packet_kind,
)
from perchctl.faults.truth import WatchedVehicle, true_sample
from perchctl.geometry import GRAVITY_MPS2
from perchctl.link.crtp import encode
from perchctl.link.mock import TELEMETRY_DELAY_S
from perchctl.link.telemetry import BLOCKS_DELETED_AFTER_S
from perchctl.mission import Phase
from perchctl.profile import TargetConfig
from perchctl.sim import CaptureSettings, Scenario
from perchctl.vehicle import EmergencyStop, Land, PositionSetpoint, RawThrust, StopMotors
from perchctl.vision import Frame
from tests.helpers.firmware_rig import raw_thrust
from tests.helpers.mission import state_with

CAMERA = load_calibration("example_640x480.yaml")
SCENARIO = Scenario(seed=2, camera_rate_hz=0.01, target_xy_m=(0.1, 0.2))
SETPOINT = encode(PositionSetpoint(0.0, 0.0, 1.0, 0.0))[0]
STOP, NOTIFY, *_ = encode(StopMotors())
STOP_S = 10.0  # of a flight that does not end


class Pictures:
    """A frame every 50 ms, each with its index as grey level and a little structure."""

    live = True
    finished = False
    size_px = (64, 48)
    _index = -1

    def poll(self, now_s: float) -> Frame | None:
        index = int(now_s / 0.05 + 1e-6)
        if index == self._index:
            return None
        self._index = index
        image = np.full((48, 64), 100 + index % 100, np.uint8)
        image[:, ::3] = 180
        return Frame(index, index * 0.05 - 0.06, image, index * 0.05)

    def problem(self, now_s: float) -> str | None:
        return None

    def describe(self) -> str:
        return "pictures"

    def close(self) -> None:
        return None


class Rig:
    """A vehicle on the floor with all that faults act on. As the link of the clock, `by_link` has
    the times to which it, and not the vehicle alone, went on."""

    def __init__(
        self,
        *effects: e.Effect,
        scenario: Scenario = SCENARIO,
        moment_s: float = 0.0,
        capture: CaptureSettings | None = None,
    ) -> None:
        scenario = e.apply_to_scenario(scenario, effects)
        self.vehicle = WatchedVehicle(scenario, CAMERA, TargetConfig(), capture)
        self.radio = FaultyRadio()
        self.by_link: list[float] = []
        self.clock = FaultyClock(self, self.radio, STOP_S)  # type: ignore[arg-type]
        self.pressed: list[str] = []
        self.problem: str | None = None
        self.edges = FaultRig(
            self.vehicle, self.radio, FaultyCamera(Pictures(), 1), self.clock,
            partial(self.pressed.append, "Ctrl-C"), partial(self.pressed.append, "hang-up"), self,
        )  # fmt: skip
        self.injector = e.Injector(self.edges, effects, Phase.SEARCH, moment_s)
        self.vehicle.on_sample = self._each

    def _each(self, t_s: float) -> None:
        self.injector.begin_due(t_s)
        self.edges.call_due(t_s)

    @property
    def now_s(self) -> float:
        return self.vehicle.t_s

    def advance_to(self, t_s: float) -> None:
        self.by_link.append(t_s)
        self.vehicle.advance_to(t_s)

    def wait(self, for_s: float) -> None:
        self.vehicle.advance_to(self.now_s + for_s)

    def begin(self) -> None:
        self.injector.begin(self.now_s)

    def tick(self, phase: Phase) -> None:
        tick: Any = SimpleNamespace(t_s=self.now_s, state=state_with(phase=phase))
        self.injector.tick(tick)


def begun(*effects: e.Effect, **options: Any) -> Rig:
    rig = Rig(*effects, **options)
    rig.wait(0.1)
    rig.begin()
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
    rig = Rig(partial(e.push, force_n=(0.1, 0.0, 0.0), for_s=0.2), moment_s=moment_s)
    for phase in phases:
        rig.tick(phase)
        rig.wait(0.4)
    expected = None if begin_s is None else pytest.approx(begin_s, abs=0.011)
    assert rig.injector.begin_s == expected


# --- the radio ----------------------------------------------------------------------------------


def test_orders_are_told_by_their_packets() -> None:
    orders = (PositionSetpoint(0.0, 0.0, 1.0, 0.0), RawThrust(5000), StopMotors(), EmergencyStop(),
              Land(0.0, 2.0))  # fmt: skip
    names = [[packet_kind(packet) for packet in encode(order)] for order in orders]
    assert names[:2] == [["setpoint"], ["raw"]]
    assert (names[2][0], *set(names[2][1:])) == ("stop", "notify")
    assert names[3] == ["emergency-stop"]
    assert "land" in names[4]


@pytest.mark.parametrize(
    ("effect", "after_s", "up", "state", "attitude"),
    [
        (partial(e.killed), 0.2, True, True, True),
        (partial(e.radio_loss, for_s=0.5, up=True), 0.2, False, True, True),
        (partial(e.radio_loss, for_s=0.5, down="all"), 0.2, True, False, False),
        (partial(e.radio_loss, for_s=0.5, up=True, down="all"), 0.6, True, True, True),
        (partial(e.radio_loss, for_s=1.0, down="state"), 0.5, True, False, True),
        (partial(e.radio_loss, for_s=1.0, down="state"), 1.5, True, True, True),
        (partial(e.reboots, boots_s=0.8), 0.7, False, False, False),
        (partial(e.reboots, boots_s=0.8), 0.9, True, False, False),
        (partial(e.reboots, boots_s=0.8), 1.1 + BLOCKS_DELETED_AFTER_S, True, True, True),
    ],
)
def test_what_passes(
    effect: e.Effect, after_s: float, up: bool, state: bool, attitude: bool
) -> None:
    """What starts again is silent, and until its blocks are asked for sends none."""
    rig = begun(effect)
    t_s = rig.now_s + after_s
    assert rig.radio.uplink_arrives(SETPOINT, t_s) is up
    blocks = [rig.radio.downlink_delay_s(block, t_s) for block in ("state", "attitude")]
    assert blocks == [TELEMETRY_DELAY_S if passes else None for passes in (state, attitude)]


def test_packets_of_one_order_are_lost_or_come_twice_and_telemetry_late() -> None:
    lost = begun(partial(e.packet_lost, order="notify", count=2)).radio
    arrived = [lost.uplink_arrives(packet, 1.1) for packet in (STOP, NOTIFY) * 3]
    assert arrived == [True, False, True, False, True, True]
    twice, second = begun(partial(e.packet_twice, order="notify")).radio, []
    twice.receive = second.append
    assert twice.uplink_arrives(NOTIFY, 1.1)
    assert twice.uplink_arrives(NOTIFY, 1.2)
    assert second == [NOTIFY]  # beside the ones that arrive by themselves
    late = begun(partial(e.radio_loss, down="all", delay_s=0.7, for_s=2.0)).radio
    assert late.downlink_delay_s("battery", 1.0) == 0.7
    assert late.downlink_delay_s("battery", 2.5) == TELEMETRY_DELAY_S
    late.cut = True
    assert not late.uplink_arrives(SETPOINT, 99.0)


# --- the camera ---------------------------------------------------------------------------------


def frames_of(fault: CameraFault, before_s: float = 0.0) -> list[tuple[float, Frame]]:
    """Frames polled at 50 Hz for 3 s, with a fault that begins at 1 s."""
    camera = FaultyCamera(Pictures(), 1)
    camera.late_s = before_s
    frames = []
    for k in range(150):
        if k == 50:
            camera.begin_fault(fault, 1.0)
        if (frame := camera.poll(k * 0.02)) is not None:
            frames.append((k * 0.02, frame))
    return frames


def during(kind: str, late_s: float = 0.0, from_s: float = 1.0) -> list[tuple[float, Frame]]:
    frames = frames_of(CameraFault(kind, 1.0, late_s))
    return [(t_s, frame) for t_s, frame in frames if from_s <= t_s < 2.0]


def test_pictures_that_come_sooner_were_late_before() -> None:
    """By what the profile is told: their times are true until the fault begins."""
    frames = frames_of(CameraFault("sooner", e.FOR_EVER, 0.2), before_s=0.2)
    late = [t_s - 0.05 * frame.index for t_s, frame in frames if 0.5 < t_s < 1.0]
    soon = [t_s - 0.05 * frame.index for t_s, frame in frames if t_s > 1.0]
    assert late == pytest.approx([0.2] * len(late), abs=0.03)
    assert soon == pytest.approx([0.0] * len(soon), abs=0.03)
    assert min(len(late), len(soon)) > 5
    sooner = partial(e.camera_fault, kind="sooner", for_s=e.FOR_EVER, late_s=0.2)
    assert Rig(sooner).edges.camera.late_s == 0.2


def test_what_each_camera_fault_does() -> None:
    assert during("silent") == []
    frozen = [frame for _, frame in during("frozen")]
    assert len(frozen) > 15
    assert all(np.array_equal(f.image, frozen[0].image) for f in frozen)
    assert len({f.t_s for f in frozen}) == len(frozen)
    for kind in ("snow", "dark"):
        assert {picture_kind(frame.image) for _, frame in during(kind)} == {kind}
    assert np.array_equal(during("mirrored")[0][1].image[:, -1], np.full(48, 180))
    late = during("late", 0.2, from_s=1.3)
    assert len(late) > 8
    for t_s, frame in late:  # it looks fresh, and was shown so long ago
        assert t_s - frame.index * 0.05 > 0.199
        assert t_s - frame.t_arrival_s < 0.05
        assert frame.t_s == pytest.approx(frame.t_arrival_s - 0.06)
    indices = [frame.index for _, frame in during("out-of-order")]
    assert len(indices) > 16
    assert all(indices[k] == indices[k + 1] + 1 for k in range(0, len(indices) - 1, 2))


# --- the positions ------------------------------------------------------------------------------


@pytest.mark.parametrize("how", sorted(e.CAPTURE_FAULTS))
def test_the_motion_capture_goes_wrong_for_its_time(how: str) -> None:
    effect = partial(e.external_positions, how=how, for_s=1.0, late_s=0.1 if how == "late" else 0.0)
    rig = Rig(effect, capture=CaptureSettings())
    assert rig.vehicle.scenario.extra["external_position"] == 1.0
    capture = rig.vehicle.capture
    assert capture is not None
    rig.vehicle.world.set_pose((0.1, 0.3, 0.02), hold=True)
    rig.wait(0.5)
    capture.take()
    rig.begin()
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
        case "mirrored":
            assert bodies[-1].position_m[:2] == pytest.approx((0.1, -0.3), abs=0.01)
        case _:
            assert min(far_m) > 1.0
    rig.wait(0.5)
    healed = capture.take()[-1].bodies["crazyflie"]
    assert healed.position_m[:2] == pytest.approx((0.1, 0.3), abs=0.05)


# --- the vehicle and the room -------------------------------------------------------------------


def test_the_estimate_steps_turns_and_slides() -> None:
    error = partial(
        e.estimate_error,
        step_m=(0.5, 0.0, -0.2), turn_deg=90.0, drift_mps=(0.0, 0.1, 0.0), for_s=1.0,
    )  # fmt: skip
    rig = begun(error, scenario=replace(SCENARIO, estimate_noise_m=0.0))
    now = rig.vehicle.firmware.estimator.now
    rig.wait(0.5)
    assert (now.x_m, now.y_m, now.vy_mps) == pytest.approx((0.5, 0.05, 0.1), abs=0.01)
    assert now.yaw_deg == pytest.approx(90.0, abs=1.0)
    rig.wait(0.7)
    assert now.x_m == pytest.approx(0.0, abs=0.01)


def test_log_variables_read_wrongly_or_stand_still_for_a_time() -> None:
    rig = begun(
        partial(e.log_reads, names=("stateEstimate.x",), value=math.nan, for_s=0.5),
        partial(e.log_reads, names=("pm.vbat",), value=None, for_s=0.5),
        partial(e.battery_sags, rate_vps=0.1, by_v=0.3),
    )
    firmware, world = rig.vehicle.firmware, rig.vehicle.world
    before_v, before_rest_v = firmware.log_value("pm.vbat"), world.battery_rest_v
    rig.wait(0.4)
    assert math.isnan(firmware.log_value("stateEstimate.x"))
    assert firmware.log_value("pm.vbat") == before_v
    rig.wait(0.6)
    assert abs(firmware.log_value("stateEstimate.x")) < 0.1
    assert firmware.log_value("pm.vbat") != before_v
    assert before_rest_v - world.battery_rest_v == pytest.approx(0.1, abs=0.002)
    rig.wait(4.0)
    assert before_rest_v - world.battery_rest_v == pytest.approx(0.3, abs=0.002)


def test_thrust_changes_and_a_push_ends() -> None:
    weak = partial(e.thrust_changed, to=(1.0, 0.85, 1.0, 1.0))
    other = partial(e.thrust_changed, to=(1.08,) * 4)
    rig = begun(weak, other, partial(e.push, force_n=(0.1, 0.0, 0.0), for_s=0.2))
    world = rig.vehicle.world
    assert world.powertrain.strength == pytest.approx((1.08, 0.918, 1.08, 1.08))
    assert world.external_force_n == (0.1, 0.0, 0.0)
    rig.wait(0.3)
    assert world.external_force_n == (0.0, 0.0, 0.0)


def test_a_vehicle_that_starts_again_stops_its_motors_and_time_goes_on() -> None:
    """The world's clock is not the firmware's."""
    rig = Rig(partial(e.reboots, boots_s=0.5))
    firmware = rig.vehicle.firmware
    rig.wait(0.1)
    for thrust in (0, 30000, 30000):
        firmware.fly_setpoint(raw_thrust(thrust))
        rig.wait(0.3)
    assert max(firmware.motors) > 0.0
    rig.begin()
    rig.wait(0.1)
    assert max(firmware.motors) == 0.0
    assert firmware.t_s == pytest.approx(0.1)
    assert rig.now_s == pytest.approx(1.1)


def test_the_magnet_lets_go_after_the_contact() -> None:
    rig = begun(partial(e.magnet_lets_go, after_s=0.5))
    vehicle, scenario = rig.vehicle, rig.vehicle.scenario
    top_m = scenario.ceiling_z_m - scenario.gear_body_m[2]
    rig.wait(1.0)
    vehicle.world.set_pose((*scenario.target_xy_m, top_m))
    rig.wait(0.4)
    assert true_sample(vehicle).hanging
    rig.wait(0.5)
    assert not true_sample(vehicle).hanging
    assert vehicle.world.z_m < top_m - 0.05


def test_what_is_so_from_the_start() -> None:
    weight_n = SCENARIO.mass_kg * GRAVITY_MPS2
    first = replace(SCENARIO, first_contact_force_n=0.1)
    weak = e.apply_to_scenario(first, (partial(e.magnet_holds, of_weight=0.5),))
    assert weak.magnet_force_n == pytest.approx(0.5 * weight_n)
    assert weak.first_contact_force_n is None
    other = e.apply_to_scenario(SCENARIO, (partial(e.room, ceiling_z_m=1.2, no_target=True),))
    assert (other.ceiling_z_m, other.no_target) == (1.2, True)
    assert e.apply_to_scenario(SCENARIO, (partial(e.killed),)) == SCENARIO


# --- the operator and the program ---------------------------------------------------------------


def test_the_operator_presses_and_the_disk_is_full_for_a_while() -> None:
    rig = begun(
        partial(e.operator, presses_s=(0.0, 0.5)),
        partial(e.operator, presses_s=(0.0,), hang_up=True),
        partial(e.disk_full, for_s=0.5),
    )
    rig.wait(0.3)
    assert rig.pressed == ["Ctrl-C", "hang-up"]
    assert rig.problem
    rig.wait(0.5)
    assert rig.pressed[2:] == ["Ctrl-C"]
    assert rig.problem is None


def test_killed() -> None:
    rig = begun(partial(e.killed))
    for _ in range(2):  # its rescue is dead as well
        with pytest.raises(ProgramKilled):
            rig.clock.wait_until(0.12)
    with pytest.raises(ProgramKilled):  # nor does it learn what time it is
        rig.clock.now()
    assert rig.clock.killed_s == pytest.approx(0.12)
    assert rig.radio.cut


def test_suspended_time_passes_without_the_link_and_hung_time_with_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = begun(partial(e.suspended, for_s=3.0))
    rig.clock.wait_until(0.12)
    assert rig.now_s == pytest.approx(3.12)
    assert rig.by_link == [0.12]
    hung = begun(partial(e.hung, for_s=2.0))
    hung.clock.wait_until(0.12)
    assert hung.by_link[-1] == pytest.approx(2.12)
    assert not hung.radio.cut
    monkeypatch.setattr(edges, "USER_PATIENCE_S", 6.0)
    ever = begun(partial(e.hung, for_s=e.FOR_EVER))
    with pytest.raises(ProgramKilled):
        ever.clock.wait_until(0.12)
    assert ever.by_link[-1] == pytest.approx(6.12)
    assert ever.radio.cut


def test_slow_ticks_and_no_endless_flight() -> None:
    rig = begun(partial(e.slow, tick_s=0.3, for_s=1.0))
    for _ in range(4):
        rig.clock.wait_until(rig.now_s + 0.02)
    assert rig.by_link == pytest.approx([0.4, 0.7, 1.0, 1.3])
    with pytest.raises(ProgramKilled):
        rig.clock.wait_until(STOP_S + 0.1)
    assert rig.clock.endless
