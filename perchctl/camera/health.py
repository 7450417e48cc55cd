"""Decide whether a frame can be used as a measurement, or whether it is frozen, snow, uniform, dark
or repeated."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.vision import Frame

FrameKind = Literal["ok", "repeated", "frozen", "snow", "uniform", "dark"]

VERDICT_TEXTS: dict[FrameKind, str] = {
    "ok": "the picture is usable",
    "repeated": "the same picture as before",
    "frozen": "the picture is frozen",
    "snow": "snow: the receiver has no signal",
    "uniform": "a blank picture: the receiver has no signal, or the lens is covered",
    "dark": "the picture is dark",
}


# Grey levels range from 0 to 255.
FROZEN_AFTER_S = 0.4
"""Time without a change after which a repeated image counts as frozen, s."""
UNIFORM_SIGMA = 1.5
"""Standard deviation below which an image shows nothing: a blank screen has less than 1."""
DARK_LEVEL = 30.0
"""An image is dark if its mean plus two standard deviations is below this grey level."""
SNOW_SIGMA, SNOW_ROUGHNESS, SNOW_GRAIN = 35.0, 0.7, 0.3
"""Thresholds above which an image is snow: its standard deviation; the mean square difference of
lines two rows apart, relative to that of unrelated pixels (1); and the same for columns two pixels
apart, where it is smaller because a receiver's bandwidth smooths along lines."""


class FrameHealth:
    """Assesses the frames from one source in order, remembering the last image."""

    def __init__(self) -> None:
        self._picture: NDArray[np.uint8] | None = None
        self._changed_s = 0.0

    def assess(self, frame: Frame, live: bool = True) -> FrameKind:
        """Classify the next frame; only "ok" frames are measurements.

        Noise makes each live image differ from the last one, so identical bytes mean that the
        receiver or the stream repeats an image. Frames marked `Frame.is_repeated` count as repeated
        as well, but not as frozen. In recordings (`live` is False), identical images are accepted.
        """
        before, self._picture = self._picture, frame.image
        if live and before is not None and same_bytes(before, frame.image):
            frozen = frame.t_s - self._changed_s >= FROZEN_AFTER_S
            return "frozen" if frozen else "repeated"
        if live and frame.is_repeated:
            return "repeated"
        self._changed_s = frame.t_s
        return picture_kind(frame.image)


def picture_kind(image: NDArray[np.uint8]) -> FrameKind:
    """Classify an image by its content, from a sample of its lines."""
    height = image.shape[0]
    first = image[: max(height - 2, 1) : 8]
    mean, sigma = (float(each[0, 0]) for each in cv2.meanStdDev(first))
    if mean + 2.0 * sigma < DARK_LEVEL:
        return "dark"
    if sigma < UNIFORM_SIGMA:
        return "uniform"
    if sigma > SNOW_SIGMA and height > 2:
        below = image[2::8][: len(first)]
        unrelated = 2.0 * sigma**2  # mean square difference of two unrelated pixels
        roughness = _mean_square(below, first) / unrelated
        grain = _mean_square(first[:, 2:], first[:, :-2]) / unrelated
        if roughness > SNOW_ROUGHNESS and grain > SNOW_GRAIN:
            return "snow"
    return "ok"


def _mean_square(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    return float(cv2.norm(one, other, cv2.NORM_L2SQR)) / one.size


# --- Images that a receiver repeats because no new one has arrived ---
# If a receiver gets 25 images per second but outputs 60, it repeats each image two or three times.
# A repetition is not a new measurement, and keeps the time of the first copy.


Grey = NDArray[np.uint8]


def same_bytes(one: Grey, other: Grey) -> bool:
    """True if both images are identical; stops at the first row that differs."""
    middle = len(one) // 2
    return (
        one.shape == other.shape
        and np.array_equal(one[middle], other[middle])
        and np.array_equal(one, other)
    )
