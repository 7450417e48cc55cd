"""From where on a mounting is blind, and the turn that is advised."""

from __future__ import annotations

import pytest

from perchctl.profile import CameraConfig, Mounting, Profile, TargetConfig
from perchctl.profile.vision import VehicleConfig
from perchctl.target import mounted_camera
from perchctl.target.sight import MountingView
from tests.target.rig import camera_of

CAMERA = camera_of()
SMALL_M = 0.0125  # its half side
WIDE, HIGH = 317 / 380, 237 / 380  # of the picture, from the axis, less the margin


def of(gear_m: tuple[float, float, float], yaw_deg: float = 0.0) -> MountingView:
    """With the gear there from the camera, body axes."""
    mount = Mounting(position_m=(0.01, 0.0, 0.005), rpy_deg=(0.0, 0.0, yaw_deg))
    x, y, z = gear_m
    profile = Profile(
        camera=CameraConfig(mount=mount),
        vehicle=VehicleConfig(gear_body_m=(x + 0.01, y, z + 0.005)),
    )
    return mounted_camera(TargetConfig(), CAMERA, profile)


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
    assert of(gear_m).blind.whole_m == pytest.approx(nearest_m, abs=0.001)


@pytest.mark.parametrize("gear_m", [(0.0, 0.0, 0.0), (-0.03, 0.0, 0.0), (0.0, 0.03, 0.02)])
def test_the_rest_of_the_drawing_halves_it(gear_m: tuple[float, float, float]) -> None:
    blind = of(gear_m).blind
    assert blind.whole_m is not None
    assert blind.left_m is not None
    assert blind.left_m <= 0.5 * blind.whole_m


def test_the_gear_along_the_picture_s_height_is_advised_against() -> None:
    mount = of((0.0, 0.03, 0.02))
    assert mount.turned_rpy_deg == (0.0, 0.0, 90.0)
    assert mount.turned == of((0.0, 0.03, 0.02), yaw_deg=90.0).blind
    first, advice = mount.lines()
    assert "by whole markers alone: blind from 48 mm" in first
    assert "turn the camera by 90 degrees" in advice
    assert "camera.mount.rpy_deg: [0, 0, 90]" in advice
    assert mount.record()["turned_rpy_deg"] == (0.0, 0.0, 90.0)


@pytest.mark.parametrize("gear_m", [(0.03, 0.0, 0.02), (0.0, 0.0, 0.0)])
def test_a_good_mounting_needs_no_advice(gear_m: tuple[float, float, float]) -> None:
    mount = of(gear_m)
    assert mount.turned is None
    assert len(mount.lines()) == 1


def test_a_gear_far_aside_is_never_seen() -> None:
    mount = of((0.28, 0.0, 0.0))
    assert mount.blind.whole_m is None
    assert "blind in all of the last 10 cm" in mount.lines()[0]
