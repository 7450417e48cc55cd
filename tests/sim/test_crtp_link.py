"""Connecting, parameters, logs, reboots and bad links, seen through cflib's `udp://` driver: rows
of docs/firmware.md."""

from __future__ import annotations

import contextlib
import errno
import itertools
import socket
import struct
import threading
from collections.abc import Iterator

import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.mem import MemoryElement
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.utils.power_switch import PowerSwitch

from perchctl.sim import Scenario, SimProcess
from perchctl.sim.crtp import LinkOptions
from perchctl.sim.host import VehicleHost
from perchctl.sim.process import HostSetup
from tests.helpers.crtp_rig import (
    LOCKED_BIT,
    READY,
    WAIT_S,
    Client,
    Pilot,
    log_block,
    parameter_update,
    wired,
)

# --- Connecting -------------------------------------------------------------------


def test_connect_sequence(sim: SimProcess) -> None:
    """Row "Connect sequence": order, sizes of the tables, no simulated time needed."""
    before_s = sim.truth()["t_s"]
    client = Client(sim.uri, None)
    assert client.connect()
    try:
        first = client.sent[:5]
        assert first[0] == (15, 1, b"\x00")  # FD 00
        assert first[1] == (13, 1, b"\x00")  # DD 00
        assert first[2] == (5, 1, b"\x05")  # 5D 05
        assert first[3] == (5, 0, b"\x03")  # 5C 03
        assert first[4] == (5, 0, b"\x02\x00\x00")  # 5C 02 id16
        assert (4, 0, b"\x01") in client.sent
        assert (4, 0, b"\x02\x00") in client.sent
        assert any(p == 2 and c == 3 and d[0] == 7 for p, c, d in client.sent)
        assert client.cf.platform.get_protocol_version() == 12
        assert sum(len(group) for group in client.cf.log.toc.toc.values()) == 385
        assert sum(len(group) for group in client.cf.param.toc.toc.values()) == 257
        assert sum(len(group) for group in client.cf.param.values.values()) == 257
        assert sim.truth()["t_s"] == before_s
    finally:
        client.close()


def test_tables_come_from_the_cache_the_second_time(client: Client) -> None:
    """Row "Connect sequence": the tables' CRCs are stable, so a cache spares the download."""
    second = Client(client.uri, client.cf._toc_cache._rw_cache)
    assert second.connect()
    try:
        assert not any(p in (2, 5) and c == 0 and d[0] == 2 for p, c, d in second.sent)
        assert sum(len(group) for group in second.cf.log.toc.toc.values()) == 385
    finally:
        second.close()


def test_firmware_and_device_names(client: Client) -> None:
    """Row "release 2026.08 (CRTP protocol 12)"."""
    assert client.cf.platform.get_protocol_version() == 12
    assert client.ask(13, 1, b"\x01") == b"\x012026.08\0"
    assert len(client.ask(13, 1, b"\x02") or b"") > 2


def test_echo(client: Client) -> None:
    """Row "ping on port 15 ch 0 every 0.1 s expects an echo"."""
    got = threading.Event()
    client.cf.link_statistics.latency_updated.add_callback(lambda _: got.set())
    assert got.wait(WAIT_S)


def test_an_oversized_or_empty_datagram_is_passed_over(client: Client) -> None:
    """Row "payload at most 30 bytes": rubbish does no harm."""
    assert client.cf.link is not None
    link_socket = client.cf.link.socket
    for rubbish in (
        b"",
        bytes(64),
        b"\x7c\x07",
        b"\x8c\x07\x00",
        b"\x3c",
        b"\x2c\x00",
        b"\x4d\x00",
    ):
        link_socket.send(rubbish)
    assert client.echo(9)


# --- Parameters -------------------------------------------------------------------


