"""Pictures of the target with exact truth: every pixel's ray meets the target's plane,
and the pattern there is known in closed form, edges softened symmetrically."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import R_MARKER_TARGET, Array, rotation_from_rpy
from perchctl.profile import aruco_dictionary
from perchctl.vision import CameraModel, undistort_to_normalised

LARGE_M, SMALL_M, SHEET_M = 0.150, 0.025, 0.200
BACKGROUND = 120.0
_FAR = 12.0  # so many widths of an edge from it there is no grey between, by 3e-12
Drawn = tuple[str, int, float]
"""A marker by its dictionary, its id, and its side in metres."""
MARKERS: dict[str, Drawn] = {
    "large": ("DICT_4X4_1000", 997, LARGE_M),
    "small": ("DICT_ARUCO_ORIGINAL", 5, SMALL_M),
}
CAMERA = CameraModel(
    (640, 480),
    np.array([[400.0, 0.0, 322.0], [0.0, 402.0, 236.0], [0.0, 0.0, 1.0]]),
    np.array([-0.2, 0.05, 0.0005, -0.001, -0.005]),
)


def pose_of(
    x_m: float,
    y_m: float,
    z_m: float,
    yaw_rad: float = 0.0,
    roll_rad: float = 0.0,
    pitch_rad: float = 0.0,
) -> tuple[Array, Array]:
    """rvec, tvec of the marker frame for a target at (x, y, z) in the camera, turned by
    yaw about the view, for a camera tilted by roll and pitch out of level."""
    R_level_cam = rotation_from_rpy(roll_rad, pitch_rad, 0.0)
    R_level_marker = rotation_from_rpy(0.0, 0.0, yaw_rad) @ R_MARKER_TARGET
    rvec = cv2.Rodrigues(R_level_cam.T @ R_level_marker)[0]
    return np.asarray(rvec, dtype=np.float64).ravel(), np.array([x_m, y_m, z_m])


def render(
    rvec: Array,
    tvec: Array,
    camera: CameraModel = CAMERA,
    *,
    markers: tuple[str | Drawn, ...] = ("large", "small"),
    sheet_m: float = SHEET_M,
    blur_px: float = 0.7,
    noise: float = 0.0,
    white: float = 205.0,
    black: float = 30.0,
    background: float = BACKGROUND,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """Grey picture (h, w), uint8, of the markers on a sheet (0: none)."""
    rays = _rays(camera)
    h, w = rays.shape[:2]
    R = cv2.Rodrigues(rvec)[0]
    n = R[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (n @ tvec) / (rays @ n)
    points = (rays * depth[..., None] - tvec) @ R  # in marker axes
    x, y = points[..., 0], points[..., 1]
    near = (depth > 0) & (np.abs(x) < 0.6 * sheet_m) & (np.abs(y) < 0.6 * sheet_m)
    picture = np.full((h, w), background)
    x, y = x[near], y[near]
    soft = blur_px * depth[near] / camera.K[0, 0]
    sheet = _box(x, -sheet_m / 2, sheet_m / 2, soft) * _box(y, -sheet_m / 2, sheet_m / 2, soft)
    dark = np.zeros_like(x)
    for marker in markers:
        dark += _pattern(*(MARKERS[marker] if isinstance(marker, str) else marker), x, y, soft)
    picture[near] = background + sheet * (white - background) - dark * (white - black)
    if noise > 0.0:
        picture += np.random.default_rng(seed).normal(0.0, noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def side_by_side(
    first: NDArray[np.uint8], second: NDArray[np.uint8], background: float = BACKGROUND
) -> NDArray[np.uint8]:
    """Both pictures' sheets in one; both without noise."""
    return np.where(second == np.uint8(background), first, second)


def bits_of(name: str, index: int) -> NDArray[np.uint8]:
    """The inner bits of a marker, 1 = white, (n, n)."""
    dictionary = aruco_dictionary(name)
    rows = np.ascontiguousarray(dictionary.bytesList[index : index + 1])
    return np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(rows, dictionary.markerSize))


def _pattern(name: str, index: int, side_m: float, x: Array, y: Array, soft: Array) -> Array:
    dark, half_m = np.zeros_like(x), side_m / 2 + _FAR * soft
    on = (np.abs(x) < half_m) & (np.abs(y) < half_m)
    x, y, soft = x[on], y[on], soft[on]
    black = np.pad(1.0 - bits_of(name, index), 1, constant_values=1.0)
    edges = np.linspace(-side_m / 2, side_m / 2, len(black) + 1)
    columns = np.diff(_step(edges[:, None] - x, soft), axis=0)
    bands = np.diff(_step(edges[:, None] + y, soft), axis=0)  # rows run against y
    dark[on] = np.einsum("rn,rn->n", bands, black @ columns)
    return dark


def _step(distance: Array, soft: Array) -> Array:
    """From 0 to 1."""
    away = distance / soft
    step = np.where(away > 0.0, 1.0, 0.0)
    near = np.abs(away) < _FAR
    step[near] = 0.5 * (1.0 + np.tanh(0.8 * np.sqrt(2.0) * away[near]))
    return step


def _box(v: Array, low: float, high: float, soft: Array) -> Array:
    return _step(v - low, soft) - _step(v - high, soft)


@cache
def _rays(camera: CameraModel) -> Array:
    w, h = camera.size_px
    grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).reshape(-1, 2)
    rays = np.ones((h * w, 3))
    rays[:, :2] = undistort_to_normalised(grid.astype(np.float64), camera)
    return rays.reshape(h, w, 3)
