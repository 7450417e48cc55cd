"""`learn_gear`: the vehicle's own gear, learned from pictures that move."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perchctl.calibration import learn_gear
from perchctl.errors import InvalidValue
from tests.helpers.gear import SIZE_PX, Pictures, legs, turned_about


def test_what_stays_the_same_is_the_gear() -> None:
    covered = learn_gear(Pictures(turned_about()))
    inner = cv2.erode(legs().astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    outer = cv2.dilate(legs().astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    assert covered[inner].all()
    assert not covered[~outer].any()


def test_what_does_not_reach_the_edge_is_no_gear() -> None:
    spot = legs()
    spot[100:130, 200:230] = True
    assert not learn_gear(Pictures(turned_about(covered=spot)))[110:120, 210:220].any()


@pytest.mark.parametrize(
    ("pictures", "told"),
    [
        (turned_about(5), "5 pictures are too few"),
        (turned_about(contrast=2.0), "hardly change"),
        (turned_about(covered=np.zeros(SIZE_PX[::-1], np.bool_)), "covers nothing"),
        ([*turned_about(3), np.zeros((10, 10), np.uint8)], "belongs to one size"),
    ],
)
def test_pictures_that_do_not_show_it_are_refused(
    pictures: list[np.ndarray[tuple[int, int], np.dtype[np.uint8]]], told: str
) -> None:
    with pytest.raises(InvalidValue, match=told):
        learn_gear(Pictures(pictures))
