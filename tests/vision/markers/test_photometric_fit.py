"""A marker's drawing laid over the picture: corners, refusals, and what blur hides."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import CameraModel, project, square_corners
from perchctl.vision.markers.blurred import (
    are_other_codewords_excluded,
    find_blurred_marker,
    find_expected_blurred_marker,
    is_alignment_confirmed,
)
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.markers.detector import DetectorInput
from perchctl.vision.markers.pattern import MarkerDrawing, make_marker_drawing
from perchctl.vision.markers.photometric_fit import DrawingAlignment, align_drawing
from perchctl.vision.types import Detection, Detections
from tests.helpers.markers import SETUP, blurry, frame
from tests.helpers.target_picture import CAMERA, bits_of, pose_of, render

LARGE_BITS, SMALL_BITS = bits_of("DICT_4X4_1000", 997), bits_of("DICT_ARUCO_ORIGINAL", 5)
DRAWINGS: dict[str, MarkerDrawing] = {
    "large": make_marker_drawing(LARGE_BITS, SMALL_BITS, 1.0 / 6.0),
    "small": make_marker_drawing(SMALL_BITS),
}
SIDES = {"large": 0.150, "small": 0.025}


def view(name: str, side_px: float, seed: int, **looks: float) -> tuple[NDArray[np.uint8], Array]:
    """A picture and the marker's true corners."""
    rng = np.random.default_rng(seed)
    z = 401.0 * SIDES[name] / side_px
    x, y, yaw, roll, pitch = rng.uniform(-1, 1, 5) * (0.3 * z, 0.25 * z, math.pi, 0.12, 0.12)
    rvec, tvec = pose_of(x, y, z, yaw, roll, pitch)
    return render(rvec, tvec, seed=seed, **looks), project(
        square_corners(SIDES[name]), rvec, tvec, CAMERA
    )


def off(corners: Array, seed: int) -> Array:
    """Corners as a poor prediction has them: moved, turned, of another size."""
    rng = np.random.default_rng(100 + seed)
    centre, side = corners.mean(axis=0), np.linalg.norm(corners[1] - corners[0])
    angle, size = rng.normal(0.0, 0.03), rng.uniform(0.95, 1.05)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return np.asarray(centre + size * (corners - centre) @ turn.T + rng.normal(0, 0.05 * side, 2))


@pytest.mark.parametrize(
    ("name", "side_px", "blur_px", "allowed_px"),
    [
        ("large", 12.0, 1.0, 0.08),
        pytest.param("large", 30.0, 1.0, 0.03, marks=pytest.mark.long),
        pytest.param("large", 40.0, 4.0, 0.15, marks=pytest.mark.long),
        pytest.param("small", 14.0, 1.0, 0.08, marks=pytest.mark.long),
        pytest.param("small", 30.0, 1.0, 0.03, marks=pytest.mark.long),
        ("small", 34.0, 4.0, 0.15),
    ],
)
def test_corners_of_small_and_blurred_markers(
    name: str, side_px: float, blur_px: float, allowed_px: float
) -> None:
    squares = []
    for seed in range(6):
        image, true = view(name, side_px, seed, blur_px=blur_px, noise=3.0)
        found = align_drawing(image, off(true, seed), DRAWINGS[name], CAMERA, 1.5)
        assert is_alignment_confirmed(found)
        error = found.corners_px - true
        squares.append((error**2).mean())
        assert np.abs(error).max() < 6.0 * found.corner_sigma_px + 0.02
    assert math.sqrt(np.mean(squares)) < allowed_px


