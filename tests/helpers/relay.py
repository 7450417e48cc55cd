"""A wire between cflib and a simulated vehicle that writes down all that goes up, from a
connection's first packet to its last."""

from __future__ import annotations

import select
import socket
import threading
from contextlib import suppress

from perchctl.link import Packet, Port

COMMANDS = (Port.COMMANDER, Port.LOCALIZATION, Port.COMMANDER_GENERIC, Port.HIGH_LEVEL)
PARAMETER_WRITE, PLATFORM_COMMAND, SUPERVISOR_COMMAND = 2, 0, 1  # channels


class Relay:
    """`uri` leads to the vehicle through it; `up` are the packets that went there."""

    def __init__(self, uri: str) -> None:
        host, _, port = uri.removeprefix("udp://").rpartition(":")
        self._vehicle = (host, int(port))
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind(("127.0.0.1", 0))
        self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._far.bind(("127.0.0.1", 0))
        self.uri = f"udp://127.0.0.1:{self._near.getsockname()[1]}"
        self.up: list[Packet] = []
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def commands(self) -> list[Packet]:
        """What could arm, place, fly or stop it."""
        return [packet for packet in self.up if _commands(packet)]

    def writes(self) -> list[Packet]:
        """Of parameters."""
        return [p for p in self.up if p.port == Port.PARAM and p.channel == PARAMETER_WRITE]

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        self._near.close()
        self._far.close()

    def _run(self) -> None:
        client = None
        while not self._closed.is_set():
            ready, _, _ = select.select([self._near, self._far], [], [], 0.05)
            for end in ready:
                with suppress(OSError):
                    datagram, sender = end.recvfrom(128)
                    if end is self._near:
                        client = sender
                        if (packet := Packet.decode(datagram)) is not None:
                            self.up.append(packet)
                        self._far.sendto(datagram, self._vehicle)
                    elif client is not None:
                        self._near.sendto(datagram, client)


def _commands(packet: Packet) -> bool:
    if packet.port == Port.PLATFORM:
        return packet.channel == PLATFORM_COMMAND
    if packet.port == Port.SUPERVISOR:  # asking for its state commands nothing
        return packet.channel == SUPERVISOR_COMMAND
    return packet.port in COMMANDS
