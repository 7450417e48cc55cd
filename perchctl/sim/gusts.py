"""Single gusts: a door, a passer-by, an air conditioner that starts.

Each is the "one minus cosine" by which gusts are modelled in aviation (MIL-F-8785C): smooth
from nothing to its peak and back, once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Gust:
    """Blows from `start_s` for `length_s`, at the most with `peak_mps` (world axes)."""

    start_s: float
    length_s: float
    peak_mps: Vector


def blown(gusts: Sequence[Gust], t_s: float) -> Vector:
    """What all of them add to the wind at that time, m/s."""
    x = y = z = 0.0
    for gust in gusts:
        phase = (t_s - gust.start_s) / gust.length_s
        if 0.0 < phase < 1.0:
            share = 0.5 * (1.0 - math.cos(2.0 * math.pi * phase))
            px, py, pz = gust.peak_mps
            x, y, z = x + share * px, y + share * py, z + share * pz
    return (x, y, z)
