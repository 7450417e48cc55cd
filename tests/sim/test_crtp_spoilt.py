"""Reboot, other firmware and bad links, seen through cflib's `udp://` driver."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator

import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.utils.power_switch import PowerSwitch

from perchctl.sim import Scenario, SimProcess
from perchctl.sim.crtp import LinkOptions
from perchctl.sim.host import VehicleHost
from perchctl.sim.process import HostSetup
from tests.helpers.crtp_rig import LOCKED_BIT, READY, Client, Pilot, log_block, wired


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
    """What the vehicle sends by itself, here its boot's text, goes to who has asked for more."""
    with (
        contextlib.closing(VehicleHost(HostSetup())) as host,
        wired(host.uri) as scan,
        wired(host.uri) as client,
    ):
        scan.send(b"\xff\x01\x01\x01")
        host.step()
        assert arrived(scan) == [b"\xff\x01\x01\x01"]
        client.send(b"\xfc\x07")
        scan.send(b"\xff\x01\x01\x01")
        host.step()
        assert len(arrived(scan)) == 1
        echo, *text = arrived(client)
        assert echo == b"\xfc\x07"
        assert b"2026.08" in b"".join(part[1:] for part in text)
