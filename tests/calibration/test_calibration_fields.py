"""Boards in interlaced pictures: corners, calibration and check from both fields."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from perchctl.calibration import BoardView, calibrate_camera, check_calibration
from perchctl.calibration.board.capture import sharpness
from perchctl.calibration.board.detect import find_board
from perchctl.camera import Grey
from perchctl.geometry import Array
from perchctl.vision import CameraModel, is_combed, project
from tests.helpers.boards import CHARUCO, BoardRenderer, draw_camera, draw_poses

FIELDS_S = 0.02
SPEED = np.array([0.15, 0.15, 0.3, 0.08, 0.08, 0.08])  # rad/s and m/s of a hand, one sigma


@pytest.fixture(scope="module")
def camera() -> CameraModel:
    return draw_camera(np.random.default_rng(5), (480, 360))


def woven(
    renderer: BoardRenderer, pose: Array, rng: np.random.Generator
) -> tuple[Grey, tuple[Array, Array]]:
    """A picture with fields of two moments, and the board's poses in them."""
    step = rng.normal(0.0, 1.0, 6) * SPEED * FIELDS_S / 2.0
    poses = pose - step, pose + step
    top, bottom = (renderer.render(each, rng, noise=2.0) for each in poses)
    top[1::2] = bottom[1::2]
    return top, poses


@pytest.fixture(scope="module")
def views(camera: CameraModel) -> list[BoardView]:
    """Of a board that is moved while its pictures are taken."""
    rng = np.random.default_rng(3)
    renderer = BoardRenderer(camera, CHARUCO)
    found, combed = [], 0
    for i, pose in enumerate(draw_poses(rng, camera, CHARUCO, 12)):
        picture, poses = woven(renderer, pose, rng)
        combed += is_combed(picture)
        view = find_board(picture, CHARUCO, f"view {i}")
        assert isinstance(view, BoardView), view
        there = [project(CHARUCO.corners_m(), p[:3], p[3:], camera)[view.ids] for p in poses]
        # Half way between the fields, or where only one of them shows the board.
        moments = [(there[0] + there[1]) / 2.0, *there]
        rms = [np.sqrt(((view.corners_px - m) ** 2).sum(axis=1).mean()) for m in moments]
        assert min(rms) < 0.1
        found.append(view)
    assert combed >= 8
    return found


def test_fields_calibrate_a_camera(views: list[BoardView], camera: CameraModel) -> None:
    result = calibrate_camera(views, "")
    assert result.fit.rms_px < 0.06
    assert result.camera.K[0, 0] == pytest.approx(camera.K[0, 0], rel=2e-3)
    assert result.camera.K[1, 1] == pytest.approx(camera.K[1, 1], rel=2e-3)


def test_fields_judge_a_calibration(views: list[BoardView], camera: CameraModel) -> None:
    assert check_calibration(camera, views).passed
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1.01
    assert not check_calibration(dataclasses.replace(camera, K=K), views).passed


def test_a_comb_is_nosharpness(camera: CameraModel) -> None:
    """Of a video's frames the sharpest are searched: not those that moved most."""
    rng = np.random.default_rng(8)
    renderer = BoardRenderer(camera, CHARUCO)
    pose = draw_poses(rng, camera, CHARUCO, 1)[0]
    still = renderer.render(pose, rng, noise=2.0)
    combed = still.copy()
    combed[1::2] = np.roll(still, 3, axis=1)[1::2]
    assert is_combed(combed)
    assert sharpness(combed) < 1.2 * sharpness(still)
