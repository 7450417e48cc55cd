"""Verdicts on frames: what the simulated camera gives is usable, what a dead link gives is not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from perchctl.camera import FrameHealth, NewestSlot
from perchctl.camera.health import picture_kind
from perchctl.geometry import make_T, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim import Renderer, Scenario
from perchctl.vision import CameraModel, Frame

SHAPE = (480, 640)


def frame(image: NDArray[np.uint8], t_s: float = 0.0) -> Frame:
    return Frame(0, t_s, image, t_s)


def noisy(level: float, sigma: float, seed: int = 0) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    return np.clip(np.rint(rng.normal(level, sigma, SHAPE)), 0, 255).astype(np.uint8)


def snow(seed: int, band_px: float) -> NDArray[np.uint8]:
    """An analogue receiver's snow: lines unrelated, bandwidth limited along them."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal(SHAPE).astype(np.float32)
    if band_px:
        white = cv2.GaussianBlur(white, (0, 0), sigmaX=band_px, sigmaY=1e-3)
    return np.clip(110.0 + 60.0 * white / white.std(), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def renderers() -> list[Renderer]:
    K = np.array([[380.0, 0, 320], [0, 380, 240], [0, 0, 1]])
    camera = CameraModel((640, 480), K, np.array([-0.17, 0.04, 0, 0, 0]))
    scenes = [
        Scenario(camera_noise_sigma=sigma, no_target=bare, extra={"analogue": analogue})
        for sigma, bare, analogue in ((20.0, False, 0.0), (0.0, True, 0.0), (10.0, False, 1.0))
    ]
    return [Renderer(scene, camera, TargetConfig()) for scene in scenes]


@pytest.mark.parametrize("below_m", [0.03, 0.08, 0.2, 0.5, 1.2, 2.1])
def test_pictures_of_the_ceiling_are_usable(renderers: list[Renderer], below_m: float) -> None:
    for renderer in renderers:
        pose = make_T(rotation_from_rpy(0.1, -0.05, 0.7), (0.02, 0.01, 2.2 - below_m))
        assert picture_kind(renderer.render([pose])) == "ok"


@pytest.mark.parametrize("band_px", [0.0, 0.5, 0.8])
@pytest.mark.parametrize("quality", [None, 50])
def test_snow(band_px: float, quality: int | None) -> None:
    image = snow(1, band_px)
    if quality is not None:
        packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)
    assert picture_kind(image) == "snow"


@pytest.mark.parametrize(("level", "sigma", "kind"), [
    *((level, sigma, kind) for sigma in (0.0, 0.6)
      for level, kind in ((0, "dark"), (24, "dark"), (41, "uniform"))),
    (8, 6.0, "dark"),  # a covered lens
])  # fmt: skip
def test_blank_screens_and_a_covered_lens(level: int, sigma: float, kind: str) -> None:
    assert picture_kind(noisy(level, sigma)) == kind


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.floats(2.0, 20.0), st.floats(60.0, 200.0))
def test_sensor_noise_alone_is_not_snow(seed: int, sigma: float, level: float) -> None:
    assert picture_kind(noisy(level, sigma, seed)) == "ok"


def judge(images: list[NDArray[np.uint8]], live: bool = True) -> list[str]:
    health = FrameHealth()
    return [health.assess(frame(image, k / 30.0), live) for k, image in enumerate(images)]


def test_a_frozen_picture_first_repeats_then_is_frozen() -> None:
    a, b = noisy(120, 5.0, 1), noisy(120, 5.0, 2)
    verdicts = judge([a, b] + [b.copy() for _ in range(20)])
    assert verdicts == ["ok"] * 2 + ["repeated"] * 11 + ["frozen"] * 9, "0.4 s at 30 Hz"

    b[240, 320] ^= 1
    assert judge([a] * 30 + [b, a])[29:] == ["frozen", "ok", "ok"], "one pixel"


def test_recordings_may_repeat_and_what_a_source_calls_repeated_is() -> None:
    assert set(judge([noisy(120, 5.0)] * 30, live=False)) == {"ok"}
    repeated = replace(frame(noisy(120, 5.0)), is_repeated=True)
    assert FrameHealth().assess(repeated) == "repeated"


# --- Pictures that a receiver gives out again ---------------------------------------------


def test_a_repetition_takes_no_new_pictures_place() -> None:
    a, b = noisy(100.0, 5.0, 1), noisy(100.0, 5.0, 2)
    slot = NewestSlot()
    slot.put(a, 1.0, 1.1)
    slot.put(a.copy(), 1.016, 1.116)
    first = slot.take()
    assert first is not None
    assert (first.index, first.t_s, first.is_repeated) == (0, 1.0, False), "at its first time"
    slot.put(a.copy(), 1.033, 1.133)
    again = slot.take()
    assert again is not None
    assert (again.index, again.t_arrival_s, again.is_repeated) == (0, 1.133, True)
    slot.put(a.copy(), 1.05, 1.15)
    slot.put(b, 1.06, 1.16)
    slot.put(b.copy(), 1.07, 1.17)
    new = slot.take()
    assert new is not None
    assert (new.index, new.t_s, new.is_repeated) == (1, 1.06, False)
    assert slot.take() is None
