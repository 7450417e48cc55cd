"""Products of tall matrices, a row for each node of a square grid.

They are taken block by block: large products wake threads, which cost more than they
save, and far more on a busy machine.
"""

from __future__ import annotations

import math

import numpy as np

from perchctl.geometry import Array


def gram(A: Array, B: Array) -> Array:
    """A^T B of tall matrices (n * n, a) and (n * n, b)."""
    n = math.isqrt(len(A))
    blocks = np.matmul(A.reshape(n, n, -1).transpose(0, 2, 1), B.reshape(n, n, -1))
    return np.asarray(blocks.sum(axis=0))


def mixed(columns: Array, coefficients: Array) -> Array:
    """The columns (r, k) times coefficients (k,)."""
    return np.asarray(np.einsum("rk,k->r", columns, coefficients))
