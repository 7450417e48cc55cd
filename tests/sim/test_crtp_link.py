"""The link's rows of docs/firmware.md, seen through cflib's `udp://` driver."""

from __future__ import annotations

import errno
import itertools
import struct
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.mem import MemoryElement
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.crtp.udpdriver import UdpDriver
from cflib.utils.power_switch import PowerSwitch

from perchctl.errors import ConnectionFailed, InvalidValue
from perchctl.sim.crtp.server import LinkOptions
from perchctl.sim.process.handle import SimProcess
from perchctl.sim.scenario import Scenario
from tests.helpers.crtp_rig import LOCKED_BIT, READY, WAIT_S, Client, Pilot


@pytest.fixture(scope="module")
def sim() -> Iterator[SimProcess]:
    with SimProcess.start(pace="stepped") as process:
        process.advance(1.0)
        yield process


@pytest.fixture(scope="module")
def client(sim: SimProcess, toc_cache: str) -> Iterator[Client]:
    """A connection of its own, whose log blocks these tests may spoil."""
    connection = Client(sim.uri, toc_cache)
    assert connection.connect()
    yield connection
    connection.close()


@pytest.fixture
def clean(client: Client) -> Iterator[Client]:
    """No log blocks before and after."""
    assert client.ask(5, 1, b"\x05") == b"\x05\x00\x00"
    client.cf.log.log_blocks.clear()
    yield client
    client.ask(5, 1, b"\x05")
    client.cf.log.log_blocks.clear()


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
    firmware = client.ask(13, 1, b"\x01")
    assert firmware is not None
    assert firmware[1:].rstrip(b"\0") == b"2026.08"
    device = client.ask(13, 1, b"\x02")
    assert device is not None
    assert len(device) > 2


def test_echo(client: Client) -> None:
    """Row "ping on port 15 ch 0 every 0.1 s expects an echo"."""
    got = threading.Event()
    client.cf.link_statistics.latency_updated.add_callback(lambda _: got.set())
    assert got.wait(WAIT_S)


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # cflib's scan leaves sockets open
def test_scan_finds_it(toc_cache: str) -> None:
    """cflib's scan of ports 19850 to 19859 finds the vehicle, also while one is connected."""
    for port in range(19859, 19849, -1):
        try:
            process = SimProcess.start(pace="stepped", port=port)
        except ConnectionFailed:  # taken by another
            continue
        with process:
            uris = [uri for uri, _ in UdpDriver().scan_interface()]
            assert process.uri == f"udp://127.0.0.1:{port}"
            assert process.uri in uris
        return
    pytest.skip("all ten ports of the scan are taken")


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


def _await_value(client: Client, name: str, act: Any) -> str:
    group, short = name.split(".")
    arrived = threading.Event()
    values: list[str] = []

    def take(_: str, value: str) -> None:
        values.append(value)
        arrived.set()

    client.cf.param.add_update_callback(group, short, take)
    try:
        act()
        assert arrived.wait(WAIT_S)
    finally:
        client.cf.param.remove_update_callback(group, short, take)
    return values[-1]


def test_parameters_are_set_and_read_back(client: Client) -> None:
    """Row "every parameter is read (reply: id16, status byte, value)"; writing answers too."""
    param = client.cf.param
    name = "posCtlPid.zVelMax"
    assert float(param.get_value(name)) == 1.0
    assert float(_await_value(client, name, lambda: param.set_value(name, "0.5"))) == 0.5
    assert float(_await_value(client, name, lambda: param.request_param_update(name))) == 0.5
    param.set_value_raw(name, 0x06, 0.75)  # by name, without an answer that cflib uses
    assert float(_await_value(client, name, lambda: param.request_param_update(name))) == 0.75
    _await_value(client, name, lambda: param.set_value(name, "1.0"))
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
    assert client.ask(2, 3, b"\x07\xff\xff") == b"\x07\xff\xff\x02"


