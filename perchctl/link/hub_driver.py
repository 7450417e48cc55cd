"""The flight's side of the radio hub: a cflib driver for `hub://` URIs, and the messages between
the two sides.

```
flight process                            hub process (perchctl/link/hub.py)
CflibLink -> Crazyflie -> HubDriver  <--- UDP on loopback --->  RadioDriver -> dongle
```

One datagram carries one CRTP packet, as with cflib's `udp://`. The two reserved bits of a CRTP
header are always set (`perchctl.link.crtp.Packet`); a datagram without them is a message:

- `HELLO`, the vehicle and a key: the flight asks for this vehicle's packets, first to connect and
  then once a second. The answer is a `REPORT`. The key is a random part of the flight's URI, so
  that no other program on the computer can take over the vehicle.
- `BYE`: the flight has closed its link.
- `ROOM` and a byte: the number of the flight's packets that are waiting in the hub for the radio.
- `REPORT` and a `HubReport` as JSON.

cflib's own `udp://` driver is not suitable. The `udp://` driver accepts any number of packets, so a
stop would be sent after all the setpoints that had piled up during a radio dropout. This driver
also cannot report a dead dongle.

Only `connect` waits for the hub; cflib calls it in a separate thread.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import queue
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from perchctl.errors import ConnectionFailed
from perchctl.link.crtp import MAX_DATA

SCHEME = "hub://"
HELLO, BYE, ROOM, REPORT = (bytes((kind,)) for kind in (0x00, 0x10, 0x20, 0x30))
_RESERVED_BITS = 0x0C
MOST_BYTES = 2048
"""Largest datagram, bytes; a report has fewer than 500. Larger: the only effect is that more memory
is used. Smaller: a report would be truncated and ignored."""
WINDOW = 1
"""Number of packets that may wait in the hub before the flight's sender holds back the next one.
The queue of cflib's radio driver also holds one packet. Larger: a stop waits behind more packets.
With 0, nothing could be sent."""
HELLO_TIMEOUT_S = 1.0
"""Timeout for the hub's first answer, s, which takes 1 ms on an idle computer. Longer: a dead hub
is reported later. Shorter: connecting fails on a busy computer."""
HELLO_PERIOD_S = 0.1
"""Time between two requests for the hub's first answer, s, in case one gets lost. Longer: a lost
request delays the connection. Shorter: no benefit."""
SIGN_OF_LIFE_S = 1.0
"""Time between two requests of an open link, s. These requests tell the hub that the flight is
still running. If the hub's process has ended, the operating system refuses them, so the flight
detects this even when it sends nothing else. Longer: the end of the hub is detected later. Shorter:
more packets are sent."""
HUB_STOP_PERIOD_S = 0.2
"""Longest time until the driver's thread reacts to a close or sends the next request, s. Longer:
the driver's socket is freed later. Shorter: the thread wakes up more often for nothing."""
HUB_ENDED = "this vehicle's radio hub has stopped"


@dataclass(frozen=True)
class HubReport:
    """State of one vehicle's radio link, as the hub sees it.

    `problem` is None, or the reason why the dongle does not work, which ends the links of all its
    vehicles. `answered` and `lost` count the packets since the hub's start that the vehicle
    acknowledged, and those that it did not acknowledge despite the radio's own retries. `quality`
    is cflib's link quality, %: 100 if no packet had to be repeated, None before the first answer.
    `waiting` is the number of the flight's packets that are waiting for the radio.
    """

    problem: str | None = None
    answered: int = 0
    lost: int = 0
    quality: float | None = None
    waiting: int = 0

    def encode(self) -> bytes:
        """Return the message."""
        return REPORT + json.dumps(dataclasses.asdict(self)).encode()

    @staticmethod
    def decode(message: bytes) -> HubReport | None:
        """Return a message's report; None for another message."""
        if message[:1] != REPORT:
            return None
        try:
            return HubReport(**json.loads(message[1:]))
        except (ValueError, TypeError):  # cut off, or from another release
            return None


def is_packet(datagram: bytes) -> bool:
    """True for a CRTP packet, False for a message."""
    return 1 <= len(datagram) <= 1 + MAX_DATA and bool(datagram[0] & _RESERVED_BITS)


class Window:
    """Stand-in for the queue of a radio driver, as read by `internals.has_room`."""

    def __init__(self) -> None:
        self.waiting = 0

    def full(self) -> bool:
        """True if the next packet should be held back."""
        return self.waiting >= WINDOW


