"""The default target's detector, and its markers' true corners in rendered pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, TargetConfig, aruco_dictionary
from perchctl.vision import MARKERS, Frame, project, square_corners
from perchctl.vision.markers.corners import RefinedCorners
from perchctl.vision.markers.detect import add_partly_visible_markers, refine_expected_markers
from perchctl.vision.markers.detector import DetectorInput, make_detector_setup
from perchctl.vision.markers.pattern import MarkerPattern
from perchctl.vision.types import MarkerName
from tests.helpers.target_picture import CAMERA, pose_of, render

SETUP = make_detector_setup(DetectorConfig(), TargetConfig())
SIDES_M: dict[MarkerName, float] = {"large": 0.150, "small": 0.025}
POSE = pose_of(0.03, -0.02, 0.35, 0.7, 0.05, -0.08)


def corners(name: MarkerName, pose: tuple[Array, Array] = POSE) -> Array:
    """The marker's true corners, (4, 2) px."""
    return project(square_corners(SIDES_M[name]), *pose, CAMERA)


def both(pose: tuple[Array, Array] = POSE, shift_px: float = 0.0) -> dict[MarkerName, Array]:
    return {name: corners(name, pose) + shift_px for name in MARKERS}


def frame(image: NDArray[np.uint8], index: int = 0) -> Frame:
    return Frame(index, index / 30.0, image)


def waved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture with its rows up to 4 px to and fro: edges all over, and no side a line."""
    return np.stack([np.roll(row, round(4.0 * math.sin(k / 5.0))) for k, row in enumerate(image)])


def followed(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    patterns: dict[MarkerName, MarkerPattern] = SETUP.patterns,
    hidden: NDArray[np.bool_] | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """What is where it is expected, wholly or partly."""
    picture = DetectorInput(image, hidden, replace(SETUP, patterns=patterns), CAMERA)
    return add_partly_visible_markers(picture, expected, refine_expected_markers(picture, expected))


def box(cx: float, cy: float, side: float) -> Array:
    """Corners (4, 2) of an upright square."""
    h = side / 2
    return np.array([[-h, -h], [h, -h], [h, h], [-h, h]]) + np.array([cx, cy])


def paste(
    image: NDArray[np.uint8], dictionary: str, index: int, at: tuple[int, int], side: int
) -> None:
    """Draw a marker on white paper into the picture."""
    marker = cv2.aruco.generateImageMarker(aruco_dictionary(dictionary), index, side)
    x, y = at
    image[y - 12 : y + side + 12, x - 12 : x + side + 12] = 230
    image[y : y + side, x : x + side] = np.where(marker > 0, 230, 20)


def blurry(side_px: float, blur_px: float, seed: int) -> tuple[NDArray[np.uint8], Array]:
    """The target so far away that its large marker has that side, and true corners."""
    rng = np.random.default_rng(seed)
    z = 401.0 * 0.150 / side_px
    x, y, yaw, roll, pitch = rng.uniform(-1, 1, 5) * (0.3 * z, 0.25 * z, math.pi, 0.1, 0.1)
    pose = pose_of(x, y, z, yaw, roll, pitch)
    sharp = render(*pose, blur_px=0.8).astype(np.float32)
    soft = cv2.GaussianBlur(sharp, (0, 0), blur_px) + rng.normal(0.0, 2.0, sharp.shape)
    return np.clip(np.rint(soft), 0, 255).astype(np.uint8), corners("large", pose)
