"""How far the lens parameters may be off.

Two estimates are made. The first takes the corners' errors as independent: the residuals'
variance times the inverse of the normal equations. The second uses the views: errors
within a view go together (blur, a bent board, a moving camera), so each view is left out
once, in the linear approximation, and the spread of those solutions is the covariance
(the jackknife over clusters). In every direction of parameter space the larger of the
two counts.
"""

from __future__ import annotations

import numpy as np

from perchctl.calibration.bundle import Fit, reduced_blocks
from perchctl.geometry import Array


def lens_covariance(fit: Fit) -> Array:
    """Covariance of the lens parameters (p, p); infinite where the views leave one free."""
    blocks = reduced_blocks(fit)
    p = len(fit.parameters)
    information = np.sum([A.T @ A for A, _ in blocks], axis=0) + np.diag(fit.prior)
    d = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    scaled = information * d[:, None] * d[None]
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < 1e-13:
        return np.diag(np.full(p, np.inf))
    inverse = (vectors / values) @ vectors.T
    rows = sum(len(r) for _, r in blocks)
    free = max(rows - p - 6 * len(blocks), 1)
    noise2 = sum(float(r @ r) for _, r in blocks) / free
    independent = noise2 * inverse
    return _larger(independent, _jackknife(blocks, scaled, d)) * d[:, None] * d[None]


def _jackknife(blocks: list[tuple[Array, Array]], scaled: Array, d: Array) -> Array:
    """Spread of the solutions without one view each, in scaled parameters, (p, p)."""
    p, v = len(d), len(blocks)
    moves = []
    for A, r in blocks:
        As = A * d[None]
        rest = scaled - As.T @ As
        # A view that alone fixes a direction would be infinite: the floor keeps it finite.
        values, vectors = np.linalg.eigh(rest)
        values = np.maximum(values, 1e-3 * np.linalg.eigvalsh(scaled)[0])
        moves.append((vectors / values) @ (vectors.T @ (As.T @ r)))
    spread = np.array(moves)
    spread -= spread.mean(axis=0)
    return np.asarray((v - 1) / v * spread.T @ spread) if v > 1 else np.zeros((p, p))


def _larger(a: Array, b: Array) -> Array:
    """The smallest covariance that is nowhere below a, and as large as b along each axis
    in which b exceeds a (axes of b in units of a)."""
    root = np.linalg.cholesky(a + 1e-15 * np.trace(a) * np.eye(len(a)))
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    lifted = root @ vectors
    return np.asarray((lifted * np.maximum(values, 1.0)) @ lifted.T)
