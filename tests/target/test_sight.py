"""What a camera sees of a target: from where on the ground, and from where on it is blind."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import Array, rot_z
from perchctl.profile import CameraConfig, Mounting, Profile, TargetConfig
from perchctl.profile.vision import VehicleConfig
from perchctl.target import overhead_text, view_from
from perchctl.target.sight import BlindRange, blind_range, overhead_reach_m
from perchctl.vision import project, square_corners
from tests.target.rig import camera_of

TARGET = TargetConfig()
SIDE_M = TARGET.large.side_m
F = 380.0
CAMERA = camera_of(F, (-0.05, 0.01, 0.0, 0.0, 0.0))
angles = st.floats(-math.pi, math.pi)
leans = st.floats(-25.0, 25.0)
mounts = st.builds(
    lambda roll, pitch, yaw: Mounting(position_m=(0.03, -0.01, 0.01), rpy_deg=(roll, pitch, yaw)),
    leans, leans, st.sampled_from([0.0, 90.0, 180.0, -37.0]),
)  # fmt: skip


def in_picture(mount: Mounting, centre_m: Array, yaw_rad: float) -> bool:
    """By the lens itself: all corners of the large marker at least 3 px inside. `centre_m` from
    the camera, body axes."""
    corners = (square_corners(SIDE_M) @ rot_z(yaw_rad).T + centre_m) @ mount.T_body_cam[:3, :3]
    if (corners[:, 2] <= 0.0).any():
        return False
    px = project(corners, np.zeros(3), np.zeros(3), CAMERA)
    return bool((px >= 2.5).all() and (px <= np.array(CAMERA.size_px) - 3.5).all())


def axis_m(mount: Mounting, height_m: float) -> tuple[float, float]:
    """Where the camera's axis is at that height."""
    x, y, z = mount.T_body_cam[:3, 2].tolist()
    return x / z * height_m, y / z * height_m


@settings(max_examples=60, deadline=None)
@given(mounts, st.floats(0.6, 3.0), angles, angles, st.floats(0.0, 0.97))
def test_within_the_reach_the_marker_is_whole_at_any_turn(
    mount: Mounting, height_m: float, towards: float, yaw_rad: float, share: float
) -> None:
    reach_m = overhead_reach_m(SIDE_M, CAMERA, mount, height_m)
    if reach_m is None:
        return
    away_m, (x, y) = share * reach_m, axis_m(mount, height_m)
    centre = np.array([x + away_m * math.cos(towards), y + away_m * math.sin(towards), height_m])
    assert in_picture(mount, centre, yaw_rad)


@settings(max_examples=30, deadline=None)
@given(mounts, st.floats(0.6, 3.0))
def test_beyond_the_reach_some_marker_is_cut(mount: Mounting, height_m: float) -> None:
    reach_m = overhead_reach_m(SIDE_M, CAMERA, mount, height_m)
    if reach_m is None:
        return
    away_m, (x, y) = 1.05 * reach_m + 0.01, axis_m(mount, height_m)
    around = np.linspace(0.0, 2.0 * math.pi, 48)
    turned = (
        (towards, towards + math.pi / 4.0)  # a corner ahead
        for towards in around
    )
    assert not all(
        in_picture(
            mount, np.array([x + away_m * math.cos(a), y + away_m * math.sin(a), height_m]), yaw
        )
        for a, yaw in turned
    )


@settings(max_examples=60, deadline=None)
@given(mounts, angles, angles, st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(0.8, 2.5))
def test_a_sight_is_the_lens_s_wherever_the_body_stands(
    mount: Mounting, yaw_rad: float, target_yaw: float, x: float, y: float, height_m: float
) -> None:
    """Far enough that the small marker is too small to count."""
    body_m, camera_m = np.array([0.4, -1.2, 0.02]), np.array(mount.position_m)
    way = np.array([x, y, height_m])
    target_m = body_m + rot_z(yaw_rad) @ (camera_m + way)
    seen = view_from(body_m, yaw_rad, target_m, target_yaw, TARGET, CAMERA, mount)
    assert abs(seen.height_m - height_m) < 1e-9
    near = [in_picture(mount, way + d, target_yaw - yaw_rad) for d in (
        np.array([dx, dy, 0.0]) for dx in (-0.01, 0.01) for dy in (-0.01, 0.01))]  # fmt: skip
    if all(near) or not any(near):  # else it is at the very edge
        assert seen.whole is all(near)
    # Walking so far brings the target onto the camera's axis.
    there = body_m + rot_z(yaw_rad) @ np.array([*seen.aside_m, 0.0])
    moved = view_from(there, yaw_rad, target_m, target_yaw, TARGET, CAMERA, mount)
    assert math.hypot(*moved.aside_m) < 1e-9
    on_axis = rot_z(yaw_rad).T @ (target_m - there) - camera_m
    assert np.linalg.norm(np.cross(on_axis, mount.T_body_cam[:3, 2])) < 1e-9


