"""What the tests of `perchctl track` share: pictures, a video, and its lines."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest

from perchctl.commands.track import resolve, track_source
from tests.helpers.recording import (
    CALIBRATION,
)

MOVING = 24


def track(source: str | Path, profile: str = "sim", **options: Any) -> list[dict[str, Any]]:
    """The JSON lines of one run."""
    out = io.StringIO()
    options.setdefault("calibration", CALIBRATION)
    track_source(resolve(str(source), profile, as_json=True, **options), out)
    return [json.loads(line, parse_constant=pytest.fail) for line in out.getvalue().splitlines()]


def write_ros(folder: Path, K: list[float], dist: list[float]) -> Path:
    path = folder / "ros.yaml"
    path.write_text(
        f"image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {K}}}\n"
        f"distortion_coefficients: {{rows: 1, cols: {len(dist)}, data: {dist}}}\n"
    )
    return path
