"""What a camera sees of a target: from where on the ground, and from where on it is blind."""

from __future__ import annotations

import dataclasses
import importlib
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import Array, rot_z
from perchctl.profile import CameraConfig, Mounting, Profile, TargetConfig, load_profile
from perchctl.profile.vision import VehicleConfig
from perchctl.target import make_design, overhead_text, view_from
from perchctl.target.design import TargetDesign
from perchctl.target.sight import (
    SURE_PX,
    BlindRange,
    FieldOfView,
    blind_range,
    circle_outline,
    overhead_reach_m,
    square_outline,
)
from perchctl.vision import project, square_corners
from tests.helpers.flights import short_profile
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


@settings(max_examples=30, deadline=None)
@given(mounts, st.floats(0.6, 3.0), angles, angles, st.floats(0.0, 0.97))
def test_within_the_reach_the_marker_is_whole_at_any_turn_and_beyond_it_some_is_cut(
    mount: Mounting, height_m: float, towards: float, yaw_rad: float, share: float
) -> None:
    reach_m = overhead_reach_m(SIDE_M, CAMERA, mount, height_m)
    if reach_m is None:
        return
    x, y = axis_m(mount, height_m)

    def seen(away_m: float, way_rad: float, turn_rad: float) -> bool:
        to_x, to_y = away_m * math.cos(way_rad), away_m * math.sin(way_rad)
        return in_picture(mount, np.array([x + to_x, y + to_y, height_m]), turn_rad)

    assert seen(share * reach_m, towards, yaw_rad)
    around = np.linspace(0.0, 2.0 * math.pi, 48)
    beyond_m = 1.05 * reach_m + 0.01
    ahead = (0.0, math.pi / 4.0)  # a corner ahead
    assert not all(seen(beyond_m, way, way + turn) for way in around for turn in ahead)


@settings(max_examples=30, deadline=None)
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
        assert seen.has_marker is all(near)
    # Walking so far brings the target onto the camera's axis.
    there = body_m + rot_z(yaw_rad) @ np.array([*seen.aside_m, 0.0])
    moved = view_from(there, yaw_rad, target_m, target_yaw, TARGET, CAMERA, mount)
    assert math.hypot(*moved.aside_m) < 1e-9
    on_axis = rot_z(yaw_rad).T @ (target_m - there) - camera_m
    assert np.linalg.norm(np.cross(on_axis, mount.T_body_cam[:3, 2])) < 1e-9


@pytest.mark.parametrize(
    ("rpy_deg", "words"),
    [
        ((0.0, 0.0, 0.0), "the large marker is found at most 3.2 m above the camera"),
        ((0.0, 0.0, 0.0), "within 0.53 m (at 1 m above it)"),
        ((0.0, 12.0, 0.0), "leans 12 deg forward"),
        ((0.0, -12.0, 90.0), "leans 12 deg to the right"),
        ((0.0, 17.0, 45.0), "leans 12 deg forward and 12 deg to the left"),
        ((1.0, -1.0, 0.0), "points straight up"),
        ((0.0, -90.0, 0.0), "the large marker is visible only to a camera that looks up"),
    ],
)
def test_where_the_target_is_found_overhead(
    rpy_deg: tuple[float, float, float], words: str
) -> None:
    """`rpy_deg` of pitch is nose down: the view goes forward."""
    assert words in overhead_text(TARGET, CAMERA, Mounting(rpy_deg=rpy_deg))


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


# --- the designer against the renderer and the paper ---------------------------------------------

ROOT = Path(__file__).resolve().parents[2]
PAPER_CAMERA = camera_of(380.0)
AHEAD = (np.eye(3), np.zeros(3))


@pytest.fixture(scope="module")
def profile() -> Profile:
    return load_profile("sim")


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark of the ranges, from beyond what may be wrong on, and quick."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    module = importlib.import_module("ranges_by_design")
    monkeypatch.setattr(module, "START", 1.2)
    return module


@pytest.fixture(scope="module")
def paper_design(profile: Profile) -> TargetDesign:
    return make_design(TARGET, PAPER_CAMERA, 2.5, profile, 2.4)


@pytest.mark.long
@pytest.mark.parametrize(("focal_px", "blur_px"), [(250.0, 2.5), (380.0, 1.5)])
def test_ranges_agree_with_the_renderer(bench: ModuleType, focal_px: float, blur_px: float) -> None:
    """The other cameras and blurs: benchmarks/ranges_by_design.py."""
    for name, designed, measured in bench.measure(focal_px, blur_px, TARGET):
        assert designed == pytest.approx(measured, rel=0.15), name


@pytest.mark.long
def test_the_paper_s_ranges_and_where_they_differ(paper_design: TargetDesign) -> None:
    """z2 and z3 agree; a blur that explains z1 = 115 cm would be 3.5 px, not 2.5."""
    design = paper_design
    assert design.z2_m == pytest.approx(0.25, rel=0.15)
    assert design.z3_upright_m == pytest.approx(0.12, rel=0.05)
    assert design.z3_m == pytest.approx(0.17, rel=0.05), "facing across, it needs more room"
    assert design.z1_m is not None
    assert 1.15 < design.z1_m < 1.75
    assert f"z1        {100 * design.z1_m:.3g} cm" in design.text("camera.yaml")
    assert design.record()["warnings"] == []


def test_z3_is_the_geometry_s() -> None:
    view = FieldOfView(PAPER_CAMERA, margin_px=0.0)
    upright, turned = square_outline(0.15), circle_outline(0.15)
    nearest_m = 0.15 * 380.0 / 480.0
    assert view.nearest_m(upright, *AHEAD) == pytest.approx(nearest_m, rel=2e-3)
    assert view.nearest_m(turned, *AHEAD) == pytest.approx(math.sqrt(2.0) * nearest_m, rel=2e-3)
    barrel = FieldOfView(camera_of(380.0, (-0.17, 0.04, 0.0, 0.0, 0.0)), margin_px=0.0)
    shown = barrel.nearest_m(turned, *AHEAD)
    assert shown is not None
    assert shown < 0.99 * math.sqrt(2.0) * nearest_m, "barrel distortion shows more"
    behind = np.diag([1.0, -1.0, -1.0])
    assert view.nearest_m(turned, behind, np.zeros(3)) is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"z1_m": 0.9}, "gap above the search: even from its highest point, 1.3 m above"),
        ({"start_range_m": 0.2}, "less than 0.3 m above the camera"),
        ({"z2_m": 0.15}, "gap between the markers"),
        ({"z1_m": None}, "never be read"),
        ({"small_nearest_m": 0.2}, "gap before contact"),
        ({"small_nearest_m": None}, "gap before contact"),
    ],
)
def test_gaps_are_named(paper_design: TargetDesign, changes: dict[str, Any], said: str) -> None:
    warnings = dataclasses.replace(paper_design, **changes).warnings
    assert len(warnings) == bool(said)
    assert said in "".join(warnings)


@pytest.mark.long
def test_a_gap_on_the_ground_is_named_where_the_target_is_the_position() -> None:
    """From the search height it would be near enough."""
    ground = short_profile({"positioning": "target"}, base="sim")
    sure_m = 380.0 * 0.150 / SURE_PX
    for ceiling_m, gap in ((0.9 * sure_m, False), (1.1 * sure_m, True)):
        design = make_design(TARGET, PAPER_CAMERA, 0.6, ground, ceiling_m)
        assert any("gap at the start" in text for text in design.warnings) is gap
