"""Rendered pictures of the target for tests: a folder of them, a video, a calibration."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration import load_calibration
from perchctl.geometry import R_MARKER_TARGET, Array, invert_T, make_T, rot_z, rotation_from_rpy
from perchctl.places import data_folder
from perchctl.profile import TargetConfig
from perchctl.sim import Renderer, Scenario
from perchctl.vision import CameraModel

CALIBRATION = data_folder("calib") / "example_640x480.yaml"
CEILING_M, TARGET_YAW_RAD = 2.2, 0.5

# Distance under the ceiling, x and y aside (m), roll, pitch, yaw of the camera.
VIEWS: dict[str, tuple[float, ...]] = {
    "far": (0.9, 0.10, -0.05, 0.05, -0.04, 0.3),
    "both": (0.30, 0.02, 0.01, -0.06, 0.08, 2.5),
    "near": (0.10, 0.005, -0.003, 0.04, 0.03, -1.0),
    "away": (0.5, 2.5, 2.0, 0.0, 0.0, 0.0),
}
# Of the large marker, "near" shows two thirds.
STAGE_OF = {"far": "both", "both": "both", "near": "both", "away": "none"}


def camera() -> CameraModel:
    return load_calibration(CALIBRATION)


@cache
def _renderer() -> Renderer:
    scenario = Scenario(
        target_yaw_rad=TARGET_YAW_RAD, ceiling_z_m=CEILING_M, camera_noise_sigma=2.0
    )
    return Renderer(scenario, camera(), TargetConfig())


def _T_world_cam(view: tuple[float, ...]) -> Array:
    below_m, x_m, y_m, roll, pitch, yaw = view
    return make_T(rotation_from_rpy(roll, pitch, yaw), (x_m, y_m, CEILING_M - below_m))


def picture(view: tuple[float, ...], index: int = 0) -> NDArray[np.uint8]:
    """Grey picture (480, 640)."""
    return np.asarray(_renderer().render([_T_world_cam(view)], frame_index=index))


def true_pose(view: tuple[float, ...]) -> tuple[Array, Array]:
    """R (3, 3) and t (3,) of the marker in the OpenCV camera frame."""
    T_world_target = make_T(rot_z(TARGET_YAW_RAD), (0.0, 0.0, CEILING_M))
    T = invert_T(_T_world_cam(view)) @ T_world_target @ make_T(R_MARKER_TARGET, (0.0, 0.0, 0.0))
    return T[:3, :3], T[:3, 3]


def moving(i: int) -> tuple[float, ...]:
    """A slow circle under the target."""
    a = i / 10.0
    return (0.4, 0.03 * math.sin(a), 0.03 * math.cos(a), 0.03 * math.sin(a), 0.02, 0.1 * a)


def write_pictures(folder: Path) -> Path:
    """`folder` with one PNG a view, named after it."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, view in VIEWS.items():
        cv2.imwrite(str(folder / f"{name}.png"), picture(view))
    return folder


def write_video(path: Path, images: list[NDArray[np.uint8]], rate_hz: float = 30.0) -> Path:
    height, width = images[0].shape
    fourcc = cv2.VideoWriter.fourcc(*"mp4v")
    video = cv2.VideoWriter(str(path), fourcc, rate_hz, (width, height), True)
    for image in images:
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()
    return path


def make_recording(folder: Path) -> None:
    """`pictures/`, `flight.mp4` and `camera.yaml`, as the README names them."""
    write_pictures(folder / "pictures")
    write_video(folder / "flight.mp4", [picture(moving(i), i) for i in range(10)])
    text = CALIBRATION.read_text(encoding="utf-8")
    (folder / "camera.yaml").write_text(f"# no copy of the example\n{text}", "utf-8")
