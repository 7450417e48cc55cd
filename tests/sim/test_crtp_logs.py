"""Logs, memories and console, seen through cflib's `udp://` driver: rows of docs/firmware.md."""

from __future__ import annotations

import errno
import itertools
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from cflib.crazyflie.mem import MemoryElement

from perchctl.sim import SimProcess
from tests.helpers.crtp_rig import READY, WAIT_S, Client, Pilot, log_block


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
    names = [f"stateEstimateZ.{n}" for n in ("x", "y", "z", "vx", "vy", "vz")]
    names += ["pm.vbatMV", "motor.m1", "motor.m2", "motor.m3", "motor.m4", "range.zrange"]
    names.append("supervisor.info")
    block = log_block("long", dict.fromkeys(names, "uint16_t"))
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


def test_memories(client: Client) -> None:
    """Row "memories 4C 01, 4C 02 n": there is an EEPROM, and no other."""
    assert client.ask(4, 0, b"\x01") == b"\x01\x01"
    assert client.ask(4, 0, b"\x02\x01") == b"\x02\x01"
    (eeprom,) = client.cf.mem.mems
    assert (eeprom.type, eeprom.size) == (MemoryElement.TYPE_I2C, 8192)


def test_console_reports_boot_and_lock(pilot: Pilot) -> None:
    """Port 0: the boot's text, and the lock's."""
    pilot.console = ""
    pilot.fresh()
    assert "2026.08" in pilot.console
    pilot.cf.supervisor.send_emergency_stop()
    pilot.advance(0.5)
    assert "Locked" in pilot.console
