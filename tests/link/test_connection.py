"""What a `Connection` finds out about cflib's driver, without a vehicle.

Time is the test's own: the clock that `perchctl.link.connection` reads.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cflib.crtp
import pytest
from cflib.crtp import radiodriver

from perchctl.link import Packet, Port
from perchctl.link import connection as room
from perchctl.link.connection import DEAD_S, Connection

PACKET = Packet(Port.SUPERVISOR, 1, b"\x03")
STEP_S = 0.05
LIMIT_S = 5.0


class Thread:
    """Of a driver, as cflib's radio has it."""

    def __init__(self) -> None:
        self.alive = True
        self._retry_before_disconnect: int | None = 100_000

    def is_alive(self) -> bool:
        return self.alive


class Driver:
    needs_resending = False

    def __init__(self) -> None:
        self._thread: Thread | None = Thread()
        self.sent: list[Any] = []

    def send_packet(self, packet: Any) -> None:
        self.sent.append(packet)

    def close(self) -> None:
        return None


@dataclass
class Bench:
    connection: Connection
    driver: Driver
    now_s: float = 100.0

    def is_dead_within(self, for_s: float, lost_packets: int = 0, period_s: float = STEP_S) -> bool:
        """Asked all the time, while the driver counts so many lost packets each time."""
        dead = False
        for _ in range(round(for_s / period_s)):
            self.now_s += period_s
            if self.driver._thread is not None and self.driver._thread._retry_before_disconnect:
                self.driver._thread._retry_before_disconnect -= lost_packets
            dead = dead or self.connection.is_dead()
        return dead


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    bench = Bench(Connection(), Driver())
    bench.connection.cf.link = bench.driver
    bench.connection.cf.link_uri = "radio://0/80/2M/E7E7E7E7E7"
    clock = SimpleNamespace(monotonic=lambda: bench.now_s, sleep=time.sleep)
    monkeypatch.setattr(room, "time", clock)
    return bench


def test_a_radio_that_counts_what_it_loses_is_alive_however_long(bench: Bench) -> None:
    assert not bench.is_dead_within(100.0, lost_packets=25)


def test_one_that_counts_nothing_is_dead(bench: Bench) -> None:
    assert not bench.is_dead_within(DEAD_S)
    assert bench.is_dead_within(2 * STEP_S)


def test_between_two_questions_that_lie_far_apart_it_may_have_counted(bench: Bench) -> None:
    """It counts anew after each packet that was answered; and a computer may have slept."""
    assert not bench.is_dead_within(100.0, period_s=2 * DEAD_S)


def test_one_whose_thread_has_ended_is_dead(bench: Bench) -> None:
    assert bench.driver._thread is not None
    bench.driver._thread.alive = False
    assert bench.connection.is_dead()


@pytest.mark.parametrize("thread", [None, SimpleNamespace(is_alive=lambda: True)])
def test_of_a_driver_that_tells_nothing_nothing_is_said(bench: Bench, thread: Any) -> None:
    bench.driver._thread = thread
    assert not any(bench.connection.is_dead() for _ in range(3))
    bench.now_s += 2 * DEAD_S
    assert not bench.connection.is_dead()


def test_a_lock_that_is_never_free_is_a_dead_link_and_a_reopened_one_has_its_own(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    connection, after = bench.connection, Driver()
    connection.cf._send_lock.acquire()
    assert not connection.send(PACKET)
    assert not connection.is_dead()
    bench.now_s += DEAD_S + 0.01
    assert not connection.send(PACKET)
    assert connection.is_dead()
    monkeypatch.setattr(cflib.crtp, "get_link_driver", lambda *_: after)
    connection.reopen("stuck")
    await_open(connection)
    assert connection.send(PACKET)
    assert (len(bench.driver.sent), len(after.sent)) == (0, 1)
    assert not connection.is_dead()


def test_cflib_listens_to_a_new_driver_at_once(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By itself it looks for one once a second."""
    connection, listened, pause = bench.connection, threading.Event(), threading.Event()

    class Heard(Driver):
        def receive_packet(self, wait: float) -> None:
            listened.set()
            pause.wait(wait)

    def driver(*_: Any) -> Driver:
        pause.wait(0.2)
        return Heard()

    connection.cf.link = Heard()
    connection.cf.incoming.start()
    assert listened.wait(LIMIT_S)
    monkeypatch.setattr(cflib.crtp, "get_link_driver", driver)
    connection.reopen("unplugged")
    pause.set()
    pause.clear()
    listened.clear()
    await_open(connection)
    assert listened.wait(0.4)
    connection.cf.incoming.stop()
    pause.set()


def test_a_dead_thread_of_a_dongles_is_not_opened_again(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """cflib would hand it out for ever, and wait for its answers."""
    radios: list[Any] = [SimpleNamespace(is_alive=lambda: False)]
    monkeypatch.setattr(radiodriver.RadioManager, "_radios", radios)
    found: list[Any] = []

    def driver(*_: Any) -> Driver:
        found.append(radios[0])
        return Driver()

    monkeypatch.setattr(cflib.crtp, "get_link_driver", driver)
    bench.connection.reopen("unplugged")
    await_open(bench.connection)
    assert found == [None]


def await_open(connection: Connection) -> None:
    pause = threading.Event()
    for _ in range(int(LIMIT_S / 0.01)):
        if connection.lost is None:
            return
        pause.wait(0.01)
    raise AssertionError(connection.lost)


def test_a_real_flight_loads_nothing_of_the_simulator() -> None:
    """Neither does its link: the mock takes a simulated vehicle as an argument."""
    program = (
        "import sys, time\n"
        "import perchctl.flight.session\n"
        "from perchctl.link import CflibLink, MockLink, Packet, ProbeLink\n"
        "from perchctl.profile import LinkConfig\n"
        "CflibLink('radio://0/80/2M', LinkConfig(), time.monotonic)\n"
        "print(*[name for name in sys.modules if name.startswith('perchctl.sim')])\n"
    )
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.split() == []
