"""Commands as bytes: those of an unmodified cflib for the same calls."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, get_args

import pytest
from cflib.crazyflie.commander import Commander
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.supervisor import Supervisor
from cflib.crtp.crtpstack import CRTPPacket
from hypothesis import given
from hypothesis import strategies as st

from perchctl.errors import InvalidValue
from perchctl.link.encode import ARM, UNLOCK_THRUST, encode
from perchctl.sim.crtp.codec import MAX_DATA, Packet
from perchctl.vehicle import (
    Command,
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    TakeOff,
)

PROTOCOL = 12
THRUST_MAX = 0xFFFF

reals = st.floats(width=32)  # also infinite ones and NaN: refusing them is the vehicle's part
radians = st.floats(-1e3, 1e3)


class Recorder:
    """Where cflib's own encoders send: the datagrams that would leave."""

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


def datagrams(packets: tuple[Packet, ...]) -> list[bytes]:
    return [packet.encode() for packet in packets]


def by_cflib(calls: Callable[[Recorder], Any]) -> list[bytes]:
    recorder = Recorder()
    calls(recorder)
    return recorder.datagrams


def test_idle_is_no_packet() -> None:
    assert encode(Idle()) == ()


@given(reals, reals, reals, radians)
def test_position_setpoint(x: float, y: float, z: float, yaw: float) -> None:
    assert datagrams(encode(PositionSetpoint(x, y, z, yaw))) == by_cflib(
        lambda cf: cf.commander.send_position_setpoint(x, y, z, math.degrees(yaw))
    )


@given(st.integers(0, THRUST_MAX))
def test_raw_thrust(thrust: int) -> None:
    assert datagrams(encode(RawThrust(thrust))) == by_cflib(
        lambda cf: cf.commander.send_setpoint(0.0, 0.0, 0.0, thrust)
    )


@given(reals, reals)
def test_take_off_keeps_the_heading(height: float, duration: float) -> None:
    assert datagrams(encode(TakeOff(height, duration))) == by_cflib(
        lambda cf: cf.high_level.takeoff(height, duration, yaw=None)
    )


@given(reals, reals)
def test_land_keeps_the_heading(height: float, duration: float) -> None:
    def calls(cf: Recorder) -> None:
        cf.commander.send_notify_setpoint_stop()
        cf.high_level.land(height, duration, yaw=None)

    assert datagrams(encode(Land(height, duration))) == by_cflib(calls)


def test_stop_motors() -> None:
    def calls(cf: Recorder) -> None:
        cf.commander.send_stop_setpoint()
        cf.commander.send_notify_setpoint_stop()

    assert datagrams(encode(StopMotors())) == by_cflib(calls)


def test_emergency_stop() -> None:
    assert datagrams(encode(EmergencyStop())) == by_cflib(
        lambda cf: cf.supervisor.send_emergency_stop()
    )


def test_arming_and_the_thrust_unlock() -> None:
    def unlock(cf: Recorder) -> None:
        cf.commander.send_setpoint(0.0, 0.0, 0.0, 0)
        cf.commander.send_notify_setpoint_stop()

    assert datagrams(UNLOCK_THRUST) == by_cflib(unlock)
    assert datagrams(ARM) == by_cflib(lambda cf: cf.supervisor.send_arming_request(True))


def test_every_command_has_its_packets() -> None:
    """At most 30 bytes each (firmware facts, "Link")."""
    commands: tuple[Command, ...] = (
        PositionSetpoint(1.0, 2.0, 3.0, 4.0),
        RawThrust(THRUST_MAX),
        TakeOff(1.0, 2.0),
        Land(0.0, 2.0),
        StopMotors(),
        EmergencyStop(),
    )
    assert {type(c) for c in commands} | {Idle} == set(get_args(Command))
    for command in commands:
        packets = encode(command)
        assert packets
        assert all(0 < len(packet.data) <= MAX_DATA for packet in packets)


@pytest.mark.parametrize(
    "command", [RawThrust(-1), RawThrust(THRUST_MAX + 1), PositionSetpoint(1e39, 0.0, 0.0, 0.0)]
)
def test_a_number_that_does_not_fit_is_refused(command: Command) -> None:
    with pytest.raises(InvalidValue, match="does not fit into a packet"):
        encode(command)
