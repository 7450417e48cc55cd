"""What a `Connection` finds out about cflib's driver and sends through its lock, without a vehicle;
and that a vehicle is one program's at a time.

Time is the test's own: the clock that `perchctl.link.connection` reads.
"""

from __future__ import annotations

import queue
import socket
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

from perchctl.errors import ConnectionFailed
from perchctl.link import CflibLink, Packet, Port
from perchctl.link import connection as room
from perchctl.link.connection import (
    DEAD_S,
    Connection,
    find_cause,
    lock_vehicle,
    open_connection,
    readable_cause,
    send_packets,
)
from perchctl.link.crtp import encode
from perchctl.profile import LinkConfig
from perchctl.vehicle import ExternalPosition
from tests.helpers.waiting import until

PACKET = Packet(Port.SUPERVISOR, 1, b"\x03")
STEP_S = 0.05
LIMIT_S = 5.0
RADIO = "radio://0/80/2M/E7E7E7E701"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


class Thread:
    """The thread of a driver, as cflib's radio has it."""

    def __init__(self) -> None:
        self.alive = True
        self._retry_before_disconnect: int | None = 100_000

    def is_alive(self) -> bool:
        return self.alive


class Driver:
    """A link of cflib's that can hang, fail, or have no room."""

    needs_resending = False

    def __init__(self) -> None:
        self._thread: Any = Thread()
        self.sent: list[bytes] = []
        self.out_queue: queue.Queue[Any] = queue.Queue(1)
        self.entered, self.free = threading.Event(), threading.Event()
        self.free.set()
        self.error: Exception | None = None

    def send_packet(self, packet: Any) -> None:
        if self.error is not None:
            raise self.error
        self.entered.set()
        assert self.free.wait(LIMIT_S)
        self.sent.append(bytes(packet.data))

    def receive_packet(self, wait: float) -> None:
        time.sleep(min(wait, 0.02))

    def close(self) -> None:
        return None


@dataclass
class Bench:
    connection: Connection
    driver: Driver
    link: CflibLink
    now_s: float = 100.0

    def is_dead_within(self, for_s: float, lost_packets: int = 0) -> bool:
        """Asked all the time, while the driver counts so many lost packets each time."""
        dead = False
        for _ in range(round(for_s / STEP_S)):
            self.now_s += STEP_S
            self.driver._thread._retry_before_disconnect -= lost_packets
            dead = dead or self.connection.is_dead()
        return dead

    def place(self, x_m: float) -> bool:
        """Hand over a position from outside."""
        return self.link.send_external(at(x_m))


def at(x_m: float) -> ExternalPosition:
    return ExternalPosition((x_m, 0.0, 0.5))


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    bench = Bench(Connection(), Driver(), CflibLink("udp://127.0.0.1:1", LinkConfig(), lambda: 0.0))
    bench.connection.cf.link = bench.driver
    bench.connection.cf.link_uri = "radio://0/80/2M/E7E7E7E7E7"
    bench.link.connection = bench.connection
    clock = SimpleNamespace(monotonic=lambda: bench.now_s, sleep=time.sleep)
    monkeypatch.setattr(room, "time", clock)
    return bench


def reopened(bench: Bench, monkeypatch: pytest.MonkeyPatch, driver: Any) -> None:
    """Gives up the driver, and waits until the connection has the next one."""
    monkeypatch.setattr(cflib.crtp, "get_link_driver", driver)
    bench.connection.reopen("unplugged")
    until(lambda: bench.connection.lost is None, LIMIT_S)


# --- A driver that takes nothing ---------------------------------------------------------------


def test_a_radio_that_counts_what_it_loses_is_alive_and_one_that_counts_nothing_is_dead(
    bench: Bench,
) -> None:
    assert not bench.is_dead_within(100.0, lost_packets=25)
    bench.now_s += 1.0
    assert not bench.is_dead_within(DEAD_S)
    assert bench.is_dead_within(2 * STEP_S)


def test_one_whose_thread_has_ended_is_dead(bench: Bench) -> None:
    bench.driver._thread.alive = False
    assert bench.connection.is_dead()


@pytest.mark.parametrize("thread", [None, SimpleNamespace(is_alive=lambda: True)])
def test_of_a_driver_that_tells_nothing_nothing_is_said(bench: Bench, thread: Any) -> None:
    bench.driver._thread = thread
    for _ in range(round(2 * DEAD_S / STEP_S)):
        bench.now_s += STEP_S
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
    reopened(bench, monkeypatch, lambda *_: after)
    assert connection.send(PACKET)
    assert (len(bench.driver.sent), len(after.sent)) == (0, 1)
    assert not connection.is_dead()


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

    reopened(bench, monkeypatch, driver)
    assert found == [None]


