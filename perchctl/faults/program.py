"""Faults of the program itself: killed, suspended, hung, slow, raising. Simulated time passes while
the loop does not run."""

from __future__ import annotations

from collections.abc import Callable

from perchctl.faults.effects import FOR_EVER, Hung, Killed, Raises, Slow, Suspended
from perchctl.link import MockLink

LONGEST_S = 60.0
"""`FOR_EVER` of a program that hangs: then somebody kills it."""


class ProgramKilled(BaseException):
    """The program is gone; no `except Exception` of it sees that."""


class PlantedError(Exception):
    """An exception that a fault raises: unforeseen by the program, but not by the campaign."""


class FaultyClock:
    """The vehicle's own time. Faults happen where the loop waits for its next turn.

    `on_killed` cuts the uplink. `stop_s`: no flight goes on for longer.
    """

    def __init__(self, link: MockLink, on_killed: Callable[[], None], stop_s: float) -> None:
        self._link = link
        self._on_killed = on_killed
        self._stop_s = stop_s
        self._pending: Killed | Suspended | Hung | Raises | None = None
        self._slow: Slow | None = None
        self._slow_until_s = 0.0
        self._gone = False
        self.endless = False
        self.killed_s: float | None = None

    def begin(self, effect: Killed | Suspended | Hung | Slow | Raises, now_s: float) -> None:
        if isinstance(effect, Slow):
            self._slow, self._slow_until_s = effect, now_s + effect.for_s
        else:
            self._pending = effect

    def now(self) -> float:
        if self._gone:
            raise ProgramKilled  # it rescues nothing any more, and says nothing
        return self._link.now_s

    def wait_until(self, t_s: float) -> None:
        now_s = self._link.now_s
        if self._slow is not None and now_s < self._slow_until_s:
            t_s = max(t_s, now_s + self._slow.turn_s)
        if t_s > now_s and not self._gone:
            self._link.advance_to(t_s)
        effect, self._pending = self._pending, None
        match effect:
            case Killed():
                self._kill()
            case Suspended(for_s):
                # Past the link: none of the program's threads runs.
                self._link.vehicle.advance_to(self._link.now_s + for_s)
            case Hung(for_s):
                self._link.advance_to(self._link.now_s + min(for_s, LONGEST_S))
                if for_s >= FOR_EVER:
                    self._kill()
            case Raises():
                raise PlantedError("an exception that the fault raised")
        if self._link.now_s > self._stop_s:
            self.endless = True
            self._kill()
        if self._gone:
            raise ProgramKilled

    def _kill(self) -> None:
        if not self._gone:
            self._gone = True
            self.killed_s = self._link.now_s
            self._on_killed()
