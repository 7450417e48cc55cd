"""What the benchmarks share: scenes, setups, the plain detector, tables."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from perchctl.geometry import (  # noqa: E402
    R_MARKER_TARGET,
    Array,
    invert_T,
    make_T,
    rot_z,
    rotation_from_rpy,
)
from perchctl.profile import (  # noqa: E402
    DetectorConfig,
    KalmanConfig,
    MergeConfig,
    PoseConfig,
    Profile,
    TargetConfig,
    aruco_dictionary,
)
from perchctl.sim import (  # noqa: E402
    Renderer,
    Scenario,
)
from perchctl.vision import (  # noqa: E402  # noqa: E402
    CameraModel,
    Pipeline,
    make_camera_only_profile,
    make_pipeline,
    project,
    square_corners,
)

Picture = NDArray[np.uint8]
SCENES = ROOT / ".." / "shared" / "data" / "scenes"
TARGET = TargetConfig(size_sigma=0.0, curl_per_m=0.0)  # printed as it should be
SIDES_M = {"large": TARGET.large.side_m, "small": TARGET.small.side_m}
CEILING_Z_M = 2.2
# 80 x 65 degrees, mildly distorted.
CAMERA = CameraModel(
    (640, 480),
    np.array([[380.0, 0.0, 321.5], [0.0, 380.6, 238.2], [0.0, 0.0, 1.0]]),
    np.array([-0.17, 0.04, 0.0004, -0.0007, -0.003]),
)


def arguments(description: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="fewer frames, for a first look")
    cv2.setNumThreads(1)
    return parser.parse_args()


def setup_with(
    camera: CameraModel = CAMERA,
    detector: DetectorConfig | None = None,
    pose: PoseConfig | None = None,
    kalman: KalmanConfig | None = None,
    merge: MergeConfig | None = None,
) -> Pipeline:
    """The pipeline with camera, body and gear in one point."""
    profile = Profile(
        target=TARGET,
        detector=detector or DetectorConfig(),
        pose=pose or PoseConfig(),
        kalman=kalman or KalmanConfig(),
        merge=merge or MergeConfig(),
    )
    bare = make_camera_only_profile(profile).model_copy(update={"pose": profile.pose})
    return make_pipeline(bare, camera)


def renderer(seed: int = 0, camera: CameraModel = CAMERA, **scenario: Any) -> Renderer:
    """The ceiling with the target in the world's origin, heading along x."""
    return Renderer(Scenario(seed=seed, ceiling_z_m=CEILING_Z_M, **scenario), camera, TARGET)


def camera_pose(
    x_m: float, y_m: float, z_m: float, yaw_rad: float = 0.0, roll_rad: float = 0.0,
    pitch_rad: float = 0.0,
) -> Array:  # fmt: skip
    """T_world_cam (4, 4) of a camera that has the target at (x, y, z) in its level frame
    and the target's heading at `yaw_rad`."""
    turn = rot_z(-yaw_rad)
    position = np.array([0.0, 0.0, CEILING_Z_M]) - turn @ np.array([x_m, y_m, z_m])
    return make_T(turn @ rotation_from_rpy(roll_rad, pitch_rad, 0.0), position)


def marker_pose(T_world_cam: Array) -> tuple[Array, Array]:
    """True rvec, tvec of the target in that camera."""
    T_world_marker = make_T(R_MARKER_TARGET, (0.0, 0.0, CEILING_Z_M))
    T = invert_T(T_world_cam) @ T_world_marker
    return np.asarray(cv2.Rodrigues(T[:3, :3])[0], dtype=float).ravel(), T[:3, 3]


def true_corners(T_world_cam: Array, marker: str, camera: CameraModel = CAMERA) -> Array:
    return project(square_corners(SIDES_M[marker]), *marker_pose(T_world_cam), camera)


def in_view(corners_px: Array, camera: CameraModel = CAMERA) -> bool:
    return bool((corners_px > 0).all() and (corners_px < np.array(camera.size_px) - 1).all())


@cache
def plain_detectors(refinement: int = cv2.aruco.CORNER_REFINE_NONE) -> tuple[Any, Any]:
    """Two detectors of the whole dictionaries, with OpenCV's defaults the paper's way."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    large, small = (
        cv2.aruco.ArucoDetector(aruco_dictionary(marker.dictionary), parameters)
        for marker in (TARGET.large, TARGET.small)
    )
    return large, small


def plain_detect(
    image: Picture, refinement: int = cv2.aruco.CORNER_REFINE_NONE
) -> dict[str, Array]:
    """The target's markers by both plain detectors: corners (4, 2) by name."""
    found = {}
    for name, config, detector in zip(
        ("large", "small"), (TARGET.large, TARGET.small), plain_detectors(refinement), strict=True
    ):
        corners, ids, _ = detector.detectMarkers(image)
        if ids is None:
            continue
        for quad, index in zip(corners, np.ravel(ids), strict=True):
            if index == config.id:
                found[name] = np.asarray(quad, dtype=float).reshape(4, 2)
    return found


@cache
def scenes() -> dict[str, Any] | None:
    """The path-traced scenes with their truth, None where they are absent."""
    file = SCENES / "truth.json"
    if not file.is_file():
        return None
    content: dict[str, Any] = json.loads(file.read_text())
    content["camera"] = CameraModel(
        tuple(content["image_size"]),
        np.array(content["camera_matrix"]),
        np.array(content["dist_coeffs"]),
    )
    return content


def scene_picture(entry: dict[str, Any]) -> Picture:
    return np.asarray(cv2.imread(str(SCENES / entry["file"]), cv2.IMREAD_GRAYSCALE), np.uint8)


def rms(values: Iterable[float]) -> float:
    squares = [v * v for v in values]
    return math.sqrt(sum(squares) / len(squares)) if squares else math.nan


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print columns, numbers to three significant digits."""

    def text(value: object) -> str:
        if isinstance(value, float):
            return "-" if math.isnan(value) else f"{value:.3g}"
        return str(value)

    lines = [list(head), *([text(v) for v in row] for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    print(f"\n{title}")
    for k, line in enumerate(lines):
        first, *rest = (f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True))
        print("  " + "  ".join([line[0].ljust(len(first)), *rest]).rstrip())
        if k == 0:
            print("  " + "  ".join("-" * w for w in widths))