def test_parameters_are_set_and_read_back(client: Client) -> None:
    """Row "every parameter is read (reply: id16, status byte, value)"; writing answers too."""
    param = client.cf.param
    name = "posCtlPid.zVelMax"
    assert float(param.get_value(name)) == 1.0
    assert parameter_update(client, name, lambda: param.set_value(name, "0.5")) == 0.5
    assert parameter_update(client, name, lambda: param.request_param_update(name)) == 0.5
    parameter_update(client, name, lambda: param.set_value(name, "1.0"))
    with pytest.raises(AttributeError, match="read-only"):
        param.set_value("deck.bcFlow2", "0")
    with pytest.raises(KeyError):
        param.set_value("no.such", "0")


def test_parameter_answers_on_the_wire(client: Client) -> None:
    """Row "reply: id16, status byte, value"; an unknown number answers ENOENT."""
    element = client.cf.param.toc.get_element_by_complete_name("stabilizer.estimator")
    ident = struct.pack("<H", element.ident)
    assert client.ask(2, 1, ident) == ident + b"\x00\x02"
    assert client.ask(2, 1, b"\xff\xff") == b"\xff\xff\x02"
    assert client.ask(2, 0, b"\x02\xff\xff") == b"\x02"
    assert client.ask(2, 3, b"\x07\xff\xff") == b"\x07\xff\xff\x02"
    toc = client.cf.param.toc
    assert toc.get_element_by_complete_name("posCtlPid.zKp").is_persistent()
    assert not toc.get_element_by_complete_name("stabilizer.stop").is_persistent()


# --- Logs and memories ----------------------------------------------------------------------------


@pytest.fixture
def clean(client: Client) -> Iterator[Client]:
    """No log blocks before and after."""
    assert client.ask(5, 1, b"\x05") == b"\x05\x00\x00"
    client.cf.log.log_blocks.clear()
    yield client
    client.ask(5, 1, b"\x05")
    client.cf.log.log_blocks.clear()


def test_log_data_have_period_and_stamp(sim: SimProcess, clean: Client) -> None:
    """Row "Log data: block id, 3-byte ms timestamp, data", with conversion on the way."""
    block = log_block("p", {"pm.vbat": "FP16", "pm.vbatMV": "uint16_t", "acc.z": "float"}, 50)
    stamps: list[int] = []
    data: list[dict[str, float]] = []
    ten = threading.Event()

    def take(stamp: int, values: dict[str, float]) -> None:
        stamps.append(stamp)
        data.append(values)
        if len(stamps) == 10:
            ten.set()

    clean.start_block(block, take)
    sim.advance(0.5)
    assert ten.wait(WAIT_S)
    assert {b - a for a, b in itertools.pairwise(stamps)} == {50}
    assert data[-1]["pm.vbat"] == pytest.approx(4.1, abs=0.1)
    assert data[-1]["pm.vbatMV"] == pytest.approx(4100, abs=100)
    assert data[-1]["acc.z"] == pytest.approx(1.0, abs=0.05)
    block.stop()
    assert clean.echo(1)  # the stop has been served before this
    count = len(stamps)
    sim.advance(0.2)
    assert clean.echo(2)
    assert len(stamps) == count


def test_log_limits_are_known_to_cflib(clean: Client) -> None:
    """Rows "Unknown log variable: KeyError. Too large a log block: AttributeError"."""
    with pytest.raises(KeyError):
        clean.cf.log.add_config(log_block("u", {"no.such": "float"}))
    too_large = {f"kalman.q{i}": "float" for i in range(4)} | {
        f"stateEstimate.{n}": "float" for n in "xyz"
    }
    with pytest.raises(AttributeError):
        clean.cf.log.add_config(log_block("l", too_large))
    with pytest.raises(AttributeError):
        clean.cf.log.add_config(log_block("s", {"acc.z": "float"}, 2550))


def _create(client: Client, ident: int, count: int, ctype: int = 7) -> int:
    answer = client.ask(5, 1, bytes((6, ident)) + bytes((ctype, 0, 0)) * count)
    assert answer is not None
    assert answer[:2] == bytes((6, ident))
    return answer[2]


