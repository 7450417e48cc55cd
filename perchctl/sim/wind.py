"""The draught in the room: a mean wind with smooth gusts of the same order."""

from __future__ import annotations

import math

import numpy as np

from perchctl.sim.scenario import Scenario

_TERMS = 5
_SLOWEST_HZ, _FASTEST_HZ = 0.05, 1.0
_SHARES = (0.6, 0.6, 0.3)  # standard deviation of the gusts over the mean speed: x, y, z
_STREAM = 1

_Terms = tuple[tuple[float, float, float], ...]


class Wind:
    """A few sines of seeded frequency and phase on top of `Scenario.draught_mps`."""

    def __init__(self, scenario: Scenario) -> None:
        self._mean = scenario.draught_mps
        speed_mps = math.sqrt(sum(v * v for v in self._mean))
        rng = np.random.default_rng([scenario.seed, _STREAM])
        self._still = speed_mps == 0.0
        self._gusts = tuple(_draw(rng, share * speed_mps) for share in _SHARES)

    def at(self, t_s: float) -> tuple[float, float, float]:
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