def test_persistent_parameters(client: Client) -> None:
    """Port 2 channel 3: extended types, default values, storing and clearing."""
    param = client.cf.param
    name = "posCtlPid.zKp"
    assert param.toc.get_element_by_complete_name(name).is_persistent()
    assert not param.toc.get_element_by_complete_name("stabilizer.stop").is_persistent()

    def call(method: Any) -> Any:
        done = threading.Event()
        results: list[Any] = []

        def take(_: str, result: Any) -> None:
            results.append(result)
            done.set()

        method(name, callback=take)
        assert done.wait(WAIT_S)
        return results[0]

    assert call(param.get_default_value) == 2.0
    assert call(param.persistent_get_state) == (False, 2.0, None)
    _await_value(client, name, lambda: param.set_value(name, "2.5"))
    assert call(param.persistent_store) is True
    assert call(param.persistent_get_state) == (True, 2.0, 2.5)
    assert call(param.persistent_clear) is True
    assert call(param.persistent_get_state) == (False, 2.0, None)
    _await_value(client, name, lambda: param.set_value(name, "2.0"))


# --- Logs -------------------------------------------------------------------------


def _block(name: str, variables: dict[str, str], period_ms: int = 10) -> LogConfig:
    block = LogConfig(name=name, period_in_ms=period_ms)
    for variable, ctype in variables.items():
        block.add_variable(variable, ctype)
    return block


def test_log_data_have_period_and_stamp(sim: SimProcess, clean: Client) -> None:
    """Row "Log data: block id, 3-byte ms timestamp, data", with conversion on the way."""
    block = _block("p", {"pm.vbat": "FP16", "pm.vbatMV": "uint16_t", "acc.z": "float"}, 50)
    clean.cf.log.add_config(block)
    stamps: list[int] = []
    data: list[dict[str, float]] = []
    started, ten = threading.Event(), threading.Event()

    def take(stamp: int, values: dict[str, float], _: Any) -> None:
        stamps.append(stamp)
        data.append(values)
        if len(stamps) == 10:
            ten.set()

    block.data_received_cb.add_callback(take)
    block.started_cb.add_callback(lambda _, on: on and started.set())
    block.start()
    assert started.wait(WAIT_S)
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
        clean.cf.log.add_config(_block("u", {"no.such": "float"}))
    too_large = {f"kalman.q{i}": "float" for i in range(4)} | {
        f"stateEstimate.{n}": "float" for n in "xyz"
    }
    with pytest.raises(AttributeError):
        clean.cf.log.add_config(_block("l", too_large))
    with pytest.raises(AttributeError):
        clean.cf.log.add_config(_block("s", {"acc.z": "float"}, 2550))


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
    assert clean.ask(5, 1, b"\x06\x03\x07\xff\xff") == bytes((6, 3, errno.ENOENT))
    assert clean.ask(5, 1, b"\x03\x63\x0a") == bytes((3, 99, errno.ENOENT))
    assert clean.ask(5, 1, b"\x04\x63") == bytes((4, 99, errno.ENOENT))
    assert clean.ask(5, 1, b"\x02\x63") == bytes((2, 99, errno.ENOENT))
    assert clean.ask(5, 1, b"\x63\x01") == bytes((99, 1, errno.ENOEXEC))
    assert clean.ask(5, 1, b"\x02\x01") == b"\x02\x01\x00"
    assert clean.ask(5, 1, b"\x05") == b"\x05\x00\x00"
    assert [_create(clean, i, 1) for i in range(16)] == [0] * 16
    assert _create(clean, 16, 1) == errno.ENOMEM
    assert clean.ask(5, 1, b"\x05") == b"\x05\x00\x00"
    assert [_create(clean, i, 9, ctype=1) for i in range(14)] == [0] * 14  # 126 variables
    assert _create(clean, 14, 3, ctype=1) == errno.ENOMEM


