from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import project, square_corners
from perchctl.vision.markers.blurred import told_apart, verified
from perchctl.vision.markers.pattern import Drawing, drawing_of
from perchctl.vision.markers.photometric_fit import align
from tests.helpers.target_picture import CAMERA, bits_of, pose_of, render

LARGE_BITS, SMALL_BITS = bits_of("DICT_4X4_1000", 997), bits_of("DICT_ARUCO_ORIGINAL", 5)
DRAWINGS: dict[str, Drawing] = {
    "large": drawing_of(LARGE_BITS, SMALL_BITS, 1.0 / 6.0),
    "small": drawing_of(SMALL_BITS),
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
        ("large", 30.0, 1.0, 0.03),
        ("large", 40.0, 4.0, 0.15),
        ("small", 14.0, 1.0, 0.08),
        ("small", 30.0, 1.0, 0.03),
        ("small", 34.0, 4.0, 0.15),
    ],
)
def test_corners_of_small_and_blurred_markers(
    name: str, side_px: float, blur_px: float, allowed_px: float
) -> None:
    squares = []
    for seed in range(6):
        image, true = view(name, side_px, seed, blur_px=blur_px, noise=3.0)
        found = align(image, off(true, seed), DRAWINGS[name], CAMERA, 1.5)
        assert found is not None
        assert verified(found)
        error = found.corners_px - true
        squares.append((error**2).mean())
        assert np.abs(error).max() < 6.0 * found.sigma_px + 0.02
        assert found.gain == pytest.approx(175.0, rel=0.2)
    assert math.sqrt(np.mean(squares)) < allowed_px


@pytest.mark.parametrize(
    ("name", "side_px", "blur_px"),
    [("large", 24.0, 4.0), ("large", 24.0, 5.0), ("small", 26.0, 4.0), ("small", 32.0, 5.0)],
)
def test_a_blur_that_nobody_expected_is_found_well_enough_to_tell_codewords_apart(
    name: str, side_px: float, blur_px: float
) -> None:
    """Of half a cell; a fit that ends while the blur still grows leaves more than they differ."""
    for seed in range(6):
        image, true = view(name, side_px, seed, blur_px=blur_px, noise=1.0)
        found = align(image, off(true, seed), DRAWINGS[name], CAMERA, 1.5)
        assert found is not None
        assert verified(found)
        assert told_apart(found)


@pytest.mark.parametrize("tone", ["gamma", "clipped"])
def test_a_bent_tone_curve_moves_no_corner(tone: str) -> None:
    for seed in range(4):
        image, true = view("small", 26.0, seed, blur_px=1.0)
        if tone == "gamma":
            image = np.rint(255.0 * (image / 255.0) ** 0.55).astype(np.uint8)
        else:
            image = np.clip(image * 1.6, 0, 255).astype(np.uint8)
        found = align(image, off(true, seed), DRAWINGS["small"], CAMERA, 1.0)
        assert found is not None
        out = true - true.mean(axis=0)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        assert abs(((found.corners_px - true) * out).sum(axis=1).mean()) < 0.05


def test_a_slope_of_the_light_moves_no_corner() -> None:
    image, true = view("large", 40.0, 3)
    ramp = np.linspace(0.45, 1.0, image.shape[1])
    found = align((image * ramp).astype(np.uint8), off(true, 3), DRAWINGS["large"], CAMERA, 1.0)
    assert found is not None
    assert verified(found)
    assert np.abs(found.corners_px - true).max() < 0.1


@pytest.mark.parametrize(
    ("name", "dictionary", "index"),
    [
        ("large", "DICT_4X4_1000", 16),
        ("large", "DICT_4X4_1000", 45),
        ("large", "DICT_4X4_1000", 314),
        ("small", "DICT_ARUCO_ORIGINAL", 320),  # its mirror image
        ("small", "DICT_ARUCO_ORIGINAL", 1),
        ("small", "DICT_ARUCO_ORIGINAL", 21),
    ],
)
@pytest.mark.parametrize(("side_px", "blur_px"), [(16.0, 1.0), (24.0, 3.0), (40.0, 4.0)])
def test_other_markers_are_not_verified(
    name: str, dictionary: str, index: int, side_px: float, blur_px: float
) -> None:
    """A picture of another marker, aligned as well as it goes in all four turns."""
    bits = bits_of(dictionary, index)
    n = len(bits) + 2
    grid = np.linspace(-0.5 * side_px, 0.5 * side_px, n + 1)
    x, y = np.meshgrid(np.arange(120) - 60.3, np.arange(120) - 59.6)
    soft = 0.5 * blur_px

    def step(d: Array) -> Array:
        return 0.5 * (1.0 + np.tanh(0.8 * d / soft))

    columns = step(x[None] - grid[:-1, None, None]) - step(x[None] - grid[1:, None, None])
    rows = step(y[None] - grid[:-1, None, None]) - step(y[None] - grid[1:, None, None])
    dark = np.einsum("rhw,rc,chw->hw", rows, np.pad(1.0 - bits, 1, constant_values=1.0), columns)
    image = np.full((480, 640), 205, np.uint8)
    noise = np.random.default_rng(0).normal(0.0, 2.0, dark.shape)
    image[180:300, 260:380] = np.clip(205.0 - 170.0 * dark + noise, 0, 255)
    h = side_px / 2
    corners = np.array([[-h, -h], [h, -h], [h, h], [-h, h]]) + np.array([320.3, 239.6])
    for k in range(4):
        found = align(image, np.roll(corners, k, axis=0), DRAWINGS[name], CAMERA, 1.0)
        assert found is None or not verified(found)


def test_nothing_is_verified_where_there_is_no_marker() -> None:
    rng = np.random.default_rng(7)
    smooth = np.zeros((480, 640))
    for step in (6, 12, 30):  # a texture of all sizes
        coarse = rng.uniform(-60, 60, (480 // step + 2, 640 // step + 2))
        smooth += np.kron(coarse, np.ones((step, step)))[:480, :640]
    image = np.clip(120 + smooth, 0, 255).astype(np.uint8)
    for _ in range(60):
        side = float(np.exp(rng.uniform(math.log(10), math.log(90))))
        angle, centre = rng.uniform(0, math.tau), rng.uniform((100, 100), (540, 380))
        turns = angle + np.arange(4) * math.pi / 2
        corners = centre + side / math.sqrt(2) * np.stack([np.cos(turns), np.sin(turns)], axis=1)
        for drawing in DRAWINGS.values():
            found = align(image, corners, drawing, CAMERA, 1.5)
            assert found is None or not verified(found)


@pytest.mark.parametrize(
    "corners",
    [
        np.full((4, 2), np.nan),
        np.full((4, 2), 100.0),
        np.array([[-200.0, 0.0], [-160.0, 0.0], [-160.0, 40.0], [-200.0, 40.0]]),
        np.array([[630.0, 0.0], [670.0, 0.0], [670.0, 40.0], [630.0, 40.0]]),
    ],
)
def test_impossible_starts_and_flat_pictures_give_nothing(corners: Array) -> None:
    flat = np.full((480, 640), 130, np.uint8)
    assert align(flat, corners, DRAWINGS["large"], CAMERA) is None
    middle = np.array([[300.0, 200.0], [340.0, 200.0], [340.0, 240.0], [300.0, 240.0]])
    assert align(flat, middle, DRAWINGS["large"], CAMERA) is None
