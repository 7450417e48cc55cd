"""The radio hub's process: cflib's radio drivers, and the transfer of packets between each driver
and its flight.

```
flight  <-- UDP -->  Carrier  <-->  cflib: RadioDriver + thread  <-->  thread of the dongle  --> USB
flight  <-- UDP -->  Carrier  <-->  cflib: RadioDriver + thread  <-->        |
```

The hub only transfers packets and does not know their meaning. The hub uses the drivers without a
`Crazyflie` object, whose `close_link` would send a zero setpoint and drop a flying vehicle.
`RadioDriver.close` sends nothing.

Threads: two for each vehicle, uplink and downlink; one that opens drivers, which may block in a USB
call; and the main thread, which monitors the dongle, sends reports and never calls anything that
blocks.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import secrets
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Sequence
from typing import Any

from perchctl.children import Channel, connect_to_parent
from perchctl.errors import ConnectionFailed, PerchError
from perchctl.link import internals
from perchctl.link.connection import init_cflib, lock_vehicle, readable_cause, start_thread
from perchctl.link.hub_driver import BYE, HELLO, HUB_ENDED, ROOM, SCHEME, HubReport, is_packet
from perchctl.link.protocol import vehicle_uri

TICK_S = 0.02
"""Period of the dongle check, s. Longer: a dead dongle is reported later. Shorter: the checks take
more processor time."""
REPORT_PERIOD_S = 0.2
"""Time between two reports, s. Longer: a lost report is replaced later. Shorter: the reports take
more processor time in each flight."""
REFUSALS = 10
"""Number of successive packets for one vehicle without any answer from the dongle after which the
dongle counts as dead. An unplugged dongle rejects each packet at once; a working dongle answers
even if the vehicle is out of range. More: a dead dongle is reported later. Fewer: a transient USB
error ends the flights."""
STUCK_TICKS = 25
"""Number of ticks without any answer from the dongle after which it counts as dead: 0.5 s, although
a working dongle reports even a lost packet within 2 ms. Counting ticks avoids a false alarm after
the computer was suspended. More: a dead dongle is reported later. Fewer: a slow USB call ends the
flights."""
REOPEN_PERIOD_S = 0.1
"""Time between two attempts to open a dead dongle, s. Longer: a dead dongle takes longer to become
available again. Shorter: the computer scans its USB ports all the time."""
SAFELINK_PACKETS = 10
"""Number of packets in which cflib's driver offers safelink to the vehicle (docs/firmware.md,
"Safelink")."""
SAFELINK_PERIOD_S = 1.0
"""Time between two safelink offers to a vehicle that has not answered yet, s. Longer: it takes more
time to find a vehicle that is switched on later. Shorter: the offers, 20 ms each, take more of the
dongle's time from the other vehicles."""
LEAST_RATE = 10
"""Lowest permitted limit on a vehicle's packet rate, 1/s. Higher: an idle vehicle uses more of the
dongle's time. Lower: a dongle whose vehicles are all idle seems dead (`STUCK_TICKS`), and commands
wait longer."""
ROOM_WAIT_S = 0.005
"""Time for which a packet waits for the radio before its carrier checks the socket again, s.
Longer: a new link from the flight is answered later. Shorter: the carrier takes more processor
time."""
IDLE_S = 0.1
"""Time for which a thread waits for a packet before it checks whether it should end, s. Longer: the
thread ends later. Shorter: the thread takes more processor time."""
CLOSE_TIMEOUT_S = 3.0
"""Timeout for closing a driver, s; a USB call may take 2 s. Longer: a hanging dongle is reopened
later. Shorter: the dongle is reopened while the old driver is still using it."""
LINGER_S = 5.0
"""Time without any datagram from a flight after which the flight counts as dead, s; an open link
sends one at least once a second. The hub then drops the flight's packets, and a hub without a
parent and without flights ends. Longer: a vehicle that was out of range may execute an old command,
and the dongle stays claimed after a crash. Shorter: a flight on a busy computer may lose its radio
while it lands."""
FAREWELL_S = 0.5
"""Time for which the last packets of a flight are still sent after it has closed its link, s.
Longer: a vehicle that was out of range may execute an old command. Shorter: a landing command sent
just before the end may get lost."""
MOST_QUEUED_PACKETS = 64
"""Largest number of a flight's packets that may wait for the radio; beyond this number, the oldest
one is dropped. A flight's sender waits after each packet, but cflib's own requests do not. Larger:
more packets are out of date. Smaller: cflib's requests get lost."""
NULL_PACKET = 0xF3
"""Header of the packet that a vehicle sends if it has no data. The signal strength may follow the
header; cflib's statistics have already read it."""

logger = logging.getLogger(__name__)

