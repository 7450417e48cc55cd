"""Connecting, parameters, logs, reboots and bad links, seen through cflib's `udp://` driver: rows
of docs/firmware.md."""

from __future__ import annotations

import contextlib
import errno
import itertools
import threading
from collections.abc import Iterator

import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.mem import MemoryElement
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.utils.power_switch import PowerSwitch

from perchctl.link import Packet
from perchctl.sim import Scenario, SimProcess
from perchctl.sim.crtp import CrtpServer
from perchctl.sim.host import VehicleHost
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
from tests.helpers.firmware_rig import make_rig
from tests.helpers.waiting import until

# --- Connecting -------------------------------------------------------------------


@pytest.mark.usefixtures("client")  # which has filled the cache
def test_connect_sequence(sim: SimProcess, toc_cache: str) -> None:
    """Row "Connect sequence": order, sizes of the tables, no simulated time needed."""
    before_s = sim.truth()["t_s"]
    with contextlib.closing(Client(sim.uri, None)) as client:
        assert client.connect()
        # FD 00, DD 00, 5D 05, 5C 03, 5C 02 id16
        begin = [(15, 1, b"\0"), (13, 1, b"\0"), (5, 1, b"\5"), (5, 0, b"\3"), (5, 0, b"\2\0\0")]
        assert client.sent[:5] == begin
        assert (4, 0, b"\x01") in client.sent
        assert (4, 0, b"\x02\x00") in client.sent
        assert any(p == 2 and c == 3 and d[0] == 7 for p, c, d in client.sent)
        assert client.cf.platform.get_protocol_version() == 12
        assert sum(len(group) for group in client.cf.log.toc.toc.values()) == 385
        assert sum(len(group) for group in client.cf.param.toc.toc.values()) == 257
        assert sum(len(group) for group in client.cf.param.values.values()) == 257
        (eeprom,) = client.cf.mem.mems
        assert (eeprom.type, eeprom.size) == (MemoryElement.TYPE_I2C, 8192)
        toc = client.cf.param.toc
        assert toc.get_element_by_complete_name("posCtlPid.zKp").is_persistent()
        assert not toc.get_element_by_complete_name("stabilizer.estimator").is_persistent()
        got = threading.Event()
        client.cf.link_statistics.latency_updated.add_callback(lambda _: got.set())
        assert got.wait(WAIT_S)  # a ping every 0.1 s
        assert sim.truth()["t_s"] == before_s
    # The tables' CRCs are stable, so a cache spares the download.
    with contextlib.closing(Client(sim.uri, toc_cache)) as second:
        assert second.connect()
        assert not any(p in (2, 5) and c == 0 and d[0] == 2 for p, c, d in second.sent)


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
    """Row "Log data: block id, 3-byte ms timestamp, data", with conversion on the way; 13 variables
    take a second packet."""
    names = [f"debugCtr.c{i}" for i in range(6)]
    names += ["pm.vbatMV", *(f"motor.m{i}" for i in (1, 2, 3, 4)), "supervisor.info"]
    block = log_block("p", dict.fromkeys(names, "uint16_t") | {"pm.vbat": "FP16"}, 50)
    got: list[tuple[int, dict[str, float]]] = []
    clean.start_block(block, lambda stamp, values: got.append((stamp, values)))
    sim.advance(0.5)
    until(lambda: len(got) == 10)
    assert {b[0] - a[0] for a, b in itertools.pairwise(got)} == {50}
    data = got[-1][1]
    assert len(data) == 13
    assert data["pm.vbat"] == pytest.approx(4.1, abs=0.1)
    assert data["pm.vbatMV"] == pytest.approx(4100, abs=100)
    assert data["supervisor.info"] == READY
    block.stop()
    assert clean.echo(1)  # the stop has been served before this
    sim.advance(0.2)
    assert clean.echo(2)
    assert len(got) == 10


def test_log_limits_are_known_to_cflib(clean: Client) -> None:
    """Rows "Unknown log variable: KeyError. Too large a log block: AttributeError"."""
    with pytest.raises(KeyError):
        clean.cf.log.add_config(log_block("u", {"no.such": "float"}))
    too_large = {
        f"{group}.{n}": "float" for group in ("acc", "gyro", "stateEstimate") for n in "xyz"
    }
    with pytest.raises(AttributeError):
        clean.cf.log.add_config(log_block("l", too_large))
    with pytest.raises(AttributeError):
        clean.cf.log.add_config(log_block("s", {"acc.z": "float"}, 2550))


# --- On the wire ----------------------------------------------------------------------------------


LOG, FULL, EIGHT = 5, b"\x07\x00\x00", b"\x01\x00\x00"  # a float, a byte
ENOENT, E2BIG, ENOEXEC, ENOMEM, EEXIST = (
    bytes((number,))
    for number in (errno.ENOENT, errno.E2BIG, errno.ENOEXEC, errno.ENOMEM, errno.EEXIST)
)
ESTIMATOR = (0).to_bytes(2, "little")
CLEAR = (LOG, 1, b"\x05", b"\x05\x00\x00")


def create(ident: int, variables: bytes, status: bytes = b"\0") -> tuple[int, int, bytes, bytes]:
    request = bytes((6, ident))
    return LOG, 1, request + variables, request + status


