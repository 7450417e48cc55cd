"""Boards seen by a known camera: as corners, and as rendered pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.polynomial import chebyshev

from perchctl.calibration.board.detect import BoardView
from perchctl.camera import Grey
from perchctl.geometry import Array
from perchctl.target import Board
from perchctl.target.boards import black_squares
from perchctl.vision import CameraModel, project, undistort_to_normalised

CHARUCO = Board.parse("charuco:10x7:25mm:18mm:DICT_5X5_100")
CHESSBOARD = Board.parse("chessboard:9x6:25mm")
_SUPER = 3  # samples across a pixel
_NODES = 24  # across the picture, at which rays are undistorted
_SQUARE_PX = 50  # of the drawn board; a marker of 18 in 25 mm is 36 px, in the middle


def draw_camera(rng: np.random.Generator, size_px: tuple[int, int] = (640, 480)) -> CameraModel:
    """A camera as small ones are: 58 to 75 deg wide, barrel distortion, centre off by a few px."""
    w, h = size_px
    f = w * rng.uniform(0.65, 0.9)
    K = np.array(
        [
            [f, 0.0, w / 2 + rng.uniform(-9, 9)],
            [0.0, f * rng.uniform(0.995, 1.005), h / 2 + rng.uniform(-9, 9)],
            [0.0, 0.0, 1.0],
        ]
    )
    k1 = rng.uniform(-0.2, -0.05)
    p = rng.uniform(-0.001, 0.001, 2)
    return CameraModel(size_px, K, np.array([k1, -0.2 * k1, p[0], p[1], rng.uniform(-0.01, 0.0)]))


def draw_poses(
    rng: np.random.Generator,
    camera: CameraModel,
    board: Board,
    views: int,
    max_tilt_deg: float = 45,
) -> list[Array]:
    """Poses (6,) as a person holds a board: here and there, near and far, tilted."""
    w, h = camera.size_px
    width_m, height_m = board.size_m
    middle = board.corners_m().mean(axis=0)
    # A chessboard has to be in view as a whole.
    aside, nearest = (0.5, 0.6) if board.kind == "chessboard" else (0.75, 0.9)
    poses = []
    for i in range(views):
        # Spread over the picture in thirds, then at random within.
        thirds = np.array([i % 3, i // 3 % 3]) + rng.uniform(0.1, 0.9, 2)
        px = thirds / 3 * (w, h)
        ray = undistort_to_normalised(
            ((1 - aside) * np.array([w / 2, h / 2]) + aside * px)[None], camera
        )[0]
        tilt = np.radians(rng.uniform(0.3, 1.0) * max_tilt_deg)
        about = rng.uniform(0, 2 * np.pi)
        roll = rng.normal(0, 0.3)
        R = (
            cv2.Rodrigues(tilt * np.array([np.cos(about), np.sin(about), 0.0]))[0]
            @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
        )
        share = rng.uniform(0.45, 1.0) * nearest
        z = max(camera.K[0, 0] * width_m / (share * w), camera.K[1, 1] * height_m / (share * h))
        t = np.array([ray[0] * z, ray[1] * z, z]) - R @ middle
        poses.append(np.concatenate([cv2.Rodrigues(R)[0].ravel(), t]))
    return poses


def corner_view(
    rng: np.random.Generator,
    camera: CameraModel,
    board: Board,
    pose: Array,
    noise_px: float,
    name: str,
) -> BoardView:
    """A view without a picture: true corners with noise; those outside of it are missing."""
    corners_m = board.corners_m()
    px = project(corners_m, pose[:3], pose[3:], camera)
    w, h = camera.size_px
    inside = ((px > 4) & (px < (w - 5, h - 5))).all(axis=1)
    noisy = px + rng.normal(0, noise_px, px.shape)
    return BoardView(
        name, camera.size_px, np.flatnonzero(inside), corners_m[inside], noisy[inside], 0.8
    )


def corner_views(
    rng: np.random.Generator,
    camera: CameraModel,
    board: Board = CHARUCO,
    views: int = 15,
    noise_px: float = 0.05,
    max_tilt_deg: float = 45,
) -> list[BoardView]:
    poses = draw_poses(rng, camera, board, views, max_tilt_deg)
    return [
        corner_view(rng, camera, board, pose, noise_px, f"view {i}") for i, pose in enumerate(poses)
    ]


class BoardRenderer:
    """Pictures of a board by a camera with distortion, blur and noise."""

    def __init__(self, camera: CameraModel, board: Board) -> None:
        self.camera, self.board = camera, board
        self._rays = _rays(camera)
        self._texture = _drawn(board)

    def render(
        self,
        pose: Array,
        rng: np.random.Generator,
        blur_px: float = 0.7,
        noise: float = 3.0,
        motion_px: tuple[float, float] = (0.0, 0.0),
    ) -> Grey:
        R = cv2.Rodrigues(pose[:3])[0]
        # Board plane (x, y, 1) -> ray; its inverse takes rays to the board.
        H = np.linalg.inv(np.column_stack([R[:, 0], R[:, 1], pose[3:]]))
        rays = self._rays
        b = rays @ H[:, :2].T + H[:, 2]
        xy = b[..., :2] / b[..., 2:]
        first = 1.0 if self.board.kind == "chessboard" else 0.0
        place = (xy + (first + 1.0) * self.board.square_m) * _SQUARE_PX / self.board.square_m - 0.5
        place[b[..., 2] <= 0] = -1e6
        drawn = cv2.remap(
            self._texture,
            place[..., 0].astype(np.float32),
            place[..., 1].astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=110,
        )
        if any(motion_px):
            drawn = _moved(drawn, motion_px)
        w, h = self.camera.size_px
        picture = cv2.resize(drawn, (w, h), interpolation=cv2.INTER_AREA).astype(np.float64)
        picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
        shade = 1.0 - 0.25 * np.hypot(*np.meshgrid(np.linspace(-1, 1, w), np.linspace(-1, 1, h)))
        picture = picture * shade + rng.normal(0, noise, picture.shape)
        return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _rays(camera: CameraModel) -> Array:
    """The undistorted ray of each sample, (h, w, 2).

    A polynomial through Chebyshev's nodes: 1e-9 px from the samples' own, which take 1 s.
    """
    nodes = chebyshev.chebpts1(_NODES)
    w, h = camera.size_px
    grid = np.stack(np.meshgrid(w * (nodes + 1) / 2 - 0.5, h * (nodes + 1) / 2 - 0.5), axis=-1)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-10)
    known = cv2.undistortPoints(grid.reshape(-1, 1, 2), camera.K, camera.dist, criteria=criteria)
    to_coefficients = np.linalg.inv(chebyshev.chebvander(nodes, _NODES - 1))
    of_x, of_y = (
        chebyshev.chebvander((np.arange(n * _SUPER) + 0.5) * 2 / (n * _SUPER) - 1, _NODES - 1)
        @ to_coefficients
        for n in (w, h)
    )
    known = known.reshape(_NODES, _NODES, 2)
    return np.stack([of_y @ known[..., k] @ of_x.T for k in range(2)], axis=-1)


def render_folder(folder: Path, camera: CameraModel, board: Board, views: int, seed: int) -> None:
    """A folder of rendered pictures."""
    rng = np.random.default_rng(seed)
    renderer = BoardRenderer(camera, board)
    folder.mkdir(parents=True, exist_ok=True)
    for i, pose in enumerate(draw_poses(rng, camera, board, views)):
        cv2.imwrite(str(folder / f"board_{i:02d}.png"), renderer.render(pose, rng))


def _drawn(board: Board) -> Grey:
    """The board with one square of white around it."""
    black = black_squares(board)
    sheet = np.where(black, 30, 225).astype(np.uint8).repeat(_SQUARE_PX, 0).repeat(_SQUARE_PX, 1)
    if board.marker_m is not None:
        made = board.cv2_board()
        side = round(board.marker_m / board.square_m * _SQUARE_PX)
        margin = (_SQUARE_PX - side) // 2
        for marker_id, (row, column) in enumerate(np.argwhere(~black)):
            marker = cv2.aruco.generateImageMarker(made.getDictionary(), marker_id, side)
            y, x = row * _SQUARE_PX + margin, column * _SQUARE_PX + margin
            sheet[y : y + side, x : x + side] = np.where(marker > 0, 225, 30)
    return np.asarray(np.pad(sheet, _SQUARE_PX, constant_values=225))


def _moved(drawn: Grey, motion_px: tuple[float, float]) -> Grey:
    """Smeared along a straight way, in px of the picture."""
    dx, dy = (d * _SUPER for d in motion_px)
    size = 2 * int(np.ceil(max(abs(dx), abs(dy)) / 2)) + 3
    kernel = np.zeros((size, size))
    for s in np.linspace(-0.5, 0.5, 8 * size):
        x, y = size // 2 + s * dx, size // 2 + s * dy
        kernel[round(y), round(x)] += 1
    return np.asarray(cv2.filter2D(drawn, -1, kernel / kernel.sum()), np.uint8)
