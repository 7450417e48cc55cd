"""Commands as bytes: those of an unmodified cflib, on the real link and in lockstep alike; the
lockstep link over a radio that loses packets, and without a deck."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from cflib.crazyflie.commander import Commander
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.supervisor import Supervisor
from cflib.crtp.crtpstack import CRTPPacket
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import InvalidValue
from perchctl.link import MockLink, Packet, Radio
from perchctl.link.connection import send_packets
from perchctl.link.crtp import (
    LAND_TIMES,
    MAX_DATA,
    NOTIFY_TIMES,
    UNLOCK_THRUST,
    UNLOCK_TIMES,
    encode,
)
from perchctl.sim import Scenario, SimulatedVehicle
from perchctl.sim.crtp import execute_packet
from perchctl.vehicle import (
    Arm,
    Command,
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)

PROTOCOL = 12
THRUST_MAX = 0xFFFF
TILTS_RAD = st.floats(-0.5, 0.5)


def commands(numbers: st.SearchStrategy[float]) -> st.SearchStrategy[Command]:
    """All commands; `numbers` for lengths, times and the yaw in degrees."""
    return st.one_of(
        st.just(Idle()),
        st.builds(PositionSetpoint, numbers, numbers, numbers, st.floats(-1e3, 1e3)),
        st.builds(RawThrust, st.integers(0, THRUST_MAX), TILTS_RAD, TILTS_RAD),
        st.builds(Land, numbers, numbers),
        st.just(StopMotors()),
        st.just(EmergencyStop()),
        st.builds(Arm, st.booleans()),
    )


class Recorder:
    """The part of cflib's `Crazyflie` that its own encoders use; keeps what would be sent."""

    def __init__(self) -> None:
        self.datagrams: list[bytes] = []
        self.platform = SimpleNamespace(get_protocol_version=lambda: PROTOCOL)
        self.commander = Commander(self)
        self.high_level = HighLevelCommander(self)
        self.supervisor = Supervisor(self)

    def add_port_callback(self, port: int, callback: Callable[..., None]) -> None:
        """The supervisor's answers; none come."""

    def send_packet(self, packet: CRTPPacket) -> None:
        assert packet.is_data_size_valid()
        self.datagrams.append(bytes((packet.get_header(),)) + bytes(packet.data))

    def unlock_thrust(self) -> None:
        self.commander.send_setpoint(0.0, 0.0, 0.0, 0)
        self.commander.send_notify_setpoint_stop()

    def call(self, command: Command) -> None:
        """The calls that a program without perchctl makes for this command."""
        match command:
            case Idle():
                pass
            case PositionSetpoint(x, y, z, yaw):
                self.commander.send_position_setpoint(x, y, z, math.degrees(yaw))
            case RawThrust(thrust, roll, pitch):
                self.commander.send_setpoint(math.degrees(roll), math.degrees(pitch), 0.0, thrust)
            case Land(height, duration):
                for _ in range(LAND_TIMES):
                    self.high_level.land(height, duration, yaw=None)  # keeps the heading
                self.commander.send_notify_setpoint_stop()
            case StopMotors():
                self.commander.send_stop_setpoint()
                for _ in range(NOTIFY_TIMES):
                    self.commander.send_notify_setpoint_stop()
            case EmergencyStop():
                self.supervisor.send_emergency_stop()
            case Arm(armed):
                self.supervisor.send_arming_request(armed)


def by_cflib(command: Command) -> list[bytes]:
    recorder = Recorder()
    recorder.call(command)
    return recorder.datagrams


def datagrams(packets: tuple[Packet, ...]) -> list[bytes]:
    return [packet.encode() for packet in packets]


class Calls:
    """A firmware that records what a decoder calls."""

    def __init__(self) -> None:
        self.made: list[tuple[str, tuple[Any, ...]]] = []
        self.supervisor = self

    def request_arming(self, do_arm: bool) -> tuple[bool, bool]:
        self.made.append(("request_arming", (do_arm,)))
        return True, do_arm

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *arguments: self.made.append((name, arguments))


def in_lockstep(command: Command) -> list[tuple[str, tuple[Any, ...]]]:
    """What the lockstep link makes the firmware do."""
    firmware = Calls()
    receive = partial(execute_packet, firmware)  # type: ignore[arg-type]
    MockLink(SimpleNamespace(t_s=0.0, receive=receive)).send(command)  # type: ignore[arg-type]
    return firmware.made


# --- Bytes ------------------------------------------------------------------------------------


@given(commands(st.floats(width=32)))  # NaN and infinities too: refusing them is the vehicle's part
def test_packets_are_cflibs_and_sent_as_they_are(command: Command) -> None:
    recorder = Recorder()
    send_packets(recorder, encode(command))
    assert datagrams(encode(command)) == recorder.datagrams == by_cflib(command)
    assert all(0 < len(packet.data) <= MAX_DATA for packet in encode(command))


def test_the_thrust_unlock_is_cflibs() -> None:
    unlock = Recorder()
    unlock.unlock_thrust()
    assert datagrams(UNLOCK_THRUST) == unlock.datagrams


@pytest.mark.parametrize(
    "command", [RawThrust(-1), RawThrust(THRUST_MAX + 1), PositionSetpoint(1e39, 0.0, 0.0, 0.0)]
)
def test_a_number_that_does_not_fit_is_refused(command: Command) -> None:
    with pytest.raises(InvalidValue, match="does not fit into a packet"):
        encode(command)


# --- The lockstep link ------------------------------------------------------------------------


@given(commands(st.floats(width=32, allow_nan=False)))
def test_the_lockstep_vehicle_decodes_what_cflib_sends(command: Command) -> None:
    firmware = Calls()
    for datagram in by_cflib(command):
        packet = Packet.decode(datagram)
        assert packet is not None
        execute_packet(firmware, packet)  # type: ignore[arg-type]
    assert in_lockstep(command) == firmware.made


class LosesTheFirst(Radio):
    """So many of the packets sent up are lost at the beginning."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.left = count

    def uplink_arrives(self, packet: Packet, now_s: float) -> bool:
        self.left -= 1
        return self.left < 0


@pytest.mark.parametrize("lost", [0, 1, 3, 2 * UNLOCK_TIMES - 2])
def test_a_lost_packet_does_not_leave_the_thrust_locked(lost: int) -> None:
    """The first raw thrust of the flight would be a cut: nothing in the air may unlock it."""
    vehicle = SimulatedVehicle(Scenario())
    link = MockLink(vehicle, radio=LosesTheFirst(lost))
    link.connect()
    for _ in range(20):
        link.send(RawThrust(15000))
        link.advance_to(link.now_s + 0.02)
    assert link.telemetry()[-1].thrust == pytest.approx(15000, abs=1500)
