"""A Crazyradio and the vehicle in its air, under cflib's own radio driver.

Everything above the USB cable is the installed cflib: the driver with its thread, its queue of
one packet, its 2 s of waiting for a place there and its calls of the error callback. Below it the
dongle carries each packet to a `CrtpServer`, and falls silent, is pulled out or comes back on a
word of the test. The vehicle's radio answers as docs/firmware.md has it ("Safelink", "Radio
silence").
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import cflib.crtp
import pytest
from cflib.crtp import radiodriver
from cflib.drivers.crazyradio import Crazyradio, _radio_ack

from perchctl.link import Packet, Port
from perchctl.sim import Scenario, SimulatedVehicle
from perchctl.sim.crtp import CrtpServer
from tests.helpers.chip import Chip

URI = "radio://0/80/2M/E7E7E7E7E7"
FORGETS_LOGS_S = 1.0
"""docs/firmware.md, "Radio silence"."""
_ANSWERED_S, _UNANSWERED_S = 0.0005, 0.002  # of a packet; unanswered it is repeated three times
_LOG_SETTINGS, _LOG_RESET = 1, bytes((5,))


class Air:
    """The vehicle at the other end, in real time.

    `heard` are the packets that reached it and when, `opened` is how often a dongle was.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.heard: list[tuple[float, Packet]] = []
        self.opened = 0
        self.silent = threading.Event()
        self.unplugged = threading.Event()
        self._changed = threading.Condition()
        self._began_s = self._heard_s = time.monotonic()
        self._vehicle = SimulatedVehicle(scenario)
        self._server = CrtpServer(self._vehicle.firmware)
        self._chip = Chip(self._take)

    def hears(self, what: Callable[[Packet], bool], since_s: float, limit_s: float) -> float | None:
        """When the first such packet since then reached the vehicle; None where none does."""

        def first() -> float | None:
            return next((t_s for t_s, p in self.heard if t_s >= since_s and what(p)), None)

        with self._changed:
            self._changed.wait_for(lambda: first() is not None, limit_s)
            return first()

    def exchange(self, data: bytes) -> bytes | None:
        """The acknowledgement of one packet of the dongle's; None without one."""
        now_s = time.monotonic()
        with self._changed:
            self._vehicle.advance_to(now_s - self._began_s)
            if self.silent.is_set():
                return None
            if now_s - self._heard_s > FORGETS_LOGS_S:
                self._server.handle(Packet(Port.LOG, _LOG_SETTINGS, _LOG_RESET))
                self._chip.waiting.clear()
            self._heard_s = now_s
            self._chip.waiting.extend(packet.encode() for packet in self._server.due_packets())
            return self._chip.acknowledge(data)

    def _take(self, data: bytes) -> None:
        packet = Packet.decode(data)
        if packet is None:
            return
        self.heard.append((self._heard_s, packet))
        self._chip.waiting.extend(answer.encode() for answer in self._server.handle(packet))
        self._changed.notify_all()


class Dongle(Crazyradio):  # type: ignore[misc]
    """cflib's Crazyradio without its USB."""

    def __init__(self, air: Air) -> None:
        if air.unplugged.is_set():
            raise Exception("Cannot find a Crazyradio Dongle")
        air.opened += 1
        self._air, self._gone = air, False
        self.version, self.arc = 0.53, 3

    def send_packet(self, data: Any) -> Any:
        self._gone = self._gone or self._air.unplugged.is_set()
        if self._gone:  # a dongle that was pulled out does not come back under its old handle
            time.sleep(_ANSWERED_S)
            return None
        answer, ack = self._air.exchange(bytes(data)), _radio_ack()
        time.sleep(_UNANSWERED_S if answer is None else _ANSWERED_S)
        if answer is not None:
            ack.ack, ack.data = True, answer
        return ack

    def set_arc(self, arc: int) -> None:
        self.arc = arc

    def ignore(self, value: Any) -> None:
        return None

    set_channel = set_address = set_data_rate = ignore

    def close(self) -> None:
        self._gone = True


def plug_in(air: Air, patch: pytest.MonkeyPatch) -> None:
    """From now on cflib finds this dongle, and its driver alone."""

    class Found(Dongle):
        def __init__(self, devid: int = 0) -> None:
            super().__init__(air)

    patch.setattr(radiodriver, "Crazyradio", Found)
    patch.setattr(radiodriver.RadioManager, "_radios", [])
    patch.setattr(cflib.crtp, "CLASSES", [radiodriver.RadioDriver])
