from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perchctl.profile import CameraConfig, Mounting, Profile
from perchctl.profile.vision import VehicleConfig
from perchctl.vision import CameraModel, Pipeline, make_pipeline
from tests.helpers.target_picture import CAMERA

SCENES = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "scenes"


BARE = Mounting(position_m=(0.0, 0.0, 0.0))


@pytest.fixture(scope="session")
def build() -> Callable[..., Pipeline]:
    """`make_pipeline` of a profile with these sections; camera = body = gear where nothing else is
    said."""

    def make(
        mount: Mounting = BARE,
        gear_body_m: Any = (0.0, 0.0, 0.0),
        camera: CameraModel = CAMERA,
        **sections: Any,
    ) -> Pipeline:
        vehicle = VehicleConfig(gear_body_m=gear_body_m)
        profile = Profile(camera=CameraConfig(mount=mount), vehicle=vehicle, **sections)
        return make_pipeline(profile, camera)

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
