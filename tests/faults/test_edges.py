"""Faults at the edges, one by one: what the radio, the camera and the clock make of them."""

from __future__ import annotations

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
from perchctl.link import BLOCKS_DELETED_AFTER_S, Packet
from perchctl.link.crtp import UNLOCK_THRUST, encode
from perchctl.link.mock import TELEMETRY_DELAY_S
from perchctl.vehicle import EmergencyStop, Land, PositionSetpoint, RawThrust, StopMotors
from perchctl.vision import Frame

SETPOINT = encode(PositionSetpoint(0.0, 0.0, 1.0, 0.0))[0]


# --- the radio ------------------------------------------------------------------------


def test_orders_are_told_by_their_packets() -> None:
    said = [
        [order_of(packet) for packet in packets]
        for packets in (
            (SETPOINT,), encode(RawThrust(5000)), encode(Land(0.0, 2.0)), encode(StopMotors()),
            encode(EmergencyStop()), UNLOCK_THRUST,
        )
    ]  # fmt: skip
    assert said[0] == ["setpoint"]
    assert said[1] == ["raw"]
    assert "land" in said[2]
    assert said[3] == ["stop", "notify"]
    assert said[4] == ["emergency-stop"]
    assert said[5] == ["raw", "notify"]
    assert {order for orders in said for order in orders} == set(ORDERS)


def test_a_radio_without_faults_loses_nothing() -> None:
    radio = FaultyRadio()
    assert radio.up(SETPOINT, 1.0)
    assert radio.down("state", 1.0) == TELEMETRY_DELAY_S


@pytest.mark.parametrize(("up", "down"), [(True, False), (False, True), (True, True)])
def test_silence(up: bool, down: bool) -> None:
    radio = FaultyRadio()
    radio.begin(e.Silence(0.5, up, down), 1.0)
    assert radio.up(SETPOINT, 1.2) is not up
    assert (radio.down("attitude", 1.2) is None) is down
    assert radio.up(SETPOINT, 1.6)
    assert radio.down("attitude", 1.6) is not None


def test_packets_of_one_order_are_lost() -> None:
    radio = FaultyRadio()
    radio.begin(e.PacketLost("notify", 2), 0.0)
    stop, notify = encode(StopMotors())
    said = [radio.up(packet, 0.1) for packet in (stop, notify, stop, notify, stop, notify)]
    assert said == [True, False, True, False, True, True]


def test_a_packet_comes_twice() -> None:
    arrived: list[Packet] = []

    class Firmware:
        def notify_setpoint_stop(self, _remain_s: float) -> None:
            arrived.append(notify)

    radio = FaultyRadio()
    radio.serves(Firmware())  # type: ignore[arg-type]
    radio.begin(e.PacketTwice("notify"), 0.0)
    notify = encode(StopMotors())[1]
    assert radio.up(notify, 0.1)
    assert radio.up(notify, 0.2)
    assert len(arrived) == 1  # beside the ones that arrive by themselves


def test_one_block_dies() -> None:
    radio = FaultyRadio()
    radio.begin(e.BlockDead("state", 1.0), 0.0)
    assert radio.down("state", 0.5) is None
    assert radio.down("attitude", 0.5) is not None
    assert radio.down("state", 1.5) is not None


def test_telemetry_comes_late() -> None:
    radio = FaultyRadio()
    radio.begin(e.TelemetryDelayed(0.7, 2.0), 0.0)
    assert radio.down("battery", 1.0) == 0.7
    assert radio.down("battery", 2.5) == TELEMETRY_DELAY_S


def test_a_vehicle_that_starts_again_is_silent_until_its_blocks_are_asked_for() -> None:
    radio = FaultyRadio()
    radio.begin(e.Reboots(0.8), 0.0)
    assert not radio.up(SETPOINT, 0.7)
    assert radio.up(SETPOINT, 0.9)
    assert radio.down("state", 0.9 + BLOCKS_DELETED_AFTER_S) is None
    assert radio.down("state", 1.1 + BLOCKS_DELETED_AFTER_S) is not None


def test_a_cut_uplink_is_cut_for_good() -> None:
    radio = FaultyRadio()
    radio.cut = True
    assert not radio.up(SETPOINT, 99.0)
    assert radio.down("state", 99.0) is not None


# --- the camera -----------------------------------------------------------------------


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


def test_pictures_that_come_sooner_were_late_before() -> None:
    """By what the profile is told: their times are true until the fault begins."""
    camera, seen = FaultyCamera(Pictures(), 1), []
    camera.late_s = 0.2
    for k in range(100):
        if k == 50:
            camera.begin(e.CameraFault("sooner", e.FOR_EVER, 0.2), 1.0)
        if (frame := camera.poll(k * 0.02)) is not None:
            seen.append((k * 0.02, 0.05 * frame.index))
    late = [now_s - taken_s for now_s, taken_s in seen if 0.5 < now_s < 1.0]
    assert late == pytest.approx([0.2] * len(late), abs=0.03)
    soon = [now_s - taken_s for now_s, taken_s in seen if now_s > 1.0]
    assert soon == pytest.approx([0.0] * len(soon), abs=0.03)
    assert len(late) > 5
    assert len(soon) > 15


