"""The clock of a flight, which follows real time or the simulated vehicle's time."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from perchctl.children import SharedTime

SIM_PATIENCE_S = 5.0
"""Time without progress in the simulator after which the flight's clock continues with the wall
clock. This time is longer than the simulator's own wait for the loop."""
_CLOCK_POLL_S = 0.001


class Clock(Protocol):
    """The time and the waits of one flight, in seconds, real or simulated."""

    def now(self) -> float:
        """Return the current monotonic time, s."""

    def wait_until(self, t_s: float) -> None:
        """Wait until the clock reads `t_s`; return at once if that time has passed."""


class WallClock:
    """The `Clock` of real time."""

    def now(self) -> float:
        return time.monotonic()

    def wait_until(self, t_s: float) -> None:
        left_s = t_s - time.monotonic()
        if left_s > 0:
            time.sleep(left_s)


class SimulatedClock:
    """Clock for a simulator that runs in real time: simulator and flight loop wait for each other.

    The simulator advances the clock, so time stands still while a busy computer delays the
    simulator. Any thread may call `now`. `zero_s`: the clock's reading at the simulator's start,
    chosen so that the first reading agrees with `time.monotonic`.
    """

    def __init__(
        self,
        shared: SharedTime,
        wall: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._shared = shared
        self._wall, self._sleep = wall, sleep
        self._lock = threading.Lock()
        self._reached_s, self._moved_s = shared.reached_s, wall()
        self._now_s = self._moved_s
        self.zero_s = self._now_s - self._reached_s
        self._waits = False

    def now(self) -> float:
        with self._lock:
            wall_s, reached_s = self._wall(), self._shared.reached_s
            if reached_s != self._reached_s:
                self._reached_s, self._moved_s = reached_s, wall_s
                # Time that passed without the simulator is added permanently, so that the clock
                # never runs backwards.
                self.zero_s = max(self.zero_s, self._now_s - reached_s)
            alone_s = max(0.0, wall_s - self._moved_s - SIM_PATIENCE_S)
            self._now_s = max(self._now_s, self.zero_s + reached_s + alone_s)
            return self._now_s

    def wait_until(self, t_s: float) -> None:
        if self._waits:
            self._shared.limit_s = t_s - self.zero_s + self._shared.MARGIN_S
        while (left_s := t_s - self.now()) > 0:
            self._sleep(max(left_s, _CLOCK_POLL_S))

    @contextlib.contextmanager
    def waiting_for_loop(self) -> Iterator[None]:
        """Context manager: simulated time stops `MARGIN_S` after the time of each `wait_until`."""
        self._waits = True
        try:
            yield
        finally:
            self._waits = False
            self._shared.limit_s = math.inf
