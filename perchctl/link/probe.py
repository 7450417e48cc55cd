"""A vehicle's link, looked at: which vehicles answer, what one holds, how good the radio is.

Nothing that is sent here flies, arms or turns a motor.
"""

from __future__ import annotations

import contextlib
import math
import struct
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from perchctl.errors import NotFound, TimedOut
from perchctl.link.cflib_link import EstimateLink
from perchctl.link.connection import Connection, plain_cause, ready_cflib, send_packets
from perchctl.link.crtp import Packet, Port
from perchctl.link.firmware import has_variable, missing_variables, parameters, variables
from perchctl.link.uri import FORMS, with_whole_address
from perchctl.profile import LinkConfig

ANSWER_S = 0.5
ECHO_PERIOD_S = 0.02
_ECHO_MARK = 1  # cflib's own pings begin with 0


@dataclass(frozen=True)
class Echoes:
    """Packets that were sent to come back, and after how long those that did came."""

    sent: int = 0
    round_trip_s: tuple[float, ...] = ()

    @property
    def lost(self) -> float:
        """Share, 0 to 1; 1 of none sent."""
        return 1.0 - len(self.round_trip_s) / self.sent if self.sent else 1.0

    @property
    def p95_s(self) -> float | None:
        """95 of 100 came sooner; None of none."""
        ordered = sorted(self.round_trip_s)
        return ordered[int(0.95 * (len(ordered) - 1))] if ordered else None


class ProbeLink(EstimateLink):
    """An `EstimateLink` that refuses no firmware: what is wrong with it is what is asked for.

    `quality` is the radio's, %: how few of its packets had to be sent again; None without one.
    """

    def __init__(self, uri: str, config: LinkConfig, clock: Callable[[], float]) -> None:
        super().__init__(uri, config, clock)
        self.quality: float | None = None
        self.missing: tuple[str, ...] = ()

    def _prepare(self, connection: Connection) -> None:
        self.missing = tuple(missing_variables(connection.cf))
        connection.cf.link_statistics.link_quality_updated.add_callback(self._on_quality)
        if not self.missing:
            try:
                self._start_logging(connection)
            except (NotFound, TimedOut):
                return  # `telemetry` stays empty

    @property
    def cf(self) -> Any:
        """cflib's object."""
        assert self.connection is not None
        return self.connection.cf

    def protocol(self) -> int:
        """-1 where the vehicle is too old to have one."""
        return int(self.cf.platform.get_protocol_version())

    def parameters(self) -> dict[str, float]:
        """All, as they were read when the link was opened."""
        return parameters(self.cf)

    def age_s(self) -> float:
        """Of the newest sample, in the older of its parts; infinite without one."""
        newest = self._blocks.newest
        return math.inf if newest is None else self._clock() - newest.t_s + newest.behind_s

    def lost(self) -> str | None:
        """Why the link is gone, None while it is there."""
        return "it was closed" if self.connection is None else self.connection.lost

    def has_variable(self, name: str) -> bool:
        return has_variable(self.cf, name)

    def variables(self, names: Iterable[str]) -> dict[str, float]:
        """The newest values of log variables; without those that are missing or do not come."""
        return variables(self.cf, names)

    def echoes(self, duration_s: float, period_s: float = ECHO_PERIOD_S) -> Echoes:
        """Send packets to come back for so long, and wait `ANSWER_S` for the last."""
        sent_s: list[float] = []
        back_s: dict[int, float] = {}
        all_back = threading.Event()

        def on_packet(packet: Any) -> None:
            data = bytes(packet.data)
            if len(data) == _ECHO.size and data[0] == _ECHO_MARK:
                back_s.setdefault(_ECHO.unpack(data)[1], time.monotonic())
                if len(back_s) == count:
                    all_back.set()

        count = max(1, round(duration_s / period_s))
        self.cf.add_header_callback(on_packet, Port.LINK, 0)
        try:
            start_s = time.monotonic()
            for number in range(count):
                sent_s.append(time.monotonic())
                send_packets(self.cf, [Packet(Port.LINK, 0, _ECHO.pack(_ECHO_MARK, number))])
                time.sleep(max(0.0, start_s + (number + 1) * period_s - time.monotonic()))
            all_back.wait(ANSWER_S)
        finally:
            self.cf.remove_header_callback(on_packet, Port.LINK, 0)
        trips = tuple(t_s - sent_s[n] for n, t_s in list(back_s.items()) if n < len(sent_s))
        return Echoes(count, trips)

    def _on_quality(self, percent: float) -> None:
        self.quality = float(percent)


_ECHO = struct.Struct("<BQ")  # as long as cflib's own, which it takes all of them for


# --- Which vehicles answer: channels, rates and addresses of the radio, USB, and UDP -----------


SCAN_TIMEOUT_S = 20.0
USUAL_ADDRESS = 0xE7E7E7E7E7


@dataclass(frozen=True)
class ScanResult:
    """The URIs that answered; `radio` is why no radio was asked, empty where one was."""

    uris: tuple[str, ...]
    radio: str = ""


def _address_of(uri: str) -> int | None:
    """A radio's address, of five bytes; None of another URI, or where it is the usual one."""
    parts = uri.partition("?")[0].split("/")
    if not uri.startswith("radio://") or len(parts) < 6:
        return None
    address = int(parts[5], 16)
    return None if address == USUAL_ADDRESS else address


def find_vehicles(uri: str = "", timeout_s: float = SCAN_TIMEOUT_S) -> ScanResult:
    """What answers now at a radio's usual address and at that of `uri`; sends null packets only.

    A radio's driver may hang: it gets a thread, and what came by then counts.
    """
    asked = dict.fromkeys((None, _address_of(uri)))
    found: list[str] = []
    why: list[str] = ["the radio did not answer in time"]

    def run() -> None:
        from cflib import crtp

        ready_cflib()
        with contextlib.suppress(Exception):  # whatever the driver raises
            why[0] = _radio_problem()
        for driver in crtp.CLASSES:
            for address in asked:
                with contextlib.suppress(Exception):
                    found.extend(uri for uri, _ in driver().scan_interface(address))

    worker = threading.Thread(target=run, name="perchctl-scan", daemon=True)
    worker.start()
    worker.join(timeout_s)
    uris = (uri for uri in dict.fromkeys(found) if uri.partition("://")[0] in FORMS)
    return ScanResult(tuple(map(with_whole_address, uris)), why[0])


def _radio_problem() -> str:
    from cflib.drivers.crazyradio import Crazyradio

    try:
        Crazyradio().close()
    except Exception as error:
        cause = plain_cause(str(error) or "Cannot find a Crazyradio Dongle")
        return cause.partition("\n")[0].rstrip(".")
    return ""
