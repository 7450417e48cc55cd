"""Messages between the process that flies and the simulated vehicle's.

A loopback connection of length-prefixed pickles. Only the child connects, and only
after it has sent the token that it received on its standard input, so neither side
unpickles foreign bytes.
"""

from __future__ import annotations

import hmac
import pickle
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from perchctl.profile import TargetConfig
from perchctl.sim.crtp.server import LinkOptions
from perchctl.sim.scenario import Scenario
from perchctl.vision.types import CameraModel

Pace = Literal["realtime", "stepped"]
START_TIMEOUT_S = 30.0
TOKEN_BYTES = 32
LINGER_S = 12.0
_ACCEPT_POLL_S = 0.05


@dataclass(frozen=True)
class HostSetup:
    """How the simulated vehicle's process is set up.

    `camera` None: no camera and no stream. Ports 0: chosen by the operating system.
    `truth_file`: JSON lines of the true state, 50 a simulated second, also after the
    parent has ended. `heard_file`: JSON lines of every packet that arrived, and who had sent it.
    `linger_s`: how long the vehicle then runs on, in wall-clock time.
    """

    scenario: Scenario = field(default_factory=Scenario)
    pace: Pace = "realtime"
    camera: CameraModel | None = None
    target: TargetConfig | None = None
    link: LinkOptions = field(default_factory=LinkOptions)
    port: int = 0
    http_port: int = 0
    truth_file: str | None = None
    heard_file: str | None = None
    linger_s: float = LINGER_S


class Channel:
    """One end. `receive` raises EOFError when the other end is gone."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, message: Any) -> None:
        raw = pickle.dumps(message)
        self.socket.sendall(struct.pack("<I", len(raw)) + raw)

    def receive(self, timeout_s: float | None = None) -> Any:
        """Raises TimeoutError after `timeout_s` without a byte."""
        self.socket.settimeout(timeout_s)
        (length,) = struct.unpack("<I", self._exactly(4))
        return pickle.loads(self._exactly(length))

    def close(self) -> None:
        self.socket.close()

    def _exactly(self, count: int) -> bytes:
        raw = b""
        while len(raw) < count:
            try:
                part = self.socket.recv(count - len(raw))
            except ConnectionError:
                part = b""
            if not part:
                raise EOFError("the other end is gone")
            raw += part
        return raw


def listen() -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.bind(("127.0.0.1", 0))
    listener.listen(4)
    listener.settimeout(_ACCEPT_POLL_S)
    return listener


def accept(
    listener: socket.socket, token: str, timeout_s: float, still_there: Callable[[], bool]
) -> Channel | None:
    """The child's connection; None when it does not come in time or has ended."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s and still_there():
        try:
            connection, _ = listener.accept()
        except TimeoutError:
            continue
        try:
            connection.settimeout(1.0)
            shown = b""
            while len(shown) < len(token):
                part = connection.recv(len(token) - len(shown))
                if not part:
                    break
                shown += part
        except OSError:
            shown = b""
        if hmac.compare_digest(shown, token.encode()):
            return Channel(connection)
        connection.close()
    return None


def connect(port: int, token: str) -> Channel:
    connection = socket.create_connection(("127.0.0.1", port), timeout=10.0)
    connection.sendall(token.encode())
    return Channel(connection)
