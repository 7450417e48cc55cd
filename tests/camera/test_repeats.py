"""Pictures that a receiver gives out again: by equal bytes, and under a converter's noise."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.camera import HealthState, NewestSlot, assess_frame
from perchctl.camera.aideck import AiDeckSource
from perchctl.camera.device import DeviceSource
from perchctl.camera.health import MOST_AGAIN, RepeatState, repeated
from perchctl.camera.network import MjpegSource, RtspSource
from perchctl.sim.camera import BLUE_GREY
from perchctl.vision import Frame
from tests.helpers.interlaced import Pass

Grey = NDArray[np.uint8]


def judged(pictures: list[Grey], hz: float = 60.0) -> list[bool]:
    state, told = RepeatState(), []
    for k, picture in enumerate(pictures):
        state, again = repeated(state, picture, k / hz)
        told.append(again)
    return told


def noisy(image: Grey | float, sigma: float, seed: int) -> Grey:
    noise = np.random.default_rng(seed).standard_normal((480, 640), dtype=np.float32)
    return np.clip(np.rint(image + sigma * noise), 0, 255).astype(np.uint8)


@cache
def given_out(noise: float) -> list[Frame]:
    return list(Pass(camera_receiver_hz=60.0, camera_receiver_noise=noise).frames(60))


def of_25_in_60(noise: float, quality: int | None = None) -> tuple[list[Grey], list[bool]]:
    """What a receiver gives out, and which of it has been there before."""
    frames = given_out(noise)
    new = [a.index != b.index for a, b in zip(frames[1:], frames, strict=False)]
    pictures = [frame.image for frame in frames]
    if quality is not None:
        flags = [cv2.IMWRITE_JPEG_QUALITY, quality]
        packed = [cv2.imencode(".jpg", image, flags)[1] for image in pictures]
        pictures = [np.asarray(cv2.imdecode(p, cv2.IMREAD_GRAYSCALE), np.uint8) for p in packed]
    return pictures, [False] + [not each for each in new]


@pytest.mark.long
@pytest.mark.parametrize(("noise", "quality"), [(0.0, None), (0.0, 80), (1.0, None), (1.0, 90)])
def test_every_repetition_is_told_and_no_new_picture_is(noise: float, quality: int | None) -> None:
    pictures, truth = of_25_in_60(noise, quality)
    assert 30 < sum(truth) < 40
    told = judged(pictures)
    learned = 0 if noise == 0.0 else 24  # both kinds must have been seen first
    assert told[learned:] == truth[learned:]
    assert not any(t and not r for t, r in zip(told, truth, strict=True))


@pytest.mark.long
@pytest.mark.parametrize("at_rest", [True, False])
def test_a_camera_without_a_receiver_repeats_nothing(at_rest: bool) -> None:
    still = {"velocity_mps": (0.0, 0.0, 0.0), "turn_radps": 0.0} if at_rest else {}
    pictures = [frame.image for frame in Pass(**still).frames(30)]  # type: ignore[arg-type]
    assert not any(judged(pictures))


def test_a_rough_ceiling_at_rest_and_one_smoothed_by_a_codec_are_no_repetitions() -> None:
    rough = noisy(128.0, 40.0, 0)
    assert not any(judged([noisy(rough, 3.0, 1 + k) for k in range(40)]))
    smooth = [cv2.GaussianBlur(noisy(128.0, 3.0, k), (0, 0), 4.0) for k in range(40)]
    assert not any(judged(smooth))


@pytest.mark.parametrize(("wobble_hz", "hz"), [(5.8, 30.0), (5.0, 30.0), (10.0, 60.0)])
def test_a_camera_that_wobbles_under_a_rough_ceiling_repeats_nothing(
    wobble_hz: float, hz: float
) -> None:
    """By 3 px: at a turn of it two pictures are nearly the same. Where its period is a whole
    number of pictures each turn falls between two that are the same but for the noise."""
    grain = np.random.default_rng(7).standard_normal((500, 700)).astype(np.float32)
    rough = np.clip(128.0 + 120.0 * cv2.GaussianBlur(grain, (0, 0), 2.0), 0, 255)

    def at(k: int) -> Grey:
        x_px = 30.0 + 3.0 * np.cos(2 * np.pi * wobble_hz * (k + 0.5) / hz)
        shift = np.array([[1.0, 0.0, -x_px], [0.0, 1.0, -8.0]])
        return noisy(cv2.warpAffine(rough, shift, (640, 480)), 1.0, k)

    assert not any(judged([at(k) for k in range(60)], hz))


def test_a_heap_of_pictures_is_no_faster_stream() -> None:
    """Behind a computer that was busy they arrive together, and the wobble seems twice as fast."""
    pair = (noisy(128.0, 3.0, 0), noisy(128.0, 3.0, 1), noisy(128.0, 3.0, 2))
    pictures = [noisy(pair[k // 2 % 3], 1.0, k) for k in range(60)]
    assert any(judged(pictures, 60.0)), "30 in 60 are told"
    state = RepeatState()
    for k, picture in enumerate(pictures):
        t_s = k / 30.0 if k % 12 else (k + 5) / 30.0
        state, again = repeated(state, picture, t_s)
        assert not again, "15 in 30 are not, however they arrive"


def test_over_a_network_only_equal_bytes_are_a_repetition() -> None:
    pictures, truth = of_25_in_60(1.0)

    def taken(slot: NewestSlot) -> list[bool]:
        told = []
        for k, picture in enumerate(pictures):
            slot.put(picture, k / 60, k / 60)
            frame = slot.take()
            assert frame is not None
            told.append(frame.repeated)
        return told

    assert taken(NewestSlot(by_noise=True))[24:] == truth[24:]
    assert not any(taken(NewestSlot()))
    assert DeviceSource._converted
    assert not MjpegSource._converted
    assert not RtspSource._converted
    assert not AiDeckSource._converted


def test_nothing_but_equal_bytes_goes_on_for_long() -> None:
    """A receiver that stands still under a noise of its own is not told from a rough ceiling
    at rest: no flight may be starved of its pictures for that."""
    pictures, _ = of_25_in_60(1.0)
    stuck = [noisy(pictures[-1], 1.0, k) for k in range(45)]
    told = judged(pictures + stuck)[len(pictures) :]
    runs = "".join("r" if each else "." for each in told).split(".")
    assert max(map(len, runs)) <= MOST_AGAIN
    assert not any(told[30:])


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
    pictures, _ = of_25_in_60(0.0)
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
    frames = given_out(0.0)
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
