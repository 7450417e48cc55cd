"""Verdicts on frames: what the simulated camera gives is usable, what a dead link gives is not."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from perchctl.camera import HealthState, HealthVerdict, NewestSlot, assess_frame
from perchctl.camera.health import content
from perchctl.geometry import make_T, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim import Renderer, Scenario
from perchctl.sim.camera import BLUE_GREY
from perchctl.vision import CameraModel, Frame
from tests.helpers.interlaced import Pass

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
        for sigma, bare, analogue in (
            (5.0, False, 0.0),
            (20.0, False, 0.0),
            (0.0, True, 0.0),
            (20.0, True, 0.0),
            (10.0, False, 1.0),
        )
    ]
    return [Renderer(scene, camera, TargetConfig()) for scene in scenes]


@pytest.mark.parametrize("below_m", [0.03, 0.08, 0.2, 0.5, 1.2, 2.1])
def test_pictures_of_the_ceiling_are_usable(renderers: list[Renderer], below_m: float) -> None:
    for renderer in renderers:
        pose = make_T(rotation_from_rpy(0.1, -0.05, 0.7), (0.02, 0.01, 2.2 - below_m))
        assert content(renderer.render([pose])) == "ok"


@pytest.mark.parametrize("band_px", [0.0, 0.5, 0.8])
@pytest.mark.parametrize("quality", [None, 50])
def test_snow(band_px: float, quality: int | None) -> None:
    image = snow(1, band_px)
    if quality is not None:
        packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)
    assert content(image) == "snow"


@pytest.mark.parametrize(("level", "kind"), [(0, "dark"), (24, "dark"), (41, "uniform")])
def test_blank_screens(level: int, kind: str) -> None:
    assert content(np.full(SHAPE, level, np.uint8)) == kind
    assert content(noisy(level, 0.6)) == kind


def test_a_covered_lens_is_dark() -> None:
    assert content(noisy(8, 6.0)) == "dark"


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.floats(2.0, 20.0), st.floats(60.0, 200.0))
def test_sensor_noise_alone_is_not_snow(seed: int, sigma: float, level: float) -> None:
    assert content(noisy(level, sigma, seed)) == "ok"


def judge(images: list[NDArray[np.uint8]], live: bool = True) -> list[HealthVerdict]:
    state, verdicts = HealthState(), []
    for k, image in enumerate(images):
        state, verdict = assess_frame(state, frame(image, k / 30.0), live)
        verdicts.append(verdict)
    return verdicts


def test_a_frozen_picture_first_repeats_then_is_frozen() -> None:
    a, b = noisy(120, 5.0, 1), noisy(120, 5.0, 2)
    verdicts = judge([a, b] + [b.copy() for _ in range(20)])
    assert [v.usable for v in verdicts[:2]] == [True, True]
    assert not any(v.usable for v in verdicts[2:])
    assert verdicts[2].kind == "repeated"
    assert verdicts[-1].kind == "frozen"
    first_frozen = next(k for k, v in enumerate(verdicts) if v.kind == "frozen")
    assert first_frozen == 1 + 12, "0.4 s at 30 Hz"


def test_one_changed_pixel_ends_the_freeze() -> None:
    a = noisy(120, 5.0, 1)
    b = a.copy()
    b[240, 320] ^= 1
    verdicts = judge([a] * 30 + [b] + [a])
    assert verdicts[29].kind == "frozen"
    assert [v.kind for v in verdicts[30:]] == ["ok", "ok"]


def test_recordings_may_repeat() -> None:
    assert all(v.usable for v in judge([noisy(120, 5.0)] * 30, live=False))


def test_every_verdict_says_what_it_means() -> None:
    _, verdict = assess_frame(HealthState(), frame(snow(3, 0.5)))
    assert "no signal" in verdict.text


# --- Pictures that a receiver gives out again ---------------------------------------------


@cache
def given_out() -> list[Frame]:
    return list(Pass(camera_receiver_hz=60.0).frames(60))


def test_over_any_source_equal_bytes_are_a_repetition_and_nothing_else() -> None:
    frames = given_out()
    truth = [False] + [a.index == b.index for a, b in zip(frames[1:], frames, strict=False)]
    assert 30 < sum(truth) < 40
    slot, told = NewestSlot(), []
    for frame in frames:
        slot.put(frame.image, frame.t_s, frame.t_arrival_s)
        taken = slot.take()
        assert taken is not None
        told.append(taken.repeated)
    assert told == truth


def test_a_repetition_takes_no_new_pictures_place() -> None:
    a, b = noisy(100.0, 5.0, 1), noisy(100.0, 5.0, 2)
    slot = NewestSlot()
    slot.put(a, 1.0, 1.1)
    slot.put(a.copy(), 1.016, 1.116)
    first = slot.take()
    assert first is not None
    assert (first.index, first.t_s, first.repeated) == (0, 1.0, False), "at its first time"
    slot.put(a.copy(), 1.033, 1.133)
    again = slot.take()
    assert again is not None
    assert (again.index, again.t_arrival_s, again.repeated) == (0, 1.133, True)
    slot.put(a.copy(), 1.05, 1.15)
    slot.put(b, 1.06, 1.16)
    slot.put(b.copy(), 1.07, 1.17)
    new = slot.take()
    assert new is not None
    assert (new.index, new.t_s, new.repeated) == (1, 1.06, False)
    assert slot.take() is None


def test_repetitions_are_not_frozen_and_a_receiver_that_is_stuck_is() -> None:
    pictures = [frame.image for frame in given_out()]
    slot, state, kinds = NewestSlot(), HealthState(), []
    for k, picture in enumerate(pictures + [pictures[-1]] * 40):
        slot.put(picture, k / 60, k / 60)
        frame = slot.take()
        assert frame is not None
        state, verdict = assess_frame(state, frame)
        kinds.append(verdict.kind)
    moving, stuck = kinds[: len(pictures)], kinds[len(pictures) :]
    assert set(moving) == {"ok", "repeated"}
    assert stuck[0] == "repeated"
    assert stuck[-1] == "frozen"
    assert 20 <= stuck.index("frozen") <= 26, "0.4 s after it was new"


# --- the simulated receiver -------------------------------------------------------------


def test_the_receiver_gives_out_at_its_own_rate_the_newest_that_has_arrived() -> None:
    frames = given_out()
    ticks = np.diff([frame.t_arrival_s for frame in frames])
    assert ticks == pytest.approx(np.full(59, 1 / 60))
    assert set(np.bincount([frame.index for frame in frames])[1:-1]) == {2, 3}
    assert all(frame.t_arrival_s - frame.t_s >= 0.06 - 1e-9 for frame in frames)


@pytest.mark.long
def test_blue_screens_come_by_the_seed_and_change_no_other_picture() -> None:
    plain = list(Pass().frames(25))
    blanks = list(Pass(camera_blank_rate=0.3).frames(25))
    blue = [float(f.image.std()) < 1.5 for f in blanks]
    assert 2 < sum(blue) < 15
    for p, b, is_blue in zip(plain, blanks, blue, strict=True):
        assert p.t_arrival_s == b.t_arrival_s
        if is_blue:
            assert float(b.image.mean()) == pytest.approx(BLUE_GREY, abs=0.5)
        else:
            assert np.array_equal(p.image, b.image)
