"""The feed in real time: a thread that turns it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

PERIOD_S = 0.01
END_TIMEOUT_S = 1.0


class Turned(Protocol):
    """What is told the time, and raises nothing."""

    def turn(self, now_s: float) -> None: ...


class FeedThread:
    """Turns `feed` every `period_s` from `start` until `close`.

    `clock`: seconds, monotonic, the flight loop's. A turn may hang in the library of the link;
    then `PositionFeed.status` says so, and `close` does not wait for it for long.
    """

    def __init__(
        self, feed: Turned, clock: Callable[[], float], period_s: float = PERIOD_S
    ) -> None:
        self._feed, self._clock, self._period_s = feed, clock, period_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="perchctl-positions", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """No position is sent any more."""
        self._ended.set()
        if self._thread.ident is not None:
            self._thread.join(END_TIMEOUT_S)

    def _run(self) -> None:
        due_s = self._clock()
        while not self._ended.is_set():
            self._feed.turn(self._clock())
            due_s = max(due_s + self._period_s, self._clock() - self._period_s)
            self._ended.wait(max(0.0, due_s - self._clock()))
