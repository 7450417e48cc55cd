"""The covariance of a least-squares solution whose errors go together within a block of rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from perchctl.geometry import Array

SIGMAS_95 = 1.96
"""Standard deviations to each side of a 95 % interval."""
_LEAST_KNOWN = 1e-10
"""Share of a parameter's information that keeps one finite which nothing holds."""


def jackknife_covariance(
    blocks: Sequence[tuple[Array, Array]], known: Array, curved: float = 1.0, sure: float = 1.0
) -> Array:
    """Return the covariance (p, p) at a minimum: the inverse information, or what leaving out each
    block in turn (the jackknife) shows where that is more.

    Args:
        blocks: information J' J (p, p) and gradient J' r (p,) of each block of rows.
        known: information (p, p) beside theirs.
        curved: by which factor a robust cost is curved less than `blocks` say.
        sure: by which factor its information is less or more than they say.
    """
    seen = np.sum([information for information, _ in blocks], axis=0)
    # Unlike units are brought to one scale.
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(known + curved * seen), 1e-300))
    both = np.outer(scale, scale)
    known = known + np.diag(_LEAST_KNOWN / scale**2)
    inverted = np.asarray(np.linalg.inv((known + curved * sure * seen) * both))
    moves = np.array(
        [
            np.linalg.solve((known + curved * (seen - information)) * both, scale * gradient)
            for information, gradient in blocks
        ]
    )
    count = len(blocks)
    spread = (count - 1) * moves.var(axis=0) * student_factor(count - 1) ** 2
    # Each parameter by itself: all together would be more than the blocks can tell.
    grown = np.sqrt(np.maximum(spread / np.diagonal(inverted), 1.0)) * scale
    return np.asarray(inverted * np.outer(grown, grown))


def student_factor(freedom: int) -> float:
    """Return half the width of a 95 % interval whose spread was estimated from so many values, over
    the normal distribution's; below 3 degrees of freedom that of 3."""
    return float(stdtrit(max(freedom, 3), 0.975)) / SIGMAS_95