def test_log_errors_on_the_wire(clean: Client) -> None:
    """Row "at most 26 bytes a block ... 16 blocks, 128 variables", with the error numbers."""
    assert _create(clean, 1, 6) == 0
    assert _create(clean, 1, 1) == errno.EEXIST
    assert clean.ask(5, 1, b"\x07\x01\x02\x00\x00") == b"\x07\x01\x00"  # 26 bytes
    assert clean.ask(5, 1, b"\x07\x01\x01\x00\x00") == bytes((7, 1, errno.E2BIG))
    assert _create(clean, 2, 7) == errno.E2BIG
    for request, status in (
        (b"\x06\x03\x07\xff\xff", errno.ENOENT),
        (b"\x03\x63\x0a", errno.ENOENT),
        (b"\x04\x63", errno.ENOENT),
        (b"\x02\x63", errno.ENOENT),
        (b"\x63\x01", errno.ENOEXEC),
    ):
        assert clean.ask(5, 1, request) == request[:2] + bytes((status,))
    assert clean.ask(5, 1, b"\x02\x01") == b"\x02\x01\x00"
    assert clean.ask(5, 1, b"\x05") == b"\x05\x00\x00"
    assert [_create(clean, i, 1) for i in range(16)] == [0] * 16
    assert _create(clean, 16, 1) == errno.ENOMEM
    assert clean.ask(5, 1, b"\x05") == b"\x05\x00\x00"
    assert [_create(clean, i, 9, ctype=1) for i in range(14)] == [0] * 14  # 126 variables
    assert _create(clean, 14, 3, ctype=1) == errno.ENOMEM


def test_blocks_longer_than_one_packet(sim: SimProcess, clean: Client) -> None:
    """Create and append V2: 13 two-byte variables need a second packet."""
    names = [f"stateEstimateZ.{n}" for n in ("x", "y", "z", "vx", "vy", "vz")]
    names += ["pm.vbatMV", "motor.m1", "motor.m2", "motor.m3", "motor.m4", "range.zrange"]
    names.append("supervisor.info")
    got: list[dict[str, float]] = []
    arrived = threading.Event()
    block = log_block("long", dict.fromkeys(names, "uint16_t"))
    clean.start_block(block, lambda _, data: (got.append(data), arrived.set()))
    assert clean.echo(3)
    sim.advance(0.05)
    assert arrived.wait(WAIT_S)
    assert len(got[-1]) == 13
    assert got[-1]["supervisor.info"] == READY


def test_memories(client: Client) -> None:
    """Row "memories 4C 01, 4C 02 n": there is an EEPROM, and no other."""
    assert client.ask(4, 0, b"\x01") == b"\x01\x01"
    assert client.ask(4, 0, b"\x02\x01") == b"\x02\x01"
    (eeprom,) = client.cf.mem.mems
    assert (eeprom.type, eeprom.size) == (MemoryElement.TYPE_I2C, 8192)


# --- Reboot, other firmware and bad links ---------------------------------------------------------


@pytest.fixture
def spoiled(sim: SimProcess) -> Iterator[SimProcess]:
    """The vehicle of these tests, new before and after."""

    def renew() -> None:
        sim.replace_vehicle(Scenario())
        sim.advance(1.0)

    renew()
    yield sim
    renew()


def test_only_a_reboot_clears_the_lock(spoiled: SimProcess, client: Client) -> None:
    """Row "the supervisor locks: only a reboot clears it", by cflib's own power switch."""
    client.cf.supervisor.send_emergency_stop()
    spoiled.advance(1.0)
    assert client.supervisor_info() & LOCKED_BIT
    switch = PowerSwitch(spoiled.uri)
    switch.reboot_to_fw()
    switch.close()
    spoiled.advance(1.0)
    assert client.supervisor_info() == READY


def _fail_in_flight(sim: SimProcess, cache: str) -> None:
    with SyncCrazyflie(sim.uri, cf=Crazyflie(rw_cache=cache)) as scf:
        scf.cf.commander.send_setpoint(0, 0, 0, 0)
        scf.cf.commander.send_notify_setpoint_stop()
        scf.cf.high_level_commander.takeoff(0.8, 2.0)
        sim.advance(5.0)
        assert sim.truth()["position_m"][2] > 0.7
        raise RuntimeError("any")