def test_blocks_longer_than_one_packet(sim: SimProcess, clean: Client) -> None:
    """Create and append V2: 13 two-byte variables need a second packet."""
    names = [f"stateEstimateZ.{n}" for n in ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")]
    names += ["pm.vbatMV", "motor.m1", "motor.m2", "supervisor.info"]
    block = _block("long", dict.fromkeys(names, "uint16_t"))
    clean.cf.log.add_config(block)
    got: list[dict[str, float]] = []
    started, arrived = threading.Event(), threading.Event()
    block.started_cb.add_callback(lambda _, on: on and started.set())
    block.data_received_cb.add_callback(lambda _, data, __: (got.append(data), arrived.set()))
    block.start()
    assert started.wait(WAIT_S)
    assert clean.echo(3)
    sim.advance(0.05)
    assert arrived.wait(WAIT_S)
    assert len(got[-1]) == 13
    assert got[-1]["supervisor.info"] == READY


# --- Memories, console ------------------------------------------------------------


def test_memories(client: Client) -> None:
    """Row "memories 4C 01, 4C 02 n": the deck's 1-wire memory and the EEPROM make sense."""
    mem = client.cf.mem
    (deck,) = mem.get_mems(MemoryElement.TYPE_1W)
    assert deck.valid
    assert deck.elements["Board name"] == "bcFlow2"
    (eeprom,) = mem.get_mems(MemoryElement.TYPE_I2C)
    done = threading.Event()
    eeprom.update(lambda _: done.set())
    assert done.wait(WAIT_S)
    assert eeprom.valid
    assert eeprom.elements["radio_address"] == 0xE7E7E7E7E7


def test_memory_is_read_and_written_in_chunks(client: Client) -> None:
    """Port 4: 24 bytes a packet, an address beyond the end is refused."""
    (tester,) = client.cf.mem.get_mems(MemoryElement.TYPE_MEMORY_TESTER)
    done = threading.Event()
    tester.read_data(5, 100, lambda _: done.set())
    assert done.wait(WAIT_S)
    assert tester.readValidationSuccess
    (trajectory,) = client.cf.mem.get_mems(MemoryElement.TYPE_TRAJ)
    written = threading.Event()
    client.cf.mem.mem_write_cb.add_callback(lambda *_: written.set())
    client.cf.mem.write(trajectory, 10, bytes(range(60)))
    assert written.wait(WAIT_S)
    head = struct.pack("<BI", trajectory.id, 10)
    assert client.ask(4, 1, head + b"\x05") == head + b"\x00\x00\x01\x02\x03\x04"
    beyond = struct.pack("<BI", trajectory.id, trajectory.size - 2)
    assert client.ask(4, 1, beyond + b"\x05") == beyond + bytes((errno.EACCES,))


def test_console_reports_boot_and_lock(pilot: Pilot) -> None:
    """Port 0: the boot's text, and the lock's."""
    pilot.console = ""
    pilot.fresh()
    assert "2026.08" in pilot.console
    pilot.cf.supervisor.send_emergency_stop()
    pilot.advance(0.5)
    assert "Locked" in pilot.console


# --- Reboot, other firmware, bad links ---------------------------------------------


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
    link = LinkOptions(protocol_version=10, missing_log_variables=("supervisor.info",))
    with SimProcess.start(pace="stepped", link=link) as process:
        process.advance(1.0)
        client = Client(process.uri, toc_cache)
        assert client.connect()
        try:
            assert client.cf.platform.get_protocol_version() == 10
            with pytest.warns(UserWarning, match="protocol version 12"):
                assert client.cf.supervisor.read_bitfield() == 0
            client.send(9, 0, b"\x0c")
            assert client.echo(4)
            assert client.ask(13, 0, b"\x01\x01") == b"\x01\x01\x01"  # arming, the old way
            name = "posCtlPid.zKp"  # extended types by the old command
            assert client.cf.param.toc.get_element_by_complete_name(name).is_persistent()
            with pytest.raises(KeyError):
                client.cf.log.add_config(_block("s", {"supervisor.info": "uint16_t"}))
            with pytest.warns(UserWarning, match="protocol version 12"):
                client.cf.supervisor.send_emergency_stop()
            process.advance(0.5)
            assert process.truth()["supervisor_info"] & LOCKED_BIT
        finally:
            client.close()


def test_a_lost_packet_hangs_cflibs_connect(toc_cache: str) -> None:
    """Row "UdpDriver sets needs_resending=False: with loss a connect can hang for ever"."""
    link = LinkOptions(loss_rate=0.02, loss_seed=3)
    with SimProcess.start(pace="stepped", link=link) as process:
        client = Client(process.uri, None)
        try:
            assert not client.connect(wait_s=1.0)
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


@pytest.mark.parametrize("wrong", [{"protocol_version": 3}, {"loss_rate": 1.5}])
def test_options_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidValue, match="choose"):
        LinkOptions(**wrong)
