"""Several vehicles behind one dongle and its hub, under the installed cflib.

The dongle works as fast as the computer lets it. What is asserted are counts, orders and what
arrived; each wait is for an event and bounded.
"""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.exceptions import WrongUriType

from perchctl.children import spawn
from perchctl.errors import ConnectionFailed, InvalidValue
from perchctl.link import (
    CflibLink,
    HubReport,
    RadioHub,
    check_uri,
    hub,
    hub_driver,
    internals,
    sharing,
)
from perchctl.link.connection import init_cflib, lock_vehicle
from perchctl.link.crtp import Port, encode
from perchctl.link.hub_driver import HubDriver
from perchctl.link.sharing import Carrier, Hub
from perchctl.profile import LinkConfig
from perchctl.vehicle import Land
from tests.helpers.dongle import TELEMETRY, Talker, UsbPort, attach, talkers, uris
from tests.helpers.waiting import until

FOUR = uris(4)
COMMAND = 0x8C  # header of a command, which a talker returns
LINK = LinkConfig(connect_timeout_s=60.0, parameters={"stabilizer.estimator": 2})
PATIENT_TICKS = 10_000
"""Instead of `sharing.STUCK_TICKS`: on a busy computer, the threads of a dongle that lives may wait
longer for the processor."""
SLOWED = 0.2
"""Of a real dongle's times: enough for the links' threads to take turns."""


class Flight:
    """A flight's end of its link: what arrived, and the errors that its driver reported."""

    def __init__(self, uri: str) -> None:
        self.telemetry: list[int] = []
        self.returned: list[bytes] = []
        self.errors: list[str] = []
        self.failed = threading.Event()
        self.driver = HubDriver()
        self.driver.connect(uri, None, self._fail)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def send(self, *numbers: int) -> None:
        """Commands of these numbers, each as soon as there is room."""
        for number in numbers:
            until(lambda: not self.driver.out_queue.full())
            self.driver.send_packet(CRTPPacket(COMMAND, bytes((number,))))

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        self.driver.close()

    def _receive(self) -> None:
        while not self._over.is_set():
            packet = self.driver.receive_packet(0.05)
            if packet is None:
                continue
            if packet.header == TELEMETRY:
                self.telemetry.append(struct.unpack("<I", packet.data)[0])
            else:
                self.returned.append(bytes(packet.data))

    def _fail(self, message: str) -> None:
        self.errors.append(message)
        self.failed.set()


def commands(*numbers: int) -> list[bytes]:
    """What a vehicle heard of `Flight.send`."""
    return [bytes((COMMAND, number)) for number in numbers]


@contextmanager
def served(hub: Hub) -> Iterator[Hub]:
    """The hub, with its main loop in a thread."""
    over = threading.Event()

    def run() -> None:
        while not over.wait(sharing.TICK_S):
            hub.tick()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        over.set()
        thread.join()
        hub.close()


class Bench:
    """A hub in this process, and a flight for each of its vehicles."""

    def __init__(self, vehicles: dict[str, Talker], port: UsbPort, hub: Hub) -> None:
        self.vehicles, self.port, self.hub = vehicles, port, hub
        self.flights = {uri: Flight(hub.uris[uri]) for uri in vehicles}

    def pass_packets(self, count: int) -> list[int]:
        """Let the dongle carry so many packets; how many of them for each vehicle."""
        before = len(self.port.order)
        until(lambda: len(self.port.order) >= before + count)
        order = self.port.order[before : before + count]
        return [order.count(place) for place in self.port.vehicles]

    def reconnect(self) -> None:
        """Each flight as `Connection.reopen` does."""

        def connect(uri: str) -> Flight | None:
            try:
                return Flight(self.hub.uris[uri])
            except ConnectionFailed:
                return None

        for uri, flight in self.flights.items():
            flight.close()
            self.flights[uri] = until(lambda uri=uri: connect(uri))


