from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perchctl.pipeline import PipelineSetup, make_setup
from perchctl.profile import (
    DetectorConfig,
    KalmanConfig,
    MergeConfig,
    PoseConfig,
    TargetConfig,
)
from perchctl.vision.types import CameraModel
from tests.helpers.target_picture import CAMERA

SCENES = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "scenes"


@pytest.fixture(scope="session")
def build() -> Callable[..., PipelineSetup]:
    """`make_setup` with defaults: camera = body = gear, unless told otherwise."""

    def make(
        detector: DetectorConfig | None = None,
        pose: PoseConfig | None = None,
        kalman: KalmanConfig | None = None,
        merge: MergeConfig | None = None,
        T_body_cam: Any = None,
        gear_body_m: Any = (0.0, 0.0, 0.0),
        camera: CameraModel = CAMERA,
    ) -> PipelineSetup:
        return make_setup(
            detector or DetectorConfig(),
            pose or PoseConfig(),
            kalman or KalmanConfig(),
            merge or MergeConfig(),
            TargetConfig(),
            np.eye(4) if T_body_cam is None else T_body_cam,
            gear_body_m,
            camera,
        )

    return make


@pytest.fixture(scope="session")
def truth() -> dict[str, Any]:
    """The shared scenes' truth.json, with `folder` and `camera` added."""
    file = SCENES / "truth.json"
    if not file.is_file():
        pytest.skip(f"the rendered scenes are absent ({SCENES})")
    content: dict[str, Any] = json.loads(file.read_text())
    content["folder"] = SCENES
    content["camera"] = CameraModel(
        tuple(content["image_size"]),
        np.array(content["camera_matrix"]),
        np.array(content["dist_coeffs"]),
    )
    return content
