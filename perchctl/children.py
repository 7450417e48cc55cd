"""Start child processes and communicate with them.

A pair of sockets carries pickled messages: only the child inherits the other end, so neither side
unpickles data from other programs.
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

# With -P and the path appended at the end, an installed package and a checkout are both found, and
# files in the working directory cannot shadow a module.
_PREFACE = "import sys; sys.path.append(sys.argv[1]); "


class SharedTime(ctypes.Structure):
    """The clock of a simulation, in memory shared by both processes: the simulated time reached so
    far (`reached_s`, set by the simulator), and the simulated time at which the simulator must wait
    for the flight (`limit_s`, set by the flight; infinity means no limit)."""

    MARGIN_S: ClassVar = 0.02
    """How far the simulator may run ahead of the time until which the flight loop is waiting, s."""

    reached_s: float
    limit_s: float
    _fields_ = (("reached_s", ctypes.c_double), ("limit_s", ctypes.c_double))


class Channel(Connection):
    """One end of a connection between two processes that carries pickled messages; `recv` raises
    EOFError if the other end is gone."""

    def receive(self, timeout_s: float | None = None) -> Any:
        """Return the next message. Raises TimeoutError if none arrives within `timeout_s`, and
        EOFError if the other end is gone."""
        if not self.poll(timeout_s):
            raise TimeoutError("no message came")
        return self.recv()


def spawn(code: str, output: int | IO[bytes]) -> tuple[subprocess.Popen[bytes], Channel]:
    """Run `code` in a new Python process that can import perchctl and does not receive the
    terminal's Ctrl-C. `output` receives what it prints: a file, or subprocess.PIPE.

    Returns the process and the connection to it. The first message, None, means that the process is
    running.
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
    """Return the connection of a `spawn`ed child to its parent, and tell the parent that the child
    is running."""
    channel = Channel(int(sys.argv[2]))
    channel.send(None)
    return channel


def end_with_parent(on_exit: Callable[[], object] = lambda: None) -> None:
    """End this `multiprocessing` process as soon as its parent has ended or was killed, because its
    results are no longer needed. `on_exit` is called first."""
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
    """Return a child's last line of output, preceded by a colon, to append to a message; empty if
    there was no output."""
    if output.closed:
        return ""
    output.seek(0)
    lines = output.read().decode(errors="replace").strip().splitlines()
    return f": {lines[-1]}" if lines else ""
