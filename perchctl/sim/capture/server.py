"""The simulated motion capture's server on loopback, read by `motioncapture` as OptiTrack's.

Of the systems that package reads without a vendor's machine this one hands a frame on the
soonest: VRPN's client looks only every 10 ms, Qualisys's binds one fixed port, so that a second
client on the same computer cannot connect.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from perchctl.errors import ConnectionFailed
from perchctl.positioning import CaptureFrame
from perchctl.sim.capture import natnet

SIMULATED_SYSTEM = "optitrack"
"""As `motioncapture` calls it."""
_HOST = "127.0.0.1"
_POLL_S = 0.2
_GONE_S = 3.0
_MOST_CLIENTS = 32


@dataclass
class _Client:
    """`refused_s`: since when nobody listens there."""

    socket: socket.socket
    refused_s: float | None = None


class CaptureServer:
    """Answers clients in a thread of its own; `publish` sends a frame to each at once.

    `port` 0 lets the operating system choose. Raises ConnectionFailed when it is taken.
    """

    def __init__(
        self, names: Sequence[str], port: int = 0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._names = tuple(names)
        self._clock = clock
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(_POLL_S)
        try:
            self._socket.bind((_HOST, port))
        except OSError as error:
            self._socket.close()
            raise ConnectionFailed(
                f"UDP port {port} on {_HOST} cannot be used ({error.strerror}): choose another"
            ) from None
        self.host = f"{_HOST}:{self._socket.getsockname()[1]}"
        self._clients: list[_Client] = []
        self._lock = threading.Lock()
        self._count = 0
        self._closed = False
        self._thread = threading.Thread(target=self._answer, name="capture-server", daemon=True)
        self._thread.start()

    def publish(self, seen: CaptureFrame) -> None:
        """Costs next to nothing while nobody is connected."""
        self._count += 1
        with self._lock:
            if not self._clients:
                return
            datagram = natnet.frame(self._count, self._names, seen)
            for client in self._clients:
                self._send(client, datagram)
            for client in [c for c in self._clients if self._is_gone(c)]:
                client.socket.close()
                self._clients.remove(client)

    def close(self) -> None:
        self._closed = True
        self._thread.join()
        self._socket.close()
        with self._lock:
            for client in self._clients:
                client.socket.close()
            self._clients.clear()

    def _send(self, client: _Client, datagram: bytes) -> None:
        try:
            client.socket.send(datagram)
        except ConnectionRefusedError:  # told of the frame before: not bound yet, or no longer
            if client.refused_s is None:
                client.refused_s = self._clock()
            with contextlib.suppress(OSError):
                client.socket.send(datagram)
        except OSError:  # a full buffer: a frame is lost, as on any network
            return
        else:
            client.refused_s = None

    def _is_gone(self, client: _Client) -> bool:
        return client.refused_s is not None and self._clock() - client.refused_s > _GONE_S

    def _answer(self) -> None:
        while not self._closed:
            try:
                request, address = self._socket.recvfrom(2048)
            except OSError:  # nothing for a while, or a client that has gone
                continue
            kind = natnet.kind_of(request)
            with contextlib.suppress(OSError):
                if kind == natnet.CONNECT:
                    self._socket.sendto(natnet.server_info(self._admit(address[0])), address)
                elif kind == natnet.ASK_MODELS:
                    self._socket.sendto(natnet.models(self._names), address)

    def _admit(self, host: str) -> int:
        """A port of the client's own: several on one computer could not share one."""
        with self._lock:
            taken = {client.socket.getpeername()[1] for client in self._clients}
            while (port := _free_port()) in taken:
                pass
            out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            out.setblocking(False)
            out.connect((host, port))
            self._clients.append(_Client(out))
            if len(self._clients) > _MOST_CLIENTS:
                self._clients.pop(0).socket.close()
        return port


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port: int = probe.getsockname()[1]
        return port