@pytest.mark.parametrize("tone", ["gamma", "clipped", "slope"])
def test_no_light_moves_the_corners(tone: str) -> None:
    for seed in range(4):
        image, true = view("small", 26.0, seed, blur_px=1.0)
        if tone == "gamma":
            image = np.rint(255.0 * (image / 255.0) ** 0.55).astype(np.uint8)
        elif tone == "clipped":
            image = np.clip(image * 1.6, 0, 255).astype(np.uint8)
        else:
            image = (image * np.linspace(0.45, 1.0, image.shape[1])).astype(np.uint8)
        found = align_drawing(image, off(true, seed), DRAWINGS["small"], CAMERA, 1.0)
        out = true - true.mean(axis=0)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        assert abs(((found.corners_px - true) * out).sum(axis=1).mean()) < 0.05


@pytest.mark.parametrize(
    ("name", "dictionary", "index"),
    [
        ("large", "DICT_4X4_1000", 16),
        ("large", "DICT_4X4_1000", 314),
        ("small", "DICT_ARUCO_ORIGINAL", 320),  # its mirror image
        ("small", "DICT_ARUCO_ORIGINAL", 1),
    ],
)
@pytest.mark.parametrize(("side_px", "blur_px"), [(16.0, 1.0), (24.0, 3.0), (40.0, 4.0)])
def test_other_markers_are_not_verified(
    name: str, dictionary: str, index: int, side_px: float, blur_px: float
) -> None:
    """A picture of another marker, aligned as well as it goes in all four turns."""
    pose = pose_of(0.0, 0.0, 401.0 * SIDES[name] / side_px)
    other = (dictionary, index, SIDES[name])
    image = render(*pose, markers=(other,), sheet_m=0.6, blur_px=blur_px, noise=2.0)
    true = project(square_corners(SIDES[name]), *pose, CAMERA)
    for k in range(4):
        found = align_drawing(image, np.roll(true, k, axis=0), DRAWINGS[name], CAMERA, 1.0)
        assert found is None or not is_alignment_confirmed(found)


@pytest.mark.parametrize(
    "corners",
    [
        np.full((4, 2), np.nan),
        np.full((4, 2), 100.0),
        np.array([[630.0, 0.0], [670.0, 0.0], [670.0, 40.0], [630.0, 40.0]]),
    ],
)
def test_impossible_starts_and_flat_pictures_give_nothing(corners: Array) -> None:
    flat = np.full((480, 640), 130, np.uint8)
    assert align_drawing(flat, corners, DRAWINGS["large"], CAMERA) is None
    middle = np.array([[300.0, 200.0], [340.0, 200.0], [340.0, 240.0], [300.0, 240.0]])
    assert align_drawing(flat, middle, DRAWINGS["large"], CAMERA) is None


# --- Which codeword it is ----------------------------------------------------------------------


PINHOLE = CameraModel(
    (160, 120), np.array([[200.0, 0, 80], [0, 200.0, 60], [0, 0, 1]]), np.zeros(5)
)
CELLS: Array = SETUP.patterns["small"].drawing.cell_whiteness
DOTS = 12


def seen(
    cells: Array, cell_size_px: float, blur_px: float, noise: float, seed: int
) -> DrawingAlignment:
    """The small marker's drawing laid over a picture of these cells."""
    image, corners = picture(cells, cell_size_px, blur_px, noise, seed)
    found = align_drawing(image, corners, SETUP.patterns["small"].drawing, PINHOLE, blur_px)
    assert found is not None
    return found


def picture(
    cells: Array, cell_size_px: float, blur_px: float, noise: float, seed: int
) -> tuple[Array, Array]:
    fine = np.kron(np.pad(cells, 2, constant_values=1.0), np.ones((DOTS, DOTS)))
    scale, shift = cell_size_px / DOTS, 42.3
    M = np.array([[scale, 0.0, shift], [0.0, scale, shift - 20.0]])
    soft = cv2.GaussianBlur(fine.astype(np.float32), (0, 0), blur_px / scale)
    grey = cv2.warpAffine(soft, M, (160, 120), borderMode=cv2.BORDER_REPLICATE)
    rng = np.random.default_rng(seed)
    noisy = 40.0 + 160.0 * grey + rng.normal(0.0, noise, grey.shape)
    first, size = 2.0 * cell_size_px, len(cells) * cell_size_px
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    # A dot's middle is half a dot from its edge.
    corners = unit * size + first + (shift, shift - 20.0) - 0.5 * scale
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), corners


