"""A simulated vehicle in a hand: carried from stop to stop, smoothly, and turned on the way."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perchctl.errors import InvalidValue
from perchctl.geometry import Array, rotation_from_rpy

_STEP_S = 1e-4


@dataclass(frozen=True)
class Stop:
    """Reached `after_s` after the one before, at rest."""

    after_s: float
    position_m: tuple[float, float, float]
    rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Motion:
    """At one moment, world axes; `rates_radps` (3,) in the body's, as a gyroscope has them."""

    position_m: Array
    velocity_mps: Array
    acceleration_mps2: Array
    R: Array
    rates_radps: Array


class Way:
    """The way through all stops, from where the vehicle is; at the last it is held still.

    Errors: InvalidValue for a stop that takes no time.
    """

    def __init__(self, start: Stop, stops: Sequence[Stop]) -> None:
        for stop in stops:
            if not stop.after_s > 0.0:
                raise InvalidValue(f"a hand needs time for its way, not {stop.after_s:g} s")
        self._stops = (start, *stops)
        self._ends_s = (0.0, *itertools.accumulate(stop.after_s for stop in stops))

    def at(self, t_s: float) -> Motion:
        """`t_s`: since it was taken in the hand."""
        before, here, after = (self._pose(t_s + k * _STEP_S) for k in (-1, 0, 1))
        turn = before[1].T @ after[1]  # so small a turn is its own vector
        rates = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / (2.0 * _STEP_S)
        return Motion(
            here[0],
            (after[0] - before[0]) / (2.0 * _STEP_S),
            (after[0] - 2.0 * here[0] + before[0]) / _STEP_S**2,
            here[1],
            rates,
        )

    def _pose(self, t_s: float) -> tuple[Array, Array]:
        """Place (3,) and turn (3, 3)."""
        t_s = min(max(t_s, 0.0), self._ends_s[-1])
        leg = next(n for n, end_s in enumerate(self._ends_s) if t_s <= end_s)
        if leg == 0:
            stop = self._stops[0]
            return np.asarray(stop.position_m), rotation_from_rpy(*stop.rpy_rad)
        one, other = self._stops[leg - 1], self._stops[leg]
        share = (t_s - self._ends_s[leg - 1]) / other.after_s
        # At both ends neither speed nor acceleration.
        share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        place, rpy = (
            np.asarray(a) + share * (np.asarray(b) - np.asarray(a))
            for a, b in ((one.position_m, other.position_m), (one.rpy_rad, other.rpy_rad))
        )
        return place, rotation_from_rpy(*(float(angle) for angle in rpy))
