"""Faults at the edges, one by one: what the radio, the camera and the clock make of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from perchctl.camera.health import content
from perchctl.faults import effects as e
from perchctl.faults.edges import (
    LONGEST_S,
    ORDERS,
    FaultyCamera,
    FaultyClock,
    FaultyRadio,
    ProgramKilled,
    order_of,
)
from perchctl.link import Packet
from perchctl.link.crtp import UNLOCK_THRUST, encode
from perchctl.link.mock import TELEMETRY_DELAY_S
from perchctl.link.telemetry import BLOCKS_DELETED_AFTER_S
from perchctl.vehicle import EmergencyStop, Land, PositionSetpoint, RawThrust, StopMotors
from perchctl.vision import Frame

SETPOINT = encode(PositionSetpoint(0.0, 0.0, 1.0, 0.0))[0]
STOP, NOTIFY = encode(StopMotors())


# --- the radio ----------------------------------------------------------------------------------


def test_orders_are_told_by_their_packets() -> None:
    orders = [
        [order_of(packet) for packet in packets]
        for packets in (
            (SETPOINT,), encode(RawThrust(5000)), (STOP, NOTIFY), encode(EmergencyStop()),
            UNLOCK_THRUST, encode(Land(0.0, 2.0)),
        )
    ]  # fmt: skip
    assert orders[:5] == [
        ["setpoint"], ["raw"], ["stop", "notify"], ["emergency-stop"], ["raw", "notify"],
    ]  # fmt: skip
    assert {order for each in orders for order in each} == set(ORDERS)


def faulty(*effects: e.RadioEffect) -> FaultyRadio:
    radio = FaultyRadio()
    for effect in effects:
        radio.begin(effect, 1.0)
    return radio


@pytest.mark.parametrize(
    ("effect", "t_s", "up", "state", "attitude"),
    [
        (None, 1.2, True, True, True),
        (e.Silence(0.5, True, False), 1.2, False, True, True),
        (e.Silence(0.5, False, True), 1.2, True, False, False),
        (e.Silence(0.5, True, True), 1.2, False, False, False),
        (e.Silence(0.5, True, True), 1.6, True, True, True),
        (e.BlockDead("state", 1.0), 1.5, True, False, True),
        (e.BlockDead("state", 1.0), 2.5, True, True, True),
        (e.Reboots(0.8), 1.7, False, False, False),
        (e.Reboots(0.8), 1.9, True, False, False),
        (e.Reboots(0.8), 1.9 + BLOCKS_DELETED_AFTER_S, True, False, False),
        (e.Reboots(0.8), 2.1 + BLOCKS_DELETED_AFTER_S, True, True, True),
    ],
)
def test_what_passes(
    effect: e.RadioEffect | None, t_s: float, up: bool, state: bool, attitude: bool
) -> None:
    """What starts again is silent, and until its blocks are asked for sends none."""
    radio = faulty() if effect is None else faulty(effect)
    assert radio.uplink_arrives(SETPOINT, t_s) is up
    blocks = [radio.downlink_delay_s(block, t_s) for block in ("state", "attitude")]
    assert blocks == [TELEMETRY_DELAY_S if passes else None for passes in (state, attitude)]


def test_packets_of_one_order_are_lost() -> None:
    radio = faulty(e.PacketLost("notify", 2))
    arrived = [radio.uplink_arrives(packet, 1.1) for packet in (STOP, NOTIFY) * 3]
    assert arrived == [True, False, True, False, True, True]


def test_a_packet_comes_twice() -> None:
    arrived: list[Packet] = []

    radio = faulty(e.PacketTwice("notify"))
    radio.serves(arrived.append)
    assert radio.uplink_arrives(NOTIFY, 1.1)
    assert radio.uplink_arrives(NOTIFY, 1.2)
    assert len(arrived) == 1  # beside the ones that arrive by themselves


def test_telemetry_comes_late() -> None:
    radio = faulty(e.TelemetryDelayed(0.7, 2.0))
    assert radio.downlink_delay_s("battery", 2.0) == 0.7
    assert radio.downlink_delay_s("battery", 3.5) == TELEMETRY_DELAY_S


def test_a_cut_uplink_is_cut_for_good() -> None:
    radio = faulty()
    radio.cut = True
    assert not radio.uplink_arrives(SETPOINT, 99.0)
    assert radio.downlink_delay_s("state", 99.0) is not None


# --- the camera ---------------------------------------------------------------------------------


class Pictures:
    """A frame every 50 ms, each with its index as grey level and a little structure."""

    live = True
    finished = False
    size_px = (64, 48)

    def __init__(self) -> None:
        self._index = -1

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


def frames_of(fault: e.CameraFault, before_s: float = 0.0) -> list[tuple[float, Frame]]:
    """Frames polled at 50 Hz for 3 s, with a fault that begins at 1 s."""
    camera = FaultyCamera(Pictures(), 1)
    camera.late_s = before_s
    frames = []
    for k in range(150):
        if k == 50:
            camera.begin(fault, 1.0)
        if (frame := camera.poll(k * 0.02)) is not None:
            frames.append((k * 0.02, frame))
    return frames


def during(kind: str, late_s: float = 0.0, from_s: float = 1.0) -> list[tuple[float, Frame]]:
    frames = frames_of(e.CameraFault(kind, 1.0, late_s))
    return [(t_s, frame) for t_s, frame in frames if from_s <= t_s < 2.0]


def test_pictures_that_come_sooner_were_late_before() -> None:
    """By what the profile is told: their times are true until the fault begins."""
    frames = frames_of(e.CameraFault("sooner", e.FOR_EVER, 0.2), before_s=0.2)
    late = [t_s - 0.05 * frame.index for t_s, frame in frames if 0.5 < t_s < 1.0]
    soon = [t_s - 0.05 * frame.index for t_s, frame in frames if t_s > 1.0]
    assert late == pytest.approx([0.2] * len(late), abs=0.03)
    assert soon == pytest.approx([0.0] * len(soon), abs=0.03)
    assert len(late) > 5
    assert len(soon) > 15


@pytest.mark.parametrize(
    "kind", ["silent", "frozen", "snow", "dark", "late", "out-of-order", "mirrored"]
)
def test_the_camera_is_well_before_and_after(kind: str) -> None:
    plain, frames = (
        [x for x in frames_of(e.CameraFault(k, 1.0, 0.2)) if x[0] < 1.0 or x[0] > 2.1]
        for k in ("none", kind)
    )
    for (t_s, frame), (_, same) in zip(frames, plain, strict=True):
        assert frame.index == same.index, t_s
        assert np.array_equal(frame.image, same.image)


def test_what_each_camera_fault_does() -> None:
    assert during("silent") == []
    frozen = [frame for _, frame in during("frozen")]
    assert len(frozen) > 15
    assert all(np.array_equal(f.image, frozen[0].image) for f in frozen)
    assert len({f.t_s for f in frozen}) == len(frozen)
    for kind in ("snow", "dark"):
        assert {content(frame.image) for _, frame in during(kind)} == {kind}
    mirrored = during("mirrored")[0][1].image
    assert np.array_equal(mirrored[:, -1], np.full(48, 180))


def test_late_pictures_look_fresh_and_are_old() -> None:
    frames = during("late", 0.2, from_s=1.3)
    assert len(frames) > 8
    for t_s, frame in frames:
        assert t_s - frame.index * 0.05 > 0.199  # shown so long ago
        assert t_s - frame.t_arrival_s < 0.05
        assert frame.t_s == pytest.approx(frame.t_arrival_s - 0.06)


def test_pictures_out_of_order() -> None:
    indices = [frame.index for _, frame in during("out-of-order")]
    pairs = list(zip(indices[::2], indices[1::2], strict=False))
    assert len(pairs) > 8
    assert all(newer == older + 1 for newer, older in pairs)


# --- the program --------------------------------------------------------------------------------


class Lockstep:
    """A link's clock; `by_link` has the times to which it, and not the vehicle alone, went on."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.by_link: list[float] = []
        self.vehicle: Any = SimpleNamespace(advance_to=lambda t_s: setattr(self, "now_s", t_s))
        self.radio = FaultyRadio()
        self.clock = FaultyClock(self, self.radio, 100.0)  # type: ignore[arg-type]

    def advance_to(self, t_s: float) -> None:
        self.by_link.append(t_s)
        self.now_s = t_s


