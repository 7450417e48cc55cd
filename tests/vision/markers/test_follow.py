"""Markers where they are expected, and the large one around a small one."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig
from perchctl.vision import make_aruco_detector
from perchctl.vision.markers.corners import RefinedCorners
from perchctl.vision.markers.detect import Picture, around, detect_markers, follow
from perchctl.vision.markers.partial import KnownBy, seen_partly
from tests.helpers.markers import POSE, SETUP, both, corners, followed, frame
from tests.helpers.target_picture import CAMERA, pose_of, render


@pytest.mark.parametrize("shift_px", [0.0, 1.0, 2.5])
def test_expected_markers_are_verified_and_refined(shift_px: float) -> None:
    seen = followed(render(*POSE, noise=3.0), both(shift_px=shift_px))
    assert set(seen) == {"large", "small"}
    assert seen["large"].refined
    assert np.abs(seen["large"].corners_px - corners("large")).max() < 0.1
    assert np.abs(seen["small"].corners_px - corners("small")).max() < 0.4


def test_other_cells_other_turns_and_mirror_images_are_not_verified() -> None:
    image = render(*POSE)
    other = make_aruco_detector(
        DetectorConfig(),
        TargetConfig(
            large=MarkerConfig(dictionary="DICT_4X4_1000", id=16, side_m=0.150),
            small=MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=7, side_m=0.025),
        ),
    )
    assert followed(image, both(), other.patterns) == {}
    for k in (1, 2, 3):
        turned = {name: np.roll(quad, k, axis=0) for name, quad in both().items()}
        assert followed(image, turned) == {}
    mirrored = {name: quad[::-1] for name, quad in both().items()}
    assert followed(image, mirrored) == {}
    empty = np.full_like(image, 120)
    assert followed(empty, both()) == {}


def test_a_small_marker_too_small_for_lines_is_seen_in_its_place() -> None:
    pose = pose_of(0.05, 0.0, 1.0, 0.4)
    expected = {"large": corners("large", pose)}
    seen = followed(render(*pose, noise=3.0), expected)
    assert not seen["small"].refined
    assert np.abs(seen["small"].corners_px - corners("small", pose)).max() < 0.5
    alone = render(*pose, markers=("large",), noise=3.0)
    assert set(followed(alone, expected)) == {"large"}


@pytest.mark.parametrize("cover", ["corner", "stripe", "none"])
def test_a_partly_covered_large_marker_is_measured_by_the_small_one(cover: str) -> None:
    pose = pose_of(0.05, 0.02, 0.6, 0.5, 0.05, -0.05)
    image = render(*pose, noise=2.0)
    true = corners("large", pose)
    if cover == "corner":
        x, y = np.rint(true[1]).astype(int)
        image[y - 14 : y + 10, x - 12 : x + 14] = 40
    elif cover == "stripe":
        a, b = true[0] * 0.6 + true[3] * 0.4, true[1] * 0.7 + true[2] * 0.3
        a, b = a + 1.6 * (a - b), b + 1.6 * (b - a)
        # beside the small marker, across two sides of the large one
        offset = 0.34 * (true[3] - true[0])
        ends = [tuple(np.rint(p + offset).astype(int).tolist()) for p in (a, b)]
        cv2.line(image, ends[0], ends[1], 50, 4)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.large is not None
    assert np.abs(found.large.corners_px - true).max() < 0.3


def test_around_a_lone_small_marker_there_is_no_large_one() -> None:
    pose = pose_of(0.02, 0.0, 0.5, 0.3)
    image = render(*pose, markers=("small",))
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.small is not None
    assert found.large is None
    seen = follow(Picture(image, None, SETUP, CAMERA), {"small": corners("small", pose)})
    assert around(Picture(image, None, SETUP, CAMERA), seen["small"]) is None


@pytest.mark.parametrize("seed", range(4))
def test_a_large_marker_that_is_cut_off_is_looked_for_around_the_small_one(seed: int) -> None:
    """As both are expected 6 px aside of where they are, as a vehicle in motion has it."""
    rng = np.random.default_rng(seed)
    pose = pose_of(*rng.uniform(-0.004, 0.004, 2), 0.12, rng.uniform(-math.pi, math.pi))
    image = render(*pose, noise=3.0, seed=seed)
    turn = rng.uniform(-math.pi, math.pi)
    off_px = 6.0 * np.array([math.cos(turn), math.sin(turn)])
    expected = {name: quad + off_px for name, quad in both(pose).items()}
    seen = followed(image, expected)
    assert seen["small"].refined
    assert np.abs(seen["large"].corners_px - corners("large", pose)).max() < 0.5


def test_a_near_target_that_has_moved_on_is_looked_for_nearby_before_parts_of_it_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[KnownBy] = []

    def noting(*args: Any) -> RefinedCorners | None:
        asked.append(args[4])
        return seen_partly(*args)

    monkeypatch.setattr("perchctl.vision.markers.detect.seen_partly", noting)
    pose = pose_of(0.0, 0.0, 0.16, 0.4)
    expected = both(pose, shift_px=25.0)
    found = detect_markers(frame(render(*pose, noise=3.0)), None, SETUP, CAMERA, expected)
    for name, one in (("large", found.large), ("small", found.small)):
        assert one is not None
        assert np.abs(one.corners_px - corners(name, pose)).max() < 0.2  # type: ignore[arg-type]
    assert not asked
