"""Corners of the target as a detector with known noise would tell them, without a picture."""

from __future__ import annotations

import math

import cv2
import numpy as np

from perchctl.geometry import R_MARKER_TARGET, Array, invert_T, make_T, rot_z
from perchctl.vision import MARKERS, project, square_corners
from perchctl.vision.types import Detection, Detections
from tests.helpers.markers import SIDES_M
from tests.helpers.target_picture import CAMERA

LEAST_SIDE_PX = 12.0


def seen_from(
    T_world_cam: Array,
    target_m: Array,
    t_s: float,
    rng: np.random.Generator,
    *,
    markers: tuple[str, ...] = MARKERS,
    heading_rad: float = 0.0,
    scale: float = 1.0,
    sigma_px: float = 0.1,
) -> Detections:
    """The corners of those of the target's markers that are wholly in the picture; they may be
    `scale` times as large as the target's."""
    T = invert_T(T_world_cam) @ make_T(rot_z(heading_rad) @ R_MARKER_TARGET, target_m)
    rvec = np.asarray(cv2.Rodrigues(T[:3, :3])[0], dtype=float).ravel()
    found = {}
    for name in MARKERS:
        true = project(square_corners(scale * SIDES_M[name]), rvec, T[:3, 3], CAMERA)
        side_px = np.linalg.norm(true[0] - true[2]) / math.sqrt(2.0)
        inside = (true > 0.0).all() and (true < np.array(CAMERA.size_px) - 1).all()
        if name in markers and inside and side_px > LEAST_SIDE_PX:
            noisy = true + rng.normal(0.0, sigma_px, (4, 2))
            found[name] = Detection(name, noisy, sigma_px, True)
    return Detections(0, t_s, **found)
