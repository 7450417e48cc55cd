"""Corners: their bias, their spread, what the window takes in, and interlaced pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.calibration import find_views, learn_gear_mask
from perchctl.calibration.board import detect
from perchctl.calibration.board.detect import BoardView, find_board, fit_saddles
from perchctl.camera import Grey
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.target import Board
from perchctl.vision import deinterlace_image, project
from tests.helpers.boards import CHARUCO, CHESSBOARD, BoardRenderer, draw_camera, draw_poses
from tests.helpers.commands import elsewhere, run  # noqa: F401
from tests.helpers.gear import SIZE_PX, Pictures, legs, turned_about
from tests.helpers.orientation import turned_picture
from tests.helpers.recording import VIEWS, picture

CAMERA = draw_camera(np.random.default_rng(1), (480, 360))


def crossing(
    at: tuple[float, float], square_px: float, angle_deg: float, slant_deg: float, blur_px: float
) -> tuple[Grey, Array]:
    """A checker of that square around one corner, drawn at 12 samples a pixel, and its sides."""
    n, s = 64, 12
    t = (np.arange(n * s) + 0.5) / s - 0.5
    x, y = np.meshgrid(t - at[0], t - at[1])
    a, b = np.radians(angle_deg), np.radians(angle_deg + 90 + slant_deg)
    along, down = np.array([np.cos(a), np.sin(a)]), np.array([np.cos(b), np.sin(b)])
    inverse = np.linalg.inv(np.column_stack([along, down]) * square_px)
    u, v = inverse[0, 0] * x + inverse[0, 1] * y, inverse[1, 0] * x + inverse[1, 1] * y
    white = (np.floor(u) + np.floor(v)) % 2 == 0
    fine = np.where(white, 200.0, 40.0)
    picture = fine.reshape(n, s, n, s).mean(axis=(1, 3))
    picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
    sides = np.column_stack([along, down]) * square_px
    return np.rint(picture).astype(np.uint8), sides[None]


@pytest.mark.parametrize("square_px", [7.0, pytest.param(12.0, marks=pytest.mark.long), 30.0])
@pytest.mark.parametrize("slant_deg", [pytest.param(0.0, marks=pytest.mark.long), 25.0])
def test_a_corner_is_found_without_bias(square_px: float, slant_deg: float) -> None:
    errors = []
    for k in range(8):
        at = (31.0 + 0.13 * k, 32.4 - 0.11 * k)
        image, sides = crossing(at, square_px, 7.0 + 11.0 * k, slant_deg, 0.8)
        start = np.array([at]) + 0.4 * np.array([np.cos(k), np.sin(k)])
        fit = fit_saddles(image, start, sides)
        assert fit.is_valid.all()
        errors.append(fit.corners_px[0] - at)
    assert np.abs(errors).max() < (0.12 if square_px < 10 else 0.03)


def test_markers_without_corners_are_refused_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a picture of a board that is far away."""
    seen = np.arange(2), np.array([[50.0, 60.0], [58.0, 60.0]]), 30
    monkeypatch.setattr(detect, "charuco_corners", lambda image, board: seen)
    reason = find_board(np.full((480, 640), 120, np.uint8), CHARUCO)
    assert isinstance(reason, str)
    assert reason.startswith("found 30 markers, but only 2 corners of the board")
    assert "too small in the image" in reason
    assert reason.endswith("move it closer")


def test_a_flat_patch_is_refused() -> None:
    image = np.full((64, 64), 120, np.uint8)
    fit = fit_saddles(image, np.array([[32.0, 32.0]]), 12.0 * np.eye(2)[None])
    assert not fit.is_valid.any()


def test_light_that_falls_off_does_not_pull() -> None:
    image, sides = crossing((32.3, 31.6), 20.0, 20.0, 0.0, 1.2)
    fall = 1.0 - 0.01 * np.arange(64)
    shaded = np.rint(image * fall).astype(np.uint8)
    fit = fit_saddles(shaded, np.array([[32.0, 32.0]]), sides)
    assert fit.corners_px[0] == pytest.approx((32.3, 31.6), abs=0.02)


def _view(board: Board, picture: Grey) -> BoardView:
    view = find_board(picture, board)
    assert isinstance(view, BoardView), view
    return view


def _errors(board_pose: Array, board: Board, seed: int = 0) -> Array:
    """Of the corners found of a rendered board, (n, 2)."""
    picture = BoardRenderer(CAMERA, board).render(
        board_pose, np.random.default_rng(seed), noise=2.0
    )
    view = _view(board, picture)
    there = project(board.corners_m(), board_pose[:3], board_pose[3:], CAMERA)
    if np.linalg.norm(view.corners_px[0] - there[view.ids[0]]) > 20:
        there = there[::-1]  # found from its other end
    return np.asarray(view.corners_px - there[view.ids])


def rms(errors: Array) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


