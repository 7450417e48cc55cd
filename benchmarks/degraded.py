"""Pictures of the target of which a part cannot be seen: cut off, glaring, or covered.

`cut` gives a camera's pose, since what lies beyond the picture's edge is not in any picture;
`highlight` and `gear` take a picture. All of them draw from the random numbers that they are given.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from common import CAMERA, Picture, camera_pose, true_corners
from numpy.typing import NDArray

from perchctl.geometry import Array

Rng = np.random.Generator
NEAR_M, FAR_M = 0.2, 1.0
_TILT_RAD = 0.08
_SOFT = 0.12  # of a highlight's radius, its edge
_GLARE = 600.0  # grey levels over black in its middle: far beyond white
_GEAR_GREY = 25.0


def pose_in_view(rng: Rng, room_px: float = 12.0) -> Array:
    """T_world_cam (4, 4) of a camera that sees the whole large marker, 0.2 to 1 m away."""
    w, h = CAMERA.size_px
    while True:
        z_m = math.exp(rng.uniform(math.log(NEAR_M), math.log(FAR_M)))
        x, y = rng.uniform(-0.6, 0.6, 2) * z_m
        roll, pitch = rng.uniform(-_TILT_RAD, _TILT_RAD, 2)
        T = camera_pose(x, y, z_m, rng.uniform(-math.pi, math.pi), roll, pitch)
        corners = true_corners(T, "large")
        if corners.min() > room_px and (corners.max(axis=0) < (w - room_px, h - room_px)).all():
            return T


def cut(rng: Rng, least: float = 0.0, most: float = 0.05) -> Array:
    """T_world_cam (4, 4) of a camera whose picture ends within the large marker: its outermost
    corner is beyond the edge by a share of a side, `least` to `most`."""
    across = int(rng.integers(2))  # the picture's left and right, or its top and bottom
    sign = float(rng.choice((-1.0, 1.0)))
    while True:
        z_m = math.exp(rng.uniform(math.log(NEAR_M), math.log(FAR_M)))
        yaw = rng.uniform(-math.pi, math.pi)
        roll, pitch = rng.uniform(-_TILT_RAD, _TILT_RAD, 2)
        aside = np.full(2, rng.uniform(-0.3, 0.3) * z_m)
        share = rng.uniform(least, most)
        low, high = 0.0, 1.5 * z_m
        T = camera_pose(aside[0], aside[1], z_m, yaw, roll, pitch)
        for _ in range(40):
            aside[across] = sign * 0.5 * (low + high)
            T = camera_pose(aside[0], aside[1], z_m, yaw, roll, pitch)
            outside = _beyond(true_corners(T, "large"), across) < share
            low, high = (0.5 * (low + high), high) if outside else (low, 0.5 * (low + high))
        corners = true_corners(T, "large")
        if abs(_beyond(corners, across) - share) < 1e-3 and _beyond(corners, 1 - across) < 0.0:
            return T


def _beyond(corners_px: Array, axis: int) -> float:
    """How far corners (4, 2) reach out of the picture along an axis, in sides."""
    side = float(np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).mean())
    along = corners_px[:, axis]
    return max(float(along.max()) - (CAMERA.size_px[axis] - 1.0), -float(along.min())) / side


def highlight(picture: Picture, corners_px: Array, rng: Rng) -> Picture:
    """Light that a glossy print throws back, far beyond white, over one of the corners
    (4, 2) of the large marker: a tenth to a quarter of a side in radius."""
    side = float(np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).mean())
    corner = corners_px[rng.integers(4)]
    inwards = (corners_px.mean(axis=0) - corner) / side
    centre = corner + inwards * side * rng.uniform(-0.05, 0.15)
    radius = side * rng.uniform(0.1, 0.25) * np.array([1.0, rng.uniform(0.6, 1.0)])
    angle = rng.uniform(0.0, math.pi)
    h, w = picture.shape
    x, y = np.meshgrid(np.arange(w) - centre[0], np.arange(h) - centre[1])
    u = (x * math.cos(angle) + y * math.sin(angle)) / radius[0]
    v = (y * math.cos(angle) - x * math.sin(angle)) / radius[1]
    light = _GLARE * 0.5 * (1.0 - np.tanh((np.hypot(u, v) - 1.0) / _SOFT))
    return np.clip(np.rint(picture + light), 0, 255).astype(np.uint8)


def gear_mask(rng: Rng) -> NDArray[np.bool_]:
    """Where the vehicle itself is in the picture (h, w): a leg from one side, another one
    from below, and a propeller guard's arc in a corner."""
    w, h = CAMERA.size_px
    drawn = np.zeros((h, w), np.uint8)
    left = bool(rng.integers(2))
    x0 = 0 if left else w - 1
    reach = int(rng.uniform(0.3, 0.45) * w)
    y0, y1 = int(rng.uniform(0.2, 0.8) * h), int(rng.uniform(0.3, 0.7) * h)
    cv2.line(drawn, (x0, y0), (x0 + (reach if left else -reach), y1), 255, int(rng.uniform(14, 34)))
    x2, x3 = int(rng.uniform(0.2, 0.8) * w), int(rng.uniform(0.3, 0.7) * w)
    up = int(rng.uniform(0.25, 0.4) * h)
    cv2.line(drawn, (x2, h - 1), (x3, h - 1 - up), 255, int(rng.uniform(14, 34)))
    centre = (int(rng.choice((0, w))), 0)
    cv2.circle(drawn, centre, int(rng.uniform(0.15, 0.25) * w), 255, 12)
    return drawn > 0


def gear(picture: Picture, rng: Rng, mask: NDArray[np.bool_] | None = None) -> Picture:
    """The picture with the vehicle's own legs and guards in it, dark, with blurred edges that are
    within the mask."""
    covered = gear_mask(rng) if mask is None else mask
    inner = cv2.erode(covered.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(np.float32)
    share = cv2.GaussianBlur(inner, (0, 0), 0.8)
    grey = _GEAR_GREY + rng.normal(0.0, 2.0, picture.shape)
    mixed = picture * (1.0 - share) + grey * share
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
