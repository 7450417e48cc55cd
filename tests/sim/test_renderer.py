"""The rendered picture against the geometry it claims to show."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.geometry import R_MARKER_TARGET, Array, invert_T, make_T, rot_z, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim import Neighbour, Renderer, Scenario
from perchctl.sim.optics import shared_lens
from perchctl.sim.sheets import PlacedSheet, SheetView
from perchctl.target.drawing import marker_corners_m
from perchctl.vision import CameraModel

K = np.array([[380.0, 0.0, 321.5], [0.0, 380.6, 238.2], [0.0, 0.0, 1.0]])
PLUMB_BOB = CameraModel((640, 480), K, np.array([-0.17, 0.04, 0.0004, -0.0007, -0.003]))
RATIONAL = CameraModel(
    (640, 480),
    K,
    np.array([-0.2, 0.05, 0.0003, -0.0004, 0.002, 0.03, -0.01, 0.001]),
    "rational_polynomial",
)
FISHEYE = CameraModel((640, 480), K, np.array([-0.02, 0.004, -0.002, 0.0003]), "fisheye")
TARGET = TargetConfig()
XY, CEILING = (0.3, -0.2), 2.2


def scenario(**changes: object) -> Scenario:
    values: dict[str, object] = {
        "target_xy_m": XY,
        "target_yaw_rad": 0.5,
        "ceiling_z_m": CEILING,
        "camera_noise_sigma": 0.0,
    }
    return Scenario(**(values | changes))  # type: ignore[arg-type]


def camera_pose(
    below_m: float, x_m: float = 0.0, y_m: float = 0.0, rpy: tuple[float, float, float] = (0, 0, 0)
) -> Array:
    """A camera `below_m` under the ceiling, off the target's centre by x, y (world axes)."""
    return make_T(rotation_from_rpy(*rpy), (XY[0] + x_m, XY[1] + y_m, CEILING - below_m))


def project(camera: CameraModel, scene: Scenario, T_world_cam: Array, points_m: Array) -> Array:
    """Image of points given in OpenCV's marker axes, by OpenCV's own projection."""
    turn = rotation_from_rpy(*scene.target_tilt_rad, 0.0) @ rot_z(scene.target_yaw_rad)
    T_world_target = make_T(turn, (*scene.target_xy_m, scene.ceiling_z_m))
    T_cam_marker = invert_T(T_world_cam) @ T_world_target @ make_T(R_MARKER_TARGET, (0, 0, 0))
    rvec = cv2.Rodrigues(T_cam_marker[:3, :3])[0]
    tvec = T_cam_marker[:3, 3].copy()
    if camera.model == "fisheye":
        found, _ = cv2.fisheye.projectPoints(
            points_m.reshape(-1, 1, 3), rvec, tvec.reshape(3, 1), camera.K, camera.dist
        )
    else:
        found, _ = cv2.projectPoints(points_m, rvec, tvec, camera.K, camera.dist)
    return np.asarray(found).reshape(-1, 2)


