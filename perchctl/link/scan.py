"""Which vehicles answer: channels, rates and addresses of the radio, USB, and UDP."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterable
from dataclasses import dataclass

from perchctl.link.connection import plain_cause, ready_cflib
from perchctl.link.uri import FORMS, with_whole_address

SCAN_TIMEOUT_S = 20.0
USUAL_ADDRESS = 0xE7E7E7E7E7


@dataclass(frozen=True)
class ScanResult:
    """The URIs that answered; `radio` is why no radio was asked, empty where one was."""

    uris: tuple[str, ...]
    radio: str = ""


def address_of(uri: str) -> int | None:
    """A radio's address, of five bytes; None of another URI, or where it is the usual one."""
    parts = uri.partition("?")[0].split("/")
    if not uri.startswith("radio://") or len(parts) < 6:
        return None
    address = int(parts[5], 16)
    return None if address == USUAL_ADDRESS else address


def find_vehicles(
    addresses: Iterable[int | None] = (), timeout_s: float = SCAN_TIMEOUT_S
) -> ScanResult:
    """What answers now at the usual address and at these; sends null packets only.

    A radio's driver may hang: it gets a thread, and what came by then counts.
    """
    asked = list(dict.fromkeys((None, *addresses)))
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
