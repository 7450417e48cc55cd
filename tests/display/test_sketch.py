"""What is drawn into a picture."""

from __future__ import annotations

import numpy as np

from perchctl.display import Sketch
from perchctl.display.live import draw_sketch
from tests.helpers.recording import camera


def test_an_axis_behind_the_camera_and_a_wild_corner_are_left_out() -> None:
    image = np.full((480, 640), 110, np.uint8)
    pose = (np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, -0.2]), 0.075)
    wild = (("large", np.full((4, 2), 1e9)), ("small", np.full((4, 2), np.nan)))
    assert (draw_sketch(Sketch(image, wild, pose), camera()) == 110).all()
