"""The report's picture: every text can be read, whatever the lens model does."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.text import Text

from perchctl.calibration import calibrate_camera
from perchctl.calibration.board.plot import report_figure
from tests.helpers.boards import CHESSBOARD, corner_views, draw_camera


@pytest.mark.long
def test_every_text_can_be_read() -> None:
    """Of few boards in the middle of the picture, which leave the rims to the lens model."""
    rng = np.random.default_rng(3)
    views = corner_views(rng, draw_camera(rng), CHESSBOARD, 8, 0.2)
    away = (np.abs(v.corners_px - np.array(v.size_px) / 2) / v.size_px for v in views)
    middle = [v.keep((a < 0.36).all(axis=1)) for v, a in zip(views, away, strict=True)]
    result = calibrate_camera(middle, "", "fisheye")
    assert "folds back" in str(result.lacks[0])
    figure = report_figure(result)
    figure.canvas.draw()
    texts = [text for part in (figure.subfigs[0], *figure.axes) for text in part.findobj(Text)]
    written = " ".join(" ".join(text.get_text() for text in texts).split())
    assert all(str(lack) in written for lack in result.lacks)
    labels = [
        label
        for axes in figure.axes
        for label in (*axes.get_xticklabels(which="both"), *axes.get_yticklabels(which="both"))
    ]
    boxes = [text.get_window_extent() for text in texts if text.get_text() and text not in labels]
    for box in boxes:
        margins = (box.x0, box.y0, figure.bbox.width - box.x1, figure.bbox.height - box.y1)
        assert min(margins) > -1.0
    for a, b in itertools.combinations(boxes, 2):
        across, up = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        assert min(across, up) < 2.0
