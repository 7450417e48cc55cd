"""The simulated motion capture's server on loopback, read by `motioncapture` as OptiTrack's.

Of the systems that package reads without a vendor's machine this one hands a frame on the
soonest: VRPN's client looks only every 10 ms, Qualisys's binds one fixed port, so that a second
client on the same computer cannot connect.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from perchctl.errors import ConnectionFailed
from perchctl.positioning import BodyPose, CaptureFrame

# --- NatNet 3.1, in which OptiTrack's server speaks: what a client asks, and the answers --------
# Little-endian; each message begins with its kind and the length of what follows. Of a frame only
# the rigid bodies are filled in; a client steps over the empty lists.


CONNECT, SERVER_INFO, ASK_MODELS, MODELS, FRAME = 0, 1, 4, 5, 7
COMMAND_PORT = 1510
_VERSION = bytes((3, 1, 0, 0))
_NAME_BYTES = 256
_TICKS_HZ = 1_000_000
_RIGID_BODY = 1
_TRACKED = 1
_NO_PARENT = -1
_EMPTY = struct.pack("<i", 0)
_UNSEEN = BodyPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def message(kind: int, body: bytes) -> bytes:
    return struct.pack("<HH", kind, len(body)) + body


def kind_of(request: bytes) -> int | None:
    """None for what is too short to be one."""
    return int.from_bytes(request[:2], "little") if len(request) >= 4 else None


def server_info(data_port: int) -> bytes:
    """The answer to `CONNECT`: frames will come to that port of the client's, by unicast."""
    name = b"perchctl".ljust(_NAME_BYTES, b"\0")
    where = struct.pack("<QH?4B", _TICKS_HZ, data_port, False, 0, 0, 0, 0)
    return message(SERVER_INFO, name + _VERSION + _VERSION + where)


def models(names: Sequence[str]) -> bytes:
    """The answer to `ASK_MODELS`: rigid bodies, numbered from 1, their origins unmoved."""
    body = struct.pack("<i", len(names))
    for number, name in enumerate(names, 1):
        body += struct.pack("<i", _RIGID_BODY) + name.encode() + b"\0"
        body += struct.pack("<ii3f", number, _NO_PARENT, 0.0, 0.0, 0.0) + _EMPTY  # no markers
    return message(MODELS, body)


def frame_message(number: int, names: Sequence[str], seen: CaptureFrame) -> bytes:
    """One frame; a body that is not in it is marked as not tracked."""
    parts = [struct.pack("<i", number), _EMPTY, _EMPTY]  # marker sets, other markers
    parts.append(struct.pack("<i", len(names)))
    for index, name in enumerate(names, 1):
        pose = seen.bodies.get(name)
        w, x, y, z = (pose or _UNSEEN).quaternion
        place = (pose or _UNSEEN).position_m
        tracked = 0 if pose is None else _TRACKED
        parts.append(struct.pack("<i3f4ffh", index, *place, x, y, z, w, 0.0, tracked))
    parts += [_EMPTY] * 4  # skeletons, labelled markers, force plates, devices
    ticks = round(seen.t_s * _TICKS_HZ)
    parts.append(struct.pack("<IId3Qh", 0, 0, seen.t_s, ticks, ticks, ticks, 0) + _EMPTY)
    return message(FRAME, b"".join(parts))


# --- The server ----------------------------------------------------------------------------------


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
            datagram = frame_message(self._count, self._names, seen)
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
            kind = kind_of(request)
            with contextlib.suppress(OSError):
                if kind == CONNECT:
                    self._socket.sendto(server_info(self._admit(address[0])), address)
                elif kind == ASK_MODELS:
                    self._socket.sendto(models(self._names), address)

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