@pytest.fixture
def link() -> Lockstep:
    return Lockstep()


def test_killed(link: Lockstep) -> None:
    link.clock.wait_until(1.0)
    link.clock.begin(e.Killed(), 1.0)
    for _ in range(2):  # its rescue is dead as well
        with pytest.raises(ProgramKilled):
            link.clock.wait_until(1.02)
    with pytest.raises(ProgramKilled):  # nor does it learn what time it is
        link.clock.now()
    assert link.clock.killed_s == 1.02
    assert link.radio.cut


def test_suspended_time_passes_without_the_link(link: Lockstep) -> None:
    link.clock.begin(e.Suspended(3.0), 0.0)
    link.clock.wait_until(0.02)
    assert link.now_s == pytest.approx(3.02)
    assert link.by_link == [0.02]
    link.clock.wait_until(3.04)
    assert link.now_s == pytest.approx(3.04)


def test_hung_time_passes_with_the_link(link: Lockstep) -> None:
    link.clock.begin(e.Hung(2.0), 0.0)
    link.clock.wait_until(0.02)
    assert link.by_link[-1] == link.now_s == pytest.approx(2.02)
    assert not link.radio.cut
    link.clock.begin(e.Hung(e.FOR_EVER), 2.0)
    with pytest.raises(ProgramKilled):
        link.clock.wait_until(2.04)
    assert link.now_s == pytest.approx(2.04 + LONGEST_S)
    assert link.radio.cut


def test_slow_turns(link: Lockstep) -> None:
    link.clock.begin(e.Slow(0.3, 1.0), 0.0)
    for _ in range(8):
        link.clock.wait_until(link.now_s + 0.02)
    assert link.by_link == pytest.approx([0.3, 0.6, 0.9, 1.2, 1.22, 1.24, 1.26, 1.28])


def test_no_flight_is_endless(link: Lockstep) -> None:
    with pytest.raises(ProgramKilled):
        link.clock.wait_until(100.1)
    assert link.clock.endless
