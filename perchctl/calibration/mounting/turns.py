"""Many rotations at once: vectors (n, 3) in rad to matrices (n, 3, 3) and back."""

from __future__ import annotations

import numpy as np

from perchctl.geometry import Array

_SMALL = 1e-6
_NEAR_HALF_TURN_RAD = 3.1


def cross_matrix(v: Array) -> Array:
    """``[v]x`` (..., 3, 3) of vectors (..., 3)."""
    out = np.zeros((*v.shape, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    out[..., 0, 1], out[..., 0, 2] = -z, y
    out[..., 1, 0], out[..., 1, 2] = z, -x
    out[..., 2, 0], out[..., 2, 1] = -y, x
    return out


def rotation_matrices(v: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    small = angle < _SMALL
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    K = cross_matrix(v)
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def rotation_vectors(R: Array) -> Array:
    """Rotation vectors (n, 3), no longer than pi, of matrices (n, 3, 3)."""
    v = 0.5 * np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    sine = np.linalg.norm(v, axis=1)
    cosine = 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0)
    angle = np.arctan2(sine, cosine)
    out = v * np.where(sine < _SMALL, 1.0, angle / np.maximum(sine, _SMALL))[:, None]
    for k in np.flatnonzero(angle > _NEAR_HALF_TURN_RAD):
        # The sine says nothing there: the axis is R + R^T's, its sign the sine's.
        values, vectors = np.linalg.eigh(R[k] + R[k].T)
        axis = vectors[:, int(np.argmax(values))]
        out[k] = angle[k] * (axis if axis @ v[k] >= 0.0 else -axis)
    return out


def turns_from_rpy(rpy_rad: Array) -> Array:
    """As `perchctl.geometry.rotation_from_rpy` of many, (n, 3) to (n, 3, 3)."""
    zero = np.zeros(len(rpy_rad))
    x, y, z = (rotation_matrices(np.stack(v, axis=1)) for v in (
        (rpy_rad[:, 0], zero, zero), (zero, rpy_rad[:, 1], zero), (zero, zero, rpy_rad[:, 2])
    ))  # fmt: skip
    return np.asarray(z @ y @ x)


def nearest_turn(M: Array) -> Array:
    """The rotation (3, 3) R that makes trace(R^T M) greatest."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