# --- Positions from outside, through cflib's lock ----------------------------------------------


def test_a_position_does_not_wait_behind_a_command_that_hangs(bench: Bench) -> None:
    driver, packets = bench.driver, encode(at(0))
    driver.free.clear()
    hanging = threading.Thread(target=send_packets, args=(bench.connection.cf, packets))
    hanging.start()
    assert driver.entered.wait(LIMIT_S)
    assert [bench.place(1.0), bench.place(2.0)] == [False, False]
    driver.free.set()
    hanging.join(LIMIT_S)
    assert bench.place(3.0) is True
    assert driver.sent == [encode(at(x))[0].data for x in (0.0, 3.0)]


def test_a_position_goes_out_at_once_or_not_at_all(bench: Bench) -> None:
    bench.driver.out_queue.put("what the radio repeats until it is acknowledged")
    assert bench.place(1.0) is False
    bench.driver.out_queue.get()
    bench.driver.error = RuntimeError("unplugged")
    assert bench.place(1.0) is False
    bench.driver.error = None
    assert bench.place(2.0) is True  # the lock is free
    assert bench.driver.sent == [encode(at(2.0))[0].data]
    assert bench.place(1e300) is False
    bench.connection.lost = "gone"
    assert bench.place(1.0) is False
    bench.connection.lost, bench.connection.cf.link = None, None
    assert bench.place(1.0) is False
    bench.link.connection = None
    assert bench.place(1.0) is False
    assert len(bench.driver.sent) == 1


# --- One program at a time ----------------------------------------------------------------------


def test_a_second_program_is_refused_until_the_first_is_gone() -> None:
    """Not one packet reaches a vehicle that is another's."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        vehicle.settimeout(0.05)
        uri = f"udp://127.0.0.1:{vehicle.getsockname()[1]}"
        with lock_vehicle(uri):
            with pytest.raises(ConnectionFailed, match="end that program"):
                open_connection(uri, 5.0)
            with pytest.raises(TimeoutError):
                vehicle.recv(64)
            lock_vehicle(RADIO).close()
        lock_vehicle(uri).close()


@pytest.mark.parametrize("farewell", [True, False])
def test_a_connection_holds_the_vehicle_until_its_end_and_a_failed_one_does_not(
    farewell: bool, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(room, "init_cflib", lambda: None)
    monkeypatch.setattr(Connection, "open", lambda *_: False)
    for _ in range(2):
        with pytest.raises(ConnectionFailed, match="no answer"):
            open_connection(RADIO, 5.0)
    monkeypatch.setattr(Connection, "open", lambda *_: True)
    connection = open_connection(RADIO, 5.0)
    with pytest.raises(ConnectionFailed, match="in use"):
        lock_vehicle(RADIO)
    connection.close(farewell=farewell)
    lock_vehicle(RADIO).close()


def test_no_message_shows_the_uri_that_is_opened_instead_of_the_vehicles() -> None:
    """The URI behind a radio hub has a key, with which other programs could take the vehicle."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
    opened = f"hub://127.0.0.1:{port}/80/2M/E7E7E7E701?key=0123456789abcdef"
    link = CflibLink(RADIO, LinkConfig(), time.monotonic, link_uri=opened)
    texts = []
    with pytest.raises(ConnectionFailed) as refused:
        link.connect()
    texts.append(str(refused.value))
    with lock_vehicle(opened), pytest.raises(ConnectionFailed) as refused:
        link.connect()
    texts.append(str(refused.value))
    with pytest.raises(ConnectionFailed) as refused:
        link.settle_estimator(None)
    texts.append(str(refused.value))
    connection = Connection(RADIO)
    connection.cf.link_uri = opened
    connection._on_failed(opened, f"No driver found or malformed URI: {opened}")
    texts += [str(connection.lost), connection.cause.found]
    assert all(RADIO in text and "127.0.0.1" not in text for text in texts), texts


def test_without_a_place_for_the_lock_or_the_tables_it_flies_all_the_same(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "perchctl").write_text("")
    monkeypatch.setattr(room, "user_folder", lambda kind: folder / "perchctl")
    lock_vehicle(RADIO).close()
    Connection()


def test_a_radio_that_another_program_has_open_is_named_as_that() -> None:
    """As cflib reports it: the error, then its traceback, which names the Crazyradio."""
    said = readable_cause(
        "Couldn't load link driver: [Errno 16] Resource busy\n\nTraceback ...\n  crazyradio.py, "
        "line 130, in __init__\n    self.dev.set_configuration(1)\nCrazyradio"
    )
    assert "another program has it open" in said
    assert "radio://1" in said
    assert "permission" not in said
    assert find_cause("Access denied").advice.startswith("Write these lines")


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
    assert (shown.returncode, shown.stdout.split()) == (0, []), shown.stderr
