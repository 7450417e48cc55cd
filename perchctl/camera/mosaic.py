"""A colour camera's mosaic in what is delivered as a grey picture.

The sensor's pixels look through colour filters, two by two, and a raw picture, or a JPEG that was
made of one as if it were grey, has their pattern all over it. Corners measured on it are off by up
to 6 times as much, and a fifth of the far markers is not found (`benchmarks/aideck.py --mosaic`).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

LEAST_SHARE = 0.04
"""By which the four filters' mean greys differ, over their mean: two pixels of a grey sensor that
lie side by side differ by less than 1 % over a whole picture, a mosaic's by 20 % and more."""
LEAST_LEVELS = 1.5
PICTURES_IN_A_ROW = 3

_KERNEL = np.array([0.25, 0.5, 0.25], np.float32)


def has_mosaic(image: NDArray[np.uint8]) -> bool:
    """Whether the pixels (height, width) of the four places of a two by two pattern differ."""
    means = [float(image[row::2, column::2].mean()) for row in (0, 1) for column in (0, 1)]
    return max(means) - min(means) > max(LEAST_SHARE * sum(means) / 4.0, LEAST_LEVELS)


def without_mosaic(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey of each pixel with its neighbours, a quarter red, a half green, a quarter blue.

    The weights 1 2 1 along rows and columns cancel whatever repeats every two pixels, so it holds
    for each order of the filters, and for a picture that was flipped or is a JPEG; OpenCV's own
    conversions err by half as much again after a JPEG, and have to be told the order.
    """
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_8U, _KERNEL, _KERNEL), np.uint8)


class MosaicFilter:
    """Takes the mosaic out of a stream's pictures; None: where one is found, and from then on."""

    def __init__(self, colour: bool | None = None) -> None:
        self.colour = colour
        self._in_a_row = 0

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self.colour is None:
            self._in_a_row = self._in_a_row + 1 if has_mosaic(image) else 0
            if self._in_a_row >= PICTURES_IN_A_ROW:
                self.colour = True
        return without_mosaic(image) if self.colour or self._in_a_row else image
