"""The rendered picture against the geometry it claims to show."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.geometry import (
    R_MARKER_TARGET,
    Array,
    invert_T,
    make_T,
    rot_z,
    rotation_from_rpy,
)
from perchctl.profile import TargetConfig
from perchctl.sim import Neighbour, Renderer, Scenario
from perchctl.sim.renderer import rounded
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


POSES = {
    "far": (camera_pose(2.0), 0.150, 2.0),
    "far, aside, turned": (camera_pose(1.15, 0.4, -0.3, (0.05, -0.08, 1.1)), 0.150, 3.0),
    "middle, tilted": (camera_pose(0.6, 0.05, 0.1, (0.25, -0.2, -0.7)), 0.150, 4.0),
    "near": (camera_pose(0.24, 0.01, -0.01, (0.03, 0.02, 2.8)), 0.150, 5.0),
    "large fills the view": (camera_pose(0.16, rpy=(0.0, 0.0, 0.5)), 0.150, 5.0),
    "small, near": (camera_pose(0.12, 0.005, 0.01, (-0.06, 0.04, 0.3)), 0.025, 4.0),
    "small, touching": (camera_pose(0.05, 0.002, 0.001, (0.02, 0.0, -2.0)), 0.025, 6.0),
}


def plain(size: tuple[int, int]) -> CameraModel:
    width, height = size
    f = 0.6 * width
    return CameraModel(
        size, np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]]), np.zeros(5)
    )


ASIDE = POSES["far, aside, turned"]
NEAR = (camera_pose(0.35, 0.02, 0.01, (0.03, -0.02, 0.2)), 0.150, 4.0)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(scenario(), PLUMB_BOB, TARGET)


def evenly_lit(image: NDArray[np.uint8], renderer: Renderer) -> NDArray[np.uint8]:
    return np.clip(image * (255.0 / renderer.shade), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("camera", "view", "changes"),
    [
        *((PLUMB_BOB, view, {}) for view in POSES.values()),
        *((camera, view, {}) for camera in (RATIONAL, FISHEYE)
          for view in (ASIDE, POSES["middle, tilted"])),
        *((plain(size), (camera_pose(0.5), 0.150, 2.5), {})
          for size in ((320, 240), (1280, 720), (333, 251))),
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
    renderer = Renderer(scene, camera, TARGET)
    image = renderer.render([pose])
    assert image.shape == camera.size_px[::-1]
    side_m = changes.get("large_side_m", side_m)
    errors = corner_errors_px(evenly_lit(image, renderer), camera, scene, pose, side_m, reach_px)
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
        image = evenly_lit(renderer.render([pose]), renderer)
        errors = corner_errors_px(image, PLUMB_BOB, scenario(), pose, 0.150, 2.5)
        corners = project(PLUMB_BOB, scenario(), pose, marker_corners_m(0.150))
        ray = corners - corners.mean(axis=0)
        outward.append((errors * ray / np.linalg.norm(ray, axis=1, keepdims=True)).sum(axis=1))
        shift.append(errors)
    assert abs(np.mean(outward)) < 0.004
    assert np.abs(np.mean(shift, axis=(0, 1))).max() < 0.004


def detect(image: NDArray[np.uint8], dictionary: str) -> dict[int, Array]:
    predefined = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners, ids, _ = cv2.aruco.ArucoDetector(predefined).detectMarkers(image)
    if ids is None:
        return {}
    return {int(i): c.reshape(4, 2) for i, c in zip(np.ravel(ids), corners, strict=True)}


def test_both_markers_read_unmirrored_with_their_corners_in_order(renderer: Renderer) -> None:
    pose = camera_pose(0.3, 0.01, 0.02, (0.03, -0.04, 0.9))
    image = renderer.render([pose])
    for dictionary, wanted, side_m in (
        ("DICT_4X4_1000", 997, 0.150),
        ("DICT_ARUCO_ORIGINAL", 5, 0.025),
    ):
        truth = project(PLUMB_BOB, scenario(), pose, marker_corners_m(side_m))
        assert np.abs(detect(image, dictionary)[wanted] - truth).max() < 1.5
    # No rotation between body, camera and target: the top-left corner is at the top left.
    aligned = Renderer(scenario(target_yaw_rad=0.0), PLUMB_BOB, TARGET)
    corners = detect(aligned.render([camera_pose(0.6)]), "DICT_4X4_1000")[997]
    assert corners[0, 0] < corners[1, 0]
    assert corners[0, 1] < corners[3, 1]
    assert abs(corners[0, 1] - corners[1, 1]) < 2.0


def moving(speed_mps: float, below_m: float = 0.6) -> list[Array]:
    reach = speed_mps * 0.008 / 2.0
    return [camera_pose(below_m, x) for x in (-reach, 0.0, reach)]


def test_motion_blur_is_the_mean_of_the_views_on_the_way(renderer: Renderer) -> None:
    """4 px of motion against the mean of 41 sharp pictures."""
    poses = moving(0.8)
    reach = 0.8 * 0.008 / 2.0
    views = [renderer.render([camera_pose(0.6, x)]) for x in np.linspace(-reach, reach, 41)]
    # An exposure's ends count half.
    weights = np.array([0.5] + [1.0] * 39 + [0.5]) / 40.0
    exact = np.tensordot(weights, np.stack(views).astype(np.float64), axes=1)
    difference = np.abs(renderer.render(poses) - exact)
    assert difference.max() < 14.0  # of a contrast of 195
    assert difference.mean() < 1.0


def test_defocus_softens(renderer: Renderer) -> None:
    pose = camera_pose(0.6)
    variances = [cv2.Laplacian(renderer.render([pose], s), cv2.CV_64F).var() for s in (0.3, 1, 3)]
    assert variances[0] > 2 * variances[1] > 4 * variances[2]


def test_a_fast_tilt_is_followed_to_the_edge_of_the_blur(renderer: Renderer) -> None:
    """20 px of motion: the sheet is not cut off where it moves out of its middle place."""
    poses = [camera_pose(1.0, rpy=(0.0, a, 0.0)) for a in (-0.026, 0.0, 0.026)]
    bare = Renderer(scenario(no_target=True), PLUMB_BOB, TARGET)
    touched = np.abs(renderer.render(poses).astype(int) - bare.render(poses)) > 3
    cols = np.flatnonzero(touched.any(axis=0))
    start, end = (
        project(PLUMB_BOB, scenario(), T, marker_corners_m(0.2)) for T in (poses[0], poses[-1])
    )
    both = np.concatenate([start, end])
    assert abs(cols[0] - both[:, 0].min()) < 3.0
    assert abs(cols[-1] - both[:, 0].max()) < 3.0


def test_same_seed_same_bytes_and_the_frame_index_changes_only_the_noise() -> None:
    scene = scenario(camera_noise_sigma=5.0, seed=3)
    a, b = (Renderer(scene, PLUMB_BOB, TARGET) for _ in range(2))
    pose = camera_pose(0.8, 0.1)
    other_first = a.render([camera_pose(0.3)], frame_index=1)
    assert other_first.shape == (480, 640)
    assert other_first.dtype == np.uint8
    assert np.array_equal(a.render([pose], frame_index=7), b.render([pose], frame_index=7))
    difference = a.render([pose], frame_index=7).astype(int) - a.render([pose], frame_index=8)
    assert abs(difference.mean()) < 0.1
    assert difference.std() == pytest.approx(5.0 * math.sqrt(2.0), rel=0.05)
    another = Renderer(scene, PLUMB_BOB, TARGET, seed=4)
    assert not np.array_equal(a.render([pose]), another.render([pose]))


def test_a_bare_ceiling_shows_texture_and_no_paper() -> None:
    image = Renderer(scenario(no_target=True), PLUMB_BOB, TARGET).render([camera_pose(0.6)])
    assert image.max() < 200
    assert image.std() > 3.0
    assert not detect(image, "DICT_4X4_1000")


def test_a_camera_that_looks_down_sees_no_target(renderer: Renderer) -> None:
    upside_down = camera_pose(1.0, rpy=(math.pi, 0.0, 0.0))
    assert renderer.render([upside_down]).max() < 80
    above = camera_pose(-0.1)
    assert renderer.render([above]).max() < 80


def test_on_its_side_the_camera_sees_ceiling_and_floor(renderer: Renderer) -> None:
    image = renderer.render([camera_pose(1.0, rpy=(math.pi / 2, 0.0, 0.0))])
    assert image[:200, 320].mean() < 80 < image[280:, 320].mean()


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
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(both.render([pose]))
    assert 145 in ids


def test_analogue_faults_spoil_but_repeat() -> None:
    pose = camera_pose(0.5)
    clean = Renderer(scenario(), PLUMB_BOB, TARGET).render([pose], frame_index=2)
    poor = Renderer(scenario(extra={"analogue": 0.9}), PLUMB_BOB, TARGET)
    spoilt = poor.render([pose], frame_index=2)
    assert np.array_equal(spoilt, poor.render([pose], frame_index=2))
    assert np.abs(spoilt.astype(int) - clean).mean() > 2.0


# --- Noise and blur ----------------------------------------------------------------------------


def test_noise_has_its_spread_and_no_memory() -> None:
    """Neither of the pixel beside, nor of the frame before; and no mean."""
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


# --- A camera at rest, whose picture is kept ---------------------------------------------------


STIRRED = Scenario(ceiling_z_m=2.0, camera_noise_sigma=3.0)


def stirring(below_m: float, stir: float, *, moving: bool = False) -> list[Array]:
    """The poses of an exposure; `stir` in m and rad."""
    far = 0.02 if moving else 0.0
    return [
        make_T(rotation_from_rpy(0.02 + stir, 0.1, 0.5 + k * far), (stir, 0.01, 2.0 - below_m))
        for k in range(3)
    ]


def test_no_picture_hangs_on_those_before() -> None:
    """Which of them are looked at is the flight's affair, and no other bytes may follow from it."""
    exposures = [stirring(0.6, 3e-6 * k) for k in range(8)]
    all_seen = Renderer(STIRRED, PLUMB_BOB, TARGET)
    frames = [all_seen.render(poses, frame_index=7) for poses in exposures]
    for poses, frame in zip(exposures, frames, strict=True):
        alone = Renderer(STIRRED, PLUMB_BOB, TARGET)
        assert np.array_equal(alone.render(poses, frame_index=7), frame)


