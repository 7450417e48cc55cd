"""Pictures of the target as a bad camera, bad light or a bad print make them: what the
simulator's renderer does not draw. Each takes a picture and the truth, and gives a picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from common import CAMERA, Picture, marker_pose, true_corners
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import project, undistort_to_normalised

Rng = np.random.Generator
Spoil = Callable[[Picture, Array, Rng], Picture]
"""(picture, T_world_cam, random numbers) -> picture."""

JPEG_QUALITY = 30
VIGNETTE = 0.75  # of the light, lost in the picture's corners
DARK, DARK_NOISE = 0.15, 3.0
OVEREXPOSED = 1.45
GLARE = 600.0  # grey levels, in a highlight's middle
GEAR_GREY = 25.0
BULGE_M, BULGE_REACH_M = 0.002, 0.075  # curl of the sheet: half a large marker's side out


def jpeg(picture: Picture, T: Array, rng: Rng) -> Picture:
    _, packed = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)


def vignette(picture: Picture, T: Array, rng: Rng) -> Picture:
    x, y = _grid(picture)
    h, w = picture.shape
    r2 = ((x - w / 2) ** 2 + (y - h / 2) ** 2) / (w**2 + h**2) * 4.0
    return _bytes(picture * (1.0 - VIGNETTE * r2))


def dark(picture: Picture, T: Array, rng: Rng) -> Picture:
    return _bytes(picture * DARK + rng.normal(0.0, DARK_NOISE, picture.shape))


def overexposed(picture: Picture, T: Array, rng: Rng) -> Picture:
    return _bytes(picture * OVEREXPOSED)


def highlight(picture: Picture, T: Array, rng: Rng) -> Picture:
    """Light that a glossy print throws back, far beyond white, over a corner of the marker that is
    in the picture: a tenth to a quarter of a side in radius."""
    large = true_corners(T, "large")
    h, w = picture.shape
    whole = bool((large > 0).all() and (large < (w, h)).all())
    corners = large if whole else true_corners(T, "small")
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
    corner = corners[rng.integers(4)]
    centre = corner + (corners.mean(axis=0) - corner) * rng.uniform(-0.05, 0.15)
    radius = side * rng.uniform(0.1, 0.25) * np.array([1.0, rng.uniform(0.6, 1.0)])
    angle = rng.uniform(0.0, math.pi)
    x, y = _grid(picture)
    x, y = x - centre[0], y - centre[1]
    u = (x * math.cos(angle) + y * math.sin(angle)) / radius[0]
    v = (y * math.cos(angle) - x * math.sin(angle)) / radius[1]
    return _bytes(picture + GLARE * 0.5 * (1.0 - np.tanh((np.hypot(u, v) - 1.0) / 0.12)))


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


GEAR = gear_mask(np.random.default_rng(7))
"""One vehicle's, for a camera that knows it."""


def gear(picture: Picture, T: Array, rng: Rng) -> Picture:
    """Legs and guards of a vehicle of its own in each picture."""
    return _with_gear(picture, gear_mask(rng), rng)


def known_gear(picture: Picture, T: Array, rng: Rng) -> Picture:
    return _with_gear(picture, GEAR, rng)


def _with_gear(picture: Picture, covered: NDArray[np.bool_], rng: Rng) -> Picture:
    """Dark, with soft edges that are within the mask."""
    inner = cv2.erode(covered.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(np.float32)
    share = cv2.GaussianBlur(inner, (0, 0), 0.8)
    own = GEAR_GREY + rng.normal(0.0, 2.0, picture.shape)
    return _bytes(picture * (1.0 - share) + own * share)


def bulge(picture: Picture, T: Array, rng: Rng) -> Picture:
    """The sheet rolled about an axis through its centre, which stays where it is: half a side
    out it hangs `BULGE_M` towards the camera, or is as far behind."""
    angle, lift = rng.uniform(0.0, math.pi), float(rng.choice((-1.0, 1.0))) * BULGE_M
    across = np.array([math.cos(angle), math.sin(angle)])
    rvec, tvec = marker_pose(T)
    R = np.asarray(cv2.Rodrigues(rvec)[0])
    # A ray in marker axes (z towards the camera); the sheet is z = lift (u / reach)^2.
    way, eye = _rays() @ R, -tvec @ R
    z = np.zeros(len(way))
    for _ in range(4):
        points = eye + way * ((z - eye[2]) / way[:, 2])[:, None]
        out = np.clip(points[:, :2] @ across / BULGE_REACH_M, -2.0, 2.0)
        z = lift * out**2
    flat = np.append(points[:, :2], np.zeros((len(points), 1)), axis=1)
    at = project(flat, rvec, tvec, CAMERA).astype(np.float32).reshape(*picture.shape, 2)
    moved = cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_CUBIC,
                      borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    return np.asarray(moved, np.uint8)


@cache
def _rays() -> Array:
    w, h = CAMERA.size_px
    pixels = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=2).reshape(-1, 2)
    return np.append(undistort_to_normalised(pixels, CAMERA), np.ones((len(pixels), 1)), axis=1)


def _grid(picture: Picture) -> tuple[Array, Array]:
    h, w = picture.shape
    x, y = np.meshgrid(np.arange(w, dtype=np.float64), np.arange(h, dtype=np.float64))
    return x, y


def _bytes(values: Array) -> Picture:
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)
