"""The undistorted picture of a live calibration."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from perchctl.calibration import CaptureMoment, LensPreview
from perchctl.calibration.preview import flat_places_px
from perchctl.commands.calibrate_live import page_state, sketch_of
from perchctl.display.page.sketch import draw_flat
from perchctl.vision import CameraModel, distort, undistort
from tests.helpers.boards import CHARUCO, corner_views, draw_camera

K = np.array([[300.0, 0.0, 330.0], [0.0, 302.0, 236.0], [0.0, 0.0, 1.0]])
LENSES = {
    "none": CameraModel((640, 480), K, np.zeros(5)),
    "barrel": CameraModel((640, 480), K, np.array([-0.25, 0.06, 0.001, -0.001, 0.0])),
    "fisheye": CameraModel((640, 480), K, np.array([0.02, -0.01, 0.002, 0.0]), "fisheye"),
}


@pytest.mark.parametrize("lens", LENSES)
def test_what_is_straight_becomes_straight(lens: str) -> None:
    """The flat picture's pixels look along the rays of a pinhole: equal steps in x / z."""
    camera = LENSES[lens]
    places = flat_places_px(camera)
    assert places.shape == (480, 640, 2)
    assert places.dtype == np.float32
    inside = ((places >= 0) & (places <= (639, 479))).all(axis=2)
    assert inside.mean() > 0.6
    rays = undistort(places[inside].astype(np.float64), camera)
    rows, columns = np.nonzero(inside)
    for values, at in ((rays[:, 0], columns), (rays[:, 1], rows)):
        slope, offset = np.polyfit(at, values, 1)
        assert np.abs(values - slope * at - offset).max() < 0.05 * slope


@pytest.mark.parametrize("lens", LENSES)
def test_the_flat_picture_has_the_middle_row_from_rim_to_rim(lens: str) -> None:
    middle = flat_places_px(LENSES[lens])[236]
    assert middle[:, 0].max() >= 638.0 or middle[:, 0].min() <= 1.0
    assert middle[0, 0] < 40.0
    assert middle[-1, 0] > 600.0


def test_the_preview_is_the_lens_of_the_views_so_far() -> None:
    rng = np.random.default_rng(4)
    camera = draw_camera(rng)
    views = corner_views(rng, camera, CHARUCO, 9)
    preview = LensPreview()
    preview.offer(views[:4])
    preview.join()
    assert preview.flat is None, "too few"
    preview.offer(views)
    preview.join()
    flat = preview.flat
    assert flat is not None
    assert flat.views == 9
    # Where the lens put a ray is where the flat picture looks for it.
    inner = flat.places_px[60:-60:20, 80:-80:20].reshape(-1, 2).astype(np.float64)
    true = flat_places_px(camera)[60:-60:20, 80:-80:20].reshape(-1, 2)
    assert np.abs(inner - true).max() < 1.5
    assert distort(undistort(inner, camera), camera) == pytest.approx(inner, abs=1e-3)
    preview.offer(views)
    preview.join()
    assert preview.flat is flat, "the same views are not solved again"


def test_views_that_fit_no_lens_leave_the_last_one() -> None:
    rng = np.random.default_rng(4)
    views = corner_views(rng, draw_camera(rng), CHARUCO, 8)
    preview = LensPreview()
    preview.offer(views)
    preview.join()
    flat = preview.flat
    nonsense = [
        dataclasses.replace(v, corners_px=rng.uniform(0, 400, v.corners_px.shape)) for v in views
    ]
    preview.offer([*nonsense, views[0]])
    preview.join()
    assert preview.flat is flat is not None


def test_the_page_is_given_the_flat_picture_and_says_so() -> None:
    rng = np.random.default_rng(4)
    image = rng.integers(0, 255, (480, 640), np.uint8)
    moment = CaptureMoment(3, image, np.empty((0, 2)), {"x": 0.5}, 9, "hold still", False)
    assert draw_flat(sketch_of(moment, None)) is None
    assert [row[0] for row in page_state(moment, None)["rows"]] == ["x", "views"]
    preview = LensPreview()
    preview.offer(corner_views(rng, draw_camera(rng), CHARUCO, 9))
    preview.join()
    drawn = draw_flat(sketch_of(moment, preview.flat))
    assert drawn is not None
    assert drawn.shape == image.shape
    name, says = page_state(moment, preview.flat)["rows"][-1]
    assert (name, says[:10]) == ("lens", "by 9 views")
