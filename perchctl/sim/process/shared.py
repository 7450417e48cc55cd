"""Simulated time, shared by the simulated vehicle's process and the flight's."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

CLOCK_MARGIN_S = 0.02
"""Simulated time may run so far past the moment that the flight loop waits for."""
LOOP_PATIENCE_S = 2.0
"""The simulator waits so long, on the wall's clock, for a loop that gives no sign of life."""


class SharedTime:
    """Two numbers in a file that both processes map.

    `reached_s` is how far simulated time has come; the simulator writes it. `limit_s` is how far
    it may go; the flight writes it, and infinity lets time run freely. Without a file they belong
    to one process.
    """

    def __init__(self, file: Path | None = None) -> None:
        if file is None:
            self._values = np.array([0.0, math.inf])
        else:
            self._values = np.memmap(file, np.float64, "r+")

    @classmethod
    def create(cls, file: Path) -> SharedTime:
        np.array([0.0, math.inf]).tofile(file)
        return cls(file)

    @property
    def reached_s(self) -> float:
        return float(self._values[0])

    @reached_s.setter
    def reached_s(self, t_s: float) -> None:
        self._values[0] = t_s

    @property
    def limit_s(self) -> float:
        return float(self._values[1])

    @limit_s.setter
    def limit_s(self, t_s: float) -> None:
        self._values[1] = t_s
