"""The vehicle's milliseconds on the loop's clock."""

from __future__ import annotations

WRAP_MS = 1 << 24
"""Log time stamps have three bytes (docs/firmware.md, "Link")."""
CLOCK_SKEW = 1e-4
"""How fast the two clocks may run apart: far above a crystal's, far below a fault's."""
REBOOTED_MS = 1000
"""Stamps that fall back by more are those of another start; packets overtake by far less."""


class Timebase:
    """Maps log time stamps to the loop's clock by the fastest delivery seen so far.

    The smallest difference between arrival and stamp belongs to the packet that
    waited least; it may grow slowly, so that a drifting clock is followed. A vehicle that has
    started again is followed from its first stamp on; `start` counts how often it has.
    """

    def __init__(self) -> None:
        self.start = 0
        self._last_ms: int | None = None
        self._unwrapped_ms = 0
        self._offset_s: float | None = None
        self._last_arrival_s = 0.0

    def to_loop_s(self, stamp_ms: int, arrival_s: float) -> float:
        if self._last_ms is None:
            self._unwrapped_ms = stamp_ms
        else:
            step = (stamp_ms - self._last_ms) % WRAP_MS
            step = step - WRAP_MS if step > WRAP_MS // 2 else step
            self._unwrapped_ms += step
            if step < -REBOOTED_MS:
                self._offset_s = None
                self.start += 1
        self._last_ms = stamp_ms
        offset_s = arrival_s - self._unwrapped_ms / 1000.0
        if self._offset_s is None:
            self._offset_s = offset_s
        else:
            allowed = self._offset_s + CLOCK_SKEW * max(0.0, arrival_s - self._last_arrival_s)
            self._offset_s = min(offset_s, allowed)
        self._last_arrival_s = arrival_s
        return self._unwrapped_ms / 1000.0 + self._offset_s
