"""Least squares of misfits (n, 3) in which wrong poses count little, and what it leaves uncertain.

A pose whose timestamp is off errs along the vehicle's rotation, by the rate times the jitter. Its
own covariance is taken as true up to a factor. Both are found from the misfits, which are counted
as Student's t with few degrees of freedom, so that wrong poses do not bend them.
"""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit

from perchctl.geometry import Array

SIGMAS_95 = 1.96
"""Standard deviations to each side of a 95 % interval."""
FREEDOM = 5.0
BLOCKS = 15
_LEAST_KNOWN = 1e-10
"""Share of a parameter's information that keeps one finite which nothing holds."""
_FACTORS = np.geomspace(0.4, 12.0, 18)
_JITTERS_S = 1e-3 * np.concatenate([np.arange(0.0, 12.0), np.geomspace(13.0, 30.0, 4)])


def squared_distance(misfit: Array, inverse: Array) -> Array:
    """Return the squared size, in standard deviations, (n,), of misfits (n, 3) by their inverse
    covariances (n, 3, 3)."""
    return np.asarray(np.einsum("ni,nij,nj->n", misfit, inverse, misfit))


def student_weights(distance2: Array) -> Array:
    """Return how much each misfit counts, (n,), by its squared distance: most where it is 0."""
    return np.asarray((FREEDOM + 3) / (FREEDOM + distance2))


def normal_equations(
    design: Array, misfit: Array, inverse: Array, counted: Array
) -> tuple[Array, Array]:
    """Return information (p, p) and gradient (p,) by a design (n, 3, p): the step to the least
    misfit is information^-1 gradient."""
    weighted = (inverse * counted[:, None, None]) @ design
    p = design.shape[2]
    flat = weighted.reshape(-1, p)
    return design.reshape(-1, p).T @ flat, -flat.T @ misfit.ravel()


def robust_least_squares(
    design: Array, right: Array, inverse: Array, rounds: int
) -> tuple[Array, Array, Array]:
    """Solve ``design @ x = right`` (n, 3): x (p,), the misfits (n, 3) and how much each counts.

    Args:
        inverse: covariances of the right-hand sides, inverted, (n, 3, 3).
    """
    counted = np.ones(len(right))
    for _ in range(rounds):
        information, gradient = normal_equations(design, -right, inverse, counted)
        found = np.asarray(np.linalg.solve(information, gradient), dtype=np.float64)
        misfit = design @ found - right
        counted = student_weights(squared_distance(misfit, inverse))
    return found, misfit, counted


def inverses(cov: Array, factor: float, along: Array, jitter_s: float) -> Array:
    """Return the inverses (n, 3, 3) of ``factor^2 cov + jitter^2 along along^T``."""
    late = jitter_s**2 * along[:, :, None] * along[:, None, :]
    return np.asarray(np.linalg.inv(factor**2 * cov + late))


def estimate_noise(misfit: Array, cov: Array, along: Array | None = None) -> tuple[float, float]:
    """Return the likeliest factor and jitter in s of misfits (n, 3) with claimed covariances
    (n, 3, 3); `along` (n, 3) is what a second of delay does to each (None: no jitter)."""
    jitters_s = _JITTERS_S if along is not None else _JITTERS_S[:1]
    along = np.zeros_like(misfit) if along is None else along
    inverse = np.asarray(np.linalg.inv(cov))
    own = squared_distance(misfit, inverse)
    mixed = np.einsum("ni,nij,nj->n", along, inverse, misfit)
    late = squared_distance(along, inverse)
    best = (np.inf, 1.0, 0.0)
    for factor in _FACTORS:
        for jitter_s in jitters_s:
            # As `inverses`, without the matrices.
            share = (jitter_s / factor) ** 2
            grown = 1.0 + share * late
            d2 = (own - share * mixed**2 / grown) / factor**2
            size = 0.5 * np.log(grown) + 3 * np.log(factor)
            cost = float((size + 0.5 * (FREEDOM + 3) * np.log1p(d2 / FREEDOM)).sum())
            best = min(best, (cost, float(factor), float(jitter_s)))
    return best[1], best[2]


def covariance(
    design: Array, misfit: Array, inverse: Array, counted: Array, known: Array, first: int
) -> Array:
    """Return the covariance of the first parameters at a minimum: the inverse information, or
    what leaving out each block of pictures in turn (the jackknife) shows where that is more, since
    the errors of neighbouring pictures go together.

    Args:
        design (n, 3, p), misfit (n, 3), inverse (n, 3, 3), counted (n,): of the poses, by time.
        known: information (p, p) beside theirs.
    """
    blocks = [
        normal_equations(design[k], misfit[k], inverse[k], counted[k])
        for k in np.array_split(np.arange(len(misfit)), BLOCKS)
    ]
    curved, sure = _robust_shares(squared_distance(misfit, inverse)[counted > 0.0])
    seen = curved * np.sum([information for information, _ in blocks], axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(known + seen), 1e-300))
    both = np.outer(scale, scale)
    known = known + np.diag(_LEAST_KNOWN / scale**2)
    inverted = np.asarray(np.linalg.inv((known + sure * seen) * both))[:first, :first]
    moves = np.array(
        [
            np.linalg.solve((known + seen - curved * information) * both, scale * gradient)[:first]
            for information, gradient in blocks
        ]
    )
    spread = (BLOCKS - 1) * moves.var(axis=0) * student_factor(BLOCKS - 1) ** 2
    # Each parameter by itself: all together would be more than the blocks can tell.
    grown = np.sqrt(np.maximum(spread / np.diagonal(inverted), 1.0)) * scale[:first]
    return np.asarray(inverted * np.outer(grown, grown))


def _robust_shares(distance2: Array) -> tuple[float, float]:
    """Return what the weights make of the normal equations: by which factor the cost is truly
    curved, as a weight sinks with the distance, and by which the information is then less or more
    than the inverse of the estimate's spread (an M-estimator's sandwich)."""
    w = student_weights(distance2)
    curved = float((w * (1.0 - 2.0 * distance2 / (3 * (FREEDOM + distance2)))).mean())
    pushed = float((w**2 * distance2).mean()) / 3
    return curved / float(w.mean()), curved / max(pushed, 1e-9)


def student_factor(freedom: int) -> float:
    """Return half the width of a 95 % interval whose spread was estimated from so many values, over
    the normal distribution's; below 3 degrees of freedom that of 3."""
    return float(stdtrit(max(freedom, 3), 0.975)) / SIGMAS_95