def test_an_exception_in_a_with_block_drops_the_vehicle(
    spoiled: SimProcess, toc_cache: str
) -> None:
    """Row "SyncCrazyflie.__exit__ does the same, so an exception inside drops the vehicle"."""
    with pytest.raises(RuntimeError, match="any"):
        _fail_in_flight(spoiled, toc_cache)
    spoiled.advance(0.006)
    assert max(spoiled.truth()["motors"]) == 0
    spoiled.advance(3.0)
    assert spoiled.truth()["supervisor_info"] & LOCKED_BIT


def test_old_firmware_has_no_supervisor_port(toc_cache: str) -> None:
    """Row "Protocol < 12": supervisor port missing, old channels work, bit field reads 0."""
    link = LinkOptions(protocol_version=11, missing_log_variables=("supervisor.info",))
    with SimProcess.start(pace="stepped", link=link) as process:
        process.advance(1.0)
        client = Client(process.uri, toc_cache)
        assert client.connect()
        try:
            assert client.cf.platform.get_protocol_version() == 11
            with pytest.warns(UserWarning, match="protocol version 12"):
                assert client.cf.supervisor.read_bitfield() == 0
            client.send(9, 0, b"\x0c")
            assert client.echo(4)
            assert client.ask(13, 0, b"\x01\x01") == b"\x01\x01\x01"  # arming, the old way
            with pytest.raises(KeyError):
                client.cf.log.add_config(log_block("s", {"supervisor.info": "uint16_t"}))
            with pytest.warns(UserWarning, match="protocol version 12"):
                client.cf.supervisor.send_emergency_stop()
            process.advance(0.5)
            assert process.truth()["supervisor_info"] & LOCKED_BIT
        finally:
            client.close()


def test_a_lost_packet_hangs_cflibs_connect(spoiled: SimProcess) -> None:
    """Row "UdpDriver sets needs_resending=False: with loss a connect can hang for ever"."""
    client = Client(spoiled.uri, None)
    spoiled.silence(0.01)
    try:
        assert not client.connect(wait_s=0.3)  # its first packet was lost
        spoiled.advance(0.1)
        assert client.echo(7)
        assert not client.connected(wait_s=0.5)
        assert client.cf.link is not None
        assert not client.cf.link.needs_resending
    finally:
        client.close()


def test_a_silent_peer_is_never_reported(pilot: Pilot) -> None:
    """Row "a silent peer is never reported": no answer, no error; then it is back."""
    lost: list[str] = []
    pilot.cf.connection_lost.add_callback(lambda _, why: lost.append(why))
    pilot.sim.silence(1.0)
    assert not pilot.echo(5, wait_s=0.3)
    pilot.sim.advance(1.0)
    pilot.t_s = round(pilot.t_s + 1.0, 6)
    assert pilot.echo(6)
    pilot.advance(0.1)
    assert lost == []


def arrived(mine: socket.socket) -> list[bytes]:
    """The datagrams that have come."""
    datagrams = []
    with contextlib.suppress(BlockingIOError):
        while True:
            datagrams.append(mine.recv(64))
    return datagrams


def test_a_scans_probe_is_answered_and_takes_nobodys_place() -> None:
    """What the vehicle sends by itself, here log data, goes to who has asked for more."""
    probe, create, start = b"\xff\x01\x01\x01", b"\x5d\x06\x01\x07\x00\x00", b"\x5d\x03\x01\x01"
    with (
        contextlib.closing(VehicleHost(HostSetup())) as host,
        wired(host.uri) as scan,
        wired(host.uri) as client,
    ):
        scan.send(probe)
        host.step()
        assert arrived(scan) == [probe]
        client.send(create)
        client.send(start)
        scan.send(probe)
        host.advance(0.02)
        assert arrived(scan) == [probe]
        *answers, _, newest = arrived(client)
        assert answers == [create[:3] + b"\x00", start[:3] + b"\x00"]
        assert newest[:2] == b"\x5e\x01"