DEAD = (
    "the Crazyradio no longer answers (it may be unplugged): the links to all its vehicles are lost"
)


class Carrier:
    """One vehicle's radio driver, and the socket for its flight."""

    def __init__(self, uri: str) -> None:
        self.uri = uri
        self.vehicle = vehicle_uri(uri).removeprefix("radio/")
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        # Any program on this computer can send to the port, but only the flight knows the key.
        self._greeting = f"{self.vehicle}?key={secrets.token_hex(8)}"
        self.hub_uri = f"{SCHEME}127.0.0.1:{self.socket.getsockname()[1]}/{self._greeting}"
        self.driver: Any = None
        self.opened_s = 0.0  # when the driver was opened, or closed because it had no safelink
        self.heard_s = time.monotonic()  # when the flight's last datagram came
        self.problem: str | None = None
        self.answered = self.lost = 0
        self.refused = self.missed = (
            0  # successive packets that the dongle, or the vehicle, did not answer
        )
        self.has_stale_packet = False
        """True if the driver must be closed because it holds an outdated packet."""
        self._offered = 0  # packets sent by the current driver
        self._has_carried = (
            False  # True once the current driver has accepted packets from the current flight
        )
        self._quality: float | None = None
        self._limit: int | None = None
        self._waiting: deque[bytes] = deque(maxlen=MOST_QUEUED_PACKETS)
        self._flight: tuple[str, int] | None = None
        self._closed = threading.Event()

    @property
    def has_flight(self) -> bool:
        """True while a flight's link is open and a datagram from it has arrived recently."""
        return self._flight is not None and time.monotonic() - self.heard_s < LINGER_S

    @property
    def lacks_safelink(self) -> bool:
        """True if the driver has no safelink and will not get it. A vehicle that was out of range
        when the driver was opened would accept at most one packet from it."""
        driver = self.driver
        offered = self._offered > SAFELINK_PACKETS
        return driver is not None and offered and not internals.has_safelink(driver)

    def open(self) -> None:
        """Open a driver. Raises any error from cflib or USB."""
        from cflib.crtp.radiodriver import RadioDriver

        driver = RadioDriver()
        self._offered = self.refused = self.missed = 0
        self.has_stale_packet = self._has_carried = False
        # cflib reports errors and continues; the hub relies on the dongle's answers instead.
        driver.connect(self.uri, self._take_statistics, lambda message: None)
        internals.count_answers(driver, self._count)
        self.opened_s, self.driver = time.monotonic(), driver
        self.limit(self._limit or driver.rate_limit)

    def limit(self, packets_per_s: int | None) -> None:
        """Limit the vehicle's packets per second; None: no limit."""
        self._limit = packets_per_s and max(LEAST_RATE, packets_per_s)
        if self.driver is not None:
            internals.limit_rate(self.driver, self._limit)

    def start(self) -> None:
        """Start transferring packets."""
        start_thread("perchctl-hub-up", self._carry_up)
        start_thread("perchctl-hub-down", self._carry_down)

    def report(self) -> HubReport:
        """Return the link's state."""
        return HubReport(
            problem=self.problem,
            answered=self.answered,
            lost=self.lost,
            quality=self._quality,
            waiting=min(len(self._waiting), 255),
        )

    def send_report(self) -> None:
        """Send the link's state to the flight."""
        self._send(self.report().encode())

    def close(self) -> None:
        """Stop transferring packets and close the driver."""
        self._closed.set()

    def _count(self, answer: bool | None) -> None:
        """Count the dongle's answer to a packet, in the driver's thread."""
        if answer is None:
            self.refused += 1
            return
        self.refused = 0
        self._offered += 1
        if answer:
            self.missed = 0
            self.answered += 1
        else:
            self.missed += 1
            self.lost += 1

    def _take_statistics(self, statistics: dict[str, float]) -> None:
        self._quality = statistics.get("link_quality", self._quality)

    def _carry_up(self) -> None:
        while not self._closed.is_set():
            wait_s = 0.0 if self._waiting else IDLE_S
            while select.select([self.socket], [], [], wait_s)[0]:
                self._take_datagram()
                wait_s = 0.0
            silent_s = time.monotonic() - self.heard_s
            if silent_s > (FAREWELL_S if self._flight is None else LINGER_S):
                self._drop_packets()
            driver = None if self.has_stale_packet else self.driver
            if driver is None:
                self._closed.wait(ROOM_WAIT_S if self._waiting else 0.0)
            elif self._waiting and self._put(driver, self._waiting[0]):
                self._waiting.popleft()
                self._send(ROOM + bytes((min(len(self._waiting), 255),)))
        self.socket.close()

    def _drop_packets(self) -> None:
        """Make sure that no packet sent by the flight so far reaches the vehicle.

        cflib's driver holds up to two packets: one that it repeats until the vehicle acknowledges
        it, and one in its queue. These packets cannot be removed, so the driver is closed; the next
        driver starts by offering safelink.
        """
        self._waiting.clear()
        driver, has_carried = self.driver, self._has_carried
        self._has_carried = False
        if driver is not None and has_carried and (self.missed or driver.out_queue.full()):
            self.has_stale_packet = True

    def _take_datagram(self) -> None:
        try:
            datagram, sender = self.socket.recvfrom(64)
        except OSError:  # an earlier datagram could not be delivered
            return
        if datagram[:1] == HELLO:
            # The request may come from another program, or from an old flight whose port now
            # belongs to another vehicle.
            if datagram[1:].decode("ascii", "replace") != self._greeting:
                return
            if sender != self._flight:
                self._drop_packets()  # packets from an earlier link are out of date
            self._flight = sender
            self.send_report()
        elif sender != self._flight:
            return
        elif datagram[:1] == BYE:
            self._flight = None
        elif is_packet(datagram):
            self._waiting.append(datagram)
        self.heard_s = time.monotonic()

    def _put(self, driver: Any, datagram: bytes) -> bool:
        from cflib.crtp.crtpstack import CRTPPacket

        packet = CRTPPacket(datagram[0], datagram[1:])
        self._has_carried = True
        return internals.put_packet(driver, packet, ROOM_WAIT_S)

    def _carry_down(self) -> None:
        while not self._closed.is_set():
            driver = self.driver
            if driver is None:
                self._closed.wait(TICK_S)
                continue
            packet = driver.receive_packet(IDLE_S)
            if packet is not None and packet.header & NULL_PACKET != NULL_PACKET:
                self._send(bytes((packet.header,)) + bytes(packet.data))

    def _send(self, datagram: bytes) -> None:
        flight = self._flight
        if flight is not None:
            with contextlib.suppress(OSError):  # lost, as over the air
                self.socket.sendto(datagram, flight)


