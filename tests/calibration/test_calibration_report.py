"""The report's picture: every text can be read, whatever the lens model does."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from perchctl.calibration import BoardView, Calibration, Rejection, calibrate_camera
from perchctl.calibration.board.adjust import ModelName
from perchctl.calibration.board.plot import BANNER, report_figure
from perchctl.calibration.board.predict import ray_errors_px
from tests.helpers.boards import CHESSBOARD, corner_views, draw_camera

MISSING = [Rejection(f"a_rather_long_name_{i}.jpg", "is cut off") for i in range(6)]


def calibrated(model: ModelName) -> Calibration:
    """By few boards in the middle of the picture, which leave the rims to the lens model."""
    rng = np.random.default_rng(3)
    camera = draw_camera(rng)
    views = [_middle(v) for v in corner_views(rng, camera, CHESSBOARD, 8, 0.2)]
    return calibrate_camera(views, "", model, missing=MISSING)


def _middle(view: BoardView) -> BoardView:
    away = np.abs(view.corners_px - np.array(view.size_px) / 2) / view.size_px
    return view.keep((away < 0.36).all(axis=1))


def texts(figure: Figure) -> dict[Text, tuple[float, float, float, float]]:
    """All that is written, with its left, bottom, right and top in px."""
    figure.canvas.draw()
    beyond = {
        label
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        for tick in axis.get_major_ticks()
        if not min(axis.get_view_interval()) <= tick.get_loc() <= max(axis.get_view_interval())
        for label in (tick.label1, tick.label2)
    }
    found = {}
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        turned = text.get_rotation() not in (0.0, 90.0)  # names of views, one beside the other
        if text.get_visible() and text.get_text().strip() and not turned and text not in beyond:
            box = text.get_window_extent()
            if box.width > 0:
                found[text] = (box.x0, box.y0, box.x1, box.y1)
    return found


@pytest.mark.long
@pytest.mark.parametrize("model", ["rational_polynomial", "fisheye"])
def test_every_text_can_be_read(model: ModelName) -> None:
    result = calibrated(model)
    figure = report_figure(result)
    placed = texts(figure)
    written = " ".join(" ".join(text.get_text() for text in placed).split())
    for lack in result.lacks:
        assert str(lack) in written  # the whole advice
    width, height = figure.bbox.width, figure.bbox.height
    for text, (x0, y0, x1, y1) in placed.items():
        assert min(x0, y0, width - x1, height - y1) > -1.0, text.get_text()
    for (one, a), (other, b) in itertools.combinations(placed.items(), 2):
        across, up = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
        assert min(across, up) < 2.0, (one.get_text(), other.get_text())
    for axes in figure.axes:
        assert axes.get_position().width > 0.2
        assert axes.get_position().height > 0.15
    assert len({*BANNER.values()}) == 3


def test_where_a_model_folds_back_no_ray_has_an_error() -> None:
    result = calibrated("fisheye")
    assert "folds back" in str(result.lacks[0])
    *_, each = ray_errors_px(result.camera, result.covariance)
    assert np.isnan(each).any()
    assert np.nanmax(each) < 1e3
