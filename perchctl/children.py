"""Processes of perchctl's own beside the one that flies, and the connection to each.

A loopback connection of length-prefixed pickles. Only the child connects, and only
after it has sent the token that it received on its standard input, so neither side
unpickles foreign bytes.
"""

from __future__ import annotations

import contextlib
import hmac
import multiprocessing
import os
import pickle
import secrets
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

_TOKEN_BYTES = 32
_ACCEPT_POLL_S = 0.05
# -P and the path at the end: an installed package is found as usual, a checkout too,
# and nothing in the working directory can shadow a module.
_PREFACE = "import sys; sys.path.append(sys.argv[1]); "


class Channel:
    """One end of a connection between two processes, which carries pickled messages; `receive`
    raises EOFError when the other end is gone."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, message: Any) -> None:
        raw = pickle.dumps(message)
        self.socket.sendall(struct.pack("<I", len(raw)) + raw)

    def receive(self, timeout_s: float | None = None) -> Any:
        """Return the next message. Raises TimeoutError after `timeout_s` without a byte, EOFError
        when the other end is gone."""
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
    """Return the connection of the child that knows the `token`; None if it does not come in time
    or `still_there` says that it has ended."""
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


def new_token() -> str:
    return secrets.token_hex(_TOKEN_BYTES)


def spawn(code: str, output: int | IO[bytes]) -> subprocess.Popen[bytes]:
    """Run `code` in a Python of its own, in which perchctl can be imported, away from the
    terminal's Ctrl-C. `output` takes what it prints: a file, or subprocess.PIPE."""
    root = str(Path(__file__).resolve().parents[1])
    command = [sys.executable, "-P", "-c", _PREFACE + code, root]
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=output,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


def send_address(child: subprocess.Popen[bytes], listener: socket.socket, token: str) -> None:
    """Tell the child on its standard input where to connect, and with which token."""
    assert child.stdin is not None
    with contextlib.suppress(OSError), child.stdin:
        child.stdin.write(f"{listener.getsockname()[1]} {token}\n".encode())


def connect_back() -> Channel:
    """Return the child's connection to the parent that has introduced itself."""
    port, token = sys.stdin.readline().split()
    connection = socket.create_connection(("127.0.0.1", int(port)), timeout=10.0)
    connection.sendall(token.encode())
    return Channel(connection)


def end_with_parent(last: Callable[[], object] = lambda: None) -> None:
    """End this process of `multiprocessing` as soon as its parent is gone, killed or not, since
    nobody waits for its work; `last` is called before. The function is here since this module loads
    at once: a busy computer takes long to load the whole program."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        with contextlib.suppress(Exception):
            last()
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def end(child: subprocess.Popen[bytes], timeout_s: float) -> None:
    """Wait until the child has ended; kill it after `timeout_s`."""
    try:
        child.wait(timeout_s)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def last_line(output: IO[bytes]) -> str:
    """Return the last line that a child has printed, with a colon before it, for a message."""
    if output.closed:
        return ""
    output.seek(0)
    lines = output.read().decode(errors="replace").strip().splitlines()
    return f": {lines[-1]}" if lines else ""
