from __future__ import annotations

import numpy as np
import pytest

from perchctl.vision.markers.search import choose, search_window
from tests.helpers.markers import SETUP, box

RATIO = SETUP.ratio


def test_the_window_leaves_room_for_the_large_marker_around_the_small_one() -> None:
    window = search_window({"small": box(300, 240, 20)}, RATIO, (480, 640))
    assert window is not None
    assert window.left <= 240
    assert window.right >= 360
    assert window.top <= 180
    assert window.bottom >= 300
    close = search_window({"small": box(300, 240, 90)}, RATIO, (480, 640))
    assert close is not None
    assert close.width * close.height < 0.4 * 640 * 480
    assert search_window({"large": box(320, 240, 430)}, RATIO, (480, 640)) is None


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
def test_choice_among_candidates(large, small, expected, result) -> None:  # type: ignore[no-untyped-def]
    chosen = choose({"large": large, "small": small}, expected, RATIO)
    pools = {"large": large, "small": small}
    assert set(chosen) == set(result)
    for name, index in result.items():
        assert chosen[name] is pools[name][index]  # type: ignore[index]
