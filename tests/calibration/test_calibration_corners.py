"""Corners: their bias, their spread, and what the window takes in."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perchctl.calibration import BoardView
from perchctl.calibration.board.detect import find_board, fit_saddles
from perchctl.camera import Grey
from perchctl.geometry import Array
from perchctl.target import Board, parse_board
from perchctl.vision import project
from tests.helpers.boards import (
    APRILGRID,
    CHARUCO,
    CHESSBOARD,
    BoardRenderer,
    draw_camera,
)

CAMERA = draw_camera(np.random.default_rng(1), (480, 360))


@pytest.fixture(scope="module")
def tag_renderer() -> BoardRenderer:
    return BoardRenderer(CAMERA, APRILGRID)


def crossing(
    at: tuple[float, float], square_px: float, angle_deg: float, slant_deg: float, blur_px: float
) -> tuple[Grey, Array, Array]:
    """A checker of that square around one corner, drawn at 12 samples a pixel."""
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
    return np.rint(picture).astype(np.uint8), along * square_px, down * square_px


@pytest.mark.parametrize("square_px", [7.0, 12.0, 30.0])
@pytest.mark.parametrize("slant_deg", [0.0, 25.0])
def test_a_corner_is_found_without_bias(square_px: float, slant_deg: float) -> None:
    errors = []
    for k in range(8):
        at = (31.0 + 0.13 * k, 32.4 - 0.11 * k)
        image, along, down = crossing(at, square_px, 7.0 + 11.0 * k, slant_deg, 0.8)
        start = np.array([at]) + 0.4 * np.array([np.cos(k), np.sin(k)])
        fit = fit_saddles(image, start, along[None], down[None])
        assert fit.ok.all()
        errors.append(fit.corners_px[0] - at)
    assert np.abs(errors).max() < (0.12 if square_px < 10 else 0.03)


def test_a_flat_patch_is_refused() -> None:
    image = np.full((64, 64), 120, np.uint8)
    axes = np.array([[12.0, 0.0]]), np.array([[0.0, 12.0]])
    fit = fit_saddles(image, np.array([[32.0, 32.0]]), *axes)
    assert not fit.ok.any()


def test_light_that_falls_off_does_not_pull() -> None:
    image, along, down = crossing((32.3, 31.6), 20.0, 20.0, 0.0, 1.2)
    fall = 1.0 - 0.01 * np.arange(64)
    shaded = np.rint(image * fall).astype(np.uint8)
    fit = fit_saddles(shaded, np.array([[32.0, 32.0]]), along[None], down[None])
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


def _tag_errors(renderer: BoardRenderer, pose: Array, blur_px: float = 0.7) -> Array:
    """Of the corners found of an aprilgrid, which all know where they belong, (n, 2)."""
    view = _view(APRILGRID, renderer.render(pose, np.random.default_rng(0), blur_px, noise=2.0))
    there = project(APRILGRID.corners_m(), pose[:3], pose[3:], CAMERA)
    return np.asarray(view.corners_px - there[view.ids])


def _turned(degrees: float, z_m: float) -> Array:
    """An aprilgrid in the middle, tilted by 25 deg and turned about the view."""
    tilt, roll = (np.radians([25.0, 0, 0]), np.radians([0, 0, degrees]))
    R = cv2.Rodrigues(tilt)[0] @ cv2.Rodrigues(roll)[0]
    t = np.array([0.0, 0.0, z_m]) - R @ APRILGRID.corners_m().mean(axis=0)
    return np.concatenate([cv2.Rodrigues(R)[0].ravel(), t])


@pytest.mark.parametrize("degrees", [0, 45, 100, 180, 270])
@pytest.mark.parametrize(("z_m", "blur_px"), [(0.3, 0.7), (0.35, 1.1), (0.45, 0.7)])
def test_an_aprilgrid_s_corners_are_as_exact_as_a_charuco_board_s(
    tag_renderer: BoardRenderer, degrees: float, z_m: float, blur_px: float
) -> None:
    """However it is turned, and where the tags (15 to 25 px) hang together by the squares."""
    errors = _tag_errors(tag_renderer, _turned(degrees, z_m), blur_px=blur_px)
    assert len(errors) > 0.7 * 144
    assert rms(errors) < 0.08
    assert np.linalg.norm(errors, axis=1).max() < 0.5
    assert np.abs(errors.mean(axis=0)).max() < 0.02


def test_a_wide_gap_s_window_leaves_the_tag_s_cells_out() -> None:
    """With a gap of 0.6 the window reaches over the tag's border."""
    board = parse_board("aprilgrid:4x4:22mm:0.6")
    pose = np.array([0.3, -0.2, 0.4, -0.03, -0.08, 0.35])
    picture = BoardRenderer(CAMERA, board).render(pose, np.random.default_rng(0), noise=2.0)
    view = _view(board, picture)
    assert len(view) == 64
    errors = view.corners_px - project(board.corners_m(), pose[:3], pose[3:], CAMERA)
    assert rms(errors) < 0.05


