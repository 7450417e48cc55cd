"""Markers where they are expected, covered, or hidden by blur."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig
from perchctl.vision.camera_model import project
from perchctl.vision.markers.blurred import expected_in_blur, hidden_in_blur
from perchctl.vision.markers.detect import detect, make_detector
from perchctl.vision.markers.follow import (
    around,
    cells_agree,
    completed,
    follow,
    nested,
    resemblance,
)
from perchctl.vision.pose import square
from perchctl.vision.types import MARKERS, Detection, Detections, Frame, MarkerName
from tests.helpers.target_picture import CAMERA, pose_of, render

SETUP = make_detector(DetectorConfig(), TargetConfig())
SIDES: dict[MarkerName, float] = {"large": 0.150, "small": 0.025}
POSE = pose_of(0.03, -0.02, 0.35, 0.7, 0.05, -0.08)
PLAIN = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000))


def corners(name: MarkerName, pose: tuple[Array, Array] = POSE) -> Array:
    return project(square(SIDES[name]), *pose, CAMERA)


def both(pose: tuple[Array, Array] = POSE, shift_px: float = 0.0) -> dict[MarkerName, Array]:
    return {name: corners(name, pose) + shift_px for name in MARKERS}


def blurry(side_px: float, blur_px: float, seed: int) -> tuple[NDArray[np.uint8], Array]:
    """The target so far away that its large marker has that side, and true corners."""
    rng = np.random.default_rng(seed)
    z = 401.0 * 0.150 / side_px
    x, y, yaw, roll, pitch = rng.uniform(-1, 1, 5) * (0.3 * z, 0.25 * z, math.pi, 0.1, 0.1)
    pose = pose_of(x, y, z, yaw, roll, pitch)
    sharp = render(*pose, blur_px=0.8).astype(np.float32)
    soft = cv2.GaussianBlur(sharp, (0, 0), blur_px) + rng.normal(0.0, 2.0, sharp.shape)
    return np.clip(np.rint(soft), 0, 255).astype(np.uint8), corners("large", pose)


@pytest.mark.parametrize("shift_px", [0.0, 1.0, 2.5])
def test_expected_markers_are_proven_and_refined(shift_px: float) -> None:
    seen = follow(render(*POSE, noise=3.0), both(shift_px=shift_px), SETUP.patterns, CAMERA)
    assert set(seen) == {"large", "small"}
    assert seen["large"].refined
    assert np.abs(seen["large"].corners_px - corners("large")).max() < 0.1
    assert np.abs(seen["small"].corners_px - corners("small")).max() < 0.4


def test_other_cells_other_turns_and_mirror_images_are_not_proven() -> None:
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


def test_every_single_cell_counts() -> None:
    image = render(*POSE)
    pattern = SETUP.patterns["large"]
    assert cells_agree(image, corners("large"), pattern)
    H = cv2.getPerspectiveTransform(
        np.array([[0, 0], [6, 0], [6, 6], [0, 6]], dtype=np.float32),
        corners("large").astype(np.float32),
    )
    central = {(r, c) for r in (2, 3) for c in (2, 3)}
    for row in range(6):
        for column in range(6):
            if (row, column) in central:
                continue  # the small marker covers part of these
            spoilt = image.copy()
            cell = np.array([[column, row], [column + 1, row], [column + 1, row + 1],
                             [column, row + 1]], dtype=np.float64)  # fmt: skip
            quad = cv2.perspectiveTransform(cell[:, None], H)[:, 0]
            grey = int(image[tuple(np.rint(quad.mean(axis=0)[::-1]).astype(int))])
            cv2.fillConvexPoly(spoilt, np.rint(quad).astype(np.int32), 30 if grey > 120 else 205)
            assert not cells_agree(spoilt, corners("large"), pattern), (row, column)


def test_resemblance_tells_the_turn_of_a_marker() -> None:
    image = cv2.GaussianBlur(render(*POSE), (0, 0), 2.0)
    for name in MARKERS:
        for k in range(4):
            rolled = np.roll(corners(name), -k, axis=0)
            likeness = resemblance(np.asarray(image), rolled, SETUP.patterns[name])
            assert int(np.argmax(likeness)) == k
            assert likeness[k] > 0.8


def test_one_marker_says_where_the_other_is() -> None:
    assert np.abs(nested(corners("large"), 1 / 6, CAMERA) - corners("small")).max() < 0.01
    whole = completed({"small": corners("small")}, SETUP.ratio, CAMERA)
    assert np.abs(whole["large"] - corners("large")).max() < 0.01
    assert set(completed({"large": corners("large")}, SETUP.ratio, CAMERA)) == {"large", "small"}


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
    found = detect(Frame(0, 0.0, image), None, SETUP, CAMERA)
    assert found.large is not None
    assert np.abs(found.large.corners_px - true).max() < 0.3


def test_around_a_lone_small_marker_there_is_no_large_one() -> None:
    pose = pose_of(0.02, 0.0, 0.5, 0.3)
    image = render(*pose, markers=("small",))
    found = detect(Frame(0, 0.0, image), None, SETUP, CAMERA)
    assert found.small is not None
    assert found.large is None
    seen = follow(image, {"small": corners("small", pose)}, SETUP.patterns, CAMERA)
    assert around(image, seen["small"], SETUP.patterns, CAMERA) is None


@pytest.mark.parametrize("seed", range(3))
def test_blur_that_hides_the_target_from_the_plain_detector(seed: int) -> None:
    image, true = blurry(26.0, 3.0, seed)
    ids = PLAIN.detectMarkers(image)[1]
    assert ids is None or 997 not in ids
    still = hidden_in_blur(image, SETUP, CAMERA)
    assert np.abs(still["large"].corners_px - true).max() < 0.5
    found = detect(Frame(0, 0.0, image), None, SETUP, CAMERA)
    assert found.large is not None
    blind = make_detector(DetectorConfig(blurred=False), TargetConfig())
    assert detect(Frame(0, 0.0, image), None, blind, CAMERA).large is None


@pytest.mark.parametrize("seed", range(3))
def test_in_blur_the_target_is_found_beside_where_it_is_expected(seed: int) -> None:
    image, true = blurry(24.0, 3.0, seed)
    way = np.random.default_rng(seed).uniform(-8.0, 8.0, 2)
    seen = expected_in_blur(image, {"large": true + way}, SETUP.patterns, CAMERA)
    assert np.abs(seen["large"].corners_px - true).max() < 0.5
    before = Detections(0, 0.0, Detection("large", true + way, 0.1, True))
    found = detect(Frame(1, 0.033, image), before, SETUP, CAMERA)
    assert found.large is not None
    assert np.abs(found.large.corners_px - true).max() < 0.5


def test_in_blur_nothing_is_taken_for_the_target() -> None:
    rng = np.random.default_rng(2)
    expected = {"large": np.array([[300.0, 200.0], [330.0, 200.0], [330.0, 230.0], [300.0, 230.0]])}
    for sigma in (1.0, 2.0, 4.0):
        noise = rng.normal(0.0, 200.0 * sigma, (480, 640)).astype(np.float32)
        image = np.clip(130 + cv2.GaussianBlur(noise, (0, 0), sigma), 0, 255).astype(np.uint8)
        for _ in range(3):  # dark squares with a light inside, of no marker
            x, y, side = rng.integers(60, 400), rng.integers(60, 380), int(rng.integers(14, 60))
            image[y : y + side, x : x + side] = 30
            image[y + side // 5 : y + 4 * side // 5, x + side // 5 : x + 4 * side // 5] = 210
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)
        assert hidden_in_blur(image, SETUP, CAMERA) == {}
        assert expected_in_blur(image, expected, SETUP.patterns, CAMERA) == {}
