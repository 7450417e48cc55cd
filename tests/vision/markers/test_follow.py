"""Markers where they are expected, and the large one around a small one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig
from perchctl.vision.markers.detect import detect, make_detector
from perchctl.vision.markers.follow import around, follow
from tests.helpers.markers import POSE, SETUP, both, corners, frame
from tests.helpers.target_picture import CAMERA, pose_of, render


@pytest.mark.parametrize("shift_px", [0.0, 1.0, 2.5])
def test_expected_markers_are_verified_and_refined(shift_px: float) -> None:
    seen = follow(render(*POSE, noise=3.0), both(shift_px=shift_px), SETUP.patterns, CAMERA)
    assert set(seen) == {"large", "small"}
    assert seen["large"].refined
    assert np.abs(seen["large"].corners_px - corners("large")).max() < 0.1
    assert np.abs(seen["small"].corners_px - corners("small")).max() < 0.4


def test_other_cells_other_turns_and_mirror_images_are_not_verified() -> None:
    image = render(*POSE)
    other = make_detector(
        DetectorConfig(),
        TargetConfig(
            large=MarkerConfig(dictionary="DICT_4X4_1000", id=16, side_m=0.150),
            small=MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=7, side_m=0.025),
        ),
    )
    assert follow(image, both(), other.patterns, CAMERA) == {}
    for k in (1, 2, 3):
        turned = {name: np.roll(quad, k, axis=0) for name, quad in both().items()}
        assert follow(image, turned, SETUP.patterns, CAMERA) == {}
    mirrored = {name: quad[::-1] for name, quad in both().items()}
    assert follow(image, mirrored, SETUP.patterns, CAMERA) == {}
    empty = np.full_like(image, 120)
    assert follow(empty, both(), SETUP.patterns, CAMERA) == {}


def test_a_small_marker_too_small_for_lines_is_seen_in_its_place() -> None:
    pose = pose_of(0.05, 0.0, 1.0, 0.4)
    expected = {"large": corners("large", pose)}
    seen = follow(render(*pose, noise=3.0), expected, SETUP.patterns, CAMERA)
    assert not seen["small"].refined
    assert np.abs(seen["small"].corners_px - corners("small", pose)).max() < 0.5
    alone = render(*pose, markers=("large",), noise=3.0)
    assert set(follow(alone, expected, SETUP.patterns, CAMERA)) == {"large"}


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
    found = detect(frame(image), None, SETUP, CAMERA)
    assert found.large is not None
    assert np.abs(found.large.corners_px - true).max() < 0.3


def test_around_a_lone_small_marker_there_is_no_large_one() -> None:
    pose = pose_of(0.02, 0.0, 0.5, 0.3)
    image = render(*pose, markers=("small",))
    found = detect(frame(image), None, SETUP, CAMERA)
    assert found.small is not None
    assert found.large is None
    seen = follow(image, {"small": corners("small", pose)}, SETUP.patterns, CAMERA)
    assert around(image, seen["small"], SETUP.patterns, CAMERA) is None
