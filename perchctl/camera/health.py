"""Whether a frame can be a measurement at all: frozen, snow, uniform, dark.

Pure: `assess_frame` is ``(state, frame) -> (state, verdict)``. A frame judged bad
gives no measurement; the detector need not search it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.camera.repeats import same_bytes
from perchctl.vision import Frame

Kind = Literal["ok", "repeated", "frozen", "snow", "uniform", "dark"]

VERDICT_TEXTS: dict[Kind, str] = {
    "ok": "the picture is usable",
    "repeated": "the same picture as before",
    "frozen": "the picture stands still",
    "snow": "snow: the receiver has no signal",
    "uniform": "an empty screen: the receiver has no signal, or the lens is covered",
    "dark": "the picture is dark",
}


@dataclass(frozen=True)
class HealthLimits:
    """Grey levels of 0..255.

    Attributes:
        frozen_after_s: time without a change after which repeated is frozen.
        uniform_sigma: spread below which a picture shows nothing; a blank video
            screen has below 1, the noise of a camera alone more than 2.
        dark_level: mean plus two spreads below which a picture is dark.
        snow_sigma, snow_roughness: snow has a spread above the first, and lines
            two rows apart that are as unlike as if unrelated (1 = unrelated).
        snow_grain: the same for columns two apart, lower because a receiver's
            bandwidth smooths along lines.
    """

    frozen_after_s: float = 0.4
    uniform_sigma: float = 1.5
    dark_level: float = 30.0
    snow_sigma: float = 35.0
    snow_roughness: float = 0.7
    snow_grain: float = 0.3


@dataclass(frozen=True, eq=False)
class HealthState:
    """Memory of the last picture; `HealthState()` is a fresh start."""

    picture: NDArray[np.uint8] | None = None
    changed_at_s: float = 0.0
    repeats: int = 0


@dataclass(frozen=True)
class HealthVerdict:
    """`repeats`: times in a row that this same picture came again;
    `unchanged_s`: how long ago the picture last changed."""

    kind: Kind
    repeats: int = 0
    unchanged_s: float = 0.0

    @property
    def usable(self) -> bool:
        return self.kind == "ok"

    @property
    def text(self) -> str:
        return VERDICT_TEXTS[self.kind]


def assess_frame(
    state: HealthState, frame: Frame, live: bool = True, limits: HealthLimits | None = None
) -> tuple[HealthState, HealthVerdict]:
    """Judge one frame.

    A camera's noise makes each live picture differ from the last, so equal bytes
    mean that the receiver or the stream repeats an old one; so does what the source
    has found to be one (`Frame.repeated`), which is never frozen for that alone. In
    recordings (`live` false) equal pictures are taken as they are.
    """
    limits = limits or HealthLimits()
    image = frame.image
    if live and state.picture is not None and same_bytes(state.picture, image):
        state = HealthState(state.picture, state.changed_at_s, state.repeats + 1)
        unchanged_s = frame.t_s - state.changed_at_s
        frozen = unchanged_s >= limits.frozen_after_s
        return state, HealthVerdict("frozen" if frozen else "repeated", state.repeats, unchanged_s)
    if live and frame.repeated:
        repeats = state.repeats + 1
        return HealthState(image, state.changed_at_s, repeats), HealthVerdict("repeated", repeats)
    return HealthState(image, frame.t_s, 0), HealthVerdict(content(image, limits))


def content(image: NDArray[np.uint8], limits: HealthLimits) -> Kind:
    """What the picture shows, from every eighth line (and the second after it)."""
    height = image.shape[0]
    first = image[: max(height - 2, 1) : 8]
    mean, sigma = (float(each[0, 0]) for each in cv2.meanStdDev(first))
    if mean + 2.0 * sigma < limits.dark_level:
        return "dark"
    if sigma < limits.uniform_sigma:
        return "uniform"
    if sigma > limits.snow_sigma and height > 2:
        below = image[2::8][: len(first)]
        unrelated = 2.0 * sigma**2  # mean square difference of unrelated pixels
        roughness = _mean_square(below, first) / unrelated
        grain = _mean_square(first[:, 2:], first[:, :-2]) / unrelated
        if roughness > limits.snow_roughness and grain > limits.snow_grain:
            return "snow"
    return "ok"


def _mean_square(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Of the pixels' differences."""
    return float(cv2.norm(one, other, cv2.NORM_L2SQR)) / one.size
