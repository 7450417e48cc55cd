"""Signals: Ctrl-C and SIGTERM in long-running commands."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

Handler = Callable[[int, FrameType | None], None]
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def handle_signals(handler: Handler) -> Iterator[None]:
    """Pass SIGINT and SIGTERM to `handler` during the block (main thread only)."""
    old = {name: signal.signal(name, handler) for name in SIGNALS}
    try:
        yield
    finally:
        for name, before in old.items():
            signal.signal(name, before)


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
    """Handles Ctrl-C: the first press sets `requested`, and the second one raises
    KeyboardInterrupt."""

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
