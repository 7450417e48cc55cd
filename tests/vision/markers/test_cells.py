from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import Array
from perchctl.vision import CameraModel
from perchctl.vision.markers.blurred import told_apart
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.markers.photometric_fit import Alignment, align
from tests.helpers.markers import SETUP, frame

PLAIN = CameraModel((160, 120), np.array([[200.0, 0, 80], [0, 200.0, 60], [0, 0, 1]]), np.zeros(5))
CELLS: Array = SETUP.patterns["small"].drawing.cells
INNER = [(row, column) for row in range(1, 6) for column in range(1, 6)]
DOTS = 12


def seen(cells: Array, cell_px: float, blur_px: float, noise: float, seed: int) -> Alignment:
    """The small marker's drawing laid over a picture of these cells."""
    image, corners = picture(cells, cell_px, blur_px, noise, seed)
    found = align(image, corners, SETUP.patterns["small"].drawing, PLAIN, blur_px)
    assert found is not None
    return found


def picture(
    cells: Array, cell_px: float, blur_px: float, noise: float, seed: int
) -> tuple[Array, Array]:
    fine = np.kron(np.pad(cells, 2, constant_values=1.0), np.ones((DOTS, DOTS)))
    scale, shift = cell_px / DOTS, 42.3
    M = np.array([[scale, 0.0, shift], [0.0, scale, shift - 20.0]])
    soft = cv2.GaussianBlur(fine.astype(np.float32), (0, 0), blur_px / scale)
    grey = cv2.warpAffine(soft, M, (160, 120), borderMode=cv2.BORDER_REPLICATE)
    rng = np.random.default_rng(seed)
    noisy = 40.0 + 160.0 * grey + rng.normal(0.0, noise, grey.shape)
    first, size = 2.0 * cell_px, len(cells) * cell_px
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    # A dot's middle is half a dot from its edge.
    corners = unit * size + first + (shift, shift - 20.0) - 0.5 * scale
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), corners


@given(
    cell_px=st.floats(2.5, 6.0),
    blurs=st.floats(0.3, 0.9),
    noise=st.floats(0.5, 4.0),
    seed=st.integers(0, 99),
)
def test_the_marker_itself_is_told_apart(
    cell_px: float, blurs: float, noise: float, seed: int
) -> None:
    assert told_apart(seen(CELLS, cell_px, blurs * cell_px, noise, seed))


@given(
    wrong=st.lists(st.sampled_from(INNER), min_size=1, max_size=3, unique=True),
    cell_px=st.floats(2.5, 6.0),
    blurs=st.floats(0.3, 0.9),
    noise=st.floats(0.5, 4.0),
    seed=st.integers(0, 99),
)
def test_wrong_bits_show_where_blur_hides_them(
    wrong: list[tuple[int, int]], cell_px: float, blurs: float, noise: float, seed: int
) -> None:
    cells = CELLS.copy()
    for row, column in wrong:
        cells[row, column] = 1.0 - cells[row, column]
    assert not told_apart(seen(cells, cell_px, blurs * cell_px, noise, seed))


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
    assert detect_markers(frame(image), None, SETUP, PLAIN).small is None
    own, _ = picture(CELLS, 4.0, 2.0, 2.0, seed=1)
    assert detect_markers(frame(own), None, SETUP, PLAIN).small is not None