def corner_errors_px(
    image: NDArray[np.uint8],
    camera: CameraModel,
    scene: Scenario,
    pose: Array,
    side_m: float,
    reach_px: float,
) -> Array:
    """How far the picture's edges meet from the true corners, (4, 2) px.

    Across each side, at places spread along it, the edge is where a step of the
    same two levels would have the same area; a line through those offsets,
    side by side, gives the corner. Unbiased for any symmetric blur.
    """
    corners_m = marker_corners_m(side_m)
    image32 = image.astype(np.float32)
    steps = np.arange(-reach_px, reach_px + 1e-9, 0.05)
    lines, normals = [], []
    for k in range(4):
        a, b = corners_m[k], corners_m[(k + 1) % 4]
        # Away from the corners, where the neighbouring side would be in reach.
        length_px = np.linalg.norm(np.subtract(*project(camera, scene, pose, np.stack([a, b]))))
        margin = min(1.5 * reach_px / float(length_px), 0.3)
        along = np.linspace(margin, 1.0 - margin, 60)
        points = project(camera, scene, pose, a + along[:, None] * (b - a))
        ahead = project(camera, scene, pose, a + (along + 1e-4)[:, None] * (b - a))
        tangent = (ahead - points) / np.linalg.norm(ahead - points, axis=1, keepdims=True)
        normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)  # outward
        where = (points[:, None, :] + steps[None, :, None] * normal[:, None, :]).astype(np.float32)
        profile = cv2.remap(image32, where, None, cv2.INTER_CUBIC)
        few = max(len(steps) // 10, 1)
        low, high = profile[:, :few].mean(axis=1), profile[:, -few:].mean(axis=1)
        dark = ((high[:, None] - profile) / (high - low)[:, None]).mean(axis=1)
        offset = (2.0 * dark - 1.0) * reach_px
        lines.append(np.polyfit(along, offset, 1))
        normals.append((normal[0], normal[-1]))
    errors = []
    for k in range(4):
        before = (k - 1) % 4
        A = np.stack([normals[before][1], normals[k][0]])
        b = np.array([np.polyval(lines[before], 1.0), np.polyval(lines[k], 0.0)])
        errors.append(np.linalg.solve(A, b))
    return np.stack(errors)


def evenly_lit(image: NDArray[np.uint8], camera: CameraModel) -> NDArray[np.uint8]:
    """The picture without the lens's shade."""
    return np.clip(image * (255.0 / shared_lens(camera).shade), 0, 255).astype(np.uint8)


def read_ids(image: NDArray[np.uint8]) -> list[int]:
    """Of all markers that a stock reader finds."""
    found: list[int] = []
    for name in (cv2.aruco.DICT_4X4_1000, cv2.aruco.DICT_ARUCO_ORIGINAL):
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(name))
        ids = detector.detectMarkers(image)[1]
        found += [] if ids is None else np.ravel(ids).tolist()
    return found


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(scenario(), PLUMB_BOB, TARGET)


def plain(width: int, height: int) -> CameraModel:
    K = np.array([[0.6 * width, 0, width / 2], [0, 0.6 * width, height / 2], [0, 0, 1.0]])
    return CameraModel((width, height), K, np.zeros(5))


ASIDE = (camera_pose(1.15, 0.4, -0.3, (0.05, -0.08, 1.1)), 0.150, 3.0)
TILTED = (camera_pose(0.6, 0.05, 0.1, (0.25, -0.2, -0.7)), 0.150, 4.0)
NEAR = (camera_pose(0.35, 0.02, 0.01, (0.03, -0.02, 0.2)), 0.150, 4.0)
LOW = (camera_pose(0.5), 0.150, 2.5)


@pytest.mark.parametrize(
    ("camera", "view", "changes"),
    [
        (PLUMB_BOB, (camera_pose(2.0), 0.150, 2.0), {}),
        *((camera, view, {}) for camera in (PLUMB_BOB, RATIONAL, FISHEYE)
          for view in (ASIDE, TILTED)),
        (PLUMB_BOB, (camera_pose(0.24, 0.01, -0.01, (0.03, 0.02, 2.8)), 0.150, 5.0), {}),
        (PLUMB_BOB, (camera_pose(0.16, rpy=(0.0, 0.0, 0.5)), 0.150, 5.0), {}),  # fills the view
        (PLUMB_BOB, (camera_pose(0.12, 0.005, 0.01, (-0.06, 0.04, 0.3)), 0.025, 4.0), {}),
        (PLUMB_BOB, (camera_pose(0.05, 0.002, 0.001, (0.02, 0.0, -2.0)), 0.025, 6.0), {}),
        *((plain(*size), LOW, {}) for size in ((320, 240), (1280, 720), (333, 251))),
        (PLUMB_BOB, NEAR, {"target_tilt_rad": (math.radians(3.0), 0.0)}),
        (PLUMB_BOB, NEAR, {"target_tilt_rad": (math.radians(-2.0), math.radians(2.0))}),
        (PLUMB_BOB, NEAR, {"large_side_m": 0.1485}),
    ],
)  # fmt: skip
def test_corners_lie_where_opencv_projects_them(
    camera: CameraModel, view: tuple[Array, float, float], changes: dict[str, Any]
) -> None:
    """For each lens, size of picture and pose, and for a target that is tilted or printed small."""
    pose, side_m, reach_px = view
    scene = scenario(**changes)
    image = Renderer(scene, camera, TARGET).render([pose])
    assert image.shape == camera.size_px[::-1]
    side_m = changes.get("large_side_m", side_m)
    errors = corner_errors_px(evenly_lit(image, camera), camera, scene, pose, side_m, reach_px)
    assert np.abs(errors).max() < 0.025
    assert np.abs(errors.mean(axis=0)).max() < (
        0.01 if camera is PLUMB_BOB and not changes else 0.025
    )


