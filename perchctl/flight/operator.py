"""The operator's commands: Ctrl-C, the other signals, and the live page's STOP button."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from perchctl.errors import Interrupted
from perchctl.mission.state import Operator

AGAIN_S = 0.5
"""A second press counts this long after the first."""
HELD_S = 0.12
"""Presses that follow each other faster are one key held down: keyboards repeat at 10 to
33 Hz, after 0.25 to 0.7 s."""


@dataclass
class OperatorSwitch:
    """Ctrl-C as the planner understands it: once lands, twice stops.

    `press` is Ctrl-C. A key held down is one press, so a second press counts once no third
    has followed it within `HELD_S`. `land` is for STOP on the live page and for the signals
    that ask a program to end: it lands as one Ctrl-C does, however often it comes, and never
    adds up to a stop of the motors. All are safe from any thread.

    Until the flight loop listens there is nothing to land: `leave` raises `Interrupted`.
    """

    listening: bool = False
    landing_requested: bool = False
    clock: Callable[[], float] = time.monotonic
    _first_s: float | None = None
    _last_s: float = 0.0
    _second_s: float | None = None
    _stopped: bool = False

    def read(self) -> Operator:
        self._confirm(self.clock())
        if self._stopped:
            return Operator.STOP
        pressed = self._first_s is not None or self.landing_requested
        return Operator.LAND if pressed else Operator.NONE

    def land(self) -> None:
        self.landing_requested = True

    def press(self) -> None:
        now_s = self.clock()
        self._confirm(now_s)
        if self._first_s is None:
            self._first_s = now_s
        elif now_s - self._last_s < HELD_S:
            self._second_s = None
        elif now_s - self._first_s >= AGAIN_S:
            self._second_s = now_s
        self._last_s = now_s

    def leave(self) -> None:
        """On a signal, in the main thread."""
        if not self.listening:
            raise Interrupted("interrupted before take-off: nothing was started")

    def _confirm(self, now_s: float) -> None:
        second_s = self._second_s
        if second_s is not None and now_s - second_s >= HELD_S:
            self._stopped = True
