"""Frames and rotations: the conventions that all other modules use.

The conventions (all of them are in `docs/conventions.md`):

- ``T_a_b`` is a 4x4 homogeneous matrix that maps coordinates in b into a, so
  inner letters cancel: ``T_world_body @ T_body_cam @ T_cam_target``.
- world and body: x forward, y left, z up. level: body with roll and pitch
  removed. cam: OpenCV (x right, y down, z along the view).
- Roll, pitch and yaw are right-handed rotations about body x, y, z:
  ``R_world_body = Rz(yaw) Ry(pitch) Rx(roll)``. Positive pitch is nose
  *down*; a Crazyflie's own `stateEstimate.pitch` is nose up and is negated in
  `perchctl.link` only.
- target: origin in the target's centre, x as in OpenCV's marker frame, z away
  from the drone (into the ceiling): OpenCV's marker frame turned by 180 deg
  about x (`R_MARKER_TARGET`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.81

R_MARKER_TARGET: Array = np.diag([1.0, -1.0, -1.0])
"""Maps target axes into OpenCV's marker axes (and back: it is its own inverse)."""


def is_finite(values: Array) -> bool:
    """True if all values are finite and small enough that the sum of their squares is finite as
    well."""
    flat = values.ravel()
    return math.isfinite(flat.dot(flat))


def wrap_rad(angle_rad: float) -> float:
    """The same angle in (-pi, pi]."""
    return -((-angle_rad + math.pi) % (2.0 * math.pi) - math.pi)


def rot_z(yaw_rad: float) -> Array:
    """The rotation about z, shape (3, 3)."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Return ``Rz(yaw) Ry(pitch) Rx(roll)``, shape (3, 3)."""
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_rotation(R: Array) -> tuple[float, float, float]:
    """Return roll, pitch and yaw: the inverse of `rotation_from_rpy` away from pitch = +-90 deg."""
    return (
        math.atan2(R[2, 1], R[2, 2]),
        math.asin(max(-1.0, min(1.0, -float(R[2, 0])))),
        math.atan2(R[1, 0], R[0, 0]),
    )


def yaw_of(R: Array) -> float:
    """The heading of the rotated x axis in the xy plane, in (-pi, pi]."""
    return math.atan2(R[1, 0], R[0, 0])


def rotation_from_quaternion(quaternion: tuple[float, float, float, float]) -> Array:
    """The rotation of a unit quaternion (w, x, y, z), shape (3, 3)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(R: Array) -> tuple[float, float, float, float]:
    """The unit quaternion (w, x, y, z) with w >= 0: the inverse of
    `rotation_from_quaternion`.

    Each row of the products is the quaternion multiplied by four times one of its components. The
    longest row is the most accurate one.
    """
    d0, d1, d2 = R[0, 0], R[1, 1], R[2, 2]
    a, b, c = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    e, f, g = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    products = np.array(
        [
            [1.0 + d0 + d1 + d2, a, b, c],
            [a, 1.0 + d0 - d1 - d2, e, f],
            [b, e, 1.0 - d0 + d1 - d2, g],
            [c, f, g, 1.0 - d0 - d1 + d2],
        ]
    )
    row = products[int(np.argmax(products.diagonal()))]
    row = row / math.copysign(float(np.linalg.norm(row)), row[0])
    w, x, y, z = (float(part) for part in row)
    return w, x, y, z


def quaternion_from_rpy(
    roll_rad: float, pitch_rad: float, yaw_rad: float
) -> tuple[float, float, float, float]:
    """The unit quaternion (w, x, y, z) of `rotation_from_rpy`, without a matrix."""
    cr, sr = math.cos(0.5 * roll_rad), math.sin(0.5 * roll_rad)
    cp, sp = math.cos(0.5 * pitch_rad), math.sin(0.5 * pitch_rad)
    cy, sy = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    return (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )


def nearest_axis(direction: Array) -> str | None:
    """The axis within 30 deg of a unit vector (3,), such as ``-y``, or None."""
    i = int(np.argmax(np.abs(direction)))
    if abs(float(direction[i])) < math.cos(math.radians(30.0)):
        return None
    return f"{'-' if direction[i] < 0 else ''}{'xyz'[i]}"


def make_T(R: Array, t_m: Array | tuple[float, float, float]) -> Array:
    """The homogeneous matrix of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t_m
    return T


def invert_T(T_a_b: Array) -> Array:
    """Return ``T_b_a`` of a rigid ``T_a_b``."""
    R = T_a_b[:3, :3]
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = R.T
    T_b_a[:3, 3] = -R.T @ T_a_b[:3, 3]
    return T_b_a


def circular_mean(weights: Array, angles_rad: Array) -> float:
    """The weighted mean of angles on the circle, in (-pi, pi]; weights sum to one.

    Linear in the difference from the first angle, so that it equals the plain weighted sum if no
    angle wraps around (equation 8 of the paper).
    """
    ref = float(angles_rad[0])
    deltas = [wrap_rad(float(a) - ref) for a in angles_rad]
    return wrap_rad(ref + float(np.dot(weights, deltas)))


@dataclass(frozen=True, eq=False)
class Place:
    """A position (3,), m, and a heading, rad, in the world of the state estimate."""

    position_m: Array
    yaw_rad: float
