"""How far single poses are off: more than they claim, by their timestamps, and some altogether.

A pose whose timestamp is off errs along the vehicle's turn, by the rate times the jitter. Its own
covariance is taken as true up to a factor. Both are found from the misfits, which are counted as
Student's t with few degrees of freedom, so that wrong poses do not bend them.
"""

from __future__ import annotations

import numpy as np

from perchctl.geometry import Array

FREEDOM = 5.0
_FACTORS = np.geomspace(0.4, 12.0, 18)
_JITTERS_S = (
    np.array(
        [
            0.0,
            0.5,
            1.0,
            1.5,
            2.0,
            3.0,
            4.0,
            5.0,
            6.0,
            7.0,
            8.0,
            9.0,
            10.0,
            11.5,
            13.0,
            17.0,
            22.0,
            30.0,
        ]
    )
    * 1e-3
)


def squared_distance(misfit: Array, inverse: Array) -> Array:
    """In standard deviations, (n,), of misfits (n, k) by inverse covariances (n, k, k)."""
    return np.asarray(np.einsum("ni,nij,nj->n", misfit, inverse, misfit))


def weights(distance2: Array, size: int) -> Array:
    """How much each counts, by Student's t, (n,): 1 where nothing is off."""
    return np.asarray((FREEDOM + size) / (FREEDOM + distance2))


def robust_shares(distance2: Array, size: int) -> tuple[float, float]:
    """What the weights make of the normal equations: by which factor the cost is truly curved, as
    a weight sinks with the distance, and by which the information is then less or more than the
    inverse of the estimate's spread (an M-estimator's sandwich)."""
    w = weights(distance2, size)
    curved = float((w * (1.0 - 2.0 * distance2 / (size * (FREEDOM + distance2)))).mean())
    pushed = float((w**2 * distance2).mean()) / size
    return curved / float(w.mean()), curved / max(pushed, 1e-9)


def inverses(cov: Array, factor: float, along: Array, jitter_s: float) -> Array:
    """Inverses (n, k, k) of ``factor^2 cov + jitter^2 along along^T``."""
    inverse = np.asarray(np.linalg.inv(cov)) / factor**2
    turned = np.einsum("nij,nj->ni", inverse, along) * jitter_s
    grown = 1.0 + jitter_s * np.einsum("ni,ni->n", turned, along)
    return np.asarray(inverse - turned[:, :, None] * turned[:, None, :] / grown[:, None, None])


def likeliest(misfit: Array, cov: Array, along: Array | None = None) -> tuple[float, float]:
    """Factor and jitter of misfits (n, k) with claimed covariances (n, k, k); `along` (n, k) is
    what a second of delay does to each."""
    k = misfit.shape[1]
    jitters_s = _JITTERS_S if along is not None else _JITTERS_S[:1]
    along = np.zeros_like(misfit) if along is None else along
    inverse = np.asarray(np.linalg.inv(cov))
    logdet = -np.linalg.slogdet(inverse)[1]
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
            size = 0.5 * (logdet + np.log(grown)) + k * np.log(factor)
            cost = float((size + 0.5 * (FREEDOM + k) * np.log1p(d2 / FREEDOM)).sum())
            best = min(best, (cost, float(factor), float(jitter_s)))
    return best[1], best[2]