def test_nothing_shifts_the_corners_together(renderer: Renderer) -> None:
    """A bias of pose, size or place would survive the mean over many views."""
    rng = np.random.default_rng(5)
    outward, shift = [], []
    for _ in range(12):
        rpy = (*rng.uniform(-0.15, 0.15, 2), rng.uniform(-3.0, 3.0))
        pose = camera_pose(rng.uniform(0.4, 1.6), *rng.uniform(-0.08, 0.08, 2), rpy)
        image = evenly_lit(renderer.render([pose]), PLUMB_BOB)
        errors = corner_errors_px(image, PLUMB_BOB, scenario(), pose, 0.150, 2.5)
        corners = project(PLUMB_BOB, scenario(), pose, marker_corners_m(0.150))
        ray = corners - corners.mean(axis=0)
        outward.append((errors * ray / np.linalg.norm(ray, axis=1, keepdims=True)).sum(axis=1))
        shift.append(errors)
    assert abs(np.mean(outward)) < 0.004
    assert np.abs(np.mean(shift, axis=(0, 1))).max() < 0.004


def test_motion_blur_is_the_mean_of_the_views_on_the_way(renderer: Renderer) -> None:
    """4 px of motion against the mean of 41 sharp pictures."""
    reach = 0.8 * 0.008 / 2.0
    poses = [camera_pose(0.6, x) for x in (-reach, 0.0, reach)]
    views = [renderer.render([camera_pose(0.6, x)]) for x in np.linspace(-reach, reach, 41)]
    # An exposure's ends count half.
    weights = np.array([0.5] + [1.0] * 39 + [0.5]) / 40.0
    exact = np.tensordot(weights, np.stack(views).astype(np.float64), axes=1)
    difference = np.abs(renderer.render(poses) - exact)
    assert difference.max() < 14.0  # of a contrast of 195
    assert difference.mean() < 1.0


def test_a_camera_that_looks_down_sees_no_target(renderer: Renderer) -> None:
    upside_down = camera_pose(1.0, rpy=(math.pi, 0.0, 0.0))
    above = camera_pose(-0.1)
    assert renderer.render([upside_down]).max() < 80
    assert renderer.render([above]).max() < 80
    on_its_side = renderer.render([camera_pose(1.0, rpy=(math.pi / 2, 0.0, 0.0))])
    assert on_its_side[:200, 320].mean() < 80 < on_its_side[280:, 320].mean()


def test_a_neighbour_s_target_hangs_where_it_is_said(renderer: Renderer) -> None:
    """In the own target's axes, with its own heading and ids; here beside a bare place, too."""
    beside = Neighbour((0.4, -0.1), 0.9, large_id=145, small_id=254)
    x, y = np.array(XY) + rot_z(0.5)[:2, :2] @ beside.xy_m
    there = scenario(target_xy_m=(x, y), target_yaw_rad=0.5 + beside.yaw_rad)
    pose = make_T(np.eye(3), (x + 0.05, y - 0.1, CEILING - 0.7))
    alone = Renderer(scenario(neighbours=(beside,), no_target=True), PLUMB_BOB, TARGET)
    both = Renderer(scenario(neighbours=(beside,)), PLUMB_BOB, TARGET)
    for each in (alone, both):
        errors = corner_errors_px(each.render([pose]), PLUMB_BOB, there, pose, 0.150, 3.0)
        assert np.abs(errors).max() < 0.1
    low = camera_pose(0.16)  # nothing but the own paper is in view
    assert np.array_equal(both.render([low]), renderer.render([low]))
    assert 145 in read_ids(both.render([pose]))
    assert {997, 5} <= set(read_ids(renderer.render([camera_pose(0.3)])))


