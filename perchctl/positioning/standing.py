"""A vehicle that stands at the origin: what its estimator is told while it is reset, where the
target is the positioning system and has not been measured yet."""

from __future__ import annotations

import math
import threading

import numpy as np

from perchctl.positioning.feed import BUSY, FeedStatus, Send
from perchctl.positioning.judge import Placed
from perchctl.vehicle import ExternalPosition


class StandingFeed:
    """`turn` by a `FeedThread`; `status` and `place` from any thread."""

    def __init__(self, send: Send, ground_z_m: float) -> None:
        self._send, self._place = send, ExternalPosition((0.0, 0.0, ground_z_m))
        self._lock = threading.Lock()
        self._sent_s, self._count = -math.inf, 0
        self._problem: str | None = None

    def turn(self, now_s: float) -> None:
        """Raises nothing: what goes wrong is the status's problem."""
        try:
            problem = BUSY if self._send(self._place) is False else None
        except Exception as error:  # of the link
            problem = f"the position cannot be passed on: {type(error).__name__}: {error}"
        with self._lock:
            self._problem = problem
            if problem is None:
                self._sent_s, self._count = now_s, self._count + 1

    def status(self, now_s: float) -> FeedStatus:
        with self._lock:
            age_s = now_s - self._sent_s
            return FeedStatus(age_s, self._problem, self._count, self._place)

    def place(self) -> Placed:
        """Level, with its front along x: so the world is defined."""
        return Placed(self._sent_s, np.array(self._place.position_m), np.eye(3))
