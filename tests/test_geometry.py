"""The laws of frames and angles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import (
    R_MARKER_TARGET,
    circular_mean,
    invert_T,
    make_T,
    quaternion_from_rpy,
    rotation_from_quaternion,
    rotation_from_rpy,
    rpy_from_rotation,
    wrap_rad,
    yaw_of,
)

angles = st.floats(-50.0, 50.0)
small_angles = st.floats(-1.4, 1.4)
metres = st.floats(-10.0, 10.0)


@st.composite
def transforms(draw: st.DrawFn) -> np.ndarray:
    R = rotation_from_rpy(draw(angles), draw(small_angles), draw(angles))
    return make_T(R, (draw(metres), draw(metres), draw(metres)))


@given(angles)
def test_wrap_keeps_the_direction_and_the_range(angle: float) -> None:
    wrapped = wrap_rad(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


@given(transforms())
def test_inverse(T_a_b: np.ndarray) -> None:
    assert np.allclose(T_a_b @ invert_T(T_a_b), np.eye(4), atol=1e-9)


@given(angles, angles, angles)
def test_a_quaternion_of_angles_turns_as_their_matrix(
    roll: float, pitch: float, yaw: float
) -> None:
    q = quaternion_from_rpy(roll, pitch, yaw)
    assert math.hypot(*q) == pytest.approx(1.0)
    R = rotation_from_rpy(roll, pitch, yaw)
    assert np.allclose(rotation_from_quaternion(q), R, atol=1e-9)


@given(angles, small_angles, angles)
def test_rpy_round_trip(roll: float, pitch: float, yaw: float) -> None:
    R = rotation_from_rpy(roll, pitch, yaw)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.allclose(rotation_from_rpy(*rpy_from_rotation(R)), R, atol=1e-9)
    assert wrap_rad(yaw_of(R) - yaw) == pytest.approx(0.0, abs=1e-9)


def test_signs_of_the_axes() -> None:
    """Positive roll lowers the right side, positive pitch the nose, yaw turns left."""
    assert (rotation_from_rpy(0.1, 0, 0) @ (0, -1, 0))[2] < 0
    assert (rotation_from_rpy(0, 0.1, 0) @ (1, 0, 0))[2] < 0
    assert (rotation_from_rpy(0, 0, 0.1) @ (1, 0, 0))[1] > 0


def test_target_axes_are_the_marker_axes_turned_about_x() -> None:
    assert np.allclose(R_MARKER_TARGET, rotation_from_rpy(math.pi, 0, 0), atol=1e-12)
    assert np.allclose(R_MARKER_TARGET @ R_MARKER_TARGET, np.eye(3))


@given(st.floats(0, 1), st.floats(-3, 3), st.floats(-0.5, 0.5), angles)
def test_circular_mean_turns_with_its_angles(
    weight: float, base: float, apart: float, turn: float
) -> None:
    weights = np.array([weight, 1 - weight])
    pair = np.array([base, base + apart])
    turned = circular_mean(weights, pair + turn)
    assert wrap_rad(turned - circular_mean(weights, pair) - turn) == pytest.approx(0, abs=1e-9)


def test_circular_mean_across_the_wrap() -> None:
    """+179 and -179 deg by the paper's 0.469 stay near 180, not near -11."""
    mean = circular_mean(np.array([0.469, 0.531]), np.radians([179.0, -179.0]))
    assert abs(math.degrees(mean)) > 179.0
