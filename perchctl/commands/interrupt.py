"""Ctrl-C and SIGTERM in the commands that run for a while."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

Handler = Callable[[int, FrameType | None], None]
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def signals_to(handler: Handler) -> Iterator[None]:
    """Hands SIGINT and SIGTERM to `handler` for the duration (main thread only)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    old = {name: signal.signal(name, handler) for name in SIGNALS}
    try:
        yield
    finally:
        for name, before in old.items():
            signal.signal(name, before)


class Stopper:
    """Ctrl-C as a request to end after this frame; a second one ends at once."""

    def __init__(self) -> None:
        self.requested = threading.Event()

    def press(self, _signal: int = 0, _frame: FrameType | None = None) -> None:
        if self.requested.is_set():
            raise KeyboardInterrupt
        self.requested.set()

    @contextlib.contextmanager
    def installed(self) -> Iterator[Stopper]:
        with signals_to(self.press):
            yield self