class Hub:
    """The carriers of all vehicles on one dongle, and the monitoring of the dongle.

    `problem` is None, or the reason why the dongle does not work. The hub reopens a dead dongle
    until it answers. The flights' links end at once and reopen by themselves.
    """

    def __init__(self, uris: Sequence[str]) -> None:
        self.problem: str | None = None
        self._dongle: threading.Thread | None = None
        self._wake, self._closed = threading.Event(), threading.Event()
        self._counted, self._stuck_ticks = -1, 0
        self._reported_s = 0.0
        init_cflib()
        with contextlib.ExitStack() as claim:
            for uri in uris:
                claim.enter_context(lock_vehicle(uri))
            self.carriers = [Carrier(uri) for uri in uris]
            try:
                self._open_dongle()
            except Exception as error:  # any error from cflib or USB
                for carrier in self.carriers:
                    carrier.socket.close()
                cause = readable_cause(str(error) or type(error).__name__)
                raise ConnectionFailed(f"the Crazyradio cannot be opened: {cause}") from None
            self._claim = claim.pop_all()
        for carrier in self.carriers:
            carrier.start()
        self._opener = start_thread("perchctl-hub-open", self._keep_open)

    @property
    def uris(self) -> dict[str, str]:
        """The flights' URIs, keyed by the URIs of their vehicles."""
        return {carrier.uri: carrier.hub_uri for carrier in self.carriers}

    def tick(self) -> bool:
        """Check the dongle and send the reports that are due. Must be called every `TICK_S`. Return
        True if reports were sent to the flights."""
        cause = None if self.problem is not None else self._find_problem()
        if cause is not None:
            self._set_problem(cause)
            self._wake.set()
        now_s = time.monotonic()
        if cause is None and now_s - self._reported_s < REPORT_PERIOD_S:
            return False
        self._reported_s = now_s
        for carrier in self.carriers:
            carrier.send_report()
        return True

    def reports(self) -> dict[str, HubReport]:
        """Return the state of each link, keyed by the vehicle's URI."""
        return {carrier.uri: carrier.report() for carrier in self.carriers}

    def limit(self, uri: str, packets_per_s: int | None) -> None:
        """Limit the packets per second of the vehicle at `uri`; None: no limit."""
        for carrier in self.carriers:
            if carrier.uri == uri:
                carrier.limit(packets_per_s)

    def has_flights(self) -> bool:
        """True while any flight's link is open and a datagram from it has arrived recently."""
        return any(carrier.has_flight for carrier in self.carriers)

    def close(self) -> None:
        """End the flights' links and close all drivers, with a timeout and without sending a
        packet."""
        self._set_problem(HUB_ENDED)
        for carrier in self.carriers:
            carrier.send_report()
        self._closed.set()
        self._wake.set()
        self._opener.join(CLOSE_TIMEOUT_S)
        for carrier in self.carriers:
            carrier.close()
        self._close_dongle()
        self._claim.close()

    def _find_problem(self) -> str | None:
        """Return why the dongle is dead, or None."""
        drivers = sum(carrier.driver is not None for carrier in self.carriers)
        counted = sum(carrier.answered + carrier.lost for carrier in self.carriers)
        is_stuck = drivers > 0 and counted == self._counted
        self._counted, self._stuck_ticks = counted, self._stuck_ticks + 1 if is_stuck else 0
        refuses = any(carrier.refused >= REFUSALS for carrier in self.carriers)
        ended = self._dongle is not None and not self._dongle.is_alive()
        return DEAD if ended or refuses or self._stuck_ticks >= STUCK_TICKS else None

    def _set_problem(self, problem: str | None) -> None:
        self.problem = problem
        for carrier in self.carriers:
            carrier.problem = problem

    def _keep_open(self) -> None:
        """Reopen a dead dongle, drivers whose vehicle was out of range, and drivers that hold a
        packet from a flight that has ended."""
        while not self._closed.is_set():
            self._wake.wait(REOPEN_PERIOD_S)
            self._wake.clear()
            if self._closed.is_set():
                return
            if self.problem is None:
                self._renew_drivers()
                continue
            self._close_dongle()
            if self._closed.is_set():  # meanwhile
                return
            try:
                self._open_dongle()
            except (
                Exception
            ) as error:  # any error from cflib or USB: the dongle is not plugged in yet
                logger.info("the dongle cannot be opened: %s", error)
                continue
            self._stuck_ticks = 0
            self._set_problem(None)

    def _renew_drivers(self) -> None:
        for carrier in self.carriers:
            if carrier.lacks_safelink:
                self._close_driver(carrier)
                carrier.opened_s = time.monotonic()
            elif carrier.has_stale_packet and carrier.driver is not None:
                self._close_driver(carrier)
                carrier.opened_s = -math.inf  # the driver must be reopened at once
            elif carrier.driver is None and time.monotonic() - carrier.opened_s > SAFELINK_PERIOD_S:
                try:
                    carrier.open()
                except Exception:  # any error from cflib or USB
                    self._set_problem(DEAD)

    def _open_dongle(self) -> None:
        try:
            for carrier in self.carriers:
                carrier.open()
                self._dongle = internals.dongle_thread(carrier.uri)
        except BaseException:
            self._close_dongle()
            raise

    def _close_dongle(self) -> None:
        for carrier in self.carriers:
            self._close_driver(carrier)
        dongle, self._dongle = self._dongle, None
        if dongle is not None:
            internals.forget_dongle(dongle)

    def _close_driver(self, carrier: Carrier) -> None:
        driver, carrier.driver = carrier.driver, None
        if driver is not None and self._dongle is not None:
            internals.close_radio(driver, self._dongle, CLOSE_TIMEOUT_S)


