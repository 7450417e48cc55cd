"""Cameras and targets that the tests here share."""

from __future__ import annotations

import numpy as np

from perchctl.profile import MarkerConfig, TargetConfig
from perchctl.vision import CameraModel


def camera_of(focal_px: float = 380.0, dist: tuple[float, ...] = (0.0,) * 5) -> CameraModel:
    """640x480; the paper's by default."""
    K = np.array([[focal_px, 0.0, 319.5], [0.0, focal_px, 239.5], [0.0, 0.0, 1.0]])
    return CameraModel((640, 480), K, np.array(dist))


def target_of(
    large: tuple[str, int, float] = ("DICT_4X4_1000", 997, 150.0),
    small: tuple[str, int, float] = ("DICT_ARUCO_ORIGINAL", 5, 25.0),
) -> TargetConfig:
    """Dictionary, id and side in mm of both markers; the paper's by default."""
    first, second = (
        MarkerConfig(dictionary=name, id=marker_id, side_m=side_mm / 1e3)
        for name, marker_id, side_mm in (large, small)
    )
    return TargetConfig(large=first, small=second)


def sized(large_mm: float, small_mm: float) -> TargetConfig:
    """The paper's markers at other sizes."""
    return target_of(("DICT_4X4_1000", 997, large_mm), ("DICT_ARUCO_ORIGINAL", 5, small_mm))
