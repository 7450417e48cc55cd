"""Connecting and parameters, seen through cflib's `udp://` driver: rows of docs/firmware.md."""

from __future__ import annotations

import struct
import threading
from typing import Any

import pytest

from perchctl.sim import SimProcess
from tests.helpers.crtp_rig import WAIT_S, Client

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
    assert client.ask(2, 0, b"\x02\xff\xff") == b"\x02"
    assert client.ask(2, 3, b"\x07\xff\xff") == b"\x07\xff\xff\x02"
    toc = client.cf.param.toc
    assert toc.get_element_by_complete_name("posCtlPid.zKp").is_persistent()
    assert not toc.get_element_by_complete_name("stabilizer.stop").is_persistent()
