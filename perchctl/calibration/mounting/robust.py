"""Least squares of misfits (n, 3) in which wrong poses count little, and what it leaves uncertain.

A pose's own covariance is taken as true up to a factor, and a pose whose timestamp is off errs
along the vehicle's rotation, by the rate times the jitter. Both are found from the misfits, which
are counted as Student's t with few degrees of freedom, so that wrong poses do not bend them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.jackknife import jackknife_covariance
from perchctl.geometry import Array

FREEDOM = 5.0
BLOCKS = 15
MOST_LEFT_OUT = 0.4
_COUNTS_LITTLE = 0.2
_JITTERS_S = 1e-3 * np.concatenate([np.arange(0.0, 12.0), np.geomspace(13.0, 30.0, 4)])
_MEDIAN_OF_CHI2 = 2.366  # with three degrees of freedom


@dataclass(frozen=True, eq=False)
class Rows:
    """Misfits (n, 3) of poses in the order of time, their derivative `design` (n, 3, p), inverse
    covariances (n, 3, 3), how much each counts (n,), and the information (p, p) beside theirs."""

    design: Array
    misfit: Array
    inverse: Array
    counted: Array
    known: Array

    @property
    def distance2(self) -> Array:
        """Squared size of each misfit in standard deviations, (n,)."""
        return _distance2(self.misfit, self.inverse)

    @property
    def left_out(self) -> float:
        """Share of the poses that hardly count."""
        return float((self.counted < _COUNTS_LITTLE).mean())

    def normal_equations(self, some: slice | NDArray[np.intp] = slice(None)) -> tuple[Array, Array]:
        """Return information (p, p) and gradient (p,) of some of the poses."""
        p = self.design.shape[2]
        design = self.design[some]
        counted = self.counted[some, None, None]
        weighted = ((self.inverse[some] * counted) @ design).reshape(-1, p)
        return design.reshape(-1, p).T @ weighted, -weighted.T @ self.misfit[some].ravel()

    def step(self, pulled: Array | float = 0.0) -> Array:
        """Return the Gauss-Newton step (p,) to the least misfit; `pulled` (p,) is what `known`
        pulls to zero of the parameters."""
        information, gradient = self.normal_equations()
        pull = self.known @ np.broadcast_to(pulled, gradient.shape)
        return np.asarray(np.linalg.solve(information + self.known, gradient - pull))

    def moved(self, step: Array) -> Rows:
        """Return the rows after a step (p,) of a linear problem."""
        misfit = self.misfit + self.design @ step
        return replace(self, misfit=misfit, counted=_weights(_distance2(misfit, self.inverse)))

    def covariance(self) -> Array:
        """Return the covariance (p, p) at the minimum, also where the errors of neighbouring
        pictures go together."""
        blocks = [
            self.normal_equations(k) for k in np.array_split(np.arange(len(self.misfit)), BLOCKS)
        ]
        return jackknife_covariance(blocks, self.known, *_robust_shares(self.distance2))


def weighed_rows(
    design: Array, misfit: Array, cov: Array, known: Array, late: Array | None = None
) -> Rows:
    """Return the rows of poses whose misfits have these covariances (n, 3, 3), up to a factor, and
    beside it, where `late` (n, 3) says what a second of delay does to each, by the likeliest
    jitter of their timestamps."""
    best_cost, best = np.inf, cov
    for jitter_s in (0.0,) if late is None else _JITTERS_S:
        spread = cov
        if late is not None:
            spread = cov + jitter_s**2 * late[:, :, None] * late[:, None, :]
        inverse = np.asarray(np.linalg.inv(spread))
        distance2 = _distance2(misfit, inverse)
        factor2 = float(np.median(distance2)) / _MEDIAN_OF_CHI2
        size = np.linalg.slogdet(factor2 * spread)[1]
        tail = (FREEDOM + 3) * np.log1p(distance2 / factor2 / FREEDOM)
        cost = float((size + tail).sum())
        if cost < best_cost:
            best_cost = cost
            best = inverse / factor2
    return Rows(design, misfit, best, _weights(_distance2(misfit, best)), known)


def _distance2(misfit: Array, inverse: Array) -> Array:
    return np.asarray(np.einsum("ni,nij,nj->n", misfit, inverse, misfit))


def _weights(distance2: Array) -> Array:
    return np.asarray((FREEDOM + 3) / (FREEDOM + distance2))


def _robust_shares(distance2: Array) -> tuple[float, float]:
    """Return what the weights make of the normal equations: by which factor the cost is truly
    curved, as a weight sinks with the distance, and by which the information is then less or more
    than the inverse of the estimate's spread (an M-estimator's sandwich)."""
    w = _weights(distance2)
    curved = float((w * (1.0 - 2.0 * distance2 / (3 * (FREEDOM + distance2)))).mean())
    pushed = float((w**2 * distance2).mean()) / 3
    return curved / float(w.mean()), curved / max(pushed, 1e-9)