@contextmanager
def bench_of(vehicles: dict[str, Talker], scale: float = 0.0) -> Iterator[Bench]:
    with pytest.MonkeyPatch.context() as patch:
        port = UsbPort(dict(vehicles), scale)
        attach(port, patch)
        patch.setattr(sharing, "STUCK_TICKS", PATIENT_TICKS)
        with served(Hub(list(vehicles))) as hub:
            bench = Bench(vehicles, port, hub)
            yield bench
            for flight in bench.flights.values():
                flight.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    with bench_of(talkers(FOUR), SLOWED) as bench:
        yield bench


# --- The share of each vehicle ------------------------------------------------------------------


def test_four_vehicles_share_a_dongle_fairly_and_each_flight_has_its_own(bench: Bench) -> None:
    counts = bench.pass_packets(400)
    assert min(counts) > 50
    assert max(counts) < 200
    for number, flight in enumerate(bench.flights.values()):
        flight.send(*range(number, number + 10))
    for number, (uri, flight) in enumerate(bench.flights.items()):
        until(lambda flight=flight: len(flight.returned) >= 10)
        assert bench.vehicles[uri].heard == commands(*range(number, number + 10))
        assert flight.returned == [bytes((n,)) for n in range(number, number + 10)]
        first = flight.telemetry[0]
        assert flight.telemetry == list(range(first, first + len(flight.telemetry)))
        assert flight.errors == []


def test_what_a_vehicle_answers_without_having_anything_to_send_stays_in_the_hub() -> None:
    vehicles = talkers(FOUR[:2])
    vehicles[FOUR[0]].quiet = True
    with bench_of(vehicles) as bench:
        bench.pass_packets(100)
        bench.flights[FOUR[0]].send(1)
        until(lambda: bench.flights[FOUR[0]].returned)
        assert bench.flights[FOUR[0]].returned == [b"\x01"]
        assert bench.flights[FOUR[0]].telemetry == []


def test_lost_packets_are_repeated_in_order_and_reported_for_their_vehicle() -> None:
    vehicles = talkers(FOUR[:3]) | {FOUR[3]: Talker(lambda number: number % 3 == 0)}
    with bench_of(vehicles, SLOWED) as bench:
        flight = bench.flights[FOUR[3]]
        flight.send(*range(20))
        until(lambda: len(flight.returned) >= 20)
        assert bench.vehicles[FOUR[3]].heard == commands(*range(20))
        first = flight.telemetry[0]
        assert flight.telemetry == list(range(first, first + len(flight.telemetry)))
        until(lambda: flight.driver.report.lost > 0)
        reports = bench.hub.reports()
        assert [reports[uri].lost for uri in FOUR[:3]] == [0, 0, 0]
        assert reports[FOUR[3]].answered > reports[FOUR[3]].lost > 0
        assert reports[FOUR[0]].quality == 100.0


def test_the_others_keep_their_rate_beside_a_silent_vehicle(bench: Bench) -> None:
    """By the dongle's own time: a packet without an answer takes 2 ms instead of 0.7."""

    def rates() -> list[float]:
        busy_s = bench.port.busy_s
        counts = bench.pass_packets(400)
        return [count / (bench.port.busy_s - busy_s) for count in counts]

    before = rates()
    bench.vehicles[FOUR[1]].silent = True
    during = rates()
    assert sum(during) - during[1] > 0.7 * (sum(before) - before[1])
    assert bench.hub.problem is None
    assert all(flight.errors == [] for flight in bench.flights.values())


def test_a_silent_vehicle_takes_no_queue_of_old_commands(bench: Bench) -> None:
    """The flight holds back what has no room, and sends what is true when there is."""
    vehicle, flight = bench.vehicles[FOUR[1]], bench.flights[FOUR[1]]
    vehicle.silent = True
    bench.pass_packets(20)
    sent = 0
    while sent < 20 and not flight.driver.out_queue.full():
        flight.send(sent)
        sent += 1
        until(lambda: len(bench.hub.carriers[1]._waiting) == flight.driver.out_queue.waiting)
    assert sent <= 3  # in the driver's thread, in its queue of one, and in the hub
    vehicle.silent = False
    flight.send(99)
    until(lambda: vehicle.heard[-1:] == commands(99))
    assert vehicle.heard == commands(*range(sent), 99)


