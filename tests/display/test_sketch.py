"""What is written into a picture can be read."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perchctl.display import Sketch, draw_sketch
from tests.helpers.recording import camera

LINES = ("frame  151   5.000 s", "target  x +1.23  y -4.56  z 45.67 cm", "yaw +135.71 deg")


@pytest.mark.parametrize("size_px", [(320, 240), (640, 480), (1280, 960)])
def test_the_dark_rim_lies_around_the_letters_and_nowhere_else(size_px: tuple[int, int]) -> None:
    """A font may have wider glyphs where they are thicker: a thick text under a thin one is
    then a second text beside it."""
    width, height = size_px
    drawn = draw_sketch(Sketch(np.full((height, width), 110, np.uint8), text=LINES), camera())
    light, dark = (drawn[:, :, 0] > 150).astype(np.uint8), drawn[:, :, 0] < 70
    assert light.sum() > 300
    reach = 2 * max(1, round(height / 480)) + 3
    near = cv2.dilate(light, np.ones((reach, reach), np.uint8)).astype(bool)
    assert dark.sum() > 300
    assert not (dark & ~near).any()


def test_a_line_is_written_on_white_too_and_smaller_if_it_is_too_long() -> None:
    line = "come nearer, until the board fills a third of the picture; " * 3
    drawn = draw_sketch(Sketch(np.full((480, 640), 255, np.uint8), text=(line,)), camera())
    assert (drawn < 70).sum() > 300
    columns = np.flatnonzero((drawn != 255).any(axis=(0, 2)))
    assert columns.min() < 10
    assert 590 < columns.max() < 638


def test_an_axis_behind_the_camera_and_a_wild_corner_are_left_out() -> None:
    """Nor is anything written without text."""
    image = np.full((480, 640), 110, np.uint8)
    pose = (np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.2]), 0.075)
    wild = (("large", np.full((4, 2), 1e9)), ("small", np.full((4, 2), np.nan)))
    assert (draw_sketch(Sketch(image, wild, pose), camera()) == 110).all()
