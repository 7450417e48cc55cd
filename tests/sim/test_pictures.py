"""What makes pictures quick leaves them as true: tiles of one grey, noise from a bank, a blur of
some tiles only, and one picture for a camera at rest."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import perchctl.sim.sheets as sheets
from perchctl.geometry import Array, make_T, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim import Neighbour, Renderer, Scenario
from perchctl.sim.renderer import Shot, defocused, rounded
from perchctl.sim.sheets import Reach, SheetTexture, Tiles, pixels_of, tiles_of
from perchctl.vision import CameraModel

K = np.array([[380.0, 0.0, 321.5], [0.0, 380.6, 238.2], [0.0, 0.0, 1.0]])
CAMERA = CameraModel((640, 480), K, np.array([-0.17, 0.04, 0.0004, -0.0007, -0.003]))
SCENE = Scenario(
    ceiling_z_m=2.0, target_yaw_rad=0.4, camera_noise_sigma=0.0, neighbours=(Neighbour((0.5, 0.1)),)
)


def pose(below_m: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Array:
    return make_T(rotation_from_rpy(roll, pitch, yaw), (0.02, -0.01, 2.0 - below_m))


EXPOSURES = {
    "far": (pose(1.5, 0.05, 0.1, 1.0),),
    "near": (pose(0.3, -0.05, 0.03, 0.2),),
    "nothing but paper": (pose(0.1, 0.02, -0.04, 2.0),),
    "touching": (pose(0.04, 0.0, 0.01, -1.0),),
    "moving": (pose(0.5), pose(0.5, 0.006, 0.01, 0.01), pose(0.5, 0.012, 0.02, 0.02)),
    "turning fast": (pose(0.2), pose(0.2, 0.0, 0.0, 0.03), pose(0.2, 0.0, 0.0, 0.06)),
    "with the horizon in view": (pose(0.3, 1.3, 0.0, 0.0),),
}


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(SCENE, CAMERA, TargetConfig())


def each_pixel(reach: Reach, texture: SheetTexture, side_m: float) -> Tiles:
    """No tile counts as even."""
    found = tiles_of(reach, texture, side_m)
    nowhere = np.zeros_like(found.inner)
    return replace(found, even=nowhere, edges=found.inner, outline=~found.inner)


@pytest.mark.parametrize("name", EXPOSURES)
def test_even_tiles_are_what_their_pixels_are(
    renderer: Renderer, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = renderer.render(EXPOSURES[name])
    monkeypatch.setattr(sheets, "tiles_of", each_pixel)
    renderer.move_target(SCENE.target_xy_m)  # no picture of before is kept
    assert np.array_equal(quick, renderer.render(EXPOSURES[name]))


def test_so_they_are_with_a_rolling_shutter(
    renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = tuple((pose(0.25, 0.01 * k, 0.0, 0.02 * k),) for k in range(5))
    quick = renderer.expose([Shot(rows)])
    monkeypatch.setattr(sheets, "tiles_of", each_pixel)
    renderer.move_target(SCENE.target_xy_m)  # no picture of before is kept
    assert np.array_equal(quick, renderer.expose([Shot(rows)]))


def test_noise_has_its_spread_and_no_memory() -> None:
    """Neither of the pixel beside, nor of the frame before; and no mean."""
    paper = EXPOSURES["nothing but paper"]
    bare = Renderer(SCENE, CAMERA, TargetConfig()).render(paper).astype(float)
    noisy = Renderer(replace(SCENE, camera_noise_sigma=6.0), CAMERA, TargetConfig())
    one, other = (noisy.render(paper, frame_index=i) - bare for i in (1, 2))
    for noise in (one, other):
        assert abs(noise.mean()) < 0.05
        assert noise.std() == pytest.approx(6.0, rel=0.02)
        assert np.abs(noise).max() > 3.5 * 6.0
        assert abs((noise[:, 1:] * noise[:, :-1]).mean()) < 0.01 * 36.0
        assert abs((noise[1:] * noise[:-1]).mean()) < 0.01 * 36.0
    assert abs((one * other).mean()) < 0.01 * 36.0


SPAN = st.tuples(st.integers(0, 9), st.integers(1, 6))
"""First tile, and how many."""


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.floats(0.1, 1.5), SPAN, SPAN)
def test_a_blur_of_some_tiles_is_that_of_the_whole_picture_there(
    seed: int, sigma_px: float, rows: tuple[int, int], cols: tuple[int, int]
) -> None:
    """And as far around as they spread; what is farther off stays as it was."""
    sharp = np.random.default_rng(seed).integers(0, 256, (128, 128)).astype(np.uint8)
    box = (slice(rows[0], rows[0] + rows[1]), slice(cols[0], cols[0] + cols[1]))
    picture = sharp.copy()
    defocused(picture, sigma_px, box)
    near = pixels_of(box, math.ceil(3.0 * sigma_px))
    assert np.array_equal(picture[near], cv2.GaussianBlur(sharp, (0, 0), sigma_px)[near])
    far = np.ones(sharp.shape, np.bool_)
    far[pixels_of(box, 8)] = False
    assert np.array_equal(picture[far], sharp[far])


# A camera at rest ---------------------------------------------------------------------


STIRRED = Scenario(ceiling_z_m=2.0, camera_noise_sigma=3.0)


def exposed(below_m: float, stir: float, *, moving: bool = False) -> list[Array]:
    """The poses of an exposure; `stir` in m and rad."""
    far = 0.02 if moving else 0.0
    return [
        make_T(rotation_from_rpy(0.02 + stir, 0.1, 0.5 + k * far), (stir, 0.01, 2.0 - below_m))
        for k in range(3)
    ]


def test_no_picture_hangs_on_those_before() -> None:
    """Which of them are looked at is the flight's affair, and no other bytes may follow from it."""
    stirring = [exposed(0.6, 3e-6 * k) for k in range(8)]
    all_seen = Renderer(STIRRED, CAMERA, TargetConfig())
    frames = [all_seen.render(poses, frame_index=7) for poses in stirring]
    for poses, frame in zip(stirring, frames, strict=True):
        alone = Renderer(STIRRED, CAMERA, TargetConfig())
        assert np.array_equal(alone.render(poses, frame_index=7), frame)