@pytest.mark.parametrize(
    ("rpy_deg", "words"),
    [
        ((0.0, 0.0, 0.0), "at most 3.2 m above the camera"),
        ((0.0, 0.0, 0.0), "than 0.53 m at 1 m above it"),
        ((0.0, 12.0, 0.0), "leans 12 deg forward"),
        ((0.0, -12.0, 0.0), "leans 12 deg back"),
        ((0.0, -12.0, 90.0), "leans 12 deg to the right"),
        ((-10.0, 0.0, 0.0), "leans 10 deg to the left"),
        ((0.0, 17.0, 45.0), "leans 12 deg forward and 12 deg to the left"),
        ((1.0, -1.0, 0.0), "points straight up"),
        ((180.0, 0.0, 0.0), "camera that looks up"),
        ((0.0, -90.0, 0.0), "camera that looks up"),
    ],
)
def test_where_the_target_is_found_overhead(
    rpy_deg: tuple[float, float, float], words: str
) -> None:
    """`rpy_deg` of pitch is nose down: the view goes forward."""
    assert words in overhead_text(TARGET, CAMERA, Mounting(rpy_deg=rpy_deg))


@pytest.mark.parametrize(
    ("place_m", "words"),
    [
        ((0.31, -0.12), "0.31 m forward and 0.12 m to the right"),
        ((-0.5, 0.004), "0.50 m back"),
        ((0.0, 0.0), "less than 1 cm"),
    ],
)
def test_a_way_is_named_by_the_vehicle_s_sides(place_m: tuple[float, float], words: str) -> None:
    mount = Mounting(position_m=(0.0, 0.0, 0.0))
    target_m = np.array([*place_m, 1.0])
    seen = view_from(np.zeros(3), 0.0, target_m, 0.0, TARGET, CAMERA, mount)
    assert seen.aside_text == words
    assert seen.reach_m == overhead_reach_m(SIDE_M, CAMERA, mount, 1.0)


# --- near the target: from where on a mounting is blind ---------------------------------------


STRAIGHT_CAMERA = camera_of()
SMALL_M = 0.0125  # its half side
WIDE, HIGH = 317 / 380, 237 / 380  # of the picture, from the axis, less the margin


def view_of(gear_m: tuple[float, float, float], yaw_deg: float = 0.0) -> BlindRange:
    """With the gear there from the camera, body axes."""
    mount = Mounting(position_m=(0.01, 0.0, 0.005), rpy_deg=(0.0, 0.0, yaw_deg))
    x, y, z = gear_m
    profile = Profile(
        camera=CameraConfig(mount=mount),
        vehicle=VehicleConfig(gear_body_m=(x + 0.01, y, z + 0.005)),
    )
    return blind_range(TargetConfig(), STRAIGHT_CAMERA, profile)


@pytest.mark.parametrize(
    ("gear_m", "nearest_m"),
    [
        ((0.0, 0.0, 0.0), SMALL_M / HIGH),
        ((-0.03, 0.0, 0.0), (0.03 + SMALL_M) / WIDE),
        ((0.0, 0.03, 0.0), (0.03 + SMALL_M) / HIGH),
        ((0.0, 0.03, 0.02), (0.03 + SMALL_M) / HIGH - 0.02),
        ((0.0, 0.0, 0.025), 0.0),
    ],
)
def test_whole_markers_are_lost_where_geometry_says(
    gear_m: tuple[float, float, float], nearest_m: float
) -> None:
    assert view_of(gear_m).whole_m == pytest.approx(nearest_m, abs=0.001)


@pytest.mark.parametrize("gear_m", [(0.0, 0.0, 0.0), (-0.03, 0.0, 0.0), (0.0, 0.03, 0.02)])
def test_the_rest_of_the_drawing_halves_it(gear_m: tuple[float, float, float]) -> None:
    blind = view_of(gear_m)
    assert blind.whole_m is not None
    assert blind.left_m is not None
    assert blind.left_m <= 0.5 * blind.whole_m


def test_a_blind_range_is_named() -> None:
    assert view_of((0.28, 0.0, 0.0)).whole_m is None
    assert "blind in all of the last 10 cm" in view_of((0.28, 0.0, 0.0)).words
    assert "by whole markers alone: blind from 48 mm" in view_of((0.0, 0.03, 0.02)).words
    assert "never blind" in view_of((0.0, 0.0, 0.025)).words
