"""Signals: Ctrl-C and SIGTERM in the commands that run for a while, and all that may ask a
flight to end."""

from __future__ import annotations

import contextlib
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from perchctl.flight import OperatorSwitch

Handler = Callable[[int, FrameType | None], None]
SIGNALS = (signal.SIGINT, signal.SIGTERM)

LANDING_SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
"""End or suspend a program elsewhere; a flight they land."""
_MUTED = (signal.SIGTTOU, signal.SIGTTIN)  # would suspend a flight in a shell's background
_NO_SUSPENDING = "Ctrl-Z does not suspend a flight: landing"


@contextlib.contextmanager
def handle_signals(handler: Handler) -> Iterator[None]:
    """Hand SIGINT and SIGTERM to `handler` during the block (main thread only)."""
    old = {name: signal.signal(name, handler) for name in SIGNALS}
    try:
        yield
    finally:
        for name, before in old.items():
            signal.signal(name, before)


@contextlib.contextmanager
def operator_signals(switch: OperatorSwitch, report: Callable[[str], None]) -> Iterator[None]:
    """Let Ctrl-C press the switch during a flight, and `LANDING_SIGNALS` land (main thread only).

    A separate thread reads the signals from Python's wakeup socket, so they take effect even while
    the main thread hangs in a library. An ignored SIGHUP (nohup) stays ignored. `report` prints a
    line.
    """

    def handler(_signal: int, _frame: FrameType | None) -> None:
        switch.interrupt()

    reader, writer = socket.socketpair()
    writer.setblocking(False)
    listener = threading.Thread(
        target=_listen, args=(reader, switch, report), name="perchctl-signals", daemon=True
    )
    listener.start()
    fd_before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    before = {}
    try:
        for name in (signal.SIGINT, *LANDING_SIGNALS):
            if name == signal.SIGINT or signal.getsignal(name) is not signal.SIG_IGN:
                before[name] = signal.signal(name, handler)
        for name in _MUTED:
            before[name] = signal.signal(name, signal.SIG_IGN)
        yield
    finally:
        for name, old in before.items():
            signal.signal(name, old)
        signal.set_wakeup_fd(fd_before)
        writer.close()
        listener.join(1.0)
        reader.close()


def _listen(reader: socket.socket, switch: OperatorSwitch, report: Callable[[str], None]) -> None:
    while numbers := reader.recv(64):
        for number in numbers:
            if number == signal.SIGINT:
                switch.press()
            elif number in LANDING_SIGNALS:
                switch.land()
        if switch.listening and signal.SIGTSTP in numbers:
            # Not from this thread: a terminal that stands still would hold up the signals.
            threading.Thread(target=report, args=(_NO_SUSPENDING,), daemon=True).start()


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM raise KeyboardInterrupt during the block."""
    with handle_signals(_interrupt):
        yield


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


@contextlib.contextmanager
def ignore_signals() -> Iterator[None]:
    """Ignore Ctrl-C and SIGTERM during the block, unless an inner block handles them."""
    with handle_signals(lambda _signal, _frame: None):
        yield


class Stopper:
    """Handles Ctrl-C: the first sets `requested`, a second one raises KeyboardInterrupt."""

    def __init__(self) -> None:
        self.requested = threading.Event()

    def press(self, _signal: int = 0, _frame: FrameType | None = None) -> None:
        if self.requested.is_set():
            raise KeyboardInterrupt
        self.requested.set()

    @contextlib.contextmanager
    def as_handler(self) -> Iterator[Stopper]:
        with handle_signals(self.press):
            yield self
