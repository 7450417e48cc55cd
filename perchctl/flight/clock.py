"""The one clock of a flight: of the wall, or of the simulated vehicle."""

from __future__ import annotations

import time
from datetime import datetime
from typing import Protocol


class Clock(Protocol):
    def now(self) -> float:
        """Seconds, monotonic."""

    def wait_until(self, t_s: float) -> None:
        """Return at `t_s`, or at once when it is past."""


class WallClock:
    """Real time."""

    def now(self) -> float:
        return time.monotonic()

    def wait_until(self, t_s: float) -> None:
        left_s = t_s - time.monotonic()
        if left_s > 0:
            time.sleep(left_s)


def wall_date() -> datetime:
    """Now, in this computer's time zone; for what is kept from one day to the next."""
    return datetime.now().astimezone()