@pytest.mark.parametrize("below_m", [0.02, 0.3, 2.0])
def test_a_rounded_pose_shows_each_place_where_it_is(below_m: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        T = make_T(
            rotation_from_rpy(*rng.uniform(-0.3, 0.3, 3)),
            (*rng.uniform(-0.5, 0.5, 2) * below_m, -below_m),
        )
        points = np.array([[*rng.uniform(-0.5, 0.5, 2) * below_m, 0.0] for _ in range(9)])
        seen = [(points - t[:3, 3]) @ t[:3, :3] for t in (T, rounded(T))]
        one, other = (400.0 * cam[:, :2] / cam[:, 2:] for cam in seen)
        within = (np.abs(one) < (400.0, 300.0)).all(axis=1)
        assert np.abs(one - other)[within].max(initial=0.0) < 0.01


def test_without_noise_a_kept_picture_is_nobody_s_to_spoil() -> None:
    renderer = Renderer(replace(STIRRED, camera_noise_sigma=0.0), CAMERA, TargetConfig())
    first = renderer.render(exposed(1.0, 0.0))
    kept = first.copy()
    first[:] = 0
    assert np.array_equal(renderer.render(exposed(1.0, 0.0)), kept)
    moved = renderer.render(exposed(1.0, 0.0, moving=True))
    renderer.move_target((0.1, 0.0))
    assert not np.array_equal(moved, kept)
    assert not np.array_equal(renderer.render(exposed(1.0, 0.0)), kept)