def looked(kind: str, late_s: float = 0.0) -> list[tuple[float, Frame]]:
    """Frames polled at 50 Hz: before, during (from 1 to 2 s) and after a fault."""
    camera = FaultyCamera(Pictures(), 1)
    frames = []
    for k in range(150):
        if k == 50:
            camera.begin(e.CameraFault(kind, 1.0, late_s), 1.0)
        if (frame := camera.poll(k * 0.02)) is not None:
            frames.append((k * 0.02, frame))
    return frames


def during(frames: list[tuple[float, Frame]]) -> list[Frame]:
    return [frame for t_s, frame in frames if 1.0 <= t_s < 2.0]


@pytest.mark.parametrize(
    "kind", ["silent", "frozen", "snow", "dark", "late", "out-of-order", "mirrored"]
)
def test_the_camera_is_well_before_and_after(kind: str) -> None:
    frames = looked(kind, 0.2)
    plain = looked("none")
    for (t_s, frame), (_, same) in zip(
        [x for x in frames if x[0] < 1.0 or x[0] > 2.1],
        [x for x in plain if x[0] < 1.0 or x[0] > 2.1],
        strict=True,
    ):
        assert frame.index == same.index, t_s
        assert np.array_equal(frame.image, same.image)


def test_what_each_camera_fault_does() -> None:
    assert during(looked("silent")) == []
    frozen = during(looked("frozen"))
    assert len(frozen) > 15
    assert all(np.array_equal(f.image, frozen[0].image) for f in frozen)
    assert len({f.t_s for f in frozen}) == len(frozen)
    assert {content(f.image) for f in during(looked("snow"))} == {"snow"}
    assert {content(f.image) for f in during(looked("dark"))} == {"dark"}
    mirrored = during(looked("mirrored"))[0].image
    assert np.array_equal(mirrored[:, -1], np.full(48, 180))


def test_late_pictures_look_fresh_and_are_old() -> None:
    frames = [(t_s, f) for t_s, f in looked("late", 0.2) if 1.3 < t_s < 2.0]
    assert len(frames) > 8
    for t_s, frame in frames:
        assert t_s - frame.index * 0.05 > 0.199  # shown so long ago
        assert t_s - frame.t_arrival_s < 0.05
        assert frame.t_s == pytest.approx(frame.t_arrival_s - 0.06)


def test_pictures_out_of_order() -> None:
    indices = [frame.index for frame in during(looked("out-of-order"))]
    pairs = list(zip(indices[::2], indices[1::2], strict=False))
    assert len(pairs) > 8
    assert all(newer == older + 1 for newer, older in pairs)


# --- the program ----------------------------------------------------------------------


class Lockstep:
    """A link's clock; the vehicle's beside it tells who let the time pass."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.by_link: list[float] = []
        self.vehicle: Any = self

    def advance_to(self, t_s: float) -> None:
        self.by_link.append(t_s)
        self.now_s = t_s


class Vehicle:
    def __init__(self, link: Lockstep) -> None:
        self._link = link

    def advance_to(self, t_s: float) -> None:
        self._link.now_s = t_s


def clock_of(link: Lockstep) -> tuple[FaultyClock, list[bool]]:
    cut: list[bool] = []
    return FaultyClock(link, lambda: cut.append(True), 100.0), cut  # type: ignore[arg-type]


def test_killed() -> None:
    clock, cut = clock_of(Lockstep())
    clock.wait_until(1.0)
    clock.begin(e.Killed(), 1.0)
    for _ in range(2):  # its rescue is dead as well
        with pytest.raises(ProgramKilled):
            clock.wait_until(1.02)
    with pytest.raises(ProgramKilled):  # nor does it learn what time it is
        clock.now()
    assert clock.killed_s == 1.02
    assert cut == [True]


def test_suspended_time_passes_without_the_link() -> None:
    link = Lockstep()
    link.vehicle = Vehicle(link)
    clock, _ = clock_of(link)
    clock.begin(e.Suspended(3.0), 0.0)
    clock.wait_until(0.02)
    assert link.now_s == pytest.approx(3.02)
    assert link.by_link == [0.02]
    clock.wait_until(3.04)
    assert link.now_s == pytest.approx(3.04)


def test_hung_time_passes_with_the_link() -> None:
    link = Lockstep()
    clock, cut = clock_of(link)
    clock.begin(e.Hung(2.0), 0.0)
    clock.wait_until(0.02)
    assert link.by_link[-1] == link.now_s == pytest.approx(2.02)
    clock.begin(e.Hung(e.FOR_EVER), 2.0)
    with pytest.raises(ProgramKilled):
        clock.wait_until(2.04)
    assert link.now_s == pytest.approx(2.04 + LONGEST_S)
    assert cut == [True]


def test_slow_turns() -> None:
    link = Lockstep()
    clock, _ = clock_of(link)
    clock.begin(e.Slow(0.3, 1.0), 0.0)
    for _ in range(8):
        clock.wait_until(link.now_s + 0.02)
    assert link.by_link[:4] == pytest.approx([0.3, 0.6, 0.9, 1.2])
    assert link.by_link[4:] == pytest.approx([1.22, 1.24, 1.26, 1.28])


def test_no_flight_is_endless() -> None:
    clock, _ = clock_of(Lockstep())
    with pytest.raises(ProgramKilled):
        clock.wait_until(100.1)
    assert clock.endless
