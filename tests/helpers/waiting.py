"""Waiting with a bound for what another thread or process does."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def until(condition: Callable[[], Any], limit_s: float = 60.0) -> Any:
    """What `condition` returns once that is true. Fails after `limit_s`, more than even a busy
    computer needs."""
    end_s, pause = time.monotonic() + limit_s, threading.Event()
    while not (value := condition()):
        assert time.monotonic() < end_s, "waited in vain"
        pause.wait(0.003)
    return value


BEAT_S = 0.005


class Stopwatch:
    """How long something took, and for how long of it the processor was another's.

    Code under test that holds the interpreter's lock for longer than `BEAT_S`, in a call of C,
    counts as another program: such a hang cannot be measured with it.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.began_s = clock()
        self.starved_s = 0.0

    @property
    def took_s(self) -> float:
        """Without the time in which this process could not run: what it waited or worked for."""
        return self._clock() - self.began_s - self.starved_s

    def longest_call_s(
        self, call: Callable[[], object], pause: Callable[[], object], for_s: float
    ) -> float:
        """The longest of the calls that fit into `for_s`, with a pause behind each: from each only
        its own starvation is taken off. That may be noticed in the pause, hence both together."""
        end_s, longest_s = self._clock() + for_s, 0.0
        while (began_s := self._clock()) < end_s:
            starved_s = self.starved_s
            call()
            took_s = self._clock() - began_s
            pause()
            longest_s = max(longest_s, took_s - (self.starved_s - starved_s))
        return longest_s


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