@pytest.mark.parametrize("exchange", [
    [(15, 0, b"hi", b"hi"), (15, 2, b"sunk", None), (15, 3, b"\x01", b"\x01")],
    [(13, 1, b"\x00", b"\x00\x0c"), (13, 1, b"\x01", b"\x012026.08\0"), (13, 1, b"\x09", None)],
    [(4, 0, b"\x01", b"\x01\x01"), (4, 0, b"\x02\x01", b"\x02\x01"), (4, 1, b"\x00", None)],
    # Parameters: id16, status byte, value.
    [(2, 1, ESTIMATOR, ESTIMATOR + b"\x00\x02"), (2, 1, b"\xff\xff", b"\xff\xff" + ENOENT)],
    [(2, 0, b"\x02\xff\xff", b"\x02"), (2, 3, b"\x07\xff\xff", b"\x07\xff\xff" + ENOENT)],
    [(2, 2, ESTIMATOR + b"\x01", ESTIMATOR + b"\x01"), (2, 2, ESTIMATOR, None)],
    # "At most 26 bytes a block, 16 blocks, 128 variables", with the error numbers.
    [create(1, 6 * FULL), create(1, FULL, EEXIST), create(2, 7 * FULL, E2BIG),
     (LOG, 1, b"\x07\x01\x02\x00\x00", b"\x07\x01\x00"),  # 26 bytes
     (LOG, 1, b"\x07\x01\x01\x00\x00", b"\x07\x01" + E2BIG)],
    [create(3, b"\x07\xff\xff", ENOENT), (LOG, 1, b"\x63\x01", b"\x63\x01" + ENOEXEC),
     *((LOG, 1, bytes((order, 99)), bytes((order, 99)) + ENOENT) for order in (2, 3, 4))],
    [*(create(i, FULL) for i in range(16)), create(16, FULL, ENOMEM), CLEAR],
    [*(create(i, 9 * EIGHT) for i in range(14)), create(14, 3 * EIGHT, ENOMEM), CLEAR],
    # What is too short, too long for a field, or of no port does no harm.
    [(7, 0, b"\x07", None), (8, 0, b"\x07\x00", None), (8, 0, b"\x03", b"\x03\0\0\0"),
     (8, 0, b"\x05\x00", b"\x05\0\0" + ENOEXEC), (3, 0, b"", None), (2, 0, b"\x00", None)],
])  # fmt: skip
def test_packets_and_their_answers(exchange: list[tuple[int, int, bytes, bytes | None]]) -> None:
    server = CrtpServer(make_rig().firmware)
    for port, channel, request, answer in exchange:
        expected = [] if answer is None else [Packet(port, channel, answer)]
        assert server.handle(Packet(port, channel, request)) == expected


def test_a_scans_probe_is_answered_and_takes_nobodys_place() -> None:
    """What the vehicle sends by itself, here log data, goes to who has asked for more; what is no
    packet is passed over."""
    probe, create, start = b"\xff\x01\x01\x01", b"\x5d\x06\x01\x07\x00\x00", b"\x5d\x03\x01\x01"
    with (
        contextlib.closing(VehicleHost(Scenario())) as host,
        wired(host.uri) as scan,
        wired(host.uri) as client,
    ):
        for datagram in (probe, b"", bytes(64)):
            scan.send(datagram)
        host.step()
        assert scan.recv(64) == probe
        client.send(create)
        client.send(start)
        scan.send(probe)
        host.advance(0.02)
        assert scan.recv(64) == probe
        for answer in (create[:3] + b"\x00", start[:3] + b"\x00", b"\x5e\x01"):
            assert client.recv(64).startswith(answer)
        assert client.recv(64).startswith(b"\x5e\x01")
        with pytest.raises(BlockingIOError):
            scan.recv(64)


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


def fail_in_flight(sim: SimProcess, cache: str) -> None:
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
        fail_in_flight(spoiled, toc_cache)
    spoiled.advance(0.006)
    assert max(spoiled.truth()["motors"]) == 0
    spoiled.advance(3.0)
    assert spoiled.truth()["supervisor_info"] & LOCKED_BIT


@pytest.mark.long
def test_old_firmware_has_no_supervisor_port(toc_cache: str) -> None:
    """Row "Protocol < 12": supervisor port missing, old channels work, bit field reads 0."""
    link = {"protocol_version": 11, "missing_log_variables": ("supervisor.info",)}
    with SimProcess.start(pace="stepped", link=link) as process:
        process.advance(1.0)
        with contextlib.closing(Client(process.uri, toc_cache)) as client:
            assert client.connect()
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


@pytest.mark.long
def test_a_lost_packet_hangs_cflibs_connect(spoiled: SimProcess) -> None:
    """Row "UdpDriver sets needs_resending=False: with loss a connect can hang for ever"."""
    spoiled.silence_link(0.01)
    with contextlib.closing(Client(spoiled.uri, None)) as client:
        assert not client.connect(wait_s=0.3)  # its first packet was lost
        spoiled.advance(0.1)
        assert client.echo(7)
        assert not client.connected(wait_s=0.5)
        assert client.cf.link is not None
        assert not client.cf.link.needs_resending


@pytest.mark.long
def test_a_silent_peer_is_never_reported(pilot: Pilot) -> None:
    """Row "a silent peer is never reported": no answer, no error; then it is back."""
    lost: list[str] = []
    pilot.cf.connection_lost.add_callback(lambda _, why: lost.append(why))
    pilot.sim.silence_link(1.0)
    assert not pilot.echo(5, wait_s=0.3)
    pilot.sim.advance(1.0)
    pilot.t_s = round(pilot.t_s + 1.0, 6)
    assert pilot.echo(6)
    pilot.advance(0.1)
    assert lost == []
