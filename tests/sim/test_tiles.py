"""Tiles that are filled with one grey look as if each pixel had been looked up."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import perchctl.sim.renderer as placed
import perchctl.sim.renderer as rendering
from perchctl.geometry import Array, make_T, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim import Neighbour, Renderer, Scenario
from perchctl.sim.pixels import defocused
from perchctl.sim.shutter import Shot
from perchctl.sim.surfaces import SheetTexture
from perchctl.sim.tiles import Reach, Tiles, pixels_of, tiles_of
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
    monkeypatch.setattr(placed, "tiles_of", each_pixel)
    renderer.move_target(SCENE.target_xy_m)  # no picture of before is kept
    assert np.array_equal(quick, renderer.render(EXPOSURES[name]))


def test_so_they_are_with_a_rolling_shutter(
    renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = tuple((pose(0.25, 0.01 * k, 0.0, 0.02 * k),) for k in range(5))
    quick = renderer.expose([Shot(rows)])
    monkeypatch.setattr(placed, "tiles_of", each_pixel)
    renderer.move_target(SCENE.target_xy_m)  # no picture of before is kept
    assert np.array_equal(quick, renderer.expose([Shot(rows)]))


def test_most_of_a_near_sheet_is_even(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    shares = []

    def watched(reach: Reach, texture: SheetTexture, side_m: float) -> Tiles:
        found = tiles_of(reach, texture, side_m)
        shares.append(float(found.even.mean()))
        return found

    monkeypatch.setattr(placed, "tiles_of", watched)
    renderer.move_target(SCENE.target_xy_m)
    renderer.render(EXPOSURES["nothing but paper"])
    assert max(shares) > 0.6


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


@pytest.mark.parametrize("below_m", [0.3, 1.0, 1.7])
def test_noise_covers_that_the_ceiling_is_drawn_at_a_quarter_of_the_size(
    below_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = replace(SCENE, no_target=True, neighbours=())
    half = Renderer(scene, CAMERA, TargetConfig()).render([pose(below_m)]).astype(float)
    monkeypatch.setattr(rendering, "_COVERING_SIGMA", 0.0)
    quarter = Renderer(scene, CAMERA, TargetConfig()).render([pose(below_m)]).astype(float)
    assert 0.0 < (half - quarter).std() < 1.5
    assert abs((half - quarter).mean()) < 0.1
    assert abs(half.std() / quarter.std() - 1.0) < 0.02


def test_4225_frames_have_noise_of_their_own() -> None:
    noisy = Renderer(replace(SCENE, camera_noise_sigma=6.0), CAMERA, TargetConfig())
    paper = EXPOSURES["nothing but paper"]
    pictures = {noisy.render(paper, frame_index=k).tobytes() for k in range(0, 4225, 65)}
    assert len(pictures) == 65
    assert noisy.render(paper, frame_index=4225).tobytes() in pictures


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
