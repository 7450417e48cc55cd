"""The air in the room: a draught with smooth gusts, together up to a given speed."""

from __future__ import annotations

import math

import numpy as np

from perchctl.sim.scenario import Scenario

Vector = tuple[float, float, float]

_TERMS = 5
_SLOWEST_HZ, _FASTEST_HZ = 0.05, 1.0
_STEADY = 0.7  # the steady part of the draught's speed
_SHARES = (0.15, 0.15, 0.1)  # standard deviation of the gusts over that speed: x, y, z
_STREAM = 1

_Terms = tuple[tuple[float, float, float], ...]


class Wind:
    """`Scenario.draught_mps` is the speed that the gusts reach at two standard deviations."""

    def __init__(self, scenario: Scenario) -> None:
        draught = scenario.draught_mps
        x, y, z = draught
        self._mean = (_STEADY * x, _STEADY * y, _STEADY * z)
        speed_mps = math.hypot(*draught)
        rng = np.random.default_rng([scenario.seed, _STREAM])
        self._still = speed_mps == 0.0
        self._gusts = tuple(_draw(rng, share * speed_mps) for share in _SHARES)

    def at(self, t_s: float) -> Vector:
        """The wind at t, m/s, world axes; exactly zero in still air."""
        if self._still:
            return (0.0, 0.0, 0.0)
        x, y, z = self._mean
        gust_x, gust_y, gust_z = self._gusts
        return (x + _sum(gust_x, t_s), y + _sum(gust_y, t_s), z + _sum(gust_z, t_s))


def _draw(rng: np.random.Generator, sigma_mps: float) -> _Terms:
    """(amplitude m/s, pulsation rad/s, phase) of each sine."""
    amplitude = sigma_mps * math.sqrt(2.0 / _TERMS)
    hz = np.exp(rng.uniform(math.log(_SLOWEST_HZ), math.log(_FASTEST_HZ), _TERMS))
    phases = rng.uniform(0.0, 2.0 * math.pi, _TERMS)
    return tuple(
        (amplitude, 2.0 * math.pi * float(f), float(phase))
        for f, phase in zip(hz, phases, strict=True)
    )


def _sum(terms: _Terms, t_s: float) -> float:
    return sum(a * math.sin(w * t_s + phase) for a, w, phase in terms)
