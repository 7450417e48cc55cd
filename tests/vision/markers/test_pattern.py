from __future__ import annotations

import cv2
import numpy as np

from perchctl.vision import MARKERS
from perchctl.vision.markers.pattern import cells_agree, cells_mostly_agree, resemblance
from tests.helpers.markers import POSE, SETUP, corners
from tests.helpers.target_picture import render


def test_every_single_cell_counts() -> None:
    image = render(*POSE)
    pattern = SETUP.patterns["large"]
    assert cells_agree(image, corners("large"), pattern)
    H = cv2.getPerspectiveTransform(
        np.array([[0, 0], [6, 0], [6, 6], [0, 6]], dtype=np.float32),
        corners("large").astype(np.float32),
    )
    central = {(r, c) for r in (2, 3) for c in (2, 3)}
    for row in range(6):
        for column in range(6):
            if (row, column) in central:
                continue  # the small marker covers part of these
            spoilt = image.copy()
            cell = np.array([[column, row], [column + 1, row], [column + 1, row + 1],
                             [column, row + 1]], dtype=np.float64)  # fmt: skip
            quad = cv2.perspectiveTransform(cell[:, None], H)[:, 0]
            grey = int(image[tuple(np.rint(quad.mean(axis=0)[::-1]).astype(int))])
            cv2.fillConvexPoly(spoilt, np.rint(quad).astype(np.int32), 30 if grey > 120 else 205)
            assert not cells_agree(spoilt, corners("large"), pattern), (row, column)


def test_resemblance_gives_the_turn_of_a_marker() -> None:
    image = cv2.GaussianBlur(render(*POSE), (0, 0), 2.0)
    for name in MARKERS:
        for k in range(4):
            rolled = np.roll(corners(name), -k, axis=0)
            likeness = resemblance(np.asarray(image), rolled, SETUP.patterns[name])
            assert int(np.argmax(likeness)) == k
            assert likeness[k] > 0.8


def test_some_covered_cells_are_allowed_for_where_the_place_is_known() -> None:
    pattern, quad = SETUP.patterns["large"], corners("large")
    image = render(*POSE)
    x, y = np.rint(0.92 * quad[1] + 0.08 * quad[3]).astype(int)
    image[y - 14 : y + 15, x - 14 : x + 15] = 200
    assert not cells_agree(image, quad, pattern)
    assert cells_mostly_agree(image, quad, pattern)
    assert not cells_mostly_agree(image, quad + 30.0, pattern)


def test_cells_outside_of_the_picture_or_without_contrast_agree_with_nothing() -> None:
    pattern, image = SETUP.patterns["large"], render(*POSE)
    flat = np.full_like(image, 120)
    for picture, quad in ((image, corners("large") + 500.0), (flat, corners("large"))):
        assert not cells_agree(picture, quad, pattern)
        assert not cells_mostly_agree(picture, quad, pattern)
        assert np.array_equal(resemblance(picture, quad, pattern), np.zeros(4))