# --- The process ---


def serve_parent() -> None:
    """Run the hub for the parent process (see `perchctl.link.hub.RadioHub`) until it is stopped, or
    until the parent and all flights have ended."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    # In cflib, an error ends the dongle's thread; the hub detects and reports this.
    threading.excepthook = lambda arguments: logger.info("a thread has ended: %s", arguments)
    channel = connect_to_parent()
    try:
        hub = Hub(channel.recv())
    except (EOFError, OSError):  # the parent has already ended
        return
    except PerchError as error:
        channel.send(error)
        return
    status = 1
    try:
        with contextlib.closing(hub):
            channel.send(hub.uris)
            run(hub, channel)
        status = 0
    except SystemExit:  # by SIGTERM
        status = 0
    except Exception:
        traceback.print_exc()  # the parent prints the last line
        sys.stderr.flush()
    finally:
        os._exit(status)  # a driver that hangs in a USB call must not keep the process alive


def run(hub: Hub, channel: Channel) -> None:
    """Serve a hub and its parent. Return once the parent and all flights have ended."""
    parent = True
    while parent or hub.has_flights():
        due_s = time.monotonic() + TICK_S
        while (wait_s := due_s - time.monotonic()) > 0.0:
            try:
                if not parent:
                    time.sleep(wait_s)
                elif channel.poll(wait_s):
                    hub.limit(*channel.recv())
            except (EOFError, OSError):
                parent = False
        # If the parent hangs, it does not read its pipe; that must not block the hub.
        if hub.tick() and parent and select.select([], [channel], [], 0.0)[1]:
            with contextlib.suppress(OSError):
                channel.send(hub.reports())
