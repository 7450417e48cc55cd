"""Flights of one profile share their pipeline; no other one does."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perchctl.calibration import profile_camera
from perchctl.flight import lockstep
from perchctl.values import replace
from tests.helpers.flights import short_profile


@pytest.mark.parametrize(
    "change",
    [{"kalman.n_max": 7}, {"camera.mount.rpy_deg": (0.0, 1.0, 0.0)}, {"target.large.side_m": 0.12}],
    ids=lambda change: next(iter(change)),
)
def test_a_profile_that_differs_has_its_own(change: dict[str, object]) -> None:
    profile, other = short_profile(), short_profile(change)
    camera, again = profile_camera(profile.camera), profile_camera(profile.camera)
    shared = lockstep._pipeline_of(profile, camera)
    assert lockstep._pipeline_of(short_profile(), again) is shared
    assert lockstep._pipeline_of(other, camera) is not shared


def test_so_has_a_camera_that_differs() -> None:
    profile = short_profile()
    camera = profile_camera(profile.camera)
    other = replace(camera, dist=camera.dist + 1e-9)
    assert lockstep._pipeline_of(profile, other) is not lockstep._pipeline_of(profile, camera)
    assert lockstep._pipeline_of(profile, other).camera is other


def test_and_a_mask_is_read_each_time(tmp_path_factory: pytest.TempPathFactory) -> None:
    file = tmp_path_factory.mktemp("mask") / "mask.png"
    profile = short_profile()
    camera = profile_camera(profile.camera)
    width, height = camera.size_px
    masked = short_profile({"camera.mask": str(file)})
    for rows in (20, 40):
        covered = np.zeros((height, width), np.uint8)
        covered[:rows, :60] = 255
        cv2.imwrite(str(file), covered)
        mask = lockstep._pipeline_of(masked, camera).detector.mask
        assert mask is not None
        assert np.count_nonzero(mask.whole) == rows * 60
