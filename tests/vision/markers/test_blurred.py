from __future__ import annotations

import cv2
import numpy as np
import pytest

from perchctl.profile import DetectorConfig, TargetConfig
from perchctl.vision import Detection, Detections, make_aruco_detector
from perchctl.vision.markers import blurred
from perchctl.vision.markers.blurred import expected_in_blur, hidden_in_blur
from perchctl.vision.markers.detect import detect_markers
from tests.helpers.markers import SETUP, blurry, frame
from tests.helpers.target_picture import CAMERA

PLAIN = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000))


@pytest.mark.parametrize("seed", range(3))
def test_blur_that_hides_the_target_from_the_plain_detector(seed: int) -> None:
    image, true = blurry(26.0, 3.0, seed)
    ids = PLAIN.detectMarkers(image)[1]
    assert ids is None or 997 not in ids
    still = hidden_in_blur(image, SETUP, CAMERA)
    assert np.abs(still["large"].corners_px - true).max() < 0.5
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.large is not None
    blind = make_aruco_detector(DetectorConfig(blurred=False), TargetConfig())
    assert detect_markers(frame(image), None, blind, CAMERA).large is None


def test_fits_to_a_blurred_marker_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit to a texture that resembles a marker costs as much as all else in a frame."""
    begun: list[float] = []

    def refused(*_: object, blur_px: float) -> None:
        begun.append(blur_px)

    monkeypatch.setattr(blurred, "aligned", refused)
    image, true = blurry(24.0, 3.0, 0)
    for turn in (None, 0, 1, 2):
        assert expected_in_blur(image, {"large": true}, SETUP.patterns, CAMERA, turn) == {}
    assert begun[2:] == [begun[0], begun[1], begun[0]]
    assert begun[0] < begun[1]


@pytest.mark.parametrize("seed", range(3))
def test_in_blur_the_target_is_found_beside_where_it_is_expected(seed: int) -> None:
    image, true = blurry(24.0, 3.0, seed)
    way = np.random.default_rng(seed).uniform(-8.0, 8.0, 2)
    seen = expected_in_blur(image, {"large": true + way}, SETUP.patterns, CAMERA)
    assert np.abs(seen["large"].corners_px - true).max() < 0.5
    before = Detections(0, 0.0, Detection("large", true + way, 0.1, True))
    found = detect_markers(frame(image, 1), before, SETUP, CAMERA)
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
