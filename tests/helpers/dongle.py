"""A Crazyradio on USB that several vehicles share: a pyusb device under the unmodified cflib.

All of cflib runs: its search for dongles (but for the USB bus itself), its `Crazyradio` with the
settings by control requests, the thread of the dongle and the thread of each link. What is false
is the device that pyusb would return.
"""

from __future__ import annotations

import array
import contextlib
import itertools
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, Protocol

import usb.core
from cflib.crtp import radiodriver
from cflib.drivers import crazyradio

from tests.helpers.chip import Chip

PACKET_S, UNANSWERED_S, SETTING_S = 0.0007, 0.002, 0.00125
"""Of a real dongle: a packet with its answer, one without, and a control request."""
TELEMETRY = 0x5E  # header of log data: port 5, channel 2


class Exchange(Protocol):
    """A vehicle in the air."""

    def exchange(self, data: bytes) -> bytes | None:
        """The acknowledgement of one packet; None for a lost one."""


class Talker:
    """A vehicle with safelink that returns what it hears, and always has telemetry to send,
    numbered, unless it is `quiet`. `is_lost(number)` says which exchanges are lost; `heard` are the
    packets that came."""

    def __init__(self, is_lost: Callable[[int], bool] = lambda number: False) -> None:
        self.heard: list[bytes] = []
        self.exchanges = 0
        self.silent = self.quiet = False
        self._is_lost = is_lost
        self._chip = Chip(self._take)
        self._numbers = itertools.count()

    def exchange(self, data: bytes) -> bytes | None:
        self.exchanges += 1
        if self.silent or self._is_lost(self.exchanges):
            return None
        if not self._chip.waiting and not self.quiet:
            self._chip.waiting.append(struct.pack("<BI", TELEMETRY, next(self._numbers)))
        return self._chip.acknowledge(data)

    def _take(self, data: bytes) -> None:
        self.heard.append(bytes((data[0] | 0x0C,)) + data[1:])
        self._chip.waiting.append(self.heard[-1])


class OnLoopback:
    """A vehicle whose packets cflib's `udp://` would carry, as a simulated one's in a process of
    its own."""

    def __init__(self, uri: str) -> None:
        host, _, port = uri.removeprefix("udp://").partition(":")
        self._wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._wire.connect((host, int(port)))
        self._wire.setblocking(False)
        self._chip = Chip(self._take)

    def exchange(self, data: bytes) -> bytes | None:
        with contextlib.suppress(OSError):  # nothing has come
            while True:
                self._chip.waiting.append(self._wire.recv(64))
        return self._chip.acknowledge(data)

    def _take(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            self._wire.send(data)


class UsbPort:
    """Where the dongle is plugged in, or is not; behind it the vehicles by channel and address.

    `opened` is how often a dongle was. `refused` counts the calls of one that is gone. `busy_s` is
    how long it has worked by the time that each packet and setting takes; it really takes `scale`
    times that.
    """

    def __init__(self, vehicles: dict[str, Exchange], scale: float = 0.0) -> None:
        self.vehicles = {_key(uri): vehicle for uri, vehicle in vehicles.items()}
        self.scale, self.busy_s = scale, 0.0
        self.opened = self.refused = 0
        self.order: list[tuple[int, int]] = []  # of the exchanges: whose turn it was
        self._device: _Device | None = None
        self.plug_in()

    def plug_in(self) -> None:
        self._device = _Device(self)

    def unplug(self) -> None:
        if self._device is not None:
            self._device.gone = True
        self._device = None

    def find(self, serial: str | None = None) -> list[Any]:
        """As cflib's search for dongles."""
        return [] if self._device is None else [self._device]

    def work(self, seconds: float) -> None:
        self.busy_s += seconds
        if self.scale:
            time.sleep(seconds * self.scale)


class _Device:
    """As pyusb has it, with the calls that cflib makes."""

    bcdDevice = 0x0053
    serial_number = "E7E7E7E7E7"

    def __init__(self, port: UsbPort) -> None:
        self.gone = False
        self._port = port
        self._ctx = SimpleNamespace(dispose=lambda device: None)
        self._channel, self._address = 2, 0xE7E7E7E7E7
        self._answer = array.array("B", [0])

    def set_configuration(self, number: int) -> None:
        self._check()
        self._port.opened += 1

    def reset(self) -> None:
        self._check()

    def ctrl_transfer(
        self, kind: int, request: int, wValue: int, wIndex: int, timeout: int, data_or_wLength: Any
    ) -> None:
        self._check()
        self._port.work(SETTING_S)
        if request == crazyradio.SET_RADIO_CHANNEL:
            self._channel = wValue
        elif request == crazyradio.SET_RADIO_ADDRESS:
            self._address = int.from_bytes(bytes(data_or_wLength), "big")

    def write(self, endpoint: int, data: Any, timeout: int) -> None:
        self._check()
        place = (self._channel, self._address)
        vehicle = self._port.vehicles.get(place)
        answer = None if vehicle is None else vehicle.exchange(bytes(data))
        self._port.order.append(place)
        self._port.work(UNANSWERED_S if answer is None else PACKET_S)
        self._answer = array.array("B", [0] if answer is None else [1, *answer])

    def read(self, endpoint: int, size: int, timeout: int) -> array.array[int]:
        self._check()
        return self._answer

    def _check(self) -> None:
        if self.gone:
            self._port.refused += 1
            raise usb.core.USBError("No such device (it may have been disconnected)", -4, 19)


def _key(uri: str) -> tuple[int, int]:
    _, channel, _, address, _ = radiodriver.RadioDriver.parse_uri(uri)
    return channel, int.from_bytes(bytes(address), "big")


def attach(port: UsbPort, patch: Any) -> None:
    """From now on cflib finds this port's dongle, and no other; what its threads end by is no
    traceback. `patch` is pytest's, or has a `setattr` that nobody takes back."""
    patch.setattr(crazyradio, "_find_devices", port.find)
    patch.setattr(radiodriver.RadioManager, "_radios", [])
    patch.setattr(threading, "excepthook", lambda arguments: None)


def uris(count: int) -> list[str]:
    """Vehicles on one channel of the first dongle."""
    return [f"radio://0/80/2M/E7E7E7E7{number:02X}" for number in range(1, count + 1)]


def talkers(of: Sequence[str]) -> dict[str, Talker]:
    return {uri: Talker() for uri in of}
