"""The ratio of the two prints from their corners, and when it is named an error."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.profile import TargetConfig
from perchctl.target.drawing import marker_corners_m
from perchctl.target.print_check import SizeRatio, combined, size_ratio, verdict
from perchctl.vision import CameraModel

TARGET = TargetConfig()
K = np.array([[380.0, 0.0, 321.5], [0.0, 380.6, 238.2], [0.0, 0.0, 1.0]])
CAMERA = CameraModel((640, 480), K, np.array([-0.17, 0.04, 0.0004, -0.0007, -0.003]))


def corners(
    scale: float, z_m: float, rng: np.random.Generator, sigma_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both markers, the small one printed `scale` times too large, tilted and turned."""
    rvec = np.array([np.pi, 0.0, 0.0]) + rng.normal(0.0, 0.08, 3)
    tvec = np.array([*rng.uniform(-0.02, 0.02, 2), z_m])
    quads = []
    for side in (TARGET.large.side_m, scale * TARGET.small.side_m):
        image, _ = cv2.projectPoints(marker_corners_m(side), rvec, tvec, CAMERA.K, CAMERA.dist)
        quads.append(image.reshape(-1, 2) + rng.normal(0.0, sigma_px, (4, 2)))
    return quads[0], quads[1]


def frames(scale: float, sigma_px: float, count: int, seed: int = 1) -> list[SizeRatio]:
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        large, small = corners(scale, float(rng.uniform(0.18, 0.26)), rng, sigma_px)
        ratio = size_ratio(large, small, (sigma_px, sigma_px), CAMERA, TARGET)
        assert ratio is not None
        found.append(ratio)
    return found


@pytest.mark.parametrize("scale", [0.97, 1.0, 1.004, 1.02])
def test_exact_corners_give_the_exact_ratio(scale: float) -> None:
    rng = np.random.default_rng(4)
    large, small = corners(scale, 0.2, rng, 0.0)
    ratio = size_ratio(large, small, (0.05, 0.05), CAMERA, TARGET)
    assert ratio is not None
    assert ratio.value == pytest.approx(scale, abs=1e-6)
    assert ratio.small_px == pytest.approx(0.025 * scale * 380.0 / 0.2, rel=0.1)


def test_its_sigma_is_what_many_frames_spread() -> None:
    ratios = frames(1.0, 0.05, 300)
    normalised = np.array([(r.value - 1.0) / r.sigma for r in ratios])
    # Inflated by the residuals, never deflated: a little below one.
    assert 0.75 < normalised.std() < 1.1
    assert abs(normalised.mean()) < 0.2


def test_frames_together_are_surer_than_one() -> None:
    ratios = frames(1.02, 0.05, 100)
    whole = combined(ratios)
    assert whole is not None
    assert whole.frames == 100
    assert whole.sigma < 0.2 * ratios[0].sigma
    assert whole.value == pytest.approx(1.02, abs=4.0 * whole.sigma)
    assert combined([]) is None


@pytest.mark.parametrize(
    ("scale", "wrong"), [(1.0, False), (1.001, False), (0.97, True), (1.02, True)]
)
def test_only_an_error_beyond_the_noise_is_named(scale: float, wrong: bool) -> None:
    found = verdict(combined(frames(scale, 0.05, 60)), TARGET)
    assert found.wrong is wrong
    said = re.search(r"small marker is ([0-9.]+) of the large one", found.text)
    assert said is not None
    assert float(said[1]) == pytest.approx(scale / 6.0, rel=2e-3)
    assert ("--measured-small" in found.text) is wrong


def test_noise_hides_a_small_error_and_few_frames_say_nothing() -> None:
    assert not verdict(combined(frames(1.006, 0.6, 6)), TARGET).wrong
    assert "not judged" in verdict(combined(frames(1.05, 0.05, 2)), TARGET).text
    assert "not judged" in verdict(None, TARGET).text


@pytest.mark.parametrize("bad", ["nan", "one point", "sigma"])
def test_corners_that_say_nothing_give_none(bad: str) -> None:
    large, small = corners(1.0, 0.2, np.random.default_rng(2), 0.0)
    sigma = (0.05, 0.05)
    if bad == "nan":
        small = np.full((4, 2), np.nan)
    elif bad == "one point":
        large, small = np.full((4, 2), 300.0), np.full((4, 2), 300.0)
    else:
        sigma = (0.0, 0.05)
    assert size_ratio(large, small, sigma, CAMERA, TARGET) is None
