"""What a camera's pictures are like: light, noise, blur. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from perchctl.check.rehearsal import Looked
from perchctl.vision import MARKERS, Pipeline, refine_lines

Grey = NDArray[np.uint8]
WHITE, BLACK = 250, 5
_CALM = 0.98  # of the differences: edges that moved are no noise
_MEAN_OF_NORMAL = 0.7979  # of |x|, standard normal


@dataclass(frozen=True)
class Light:
    """Grey levels 0..255; `white` and `black` are the shares of clipped pixels."""

    mean: float
    white: float
    black: float


@dataclass(frozen=True)
class Blur:
    """Sigma of the edges of the target's markers, px: of the sharpest and the softest side."""

    least_px: float
    most_px: float


def light_of(looked: Sequence[Looked]) -> Light | None:
    if not looked:
        return None
    image = looked[-1].frame.image[::2, ::2]
    share = 1.0 / image.size
    return Light(
        float(image.mean()),
        share * int(np.count_nonzero(image >= WHITE)),
        share * int(np.count_nonzero(image <= BLACK)),
    )


def noise_of(looked: Sequence[Looked]) -> float | None:
    """Sigma in grey levels, from what differs between neighbouring pictures at rest; None of
    fewer than two."""
    pairs = [(a.frame.image, b.frame.image) for a, b in pairwise(looked)]
    sigmas = [_noise(a, b) for a, b in pairs if a.shape == b.shape]
    return float(np.median(sigmas)) if sigmas else None


def _noise(one: Grey, other: Grey) -> float:
    difference = np.abs(one[::2, ::2].astype(np.int16) - other[::2, ::2])
    calm = np.sort(difference.ravel())[: max(1, int(_CALM * difference.size))]
    return float(calm.mean()) / _MEAN_OF_NORMAL / math.sqrt(2.0)


def blur_of(looked: Sequence[Looked], pipeline: Pipeline) -> Blur | None:
    """By the target's own edges; None where it was not seen."""
    least, most = [], []
    for each in looked:
        for name in MARKERS:
            seen = each.detections.get(name)
            if seen is None:
                continue
            rim = pipeline.detector.patterns[name].rim
            corners = seen.corners_px.reshape(1, 4, 2)
            (refined,) = refine_lines(each.frame.image, corners, [rim], pipeline.camera)
            if refined is not None:
                least.append(refined.least_blur_px)
                most.append(refined.blur_px)
                break  # the large one, where there is one
    return Blur(float(np.median(least)), float(np.median(most))) if least else None
