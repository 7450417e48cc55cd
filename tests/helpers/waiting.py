"""Waiting with a bound for what another thread or process does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def until(condition: Callable[[], Any], limit_s: float = 20.0) -> Any:
    """What `condition` returns once that is true; fails when it stays away so long."""
    end_s, pause = time.monotonic() + limit_s, threading.Event()
    while not (value := condition()):
        assert time.monotonic() < end_s, "waited in vain"
        pause.wait(0.003)
    return value


BEAT_S = 0.005


class Stopwatch:
    """How long something took, and for how long of it the processor was another's."""

    def __init__(self) -> None:
        self.began_s = time.monotonic()
        self.starved_s = 0.0

    @property
    def took_s(self) -> float:
        """Without the time in which this process could not run: what it waited or worked for."""
        return time.monotonic() - self.began_s - self.starved_s


@contextmanager
def stopwatch() -> Iterator[Stopwatch]:
    """A limit on `took_s` means the same on a busy machine: a thread that only wakes up tells by
    its delays when nothing of this process ran."""
    watch, over = Stopwatch(), threading.Event()

    def beat() -> None:
        due_s = time.monotonic() + BEAT_S
        while not over.wait(BEAT_S):
            now_s = time.monotonic()
            late_s = now_s - due_s
            if late_s > BEAT_S:
                watch.starved_s += late_s
            due_s = now_s + BEAT_S

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield watch
    finally:
        over.set()
        thread.join()
