"""Pictures and a video that the tests of `perchctl track` share."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.recording import moving, picture, write_pictures, write_video
from tests.helpers.track import MOVING


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pictures(tmp_path_factory.mktemp("track") / "pictures")


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    images = [picture(moving(i), i) for i in range(MOVING)]
    return write_video(tmp_path_factory.mktemp("track") / "moving.mp4", images)
