"""What sources over the network share: they connect, read, and connect again, with a limit."""

from __future__ import annotations

import contextlib
import http.client
import socket

from perchctl.camera.source import Clock, LiveSource, one_line

CONNECT_TIMEOUT_S = 3.0
READ_TIMEOUT_S = 2.0
MAX_FAILED_CONNECTIONS = 5
"""Connections in a row that bring no picture before the source gives up."""
RECONNECT_WAIT_S = 0.3


class StreamSource(LiveSource):
    """Reconnects when the stream ends, stalls or breaks; gives up after
    `MAX_FAILED_CONNECTIONS` in a row without a picture, or at once when the server
    answers that there is no such stream before the first picture came (`not_found`).

    A subclass has `_connection`, sets `_socket` in it, and calls `_start(self._run)` when it
    is ready. `damaged` counts the pictures that were dropped.
    """

    def __init__(
        self,
        name: str,
        latency_s: float,
        clock: Clock,
        read_timeout_s: float = READ_TIMEOUT_S,
        reconnect_wait_s: float = RECONNECT_WAIT_S,
    ) -> None:
        super().__init__(name, latency_s, clock)
        self._read_timeout_s = read_timeout_s
        self._reconnect_wait_s = reconnect_wait_s
        self._socket: socket.socket | None = None
        self.not_found = False
        self.connections = 0
        self.damaged = 0

    def close(self) -> None:
        self._stop.set()
        self._wake()
        super().close()

    def _wake(self) -> None:
        """End a read that waits for bytes."""
        current = self._socket
        if current is not None:
            with contextlib.suppress(OSError):
                current.shutdown(socket.SHUT_RDWR)

    def _connection(self) -> str:
        """Read one connection until it ends; return why it ended. It may raise any Exception."""
        raise NotImplementedError

    def _run(self) -> None:
        failed = 0
        while not self._stop.is_set():
            before = self._arrived
            self.connections += 1
            try:
                reason = self._connection()
            except Exception as error:
                # Whatever damaged bytes do to a library: a new connection may bring whole ones.
                reason = _reason(error)
            if self.not_found:
                self._fail(f"{self._name}: {reason}")
                return
            failed = 0 if self._arrived > before else failed + 1
            if failed >= MAX_FAILED_CONNECTIONS:
                self._fail(f"{self._name} gave no picture in {failed} attempts: {reason}")
                return
            self._stop.wait(self._reconnect_wait_s)


def _reason(error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return "no answer in time"
    if isinstance(error, ConnectionRefusedError):
        return "connection refused"
    if isinstance(error, (OSError, http.client.HTTPException, ValueError)):
        return str(error) or type(error).__name__
    return one_line(error)