def test_a_new_link_does_not_send_what_an_earlier_one_had_waiting(bench: Bench) -> None:
    vehicle, carrier = bench.vehicles[FOUR[1]], bench.hub.carriers[1]
    vehicle.silent = True
    bench.pass_packets(20)
    for number in range(6):  # without asking for room, as cflib's own requests
        bench.flights[FOUR[1]].driver.send_packet(CRTPPacket(COMMAND, bytes((number,))))
    until(lambda: len(carrier._waiting) >= 4)
    bench.flights[FOUR[1]].close()
    bench.flights[FOUR[1]] = Flight(bench.hub.uris[FOUR[1]])
    until(lambda: not carrier.has_stale_packet)
    vehicle.silent = False
    bench.flights[FOUR[1]].send(99)
    until(lambda: vehicle.heard)
    assert vehicle.heard == commands(99)


def kill(flight: Flight) -> None:
    """End a flight as the death of its process does: its hub hears nothing more, not even that."""
    flight.driver._closed.set()
    flight.close()


@pytest.mark.parametrize("end", [Flight.close, kill])
def test_a_vehicle_that_is_back_hears_nothing_of_a_flight_that_is_over(
    bench: Bench, end: Callable[[Flight], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also what cflib's driver was repeating as the flight ended."""
    monkeypatch.setattr(sharing, "LINGER_S", 0.3)
    monkeypatch.setattr(sharing, "FAREWELL_S", 0.1)
    vehicle, carrier = bench.vehicles[FOUR[1]], bench.hub.carriers[1]
    vehicle.silent = True
    bench.pass_packets(20)
    flight = bench.flights.pop(FOUR[1])
    for number in range(6):
        flight.driver.send_packet(CRTPPacket(COMMAND, bytes((number,))))
    until(lambda: len(carrier._waiting) >= 4)
    old = carrier.driver
    end(flight)
    until(lambda: carrier.driver is not old and not carrier._waiting)
    monkeypatch.setattr(sharing, "LINGER_S", 60.0)  # the next flight speaks once a second
    vehicle.silent = False
    bench.flights[FOUR[1]] = Flight(bench.hub.uris[FOUR[1]])
    bench.flights[FOUR[1]].send(99)
    until(lambda: vehicle.heard)
    assert vehicle.heard == commands(99)


def test_what_a_flight_sends_just_before_its_end_still_goes_out(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sharing, "FAREWELL_S", 10.0)  # also on a slow computer
    vehicle, flight = bench.vehicles[FOUR[1]], bench.flights.pop(FOUR[1])
    for number in range(6):
        flight.driver.send_packet(CRTPPacket(COMMAND, bytes((number,))))
    flight.close()
    until(lambda: len(vehicle.heard) == 6)
    assert vehicle.heard == commands(*range(6))


def test_a_vehicle_that_is_switched_on_late_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a driver with safelink: one without would be heard once."""
    monkeypatch.setattr(sharing, "SAFELINK_PERIOD_S", 0.05)
    vehicles = talkers(FOUR)
    vehicles[FOUR[2]].silent = True
    with bench_of(vehicles) as bench:
        until(lambda: bench.hub.carriers[2].driver is None)
        bench.pass_packets(100)
        vehicles[FOUR[2]].silent = False
        flight = bench.flights[FOUR[2]]
        flight.send(1, 2, 3)
        until(lambda: len(flight.returned) == 3)
        assert vehicles[FOUR[2]].heard == commands(1, 2, 3)
        assert internals.has_safelink(bench.hub.carriers[2].driver)


def test_an_idle_vehicle_is_slowed_down_and_back_at_its_share(bench: Bench) -> None:
    bench.hub.limit(FOUR[0], 1)  # less than the hub allows
    bench.pass_packets(40)
    counts = bench.pass_packets(400)
    assert counts[0] < min(counts[1:]) / 2
    bench.flights[FOUR[0]].send(1)
    until(lambda: bench.vehicles[FOUR[0]].heard)
    bench.hub.limit(FOUR[0], None)
    until(lambda: bench.pass_packets(40)[0] >= 5)


# --- The dongle's end ---------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 4])
def test_an_unplugged_dongle_ends_every_link_at_once(count: int) -> None:
    """With several vehicles, the thread of cflib's dongle ends; with one, it goes on for ever. The
    hub does not wait as for a dongle that hangs."""
    with bench_of(talkers(FOUR[:count]), SLOWED) as bench:
        bench.pass_packets(40)
        bench.port.unplug()
        for flight in bench.flights.values():
            assert flight.failed.wait(20.0)
            assert flight.errors == [sharing.DEAD]
        with pytest.raises(ConnectionFailed, match="Crazyradio no longer answers"):
            HubDriver().connect(bench.hub.uris[FOUR[0]], None, lambda message: None)
        assert all(report.problem == sharing.DEAD for report in bench.hub.reports().values())


@pytest.mark.parametrize("count", [1, 4])
def test_a_dongle_that_is_plugged_in_again_goes_on_also_a_second_time(count: int) -> None:
    with bench_of(talkers(FOUR[:count]), SLOWED) as bench:
        for time_ in (1, 2):
            bench.port.unplug()
            assert all(flight.failed.wait(20.0) for flight in bench.flights.values())
            bench.port.plug_in()
            bench.reconnect()
            for uri, flight in bench.flights.items():
                flight.send(time_)
                until(lambda flight=flight: flight.returned and flight.telemetry)
                assert flight.returned == [bytes((time_,))]
                assert bench.vehicles[uri].heard[-1:] == commands(time_)
        drivers = [t for t in threading.enumerate() if t.name == "RadioDriverThread"]
        assert len(drivers) == count  # those of the dead dongles have ended


def test_a_dongle_that_hangs_is_dead(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """It neither answers nor refuses."""
    go_on = threading.Event()
    monkeypatch.setattr(sharing, "STUCK_TICKS", 25)
    monkeypatch.setattr(bench.port, "work", lambda seconds: go_on.wait())
    assert all(flight.failed.wait(20.0) for flight in bench.flights.values())
    go_on.set()


# --- Flights that end ---------------------------------------------------------------------------

CHILD = """
from perchctl.children import connect_to_parent
from perchctl.link.crtp import Port, encode
from perchctl.link.hub_driver import HubDriver
from cflib.crtp.crtpstack import CRTPPacket
channel = connect_to_parent()
driver = HubDriver()
driver.connect(channel.recv(), None, lambda message: None)
driver.send_packet(CRTPPacket(0x8C, b"k"))
while driver.receive_packet(-1).header != 0x8C:
    pass
channel.send("flying")
channel.recv()
"""


def test_a_killed_flight_stops_no_other_and_its_vehicle_hears_nothing_more(bench: Bench) -> None:
    uri, others = FOUR[3], FOUR[:3]
    bench.flights.pop(uri).close()
    child, channel = spawn(CHILD, subprocess.DEVNULL)
    with channel:
        channel.receive(20.0)
        channel.send(bench.hub.uris[uri])
        assert channel.receive(20.0) == "flying"
        heard = list(bench.vehicles[uri].heard)
        child.kill()
        child.wait()
    counts = bench.pass_packets(200)
    assert min(counts) > 20
    for number, other in enumerate(others):
        bench.flights[other].send(number)
        until(lambda other=other: bench.flights[other].returned)
        assert bench.flights[other].errors == []
        assert bench.vehicles[other].heard == commands(number)
    assert bench.vehicles[uri].heard == heard
    bench.flights[uri] = Flight(bench.hub.uris[uri])  # the next flight of this vehicle
    bench.flights[uri].send(7)
    until(lambda: bench.vehicles[uri].heard == [*heard, *commands(7)])


def test_closing_a_link_or_the_hub_sends_nothing_to_any_vehicle(bench: Bench) -> None:
    """cflib's `close_link` would send a zero setpoint."""
    bench.flights.pop(FOUR[0]).close()
    until(lambda: not bench.hub.carriers[0].has_flight)
    bench.pass_packets(40)
    bench.hub.close()
    assert all(flight.failed.wait(20.0) for flight in bench.flights.values())
    assert [vehicle.heard for vehicle in bench.vehicles.values()] == [[], [], [], []]
    assert bench.port.refused == 0


@pytest.mark.parametrize(("known", "guessed"), [("E7E7E7E701", "E7E7E7E7AA"), ("?key=", "?key=0")])
def test_an_old_flight_or_another_program_does_not_reach_the_vehicle(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, known: str, guessed: str
) -> None:
    """The port may be another vehicle's by now; and its key is told to one flight alone."""
    monkeypatch.setattr(hub_driver, "HELLO_TIMEOUT_S", 0.3)
    stranger = bench.hub.uris[FOUR[0]].replace(known, guessed)
    assert stranger != bench.hub.uris[FOUR[0]]
    with pytest.raises(ConnectionFailed, match="does not answer"):
        HubDriver().connect(stranger, None, lambda message: None)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        port = int(bench.hub.uris[FOUR[0]].split(":")[2].partition("/")[0])
        other.sendto(bytes((COMMAND, 66)), ("127.0.0.1", port))
    bench.flights[FOUR[0]].send(1)
    until(lambda: bench.vehicles[FOUR[0]].heard)
    assert bench.vehicles[FOUR[0]].heard == commands(1)


# --- A whole link ---------------------------------------------------------------------------------


def test_a_cflib_link_flies_through_the_hub_and_survives_its_dongle(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Beside another vehicle, which hears nothing of it."""
    pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")
    from perchctl.sim import Scenario
    from tests.helpers.radio import Air

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    air, other = Air(Scenario(mass_kg=0.036, ceiling_z_m=0.9)), Talker()
    port = UsbPort({FOUR[0]: air, FOUR[1]: other})
    attach(port, monkeypatch)
    with served(Hub(FOUR[:2])) as shared:
        link = CflibLink(
            FOUR[0], LINK, time.monotonic, landing_wait_s=0.2, link_uri=shared.uris[FOUR[0]]
        )
        link.connect()
        until(link.telemetry)
        assert link.problem(time.monotonic()) is None

        def order(duration_s: float) -> None:
            land = Land(-0.05, duration_s)
            link.send(land)
            assert air.hears(lambda packet: packet == encode(land)[-1], 0.0, 20.0) is not None

        order(1.0)
        port.unplug()
        until(lambda: link.problem(time.monotonic()) == sharing.DEAD)
        port.plug_in()
        until(lambda: link.problem(time.monotonic()) is None)
        now_s = time.monotonic()
        until(lambda: any(sample.t_s > now_s for sample in link.telemetry()))
        order(2.0)
        link.close()
        assert air.hears(lambda packet: packet.port == Port.COMMANDER, 0.0, 20.0) is not None
    assert other.heard == []


# --- A hub that hangs or has ended, at the flight's end ------------------------------------------


def test_nothing_in_a_flight_waits_for_a_hub_that_hangs() -> None:
    """It says nothing after its first answer."""
    errors: list[str] = []
    failed = threading.Event()
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.bind(("127.0.0.1", 0))
    wire.settimeout(20.0)

    def answer() -> None:
        _, sender = wire.recvfrom(64)
        wire.sendto(HubReport().encode(), sender)

    thread = threading.Thread(target=answer)
    thread.start()
    driver = HubDriver()
    uri = f"hub://127.0.0.1:{wire.getsockname()[1]}/80/2M/E7E7E7E701"
    driver.connect(uri, None, lambda message: (errors.append(message), failed.set()))
    thread.join()
    assert internals.has_room(driver)
    for _ in range(100):  # which cflib might send; perchctl asks for room
        driver.send_packet(CRTPPacket(COMMAND, b"x"))
    assert not internals.has_room(driver)
    assert driver.receive_packet(0) is None
    assert driver.receive_packet(0.01) is None
    assert errors == []
    wire.close()
    driver.send_packet(CRTPPacket(COMMAND, b"x"))
    assert failed.wait(20.0)
    driver.send_packet(CRTPPacket(COMMAND, b"x"))
    assert errors == [hub_driver.HUB_ENDED]
    driver.close()
    with pytest.raises(ConnectionFailed, match="has stopped"):
        HubDriver().connect(uri, None, lambda message: None)


@pytest.mark.parametrize("message", [b"", b"0", b"0{", b'0{"other": 1}', b"0[]", b"\x20", b"\xff"])
def test_a_message_that_is_none_is_ignored(message: bytes) -> None:
    driver = HubDriver()
    driver._take(message)
    assert driver.report == HubReport()
    assert driver.out_queue.waiting == 0


def test_a_report_arrives_as_it_was_sent() -> None:
    report = HubReport("dead", 3, 2, 97.5, 1)
    assert HubReport.decode(report.encode()) == report
    assert not hub_driver.is_packet(report.encode())


def test_the_driver_is_cflibs_for_its_own_uris_only() -> None:
    import cflib.crtp

    with pytest.raises(WrongUriType):
        HubDriver().connect("udp://127.0.0.1:9", None, lambda message: None)
    init_cflib()
    assert cflib.crtp.CLASSES.count(HubDriver) == 1
    assert HubDriver().scan_interface(None) == []


# --- What a hub refuses ---------------------------------------------------------------------------


@pytest.mark.parametrize(("given", "words"), [
    (["udp://127.0.0.1:1"], "not a radio URI"),
    ([FOUR[0], "radio://1/80/2M/E7E7E7E702"], "one dongle"),
    ([FOUR[0], "radio://0/80/2M/e7e7e7e701?rate_limit=50"], "are the same vehicle"),
    ([FOUR[0], "radio://0/80/2M/XX"], "is not the URI of a vehicle"),
])  # fmt: skip
def test_uris_that_one_dongle_cannot_serve_are_refused(given: list[str], words: str) -> None:
    hub.check_uris([FOUR[0], "radio://0/80"])  # of the usual rate and address
    with pytest.raises(InvalidValue, match=words):
        RadioHub(given)


def test_a_vehicle_in_use_by_another_program_is_refused_and_nothing_is_opened() -> None:
    with pytest.MonkeyPatch.context() as patch:
        port = UsbPort(dict(talkers(FOUR)))
        attach(port, patch)
        with lock_vehicle(FOUR[2]), pytest.raises(ConnectionFailed, match="in use by another"):
            Hub(FOUR)
        assert (port.opened, port.order) == (0, [])
        for uri in FOUR:
            lock_vehicle(uri).close()


def test_the_flights_uris_are_taken_and_say_which_vehicle_it_is() -> None:
    carrier = Carrier(FOUR[0] + "?rate_limit=100")
    assert check_uri(carrier.hub_uri) == "hub"
    assert carrier.hub_uri.partition("?")[0].endswith("/80/2M/E7E7E7E701")
    again = Carrier(FOUR[0])
    keys = {each.hub_uri.partition("?")[2] for each in (carrier, again)}
    assert len(keys) == 2
    for each in (carrier, again):
        each.socket.close()


# --- The hub as a process -------------------------------------------------------------------------

FAKE = """
from types import SimpleNamespace
from tests.helpers.dongle import UsbPort, attach, talkers
vehicles = talkers({uris!r})
for vehicle in vehicles.values():
    vehicle.quiet = True
attach(UsbPort(vehicles), SimpleNamespace(setattr=setattr))
from perchctl.link import sharing
sharing.STUCK_TICKS = {ticks}
sharing.serve_parent()
"""


def start_hub(monkeypatch: pytest.MonkeyPatch, of: Sequence[str]) -> RadioHub:
    """A hub over a false dongle. Its vehicles are quiet: telemetry as fast as a processor makes it
    would overflow the socket of a busy flight, which drops what comes then."""
    monkeypatch.setattr(hub, "PROGRAM", FAKE.format(uris=list(of), ticks=PATIENT_TICKS))
    return RadioHub(of)


def test_a_hub_in_its_own_process_carries_reports_and_ends_as_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with start_hub(monkeypatch, FOUR[:2]) as shared:
        flights = [Flight(shared.uris[uri]) for uri in FOUR[:2]]
        for number, flight in enumerate(flights):
            flight.send(number)
            until(lambda flight=flight: flight.returned)
        shared.limit(FOUR[0], 10)
        until(lambda: shared.update() is None and shared.reports)
        assert list(shared.reports) == FOUR[:2]
        until(lambda: shared.update() is None and shared.reports[FOUR[1]].answered > 0)
        with pytest.raises(ConnectionFailed, match="in use by another program"):
            start_hub(monkeypatch, FOUR[1:2])
    assert shared._child.returncode == 0
    for flight in flights:
        assert flight.failed.wait(20.0)
        assert flight.errors == [hub_driver.HUB_ENDED]
        flight.close()


def test_a_hub_outlives_its_parent_until_the_flights_have_landed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And a parent that reads no reports does not stop it."""
    shared = start_hub(monkeypatch, FOUR[:1])
    flight = Flight(shared.uris[FOUR[0]])
    shared._channel.close()  # as if the parent were gone
    for number in range(100):
        flight.send(number)
        until(lambda number=number: flight.returned[-1:] == [bytes((number,))])
    assert shared._child.poll() is None
    flight.close()
    assert shared._child.wait(20.0) == 0
    shared.stop()


@pytest.mark.long
def test_a_killed_hub_is_one_sentence_to_parent_and_flights(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with start_hub(monkeypatch, FOUR[:1]) as shared:
        flight = Flight(shared.uris[FOUR[0]])
        os.kill(shared._child.pid, signal.SIGKILL)
        assert flight.failed.wait(20.0)
        assert flight.errors == [hub_driver.HUB_ENDED]
        assert until(shared.update) == "the radio hub has stopped"
        flight.close()


@pytest.mark.long
def test_a_hub_that_is_stopped_is_noticed_by_its_parent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub, "SILENT_S", 0.3)
    with start_hub(monkeypatch, FOUR[:1]) as shared:
        os.kill(shared._child.pid, signal.SIGSTOP)
        assert "has not reported for" in until(shared.update)
        os.kill(shared._child.pid, signal.SIGCONT)


def test_a_hub_without_a_dongle_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    program = "from cflib.drivers import crazyradio; crazyradio._find_devices = lambda: []; "
    monkeypatch.setattr(hub, "PROGRAM", program + hub.PROGRAM)
    with pytest.raises(ConnectionFailed, match=r"^the Crazyradio cannot be opened: no Crazyradio"):
        RadioHub(FOUR)


def test_a_parents_orders_are_no_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dongle is dead after so many ticks without an answer, however many orders come."""
    now_s, ticks, limits = [0.0], [], []

    class Parent:
        def poll(self, wait_s: float) -> bool:
            now_s[0] += 0.001
            return True

        def recv(self) -> tuple[str, int]:
            if len(limits) == 100:
                raise EOFError
            return FOUR[0], len(limits)

    class Shared:
        def limit(self, uri: str, rate: int) -> None:
            limits.append(rate)

        def tick(self) -> bool:
            ticks.append(now_s[0])
            return False

        def has_flights(self) -> bool:
            return False

    def sleep(duration_s: float) -> None:
        now_s[0] += duration_s

    monkeypatch.setattr(sharing, "time", SimpleNamespace(monotonic=lambda: now_s[0], sleep=sleep))
    sharing.run(Shared(), Parent())  # type: ignore[arg-type]
    assert limits == list(range(100))
    assert len(ticks) == pytest.approx(0.1 / sharing.TICK_S, abs=2)


def test_a_hub_that_fails_says_its_last_line(monkeypatch: pytest.MonkeyPatch) -> None:
    fails = "sharing.run = lambda hub, channel: channel.recv() + 1; sharing.serve_parent()"
    program = FAKE.format(uris=FOUR[:1], ticks=PATIENT_TICKS)
    monkeypatch.setattr(hub, "PROGRAM", program.replace("sharing.serve_parent()", fails))
    shared = RadioHub(FOUR[:1])
    shared.limit(FOUR[0], 10)
    assert "the radio hub has stopped: TypeError: can only concatenate tuple" in until(
        shared.update
    )
    shared.stop()


def test_a_hub_that_ends_at_its_start_says_its_last_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub, "PROGRAM", "raise SystemExit('no room')")
    with pytest.raises(ConnectionFailed, match=r"^the radio hub stopped while starting: no room$"):
        RadioHub(FOUR)