def test_blocks_of_one_grey_are_what_each_pixel_s_look_up_gives(
    renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At any distance and motion, on paper, print and ceiling; and so a near sheet costs little."""
    exposures = [
        [camera_pose(below_m, 0.02 + x, -0.03, (0.1, -0.05, turn)) for x in (0.0, way_m)]
        for below_m in (*np.arange(0.06, 0.12, 0.012), 0.2, 0.6, 1.5)
        for way_m, turn in ((0.0, 0.3), (1e-4, 1.0), (0.05 * below_m, 2.2))
    ]
    pictures = [renderer.render(poses) for poses in exposures]
    view = PlacedSheet.view

    def each_pixel(*args: Any) -> SheetView | None:
        seen = view(*args)
        return seen and seen._replace(is_uniform=np.zeros_like(seen.is_uniform), covers_all=False)

    monkeypatch.setattr(PlacedSheet, "view", each_pixel)
    for poses, picture in zip(exposures, pictures, strict=True):
        assert np.array_equal(renderer.render(poses), picture)


def test_noise_has_its_spread_no_memory_and_hangs_on_seed_and_index() -> None:
    """No memory of the pixel beside, nor of the frame before; and no mean."""
    paper = [camera_pose(0.1, 0.02, -0.01)]
    bare = Renderer(scenario(), PLUMB_BOB, TARGET).render(paper).astype(float)
    noisy = Renderer(scenario(camera_noise_sigma=6.0), PLUMB_BOB, TARGET)
    one, other = (noisy.render(paper, frame_index=i) - bare for i in (1, 2))
    for noise in (one, other):
        assert abs(noise.mean()) < 0.05
        assert noise.std() == pytest.approx(6.0, rel=0.02)
        assert np.abs(noise).max() > 3.5 * 6.0
        assert abs((noise[:, 1:] * noise[:, :-1]).mean()) < 0.01 * 36.0
        assert abs((noise[1:] * noise[:-1]).mean()) < 0.01 * 36.0
    assert abs((one * other).mean()) < 0.01 * 36.0
    same, another = (
        Renderer(scenario(camera_noise_sigma=6.0), PLUMB_BOB, TARGET, seed) for seed in (None, 4)
    )
    assert np.array_equal(same.render(paper, frame_index=2), noisy.render(paper, frame_index=2))
    assert not np.array_equal(another.render(paper), noisy.render(paper))


def test_no_picture_hangs_on_those_before() -> None:
    """Which of them are looked at is the flight's affair, and no other bytes may follow from it;
    nor does the caller spoil one by writing into it. The camera stirs, and rests."""
    scene = Scenario(ceiling_z_m=2.0, camera_noise_sigma=3.0, extra={"analogue": 0.9})
    exposures = [
        [make_T(rotation_from_rpy(0.02 + stir, 0.1, 0.5), (stir, 0.01, 1.4))] * 3
        for stir in (0.0, 3e-6, 6e-6, 6e-6, 9e-6)
    ]
    seen = Renderer(scene, PLUMB_BOB, TARGET)
    for poses in exposures:
        frame = seen.render(poses, frame_index=7)
        alone = Renderer(scene, PLUMB_BOB, TARGET)
        assert np.array_equal(alone.render(poses, frame_index=7), frame)
        frame[:] = 0
    before = seen.render(exposures[-1], frame_index=7)
    seen.move_target((0.1, 0.0))
    assert not np.array_equal(seen.render(exposures[-1], frame_index=7), before)
