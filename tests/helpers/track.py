"""`perchctl track` as tests run it, and the pictures, video and calibration that it reads."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.helpers.commands import run
from tests.helpers.recording import CALIBRATION

MOVING = 24
"""Frames of the video of a moving camera."""
PINHOLE = [380.0, 0.0, 321.5, 0.0, 380.6, 238.2, 0.0, 0.0, 1.0]
DISTORTION = [-0.17, 0.04, 0.0004, -0.0007, 0.0]
parse = partial(json.loads, parse_constant=pytest.fail)


@dataclass(frozen=True)
class Tracked:
    """One run: its exit code, the objects on stdout, and the sentences on stderr."""

    code: int
    lines: list[dict[str, Any]]
    stderr: str


def track(source: str | Path, *words: str | Path, calibration: Path = CALIBRATION) -> Tracked:
    """`perchctl track SOURCE --json` with these words."""
    given = ("track", source, "--json", "--calibration", calibration, *words)
    said = run(*map(str, given))
    return Tracked(said.code, [parse(line) for line in said.stdout.splitlines()], said.stderr)


def lines(source: str | Path, *words: str | Path, **options: Path) -> list[dict[str, Any]]:
    """Those of a run that ends well."""
    tracked = track(source, *words, **options)
    assert tracked.code == 0, tracked.stderr
    return tracked.lines


def write_ros(folder: Path, K: list[float], dist: list[float]) -> Path:
    path = folder / "ros.yaml"
    path.write_text(
        f"image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {K}}}\n"
        f"distortion_coefficients: {{rows: 1, cols: {len(dist)}, data: {dist}}}\n"
    )
    return path


def write_opencv(
    path: Path, size_px: tuple[int, int] | None, K: Any = PINHOLE, dist: Any = DISTORTION
) -> Path:
    """A calibration as OpenCV's FileStorage writes it."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if size_px is not None:
        storage.write("image_width", size_px[0])
        storage.write("image_height", size_px[1])
    storage.write("camera_matrix", np.array(K).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(dist).reshape(-1, 1))
    storage.release()
    return path
