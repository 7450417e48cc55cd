"""The search, its choice among candidates, and its turns after a loss."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.vision import Frame, Pipeline, PipelineState, step
from perchctl.vision.markers.search import choose_markers
from tests.helpers.markers import SETUP, box
from tests.helpers.target_picture import pose_of, render

RATIO = SETUP.small_to_large_side_ratio
Build = Callable[..., Pipeline]


@pytest.mark.parametrize(
    ("large", "small", "expected", "result"),
    [
        ([box(200, 200, 60)], [box(200, 200, 10)], {}, {"large": 0, "small": 0}),
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
            {},
            {"large": 0, "small": 0},
        ),
        # two of the same and nothing to choose by
        ([], [box(200, 200, 30), box(400, 200, 30)], {}, {}),
        # the last detections decide
        ([], [box(200, 200, 30), box(400, 200, 30)], {"small": box(410, 205, 30)}, {"small": 1}),
        ([box(100, 100, 60)], [box(400, 200, 30)], {"small": box(410, 205, 30)}, {"small": 0}),
        ([], [box(400, 200, 10)], {"large": box(405, 200, 60)}, {"small": 0}),
    ],
)
def test_choice_among_candidates(large, small, expected, result) -> None:
    chosen = choose_markers({"large": large, "small": small}, expected, RATIO)
    pools = {"large": large, "small": small}
    assert set(chosen) == set(result)
    for name, index in result.items():
        assert chosen[name] is pools[name][index]


def test_a_whole_target_elsewhere_does_not_stand_in_for_the_own_one() -> None:
    """Of which the search sees one marker only: large of one, and small of the other, never."""
    large, small = [box(100, 100, 60), box(400, 200, 60)], [box(400, 200, 10)]
    near = choose_markers({"large": large, "small": small}, {"large": box(104, 98, 60)}, RATIO)
    assert list(near) == ["large"]
    assert near["large"] is large[0]
    # Not a look-alike of another size: that goes on from nothing.
    other = {"large": [box(100, 100, 20), large[1]], "small": small}
    assert choose_markers(other, {"large": box(104, 98, 60)}, RATIO)["large"] is large[1]
    small = [box(100, 100, 10), box(400, 200, 10)]
    near = choose_markers({"large": large[1:], "small": small}, {"small": box(104, 98, 10)}, RATIO)
    assert list(near) == ["small"]
    assert near["small"] is small[0]


# --- After a loss the searches take turns ------------------------------------------------------


EMPTY: NDArray[np.uint8] = np.full((480, 640), 120, np.uint8)
NEAR, ASIDE = pose_of(0.05, -0.05, 1.2, 0.4), pose_of(-0.45, 0.3, 1.2, 0.4)


@pytest.mark.parametrize(
    "lost", [0, 1, 2, *(pytest.param(lost, marks=pytest.mark.long) for lost in (3, 7, 40))]
)
@pytest.mark.parametrize("place", [NEAR, ASIDE])
def test_what_comes_back_is_found_by_the_second_frame(
    build: Build, lost: int, place: tuple[np.ndarray, np.ndarray]
) -> None:
    """Wherever it is by then, sharp as it is; a jump out of the window costs one frame at most."""
    images = [render(*NEAR)] * 3 + [EMPTY] * lost + [render(*place)] * 2
    state, seen, pipeline = PipelineState(), [], build()
    for k, image in enumerate(images):
        state, output = step(state, Frame(k, k / 30.0, image), None, pipeline)
        seen.append(output.detections.large is not None)
    assert seen[: 3 + lost] == [True] * 3 + [False] * lost
    assert any(seen[3 + lost :])