@given(
    cell_size_px=st.floats(2.5, 6.0),
    blurs=st.floats(0.3, 0.9),
    noise=st.floats(0.5, 4.0),
    seed=st.integers(0, 99),
)
def test_the_marker_itself_is_told_apart(
    cell_size_px: float, blurs: float, noise: float, seed: int
) -> None:
    assert are_other_codewords_excluded(
        seen(CELLS, cell_size_px, blurs * cell_size_px, noise, seed)
    )


@pytest.mark.parametrize(
    "wrong",
    [
        [(1, 1), (1, 2)],
        [(1, 1), (4, 1)],
        [(1, 1), (2, 4)],
        [(1, 5), (3, 4), (4, 4)],
        [(1, 2), (1, 4), (3, 2)],
    ],
)
def test_a_blurred_marker_of_another_codeword_is_not_taken(wrong: list[tuple[int, int]]) -> None:
    cells = CELLS.copy()
    for row, column in wrong:
        cells[row, column] = 1.0 - cells[row, column]
    image, _ = picture(cells, 4.0, 2.0, 2.0, seed=1)
    assert detect_markers(frame(image), None, SETUP, PINHOLE).small is None
    own, _ = picture(CELLS, 4.0, 2.0, 2.0, seed=1)
    assert detect_markers(frame(own), None, SETUP, PINHOLE).small is not None


# --- Blur that hides the target ----------------------------------------------------------------


ARUCO = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000))


@pytest.mark.parametrize("seed", range(3))
def test_blur_that_hides_the_target_from_the_plain_detector(seed: int) -> None:
    image, true = blurry(26.0, 3.0, seed)
    ids = ARUCO.detectMarkers(image)[1]
    assert ids is None or 997 not in ids
    still = find_blurred_marker(DetectorInput(image, None, SETUP, CAMERA))
    assert np.abs(still["large"].corners_px - true).max() < 0.5
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.large is not None


@pytest.mark.parametrize("seed", range(3))
def test_in_blur_the_target_is_found_beside_where_it_is_expected(seed: int) -> None:
    image, true = blurry(24.0, 3.0, seed)
    way = np.random.default_rng(seed).uniform(-8.0, 8.0, 2)
    seen = find_expected_blurred_marker(
        DetectorInput(image, None, SETUP, CAMERA), {"large": true + way}
    )
    assert np.abs(seen["large"].corners_px - true).max() < 0.5
    before = Detections(0, 0.0, Detection("large", true + way, 0.1, True))
    found = detect_markers(frame(image, 1), before, SETUP, CAMERA)
    assert np.abs(found.large.corners_px - true).max() < 0.5


def test_in_blur_nothing_is_taken_for_the_target() -> None:
    rng = np.random.default_rng(2)
    expected = {"large": np.array([[300.0, 200.0], [330.0, 200.0], [330.0, 230.0], [300.0, 230.0]])}
    for sigma in (1.0, 2.0, 4.0):
        noise = rng.normal(0.0, 200.0 * sigma, (480, 640)).astype(np.float32)
        image = np.clip(130 + cv2.GaussianBlur(noise, (0, 0), sigma), 0, 255).astype(np.uint8)
        for _ in range(3):  # dark squares with a light inside, of no marker
            x, y, side = rng.integers(60, 400), rng.integers(60, 380), int(rng.integers(14, 60))
            image[y : y + side, x : x + side] = 30
            image[y + side // 5 : y + 4 * side // 5, x + side // 5 : x + 4 * side // 5] = 210
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)
        assert find_blurred_marker(DetectorInput(image, None, SETUP, CAMERA)) == {}
        assert (
            find_expected_blurred_marker(DetectorInput(image, None, SETUP, CAMERA), expected) == {}
        )
