"""Markers in pictures so blurred that no search decodes them.

Candidates may come from anywhere, because none is taken that the marker's drawing,
laid over the picture itself, does not prove (`perchctl.vision.markers.follow.aligned`).
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.corners import RefinedCorners, side_lengths_px
from perchctl.vision.markers.follow import LEAST_SIDE_PX, Pattern, aligned, resemblance, within
from perchctl.vision.markers.search import DetectorSetup
from perchctl.vision.types import MARKERS, CameraModel, MarkerName

_BLURS_PX, _BLUR_PX = (1.5, 3.0), 2.0  # to start with
_SEARCH_PX, _SEARCH_SIDES = 10.0, 0.5  # how far a prediction may be off
_MAX_TEMPLATE_PX = 96.0
_MIN_RESEMBLANCE = 0.5
_MAX_CANDIDATES = 3
_CENTRE_GREY = 0.3
_UNIT = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float32)
_SAME = 0.15  # of a side
_SHEET = 1.3  # half sides of a marker that are surely paper


def expected_in_blur(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
) -> dict[MarkerName, RefinedCorners]:
    """The first of the markers that is near to where it is expected (4, 2) px."""
    for name in MARKERS:
        if name not in expected or not within(expected[name], image.shape):
            continue
        if float(side_lengths_px(expected[name]).mean()) < LEAST_SIDE_PX:
            continue
        start = _shifted(image, expected[name], patterns[name])
        for blur_px in _BLURS_PX:
            seen = aligned(image, start, patterns[name], camera, blur_px=blur_px)
            if seen is not None:
                return {name: seen}
    return {}


def hidden_in_blur(
    image: NDArray[np.uint8], setup: DetectorSetup, camera: CameraModel
) -> dict[MarkerName, RefinedCorners]:
    """A marker anywhere in the picture: of all its quadrilaterals, those whose grey values
    go best with a marker's cells are put to the proof."""
    corners, _, others, _ = setup.loose.detectMarkersMultiDict(image)
    quads = [np.asarray(q, dtype=np.float64).reshape(4, 2) for q in (*corners, *others)]
    for name, quad in _candidates(image, quads, setup):
        seen = aligned(image, quad, setup.patterns[name], camera, blur_px=_BLUR_PX)
        if seen is not None:
            return {name: seen}
    return {}


def _candidates(
    image: NDArray[np.uint8], quads: list[Array], setup: DetectorSetup
) -> list[tuple[MarkerName, Array]]:
    ranked: list[tuple[float, MarkerName, Array]] = []
    for quad in quads:
        if float(side_lengths_px(quad).min()) < LEAST_SIDE_PX:
            continue
        for name in MARKERS:
            likeness = resemblance(image, quad, setup.patterns[name])
            best = int(np.argmax(likeness))
            if likeness[best] > _MIN_RESEMBLANCE:
                ranked.append((float(likeness[best]), name, np.roll(quad, best, axis=0)))
    ranked.sort(key=lambda entry: -entry[0])
    chosen: list[tuple[MarkerName, Array]] = []
    for _, name, quad in ranked:
        # Several thresholds find the same quadrilateral.
        centre, side_px = quad.mean(axis=0), float(side_lengths_px(quad).mean())
        known = any(
            name == other and float(np.abs(q.mean(axis=0) - centre).max()) < _SAME * side_px
            for other, q in chosen
        )
        if not known:
            chosen.append((name, quad))
        if len(chosen) == _MAX_CANDIDATES:
            break
    return chosen


def _shifted(image: NDArray[np.uint8], corners_px: Array, pattern: Pattern) -> Array:
    """The expected corners moved to where the marker's drawing, as it would look there,
    correlates best with the picture."""
    side_px = float(side_lengths_px(corners_px).mean())
    # Large markers are found on a picture reduced to what the search needs.
    scale = min(1.0, _MAX_TEMPLATE_PX / (2.0 * side_px))
    reach = max(_SEARCH_PX, _SEARCH_SIDES * side_px)
    centre = corners_px.mean(axis=0)
    half = float(np.abs(corners_px - centre).max()) * _SHEET
    h, w = image.shape
    low = np.clip(np.floor(centre - half - reach), 0, (w - 1, h - 1)).astype(int)
    high = np.clip(np.ceil(centre + half + reach) + 1, 1, (w, h)).astype(int)
    patch = image[low[1] : high[1], low[0] : high[0]]
    if scale < 1.0:
        reduced = cv2.resize(patch, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        patch = np.asarray(reduced, np.uint8)
    local = (corners_px - low + 0.5) * scale - 0.5
    size = int(np.ceil(2.0 * half * scale))
    middle = local.mean(axis=0)
    first = np.floor(middle - 0.5 * (size - 1))
    H = cv2.getPerspectiveTransform((local - first).astype(np.float32), _UNIT)
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1)
    own = cv2.perspectiveTransform(grid.reshape(-1, 1, 2).astype(np.float64), H)
    points = np.asarray(own, dtype=np.float64).reshape(size, size, 2)
    template = _look(pattern, points, side_px * scale)
    if min(patch.shape) <= size or size < 6:
        return corners_px
    score = cv2.matchTemplate(patch.astype(np.float32), template, cv2.TM_CCOEFF_NORMED)
    _, _, _, peak = cv2.minMaxLoc(score)
    return corners_px + (np.array(peak) - first) / scale


def _look(pattern: Pattern, own: Array, side_px: float) -> NDArray[np.float32]:
    """The drawing at points (n, n, 2) of the marker's own coordinates, softened; grey
    where there may be anything."""
    n = len(pattern.drawing.cells)
    cell = np.floor((own + 1.0) * 0.5 * n).astype(np.intp)
    inside = ((cell >= 0) & (cell < n)).all(axis=2)
    cell = np.clip(cell, 0, n - 1)
    white = np.where(inside, pattern.drawing.cells[cell[..., 1], cell[..., 0]], 1.0)
    if pattern.drawing.centre is not None:
        white[np.abs(own).max(axis=2) < pattern.drawing.ratio] = _CENTRE_GREY
    white[np.abs(own).max(axis=2) > _SHEET] = 0.6
    sigma = max(1.0, 0.5 * side_px / n)
    return np.asarray(cv2.GaussianBlur(white.astype(np.float32), (0, 0), sigma))
