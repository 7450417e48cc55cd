"""Products of tall matrices, a row for each node of a square grid.

They are taken block by block: large products wake threads, which cost more than they
save, and far more on a busy machine.
"""

from __future__ import annotations

import numpy as np

from perchctl.geometry import Array

_BLOCK = 256  # rows


def gram(A: Array, B: Array) -> Array:
    """A^T B of tall matrices (rows, a) and (rows, b)."""
    whole = len(A) - len(A) % _BLOCK
    left, right = (M[:whole].reshape(-1, _BLOCK, M.shape[1]) for M in (A, B))
    total = np.matmul(left.transpose(0, 2, 1), right).sum(axis=0)
    return np.asarray(total + A[whole:].T.dot(B[whole:]))


def mixed(columns: Array, coefficients: Array) -> Array:
    """The columns (r, k) times coefficients (k,)."""
    return np.asarray(np.einsum("rk,k->r", columns, coefficients))
