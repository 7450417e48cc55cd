"""The radio hub: a process that owns a Crazyradio and shares it between several flight processes.

cflib shares a dongle only within one process (docs/firmware.md, "Shared dongle"). Each vehicle's
flight runs in its own process, so that a hang or a crash in one never delays another. The hub
carries the packets of all vehicles. `RadioHub` is the handle used by the process that starts the
flights; `perchctl.link.sharing` runs in the hub process.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Sequence

from perchctl.children import last_line, spawn, wait_or_kill
from perchctl.errors import ConnectionFailed, InvalidValue, PerchError
from perchctl.link.hub_driver import HubReport
from perchctl.link.protocol import check_uri, vehicle_uri

HUB_START_TIMEOUT_S = 20.0
"""Timeout for a hub to start and open its dongle, s. Loading takes 1 s on an idle computer, and
each setting of the dongle at most 1 s. Longer: a hanging hub is detected later. Shorter: the start
fails on a busy computer."""
HUB_END_TIMEOUT_S = 5.0
"""Time after which a hub that does not end is killed, s. Longer: a hanging hub delays the end.
Shorter: the hub's dongle may stay claimed until the system has cleaned up."""
SILENT_S = 1.0
"""Time without a report after which the hub counts as hanging, s. The hub reports five times a
second. Longer: a hang is detected later. Shorter: a busy computer looks like a hang."""
PROGRAM = "from perchctl.link.sharing import serve_parent; serve_parent()"


class RadioHub:
    """Handle of a hub for the vehicles at `uris`, radio URIs of one dongle; a context manager.

    Raises InvalidValue for URIs that one dongle cannot serve, ConnectionFailed if the dongle cannot
    be opened or a vehicle is in use by another program, and TimedOut. If an error is raised, no
    packet has been sent to any vehicle. A vehicle that does not answer causes no error here; its
    flight fails to connect instead.

    If its parent process ends, the hub keeps running until the flights have ended, because they
    need it to land.

    Attributes:
        uris: maps each given URI to the `hub://` URI for the flight's `CflibLink`.
        reports: maps each given URI to the newest report that `update` has read.
    """

    def __init__(self, uris: Sequence[str]) -> None:
        check_uris(uris)
        self._output = tempfile.TemporaryFile()  # noqa: SIM115
        self._child, self._channel = spawn(PROGRAM, self._output)
        self._heard_s = time.monotonic()
        self.reports: dict[str, HubReport] = {}
        try:
            self._channel.receive(HUB_START_TIMEOUT_S)
            self._channel.send(list(uris))
            answer = self._channel.receive(HUB_START_TIMEOUT_S)
            if isinstance(answer, PerchError):
                raise answer
            self.uris: dict[str, str] = answer
        except TimeoutError:
            self.stop()
            raise ConnectionFailed("the radio hub did not start in time") from None
        except (EOFError, OSError):
            why = last_line(self._output)
            self.stop()
            raise ConnectionFailed(f"the radio hub stopped while starting{why}") from None
        except BaseException:
            self.stop()
            raise
        self._heard_s = time.monotonic()

    def update(self) -> str | None:
        """Read the hub's newest reports. Return None, or a message if the hub itself has failed.
        Never blocks."""
        try:
            while self._channel.poll():
                self.reports = self._channel.recv()
                self._heard_s = time.monotonic()
        except (EOFError, OSError):
            return f"the radio hub has stopped{last_line(self._output)}"
        silent_s = time.monotonic() - self._heard_s
        return (
            f"the radio hub has not reported for {silent_s:.1f} s" if silent_s > SILENT_S else None
        )

    def limit(self, uri: str, packets_per_s: int | None) -> None:
        """Limit the packet rate of an idle vehicle to leave more for the others; None: no limit.

        Takes effect after the vehicle's next packet. The limit includes telemetry: if a flight
        requests more than fits, its telemetry arrives late.
        """
        with contextlib.suppress(OSError):  # the hub has ended, which `update` reports
            self._channel.send((uri, packets_per_s))

    def stop(self) -> None:
        """Stop the hub. The hub sends no more packets. May be called twice."""
        self._channel.close()
        if self._child.poll() is None:
            with contextlib.suppress(OSError):
                self._child.terminate()
            wait_or_kill(self._child, HUB_END_TIMEOUT_S)
        self._output.close()

    def __enter__(self) -> RadioHub:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def check_uris(uris: Sequence[str]) -> None:
    """Raise InvalidValue unless these are radio URIs of different vehicles on one dongle."""
    for uri in uris:
        if check_uri(uri) != "radio":
            raise InvalidValue(f"{uri} is not a radio URI: a hub can share only a Crazyradio")
    dongles = {dongle_of(uri): uri for uri in uris}
    if len(dongles) != 1:
        raise InvalidValue(
            "all vehicles of a radio hub must be on one dongle, found "
            f"{' and '.join(dongles.values())}"
        )
    vehicles: dict[str, str] = {}
    for uri in uris:
        other = vehicles.setdefault(vehicle_uri(uri), uri)
        if other is not uri:
            raise InvalidValue(
                f"{other} and {uri} are the same vehicle: give each vehicle its own address"
            )


def dongle_of(uri: str) -> str:
    """Return the number or serial number of the dongle in a radio URI."""
    return uri.removeprefix("radio://").partition("?")[0].partition("/")[0].upper()
