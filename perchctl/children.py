"""Child processes beside the one that flies, and the connection to each.

A pair of sockets carries pickled messages: only the child inherits the other end, so neither side
unpickles foreign bytes.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any, ClassVar

# -P and the path at the end: an installed package is found as usual, a checkout too,
# and nothing in the working directory can shadow a module.
_PREFACE = "import sys; sys.path.append(sys.argv[1]); "


class SharedTime(ctypes.Structure):
    """How far simulated time has come (`reached_s`, by the simulator) and may go (`limit_s`, by the
    flight; infinity lets it run freely), where both processes see it."""

    MARGIN_S: ClassVar = 0.02
    """Simulated time may run so far past the moment that the flight loop waits for."""

    reached_s: float
    limit_s: float
    _fields_ = (("reached_s", ctypes.c_double), ("limit_s", ctypes.c_double))


class Channel(Connection):
    """One end of a connection between two processes, which carries pickled messages; `recv` raises
    EOFError when the other end is gone."""

    def receive(self, timeout_s: float | None = None) -> Any:
        """The next message. Raises TimeoutError after `timeout_s` without one, EOFError when
        the other end is gone."""
        if not self.poll(timeout_s):
            raise TimeoutError("no message came")
        return self.recv()


def spawn(code: str, output: int | IO[bytes]) -> tuple[subprocess.Popen[bytes], Channel]:
    """Run `code` in a new Python process that can import perchctl and is safe from the terminal's
    Ctrl-C. `output` takes what it prints: a file, or subprocess.PIPE.

    Returns the process and the connection to it; its first message, None, says that it is up.
    """
    root = str(Path(__file__).resolve().parents[1])
    own, its = socket.socketpair()
    with its:
        command = [sys.executable, "-P", "-c", _PREFACE + code, root, str(its.fileno())]
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            pass_fds=[its.fileno()],
            start_new_session=True,
        )
    return child, Channel(own.detach())


def connect_to_parent() -> Channel:
    """Return a `spawn`ed child's connection to its parent, and tell the parent it is up."""
    channel = Channel(int(sys.argv[2]))
    channel.send(None)
    return channel


def end_with_parent(on_exit: Callable[[], object] = lambda: None) -> None:
    """End this process of `multiprocessing` as soon as its parent is gone, killed or not, since
    nobody waits for its work; `on_exit` is called first."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        with contextlib.suppress(Exception):
            on_exit()
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def wait_or_kill(child: subprocess.Popen[bytes], timeout_s: float) -> None:
    """Wait until the child has ended; kill it after `timeout_s`."""
    try:
        child.wait(timeout_s)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


def last_line(output: IO[bytes]) -> str:
    """A child's last line of output, after a colon, for a message; empty without output."""
    if output.closed:
        return ""
    output.seek(0)
    lines = output.read().decode(errors="replace").strip().splitlines()
    return f": {lines[-1]}" if lines else ""
