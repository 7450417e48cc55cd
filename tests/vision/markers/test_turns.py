"""After a loss the searches take turns: none is left out, and no frame has two dear ones."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.profile import DetectorConfig
from perchctl.vision import Frame, PipelineState, step
from perchctl.vision.markers import detect as detect_room
from perchctl.vision.markers import search as search_room
from tests.helpers.target_picture import pose_of, render

RATE_HZ = 30.0
EMPTY: NDArray[np.uint8] = np.full((480, 640), 120, np.uint8)
NEAR, ASIDE = pose_of(0.05, -0.05, 1.2, 0.4), pose_of(-0.45, 0.3, 1.2, 0.4)


@dataclass
class Done:
    """What one frame was searched by."""

    window: int = 0
    whole: int = 0
    near_in_blur: int = 0
    all_in_blur: int = 0

    @property
    def dear(self) -> int:
        return self.whole + self.near_in_blur + self.all_in_blur


@dataclass
class Stream:
    """Frames through the pipeline, and what each was searched by."""

    setup: object
    state: PipelineState = field(default_factory=PipelineState)
    done: list[Done] = field(default_factory=list)

    def see(self, picture: NDArray[np.uint8]) -> bool:
        self.done.append(Done())
        k = len(self.done)
        self.state, output = step(self.state, Frame(k, k / RATE_HZ, picture), None, self.setup)  # type: ignore[arg-type]
        return output.detections.large is not None


@pytest.fixture
def stream(build: object, monkeypatch: pytest.MonkeyPatch) -> Stream:
    made = Stream(build())  # type: ignore[operator]
    one_pass, near, anywhere = (
        search_room._pass,
        detect_room.expected_in_blur,
        detect_room.hidden_in_blur,
    )

    def passed(image, window, *rest):  # type: ignore[no-untyped-def]
        whole = image[window].shape == image.shape
        made.done[-1].whole += whole
        made.done[-1].window += not whole
        return one_pass(image, window, *rest)

    def near_in_blur(*rest):  # type: ignore[no-untyped-def]
        made.done[-1].near_in_blur += 1
        return near(*rest)

    def all_in_blur(*rest):  # type: ignore[no-untyped-def]
        made.done[-1].all_in_blur += 1
        return anywhere(*rest)

    monkeypatch.setattr(search_room, "_pass", passed)
    monkeypatch.setattr(detect_room, "expected_in_blur", near_in_blur)
    monkeypatch.setattr(detect_room, "hidden_in_blur", all_in_blur)
    return made


def test_no_frame_of_a_stream_has_two_dear_searches(stream: Stream) -> None:
    for k in range(60):
        stream.see(render(*NEAR) if k < 3 else EMPTY)
    lost = stream.done[3:]
    assert max(done.dear for done in lost) == 1
    # ... and each of them has its turn.
    assert sum(done.near_in_blur for done in lost) > 1
    assert sum(done.all_in_blur for done in lost) > 5
    assert sum(done.whole for done in lost) > 20
    assert lost[0].window > 0


def test_a_first_picture_is_searched_by_all(stream: Stream) -> None:
    stream.see(EMPTY)
    assert stream.done[0].whole == 1
    assert stream.done[0].all_in_blur == 1


@pytest.mark.parametrize("lost", [0, 1, 2, 3, 7, 40])
@pytest.mark.parametrize("place", [NEAR, ASIDE])
def test_what_comes_back_is_found_by_the_second_frame(
    stream: Stream, lost: int, place: tuple[np.ndarray, np.ndarray]
) -> None:
    """Wherever it is by then, sharp as it is; a jump out of the window costs one frame at most."""
    for _ in range(3):
        assert stream.see(render(*NEAR))
    for _ in range(lost):
        assert not stream.see(EMPTY)
    back = render(*place)
    assert any(stream.see(back) for _ in range(2))


@pytest.mark.parametrize("lost", [2, 6])
def test_without_fits_to_blurred_targets_no_frame_is_left_unsearched(
    build: object, lost: int
) -> None:
    stream = Stream(build(detector=DetectorConfig(blurred=False)))  # type: ignore[operator]
    for k in range(3 + lost):
        assert stream.see(render(*NEAR) if k < 3 else EMPTY) == (k < 3)
    assert stream.see(render(*NEAR))


def test_blur_after_a_loss_is_seen_through_near_the_old_place(stream: Stream) -> None:
    for _ in range(3):
        assert stream.see(render(*NEAR))
    soft = cv2.GaussianBlur(render(*pose_of(0.1, -0.03, 1.2, 0.4)).astype(np.float32), (0, 0), 5.0)
    picture = np.clip(np.rint(soft), 0, 255).astype(np.uint8)
    for _ in range(2):
        stream.see(EMPTY)
    assert any(stream.see(picture) for _ in range(2))
    assert stream.done[-1].near_in_blur == 1


def test_what_is_seen_and_not_the_target_does_not_end_the_sharp_search(stream: Stream) -> None:
    """A stranger in every frame: once nothing is expected any more, all is searched."""
    for _ in range(8):
        assert stream.see(render(*NEAR))
    farther = render(*pose_of(-0.3, 0.2, 2.2, 0.4))
    for _ in range(45):
        stream.see(farther)
    assert stream.state.lock is not None
    assert stream.state.lock.pose.tvec_m[2] < 1.3
    assert [(done.whole, done.all_in_blur) for done in stream.done[-10:]] == [(1, 0)] * 10
