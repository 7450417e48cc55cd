from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from perchctl.vision.markers.detector import DetectorSetup, Thresholds, strict_detector
from perchctl.vision.markers.search import choose, search, search_window
from tests.helpers.markers import SETUP, both, box
from tests.helpers.markers import corners as corners_of
from tests.helpers.target_picture import pose_of, render

RATIO = SETUP.ratio


def test_the_window_leaves_room_for_the_large_marker_around_the_small_one() -> None:
    window = search_window({"small": box(300, 240, 20)}, RATIO, (480, 640))
    assert window is not None
    rows, columns = window
    assert columns.start <= 240 < 360 <= columns.stop
    assert rows.start <= 180 < 300 <= rows.stop
    close = search_window({"small": box(300, 240, 90)}, RATIO, (480, 640))
    assert close is not None
    assert np.empty((480, 640))[close].size < 0.4 * 640 * 480
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


@pytest.mark.parametrize(("z_m", "found"), [(0.1, {"small"}), (0.16, {"large", "small"})])
def test_large_markers_are_found_at_half_the_size_at_their_place(
    z_m: float, found: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the last centimetres the prediction may be off by more than lines are looked for. A search
    of the whole picture takes eight times as long."""
    widths: list[int] = []

    def noting(setup: DetectorSetup, size_px: tuple[int, int], thresholds: Thresholds) -> Any:
        widths.append(size_px[0])
        return strict_detector(setup, size_px, thresholds)

    monkeypatch.setattr("perchctl.vision.markers.search.strict_detector", noting)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        x_m, y_m = rng.uniform(-0.02, 0.02, 2) * z_m
        pose = pose_of(x_m, y_m, z_m, 0.5 * math.pi * seed + rng.uniform(-0.1, 0.1))
        off = {name: corners + rng.uniform(-25.0, 25.0, 2) for name, corners in both(pose).items()}
        seen = search(render(*pose, noise=4.0, seed=seed), off, SETUP, "near").corners_px
        assert seen.keys() == found
        for name, quad in seen.items():  # lines are looked for within 7 px
            assert np.abs(quad - corners_of(name, pose)).max() < 4.0
    assert len(widths) == 8
    assert max(widths) <= 320
