"""The search, its choice among candidates, and its turns after a loss."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.vision import Frame, PipelineState, step
from perchctl.vision.markers import detect as detect_room
from perchctl.vision.markers import search as search_room
from perchctl.vision.markers.search import choose
from tests.helpers.markers import SETUP, box
from tests.helpers.target_picture import pose_of, render

RATIO = SETUP.ratio


@pytest.mark.parametrize(
    ("large", "small", "expected", "result"),
    [
        ([box(200, 200, 60)], [box(200, 200, 10)], {}, {"large": 0, "small": 0}),
        ([box(200, 200, 60), box(400, 300, 60)], [box(400, 300, 10)], {}, {"large": 1, "small": 0}),
        # wrong size and wrong place: the small marker is dropped
        ([box(200, 200, 60)], [box(200, 200, 20)], {}, {"large": 0}),
        ([box(200, 200, 60)], [box(300, 200, 10)], {}, {"large": 0}),
        # turned by a quarter: not this target
        ([box(200, 200, 60)], [np.roll(box(200, 200, 10), 1, axis=0)], {}, {"large": 0}),
        # of two whole targets the one that the last detections continue, else the better
        (
            [box(200, 200, 60), box(400, 200, 60)],
            [box(200, 200, 10), box(400.5, 200, 10)],
            {"large": box(395, 205, 60)},
            {"large": 1, "small": 1},
        ),
        (
            [box(200, 200, 60), box(400, 200, 60)],
            [box(200, 200, 10), box(400.5, 200, 10)],
            {"small": box(210, 205, 10)},
            {"large": 0, "small": 0},
        ),
        (
            [box(200, 200, 60), box(400, 200, 60)],
            [box(200, 200, 10), box(400.5, 200, 10)],
            {},
            {"large": 0, "small": 0},
        ),
        # two of the same and nothing to choose by
        ([], [box(200, 200, 30), box(400, 200, 30)], {}, {}),
        ([], [box(200, 200, 30)], {}, {"small": 0}),
        # the last detections decide
        ([], [box(200, 200, 30), box(400, 200, 30)], {"small": box(410, 205, 30)}, {"small": 1}),
        ([box(100, 100, 60)], [box(400, 200, 30)], {"small": box(410, 205, 30)}, {"small": 0}),
        ([], [box(400, 200, 10)], {"large": box(405, 200, 60)}, {"small": 0}),
    ],
)
def test_choice_among_candidates(large, small, expected, result) -> None:
    chosen = choose({"large": large, "small": small}, expected, RATIO)
    pools = {"large": large, "small": small}
    assert set(chosen) == set(result)
    for name, index in result.items():
        assert chosen[name] is pools[name][index]


def test_a_whole_target_elsewhere_does_not_stand_in_for_the_own_one() -> None:
    """Of which the search sees one marker only: large of one, and small of the other, never."""
    large, small = [box(100, 100, 60), box(400, 200, 60)], [box(400, 200, 10)]
    near = choose({"large": large, "small": small}, {"large": box(104, 98, 60)}, RATIO)
    assert list(near) == ["large"]
    assert near["large"] is large[0]
    small = [box(100, 100, 10), box(400, 200, 10)]
    near = choose({"large": large[1:], "small": small}, {"small": box(104, 98, 10)}, RATIO)
    assert list(near) == ["small"]
    assert near["small"] is small[0]


def test_a_lone_look_alike_goes_before_a_whole_target_until_it_is_out_of_sight() -> None:
    """As the gate says of it: with the whole picture searched both are seen, and one is told."""
    whole = {"large": [box(400, 200, 60)], "small": [box(400, 200, 10)]}
    lone = {"large": box(104, 98, 60)}
    both = {"large": [box(100, 100, 60), *whole["large"]], "small": whole["small"]}
    assert list(choose(both, lone, RATIO)) == ["large"]
    assert choose(both, lone, RATIO)["large"] is both["large"][0]
    assert choose(whole, lone, RATIO) == {"large": whole["large"][0], "small": whole["small"][0]}
    # Not a look-alike of another size: that goes on from nothing.
    other = {"large": [box(100, 100, 20), *whole["large"]], "small": whole["small"]}
    assert choose(other, lone, RATIO)["large"] is whole["large"][0]


# --- After a loss the searches take turns: none is left out, and no frame has two dear ones ----


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
        self.state, output = step(self.state, Frame(k, k / RATE_HZ, picture), None, self.setup)
        return output.detections.large is not None


@pytest.fixture
def stream(build: object, monkeypatch: pytest.MonkeyPatch) -> Stream:
    made = Stream(build())
    one_pass, near, anywhere = (
        search_room._pass,
        detect_room.expected_in_blur,
        detect_room.hidden_in_blur,
    )

    def passed(image, window, *rest):
        whole = image[window].shape == image.shape
        made.done[-1].whole += whole
        made.done[-1].window += not whole
        return one_pass(image, window, *rest)

    def near_in_blur(*rest):
        made.done[-1].near_in_blur += 1
        return near(*rest)

    def all_in_blur(*rest):
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
