"""Student's t for intervals over a handful of positions."""

from __future__ import annotations

import math
from functools import cache
from statistics import NormalDist

import numpy as np

from perchctl.geometry import Array

LEVEL = 0.95


@cache
def quantile(freedom: int, level: float = LEVEL) -> float:
    """The two-sided quantile: |t| stays below it with probability `level`.

    Exact (Abramowitz and Stegun 26.7.3 and 26.7.4, inverted by bisection) up to 200
    degrees of freedom, above that by the first terms of their 26.7.5.
    """
    if freedom < 1:
        return math.inf
    if freedom > 200:
        x = NormalDist().inv_cdf(0.5 + level / 2.0)
        g1 = (x**3 + x) / 4.0
        g2 = (5 * x**5 + 16 * x**3 + 3 * x) / 96.0
        return x + g1 / freedom + g2 / freedom**2
    low, high = 0.0, 1.0
    while _within(high, freedom) < level:
        high *= 2.0
    for _ in range(100):
        middle = (low + high) / 2.0
        low, high = (middle, high) if _within(middle, freedom) < level else (low, middle)
    return (low + high) / 2.0


def _within(t: float, freedom: int) -> float:
    """P(|T| < t)."""
    theta = math.atan(t / math.sqrt(freedom))
    c2 = math.cos(theta) ** 2
    if freedom % 2:
        term = total = math.cos(theta) if freedom > 1 else 0.0
        for k in range(3, freedom - 1, 2):
            term *= (k - 1) / k * c2
            total += term
        return 2.0 / math.pi * (theta + math.sin(theta) * total)
    term = total = 1.0
    for k in range(2, freedom - 1, 2):
        term *= (k - 1) / k * c2
        total += term
    return math.sin(theta) * total


def half_width(values: Array, level: float = LEVEL) -> Array:
    """Of the interval of the mean of `values` (g, ...), over the first axis."""
    g = len(values)
    if g < 2:
        return np.full(values.shape[1:], np.inf)
    return np.asarray(quantile(g - 1, level) * values.std(axis=0, ddof=1) / math.sqrt(g))
