"""A tilted and a glossy print: where the picture has the target, and the lamp in it."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.geometry import Array, invert_T, make_T, rot_z, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim import Renderer, Scenario
from perchctl.sim.sheets import SLOPE, lobe
from perchctl.vision import CameraModel
from tests.sim.test_renderer import CEILING, PLUMB_BOB, XY, camera_pose
from tests.sim.test_renderer import scenario as level

FLAT = CameraModel((640, 480), PLUMB_BOB.K, np.zeros(5))
LAMP = (XY[0] + 0.4, XY[1] + 0.1, 0.3)


def picture(scene: Scenario, pose: Array) -> Array:
    return Renderer(scene, FLAT, TargetConfig()).render([pose]).astype(float)


def mirrored(point: Array, T_world_target: Array) -> Array:
    """The lamp behind the mirror that the print's plane is."""
    normal, origin = T_world_target[:3, 2], T_world_target[:3, 3]
    return np.asarray(point - 2.0 * float((point - origin) @ normal) * normal)


def pixel(point: Array, pose: Array) -> Array:
    seen = (invert_T(pose) @ np.append(point, 1.0))[:3]
    return (FLAT.K @ seen)[:2] / seen[2]


def brightest(scene: Scenario, pose: Array) -> tuple[Array, float]:
    """Centre and peak of what the lamp adds."""
    matt = Scenario(**{k: v for k, v in vars(scene).items() if k != "gloss"})
    added = cv2.GaussianBlur(picture(scene, pose) - picture(matt, pose), (0, 0), 2.0)
    row, col = np.unravel_index(int(added.argmax()), added.shape)
    return np.array([float(col), float(row)]), float(added.max())


@pytest.mark.parametrize("tilt_rad", [(0.0, 0.0), (0.03, -0.04)])
@pytest.mark.parametrize(("below_m", "x_m"), [(0.3, 0.0), (0.3, 0.03), (0.22, -0.02)])
def test_the_highlight_is_where_a_mirror_would_show_the_lamp(
    tilt_rad: tuple[float, float], below_m: float, x_m: float
) -> None:
    scene = level(gloss=0.1, lamp_m=LAMP, target_tilt_rad=tilt_rad)
    pose = camera_pose(below_m, x_m, 0.0, (0.02, -0.03, 0.4))
    T = Renderer(scene, FLAT, TargetConfig()).T_world_target
    shown = pixel(mirrored(np.array(LAMP), T), pose)
    found, grey = brightest(scene, pose)
    assert np.linalg.norm(found - shown) < 6.0  # the lobe's width is 40 px and more
    assert grey == pytest.approx(0.1 * 225.0, abs=3.0)


def test_it_moves_over_the_print_as_the_viewpoint_does() -> None:
    scene = level(gloss=0.1, lamp_m=LAMP)
    depth_m = CEILING - LAMP[2]
    on_print = []
    for below_m in (0.3, 0.15):
        pose = camera_pose(below_m)
        found, _ = brightest(scene, pose)
        ray = np.linalg.solve(FLAT.K, np.append(found, 1.0))
        world = pose[:3, :3] @ ray
        point = pose[:3, 3] + world * below_m / world[2]
        on_print.append(point[0] - XY[0])
        expected = 0.4 * below_m / (below_m + depth_m)
        assert on_print[-1] == pytest.approx(expected, abs=0.004)
    assert on_print[0] > 1.5 * on_print[1]


def test_the_lobe_is_one_at_the_mirrors_point_and_falls_with_the_slope() -> None:
    eye, lamp = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, -1.0])
    x = np.array([[0.0, 0.0], [math.tan(math.atan(SLOPE)), 0.0]], np.float32)
    assert lobe(x, eye, lamp) == pytest.approx([1.0, math.exp(-1.0)], rel=1e-3)


def test_only_the_print_is_glossy_and_strong_light_hides_the_ink() -> None:
    pose = camera_pose(0.6)
    lamp = (XY[0] + 0.9, XY[1], 1.0)  # its mirror's place lies beside the sheet
    scene = level(gloss=2.0, lamp_m=lamp)
    matt = picture(level(), pose)
    assert (np.abs(picture(scene, pose) - matt) > 1.0).mean() < 0.02
    near = camera_pose(0.25)
    dazzled = picture(level(gloss=2.0, lamp_m=(XY[0] + 0.1, XY[1], 0.5)), near)
    at = pixel(np.array([XY[0] + 0.1 * 0.25 / 1.95, XY[1], CEILING]), near).astype(int)
    patch = dazzled[at[1] - 8 : at[1] + 8, at[0] - 8 : at[0] + 8]
    assert patch.min() > 220.0


def test_a_lamp_changes_nothing_in_a_matt_print() -> None:
    pose = camera_pose(0.4)
    assert (picture(level(), pose) == picture(level(lamp_m=LAMP), pose)).all()


@pytest.mark.parametrize("tilt_deg", [(3.0, 0.0), (-2.0, 2.0)])
def test_the_corners_of_a_tilted_target_are_in_its_plane(tilt_deg: tuple[float, float]) -> None:
    tilt = (math.radians(tilt_deg[0]), math.radians(tilt_deg[1]))
    pose = camera_pose(0.35, 0.02, 0.01, (0.03, -0.02, 0.2))
    true, found = [], []
    for scene in (level(), level(target_tilt_rad=tilt)):
        image = Renderer(scene, FLAT, TargetConfig()).render([pose])
        true.append(_corners_px(scene, pose))
        found.append(np.array([_corner_near(image, corner) for corner in true[-1]]))
    # OpenCV's corners lie inside by some tenths of a pixel, the same in both.
    assert np.abs(found[0] - true[0]).max() < 0.3
    moved = true[1] - true[0]
    assert np.linalg.norm(moved, axis=1).max() > 1.0
    assert found[1] - found[0] == pytest.approx(moved, abs=0.1)


def _corners_px(scene: Scenario, pose: Array) -> Array:
    turn = rotation_from_rpy(*scene.target_tilt_rad, 0.0) @ rot_z(scene.target_yaw_rad)
    T = make_T(turn, (*scene.target_xy_m, scene.ceiling_z_m))
    half = scene.large_side_m / 2.0
    corners = [(x * half, y * half, 0.0) for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    return np.array([pixel((T @ (*corner, 1.0))[:3], pose) for corner in corners])


def _corner_near(image: Array, corner: Array) -> Array:
    start = corner.astype(np.float32).reshape(1, 1, 2) + np.float32(1.0)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    smooth = cv2.GaussianBlur(np.asarray(image, np.uint8), (0, 0), 1.0)
    return np.asarray(cv2.cornerSubPix(smooth, start, (5, 5), (-1, -1), criteria)).reshape(2)
