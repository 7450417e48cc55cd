"""Products of long rows, a value for each node of a square grid.

They are taken block by block: large products wake threads, which cost more than they
save, and far more on a busy machine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array

_BLOCK = 256  # values of a row


@dataclass(frozen=True, eq=False)
class Basis:
    """Rows (k, n) by which pictures are explained, and their products (k, k)."""

    rows: Array
    products: Array


def make_basis(rows: Array) -> Basis:
    return Basis(rows, gram(rows))


def gram(rows: Array) -> Array:
    """Products (k, k) of rows (k, n) with each other."""
    k, n = rows.shape
    whole = n - n % _BLOCK
    blocks = rows[:, :whole].reshape(k, -1, _BLOCK).transpose(1, 0, 2)
    rest = rows[:, whole:]
    total = np.matmul(blocks, blocks.transpose(0, 2, 1)).sum(axis=0)
    return np.asarray(total + rest.dot(rest.T))


def onto(rows: Array, values: Array) -> Array:
    """Products (k,) of the rows (k, n) with values (n,)."""
    return np.asarray(np.einsum("kn,n->k", rows, values))


def mixed(rows: Array, coefficients: Array) -> Array:
    """The rows (k, n) times coefficients (k,)."""
    return np.asarray(np.einsum("kn,k->n", rows, coefficients))
