"""Read a target with a plain detector: its drawing before it is printed, and small images with
blur and noise.

The smallest readable side is found by trial, which takes a second.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.profile import MarkerConfig, TargetConfig, aruco_dictionary
from perchctl.target.drawing import TargetDrawing, draw_target, marker_cells, mm_text
from perchctl.vision import MARKERS


class ArucoReader:
    """Reads a target's markers with cv2.aruco's default parameters, looking for their ids only."""

    def __init__(self, target: TargetConfig) -> None:
        dictionaries = [_single_marker_dictionary(m) for m in (target.large, target.small)]
        self._detector: Any = cv2.aruco.ArucoDetector(dictionaries, cv2.aruco.DetectorParameters())

    def read(self, image: NDArray[np.uint8]) -> dict[str, NDArray[np.float32]]:
        """The corners (4, 2) px of the markers in a grey image (TL TR BR BL)."""
        corners, ids, _, which = self._detector.detectMarkersMultiDict(image)
        if ids is None or len(corners) == 0:
            return {}
        return {
            MARKERS[int(dictionary)]: np.asarray(quad, np.float32).reshape(4, 2)
            for quad, dictionary in zip(corners, np.asarray(which).ravel(), strict=True)
        }


def _single_marker_dictionary(marker: MarkerConfig) -> Any:
    source = aruco_dictionary(marker.dictionary)
    return cv2.aruco.Dictionary(
        np.ascontiguousarray(source.bytesList[marker.id : marker.id + 1]), source.markerSize, 0
    )


# --- The smallest marker side that can be read despite blur and noise ---


FOUND_RATE = 0.9
NOISE = 5.0
"""Standard deviation of the noise, grey levels (0..255)."""
TRIALS = 24
SIDE_STEP_RATIO = 1.04
"""Ratio between successive sides that are tried."""
SIDE_RANGE_PX = (6.0, 400.0)
_READING_STREAM = 801
_PAPER, _INK, _CEILING = 225.0, 30.0, 140.0
_MIN_PICTURE_PX = 64
_PERIMETER_RATE = 0.03  # cv2.aruco's smallest perimeter, relative to the image's larger side


@cache
def smallest_side_px(
    target: TargetConfig, marker: str, blur_px: float, picture_px: int
) -> float | None:
    """The smallest side, px, at which the marker, facing the camera in any rotation, is found in a
    share `FOUND_RATE` of the images; None if even `SIDE_RANGE_PX[1]` is too small.

    Args:
        blur_px: sigma of lens, focus and link together.
        picture_px: the larger side of the camera's image.
    """
    drawing = draw_target(target)
    reader = ArucoReader(target)
    side_m = drawing.large_side_m if marker == "large" else drawing.small_side_m
    count = math.ceil(math.log(SIDE_RANGE_PX[1] / SIDE_RANGE_PX[0]) / math.log(SIDE_STEP_RATIO))

    @cache
    def rate(i: int) -> float:
        side_px = SIDE_RANGE_PX[0] * SIDE_STEP_RATIO**i
        hits = 0
        for picture in sample_pictures(drawing, side_px / side_m, side_px, blur_px):
            quad = reader.read(picture).get(marker)
            hits += quad is not None and cv2.arcLength(quad, True) >= _PERIMETER_RATE * picture_px
        return hits / TRIALS

    def found(i: int) -> bool:
        # Three adjacent sizes are averaged, because the rate rises slowly between 0.8 and 1.
        return (rate(i - 1) + rate(i) + rate(i + 1)) / 3.0 >= FOUND_RATE

    # Starting with the largest sides would be slow because the images are large, so the search
    # starts with the smallest side, takes growing steps, and then bisects.
    low, high, stride = -1, 0, 4
    while not found(high):
        low = high
        high = high + stride
        stride = min(2 * stride, 16)
        if high > count:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if found(middle) else (middle, high)
    return float(SIDE_RANGE_PX[0] * SIDE_STEP_RATIO**high)


def sample_pictures(
    drawing: TargetDrawing, px_per_m: float, side_px: float, blur_px: float
) -> Iterator[NDArray[np.uint8]]:
    """Yield `TRIALS` images of the drawing's centre, at least 3 `side_px` wide, blurred with
    sigma `blur_px`, at various rotations and offsets."""
    fine = 2 if blur_px >= 1.0 else 4
    size = max(_MIN_PICTURE_PX, math.ceil(3.0 * side_px))
    n = size * fine
    ink = drawing.ink_coverage(px_per_m * fine, n)
    sheet = drawing.sheet_coverage(px_per_m * fine, n)
    flat = (_CEILING * (1.0 - sheet) + _PAPER * (sheet - ink) + _INK * ink).astype(np.float32)
    rng = np.random.default_rng([_READING_STREAM, round(1e3 * side_px)])
    for _ in range(TRIALS):
        shift = rng.uniform(-0.5, 0.5, 2)
        turn = cv2.getRotationMatrix2D(((n - 1) / 2.0, (n - 1) / 2.0), rng.uniform(0.0, 360.0), 1.0)
        turn = np.asarray(turn, np.float64) + np.outer(shift * fine, (0.0, 0.0, 1.0))
        turned = cv2.warpAffine(flat, turn, (n, n), borderMode=cv2.BORDER_REPLICATE)
        if blur_px > 0.05:
            turned = cv2.GaussianBlur(turned, (0, 0), blur_px * fine)
        picture = cv2.resize(turned, (size, size), interpolation=cv2.INTER_AREA)
        noisy = np.asarray(picture, np.float64) + rng.normal(0.0, NOISE, picture.shape)
        yield np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


# --- Checks before the target is printed ---


MIN_DISTANCE = 3
"""Number of cells in which two patterns of the same size must differ: one more than the total
number of wrong bits that the detector corrects in both patterns."""
_READ_SIDE_PX = 480.0


def check_target(target: TargetConfig, magnet_m: float) -> None:
    """Raise InvalidValue if the target is unreadable, or a magnet `magnet_m` wide does not fit."""
    large, small = target.large, target.small
    if magnet_m > large.side_m:
        raise InvalidValue(
            f"the magnet ({mm_text(magnet_m)} mm) does not fit behind the large marker "
            f"({mm_text(large.side_m)} mm): use a smaller one (--magnet)"
        )
    diagonal = math.sqrt(2.0) * small.side_m
    if diagonal > magnet_m:
        raise InvalidValue(
            f"the small marker's diagonal ({diagonal * 1e3:.1f} mm) exceeds the magnet "
            f"({mm_text(magnet_m)} mm), so the gear could touch where there is no magnet: make "
            f"its side at most {math.floor(magnet_m * 1e4 / math.sqrt(2.0)) / 10:g} mm, or use a "
            "larger --magnet"
        )
    for kind, marker in (("large", large), ("small", small)):
        if _cells_apart(marker, marker, turns=(1, 2, 3)) == 0:
            raise InvalidValue(
                f"{kind} marker: id {marker.id} of {marker.dictionary} looks the same when "
                "rotated, so its heading is ambiguous: choose another id"
            )
    if _cells_apart(large, small) < MIN_DISTANCE:
        raise InvalidValue(
            f"id {large.id} of {large.dictionary} and id {small.id} of {small.dictionary} "
            "have nearly the same pattern, so one marker could be mistaken for the other: "
            "choose another id for one of them"
        )
    seen = ArucoReader(target).read(draw_target(target).bitmap(_READ_SIDE_PX / large.side_m))
    for name in MARKERS:
        if name not in seen:
            raise InvalidValue(
                f"the {name} marker cannot be read from this drawing: make the small one "
                "smaller, or choose an id for the large one that is white in the middle, such "
                "as 997 of DICT_4X4_1000"
            )


def _cells_apart(a: MarkerConfig, b: MarkerConfig, turns: Sequence[int] = (0, 1, 2, 3)) -> int:
    """Return the smallest number of differing cells over all quarter turns; the number of all cells
    if the sizes differ."""
    first = marker_cells(a)
    second = marker_cells(b)
    if first.shape != second.shape:
        return first.size
    return min(int((np.rot90(first, turn) != second).sum()) for turn in turns)