def test_a_partly_seen_aprilgrid_is_used(tag_renderer: BoardRenderer) -> None:
    errors = _tag_errors(tag_renderer, np.array([0.2, 0.3, 0.0, -0.02, -0.03, 0.15]))
    assert 24 < len(errors) < 120
    assert rms(errors) < 0.08


@pytest.mark.parametrize("degrees", [0, 100])
def test_small_soft_tags_are_found_by_either_threshold(
    tag_renderer: BoardRenderer, degrees: float
) -> None:
    """Tags of 15 px, each way of which one threshold alone finds no two."""
    assert len(_tag_errors(tag_renderer, _turned(degrees, 0.45), blur_px=1.1)) > 60


def test_a_window_as_wide_as_the_gap_allows_holds_a_steep_board(
    tag_renderer: BoardRenderer,
) -> None:
    R = cv2.Rodrigues(np.radians([60.0, 0, 0]))[0]
    t = np.array([0, 0, 0.28]) - R @ APRILGRID.corners_m().mean(axis=0)
    pose = np.concatenate([np.radians([60.0, 0, 0]), t])
    errors = _tag_errors(tag_renderer, pose, blur_px=1.2)
    assert len(errors) > 60
    assert rms(errors) < 0.09


def test_a_corner_on_the_picture_s_rim_is_not_measured(tag_renderer: BoardRenderer) -> None:
    """Its window sees one side only: it would be off by 0.6 px."""
    pose, off = _turned(20, 0.3), 1.0
    while abs(off) > 0.01:  # until the leftmost corner is on the left rim
        off = project(APRILGRID.corners_m(), pose[:3], pose[3:], CAMERA)[:, 0].min()
        pose[3] -= off * pose[5] / CAMERA.K[0, 0]
    picture = tag_renderer.render(pose, np.random.default_rng(0), noise=2.0)
    view = _view(APRILGRID, picture)
    assert 130 < len(view) < 144
    there = project(APRILGRID.corners_m(), pose[:3], pose[3:], CAMERA)[view.ids]
    assert np.linalg.norm(view.corners_px - there, axis=1).max() < 0.3


def test_a_tag_of_something_else_is_none_of_the_board_s(tag_renderer: BoardRenderer) -> None:
    """One that the board has too, and one in the place of whose like a hand lies."""
    pose = _turned(0, 0.45)
    picture = tag_renderer.render(pose, np.random.default_rng(0), noise=2.0)
    there = project(APRILGRID.corners_m(), pose[:3], pose[3:], CAMERA)
    hand = there[list(APRILGRID.tag_corners(7))].round().astype(np.int32)
    cv2.fillConvexPoly(picture, hand, 120)
    stranger = np.full((50, 50), 225, np.uint8)
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for tag, (x, y) in ((3, (5, 5)), (7, (5, 300))):
        stranger[5:45, 5:45] = tags.generateImageMarker(tag, 40, borderBits=2)
        picture[y : y + 50, x : x + 50] = stranger
    view = _view(APRILGRID, picture)
    assert len(view) > 100
    assert np.abs(view.corners_px - there[view.ids]).max() < 0.5
    assert not set(APRILGRID.tag_corners(7)) & set(view.ids)
