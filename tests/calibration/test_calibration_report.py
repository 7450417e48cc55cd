"""The report's picture: every text can be read, whatever the lens model does."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.text import Text

from perchctl.calibration import BoardView, Rejection, calibrate_camera
from perchctl.calibration.board.plot import report_figure
from tests.helpers.boards import CHESSBOARD, corner_views, draw_camera

MISSING = [Rejection(f"a_rather_long_name_{i}.jpg", "is cut off") for i in range(6)]


def _middle(view: BoardView) -> BoardView:
    away = np.abs(view.corners_px - np.array(view.size_px) / 2) / view.size_px
    return view.keep((away < 0.36).all(axis=1))


@pytest.mark.long
@pytest.mark.parametrize("model", ["rational_polynomial", "fisheye"])
def test_every_text_can_be_read(model: str) -> None:
    """Of few boards in the middle of the picture, which leave the rims to the lens model."""
    rng = np.random.default_rng(3)
    views = [_middle(v) for v in corner_views(rng, draw_camera(rng), CHESSBOARD, 8, 0.2)]
    result = calibrate_camera(views, "", model, missing=MISSING)
    if model == "fisheye":
        assert "folds back" in str(result.lacks[0])
    figure = report_figure(result)
    figure.canvas.draw()
    boxes = {
        text: text.get_window_extent()
        for part in (figure.subfigs[0], *figure.axes)
        for text in part.findobj(Text)
        if text.get_visible() and text.get_text().strip()
    }
    written = " ".join(" ".join(text.get_text() for text in boxes).split())
    for lack in result.lacks:
        assert str(lack) in written  # the whole advice
    ticks = {label for axes in figure.axes for label in axes.get_xticklabels(which="both")}
    ticks |= {label for axes in figure.axes for label in axes.get_yticklabels(which="both")}
    placed = {text: box for text, box in boxes.items() if text not in ticks and box.width > 0}
    for text, box in placed.items():
        margins = (box.x0, box.y0, figure.bbox.width - box.x1, figure.bbox.height - box.y1)
        assert min(margins) > -1.0, text.get_text()
    for (one, a), (other, b) in itertools.combinations(placed.items(), 2):
        across, up = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        assert min(across, up) < 2.0, (one.get_text(), other.get_text())