class HubDriver:
    """A driver for cflib (`cflib.crtp.CLASSES`) that reaches a vehicle through the radio hub.

    A dead dongle or a hub that has ended is reported once through cflib's error callback, which
    ends the link like any driver error. A hanging hub reports nothing, but the flight's sender
    finds the queue full and its telemetry becomes stale.
    """

    needs_resending = False  # the hub's radio driver has safelink
    """Read by cflib: with True, cflib would repeat its requests."""

    def __init__(self) -> None:
        self.uri = ""
        self.report = HubReport()
        self.in_queue: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.out_queue = Window()
        self._hello = b""
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._closed = threading.Event()
        self._once = threading.Lock()  # acquired permanently by the first error report
        self._on_error: Callable[[str], None] = lambda message: None
        self._on_statistics: Callable[[dict[str, float]], None] | None = None

    def connect(
        self,
        uri: str,
        on_statistics: Callable[[dict[str, float]], None] | None,
        on_error: Callable[[str], None],
    ) -> None:
        """Ask the hub for the vehicle's packets and wait at most `HELLO_TIMEOUT_S` for the answer.
        Raises ConnectionFailed if no hub answers or its dongle is dead, and cflib's WrongUriType
        for another driver's URI."""
        from cflib.crtp.exceptions import WrongUriType

        if not uri.startswith(SCHEME):
            raise WrongUriType("not a URI of the radio hub")
        self.uri, self._on_statistics = uri, on_statistics
        address, _, vehicle = uri.removeprefix(SCHEME).partition("/")
        host, _, port = address.partition(":")
        self._hello = HELLO + vehicle.encode()
        wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            wire.connect((host, int(port)))
            self._await_report(wire)
            if self.report.problem is not None:
                raise ConnectionFailed(self.report.problem)
        except OSError:  # no process uses the port any more
            wire.close()
            raise ConnectionFailed(HUB_ENDED) from None
        except BaseException:
            wire.close()
            raise
        self._on_error, self._socket = on_error, wire
        self._thread = threading.Thread(target=self._listen, name="perchctl-hub", daemon=True)
        self._thread.start()

    def send_packet(self, packet: Any) -> bool:
        """Send a packet at once, without waiting. A caller that can wait asks `out_queue` for room
        first."""
        if self._socket is None or self._closed.is_set():
            return False
        self.out_queue.waiting += 1
        try:
            self._socket.send(bytes((packet.header,)) + bytes(packet.data))
        except OSError:
            self._fail(HUB_ENDED)
            return False
        return True

    def receive_packet(self, wait: float = 0) -> Any:
        """Return the next packet; None after `wait` seconds without one. Negative: wait forever."""
        try:
            return self.in_queue.get(wait != 0, wait if wait > 0 else None)
        except queue.Empty:
            return None

    def close(self) -> None:
        """Tell the hub that the flight has closed its link. The hub keeps the radio link to the
        vehicle open and sends nothing to it."""
        if self._socket is not None and not self._closed.is_set():
            self._closed.set()  # the thread frees the socket
            with contextlib.suppress(OSError):
                self._socket.send(BYE)

    def scan_interface(self, address: int | None = None) -> list[list[str]]:
        """Return no vehicles: the flights of a fleet get their URIs from the parent process."""
        return []

    def get_name(self) -> str:
        return "hub"

    def get_status(self) -> str:
        return "No information available"

    def _await_report(self, wire: socket.socket) -> None:
        wire.settimeout(HELLO_PERIOD_S)
        end_s = time.monotonic() + HELLO_TIMEOUT_S
        wire.send(self._hello)
        while time.monotonic() < end_s:
            try:
                datagram = wire.recv(MOST_BYTES)
            except TimeoutError:
                wire.send(self._hello)
                continue
            self._take(datagram)
            if datagram[:1] == REPORT:
                return
        raise ConnectionFailed("the radio hub of this vehicle does not answer")

    def _listen(self) -> None:
        assert self._socket is not None
        asked_s = time.monotonic()
        with self._socket as wire:
            wire.settimeout(HUB_STOP_PERIOD_S)
            while not self._closed.is_set():
                try:
                    if time.monotonic() - asked_s > SIGN_OF_LIFE_S:
                        asked_s = time.monotonic()
                        wire.send(self._hello)
                    self._take(wire.recv(MOST_BYTES))
                except TimeoutError:
                    continue
                except OSError:  # refused, since no process uses the hub's port any more
                    self._fail(HUB_ENDED)
                    return
                if self.report.problem is not None:
                    self._fail(self.report.problem)
                    return

    def _take(self, datagram: bytes) -> None:
        from cflib.crtp.crtpstack import CRTPPacket

        if is_packet(datagram):
            self.in_queue.put(CRTPPacket(datagram[0], datagram[1:]))
        elif datagram[:1] == ROOM and len(datagram) > 1:
            self.out_queue.waiting = datagram[1]
        elif (report := HubReport.decode(datagram)) is not None:
            self.report = report
            self.out_queue.waiting = report.waiting
            if self._on_statistics is not None and report.quality is not None:
                self._on_statistics({"link_quality": report.quality})

    def _fail(self, message: str) -> None:
        if not self._closed.is_set() and self._once.acquire(blocking=False):
            self._on_error(message)