@pytest.mark.parametrize("below_m", [0.02, 0.3, 2.0])
def test_a_rounded_pose_shows_each_place_where_it_is(below_m: float) -> None:
    rng = np.random.default_rng(5)
    K = np.diag([400.0, 400.0, 1.0])
    for _ in range(100):
        T = make_T(
            rotation_from_rpy(*rng.uniform(-0.3, 0.3, 3)),
            (*rng.uniform(-0.5, 0.5, 2) * below_m, -below_m),
        )
        points = np.hstack([rng.uniform(-0.5, 0.5, (9, 2)) * below_m, np.zeros((9, 1))])
        cams = [(points - t[:3, 3]) @ t[:3, :3] @ K for t in (T, rounded(T))]
        one, other = (cam[:, :2] / cam[:, 2:] for cam in cams)
        within = (np.abs(one) < (400.0, 300.0)).all(axis=1)
        assert np.abs(one - other)[within].max(initial=0.0) < 0.01


def test_without_noise_a_kept_picture_is_nobody_s_to_spoil() -> None:
    renderer = Renderer(replace(STIRRED, camera_noise_sigma=0.0), PLUMB_BOB, TARGET)
    first = renderer.render(stirring(1.0, 0.0))
    kept = first.copy()
    first[:] = 0
    assert np.array_equal(renderer.render(stirring(1.0, 0.0)), kept)
    moved = renderer.render(stirring(1.0, 0.0, moving=True))
    renderer.move_target((0.1, 0.0))
    assert not np.array_equal(moved, kept)
    assert not np.array_equal(renderer.render(stirring(1.0, 0.0)), kept)
