"""The ratio of the two prints from their corners, and when it is named an error."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.profile import TargetConfig
from perchctl.target.drawing import marker_corners_m
from perchctl.target.prints import PrintCheck, size_ratio
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


def checked(scale: float, sigma_px: float, count: int, wrong: int = 0) -> PrintCheck:
    """A check of so many pictures, of which the last `wrong` show something else."""
    rng, check = np.random.default_rng(1), PrintCheck(CAMERA, TARGET)
    for k in range(count):
        large, small = corners(scale, float(rng.uniform(0.18, 0.26)), rng, sigma_px)
        check.add_corners(large, small + 3.0 * rng.normal(size=2) * (k >= count - wrong))
    return check


@pytest.mark.parametrize("scale", [0.97, 1.0, 1.02])
def test_exact_corners_give_the_exact_ratio(scale: float) -> None:
    large, small = corners(scale, 0.2, np.random.default_rng(4), 0.0)
    ratio = size_ratio(large, small, CAMERA, TARGET)
    assert ratio is not None
    assert ratio[0] == pytest.approx(scale, abs=1e-5)
    assert size_ratio(large, np.full((4, 2), np.nan), CAMERA, TARGET) is None
    assert size_ratio(*np.full((2, 4, 2), 300.0), CAMERA, TARGET) is None


def claimed(text: str) -> tuple[float, float]:
    """The ratio of the sides and its sigma, a share."""
    found = re.search(r"is ([0-9.]+) of the large one.*sigma ([0-9.]+) %", text)
    assert found is not None, text
    return float(found[1]), float(found[2]) / 100


@pytest.mark.parametrize(
    ("scale", "wrong"), [(1.0, False), (1.001, False), (0.97, True), (1.02, True)]
)
def test_only_an_error_beyond_the_noise_is_named(scale: float, wrong: bool) -> None:
    named, text = checked(scale, 0.05, 60, wrong=6).verdict()
    assert named is wrong
    value, sigma = claimed(text)
    assert value == pytest.approx(scale / 6.0, abs=3.0 * sigma / 6.0 + 1e-4)
    assert ("--measured-small" in text) is wrong


def test_noise_hides_a_small_error_more_frames_are_surer_and_few_say_nothing() -> None:
    few, many = (claimed(checked(1.02, 1.0, n).verdict()[1])[1] for n in (10, 200))
    assert many < 0.4 * few
    assert not checked(1.006, 0.6, 6).verdict()[0]
    assert not checked(1.05, 0.05, 2).judged
    assert "not judged" in checked(1.05, 0.05, 2).verdict()[1]