@pytest.mark.parametrize(("board", "far_m"), [(CHESSBOARD, 0.85), (CHARUCO, 0.42)])
def test_small_squares_of_a_tilted_board(board: Board, far_m: float) -> None:
    """Squares of 9 and 18 px: a window of 11x11 would take in the neighbours."""
    assert rms(_errors(np.array([0.35, -0.5, 0.1, -0.1, -0.07, far_m]), board)) < 0.08


def test_a_partly_seen_charuco_board_is_used() -> None:
    errors = _errors(np.array([0.2, 0.3, 0.0, -0.02, -0.03, 0.22]), CHARUCO)
    assert 12 < len(errors) < 54
    assert rms(errors) < 0.08


def test_a_large_picture_keeps_the_places_of_its_pixels() -> None:
    """The search runs on a smaller picture; the corners belong to the full one."""
    pose = np.array([0.3, -0.2, 0.1, -0.11, -0.07, 0.42])
    picture = BoardRenderer(CAMERA, CHARUCO).render(pose, np.random.default_rng(0), noise=1.0)
    large = np.asarray(cv2.resize(picture, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC))
    view = _view(CHARUCO, large)
    there = project(CHARUCO.corners_m(), pose[:3], pose[3:], CAMERA)[view.ids]
    expected = (there + 0.5) * 4 - 0.5
    assert np.abs((view.corners_px - expected).mean(axis=0)).max() < 0.1


# --- interlaced pictures -------------------------------------------------------------------


def test_pictures_of_a_camera_that_was_held_both_ways_have_one_grid(tmp_path: Path) -> None:
    pose = np.array([0.1, -0.2, 0.05, -0.11, -0.08, 0.42])
    rendered = BoardRenderer(CAMERA, CHARUCO).render(pose, np.random.default_rng(0), noise=1.0)
    for orientation in (1, 3, 6):
        data = turned_picture(rendered, "PNG", orientation)
        (tmp_path / f"{orientation}.png").write_bytes(data)
    views = find_views(sorted(tmp_path.iterdir()), CHARUCO).views
    assert len(views) == 3
    for view in views:
        np.testing.assert_array_equal(view.corners_px, views[0].corners_px)


def test_the_corners_of_an_interlaced_picture_are_its_first_fields() -> None:
    rng, renderer = np.random.default_rng(3), BoardRenderer(CAMERA, CHARUCO)
    for pose in draw_poses(rng, CAMERA, CHARUCO, 4):
        after = pose + np.array([0.0, 0.0, 0.0, 0.004, 0.001, 0.0])
        picture, bottom = (renderer.render(each, rng, noise=2.0) for each in (pose, after))
        picture[1::2] = bottom[1::2]
        assert len(deinterlace_image(picture)) == 2
        view = _view(CHARUCO, picture)
        there = project(CHARUCO.corners_m(), pose[:3], pose[3:], CAMERA)[view.ids]
        assert rms(view.corners_px - there) < 0.1


# --- the vehicle's own gear, learned from pictures that move -------------------------------------


def test_what_stays_the_same_is_the_gear() -> None:
    covered = learn_gear_mask(Pictures(turned_about()))
    inner = cv2.erode(legs().astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    outer = cv2.dilate(legs().astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    assert covered[inner].all()
    assert not covered[~outer].any()


def test_what_does_not_reach_the_edge_is_no_gear() -> None:
    spot = legs()
    spot[100:130, 200:230] = True
    assert not learn_gear_mask(Pictures(turned_about(covered=spot)))[110:120, 210:220].any()


def test_a_vehicle_that_covers_nothing_needs_no_mask() -> None:
    pictures = turned_about(covered=np.zeros(SIZE_PX[::-1], np.bool_))
    assert not learn_gear_mask(Pictures(pictures)).any()
    Path("turned").mkdir()
    for number, image in enumerate(pictures):
        cv2.imwrite(f"turned/{number:03}.png", image)
    said = run("calibrate", "mask", "images:turned", "-o", "gear.png")
    assert (said.code, said.stdout) == (0, "")
    assert "camera.mask is not needed: gear.png was not written" in said.complaint
    assert not Path("gear.png").exists()


@pytest.mark.parametrize(
    ("pictures", "told"),
    [
        (turned_about(5), "5 images are too few"),
        (turned_about(contrast=2.0), "hardly change"),
        ([*turned_about(3), np.zeros((10, 10), np.uint8)], "needs images of the same size"),
    ],
)
def test_pictures_that_do_not_show_it_are_refused(
    pictures: list[np.ndarray[tuple[int, int], np.dtype[np.uint8]]], told: str
) -> None:
    with pytest.raises(InvalidValue, match=told):
        learn_gear_mask(Pictures(pictures))


def test_a_picture_of_the_target_is_named_as_that() -> None:
    said = find_board(picture(VIEWS["both"]), CHARUCO)
    assert "perching target" in str(said)
    assert "make-target board" in str(said)
