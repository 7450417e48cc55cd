"""What no signal may end halfway."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def defer_interrupts() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait until after the block; what is started within, processes and
    threads, never sees them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        with _kept_for_later():
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _kept_for_later() -> Iterator[None]:
    """A mask is one thread's: some other, of a library, takes the signal, and Python handles it
    in the main thread all the same."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handlers = {s: signal.signal(s, lambda number, _frame: came.append(number)) for s in SIGNALS}
    try:
        yield
    finally:
        for name, handler in handlers.items():
            if handler is not None:  # None: not Python's own
                signal.signal(name, handler)
        for number in came:  # the mask holds these, too, until the block is left
            signal.pthread_kill(threading.get_ident(), number)
