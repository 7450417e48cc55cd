from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perchctl.vision import CameraModel
from tests.helpers.boards import CHARUCO, draw_camera, render_folder

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def chessboard_folder() -> Path:
    folder = DATA / "chessboard"
    if not folder.is_dir():
        pytest.skip(f"the photographs are absent ({folder})")
    return folder


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CameraModel]:
    """A folder of ten pictures of a ChArUco board, and the camera that took them."""
    camera = draw_camera(np.random.default_rng(5), (480, 360))
    folder = tmp_path_factory.mktemp("board")
    render_folder(folder, camera, CHARUCO, 10, seed=5)
    return folder, camera
