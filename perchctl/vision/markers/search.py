"""Search for both markers, in a window and then in the whole image, and choose among the results.

OpenCV's ArUco detector thresholds the image adaptively and decodes the quadrilaterals that it
finds. Its corners are raw: they are about 0.5 px off, mostly inwards, and the image border may be
mistaken for a side. In a window that starts at pixel o of the image and is reduced to half size,
the pixel p' corresponds to the image pixel

    p = 2 p' + 1/2 + o

The search fails if blur or the image border hides the bits. Corners are arrays (4, 2), px.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from perchctl.geometry import Array
from perchctl.vision.markers.corners import is_inside_image, mean_side_px, scale_square
from perchctl.vision.markers.detector import (
    MIRRORED_MARKER_ID,
    OPENCV_DEFAULT_THRESHOLD_WINDOW_RANGE_PX,
    QUICK_SEARCH_THRESHOLD_WINDOW_RANGE_PX,
    DetectorInput,
    ThresholdWindowRange,
    make_aruco_detector,
)
from perchctl.vision.target_selection import MarkerToOwnTargetDistanceFunction
from perchctl.vision.types import MARKERS, MarkerName

SearchMode = Literal[
    "near_expected", "expected_window", "expected_fits", "whole_sharp", "whole_blurred", "all"
]
"""Kinds of search in one frame. "expected_window" searches the window around the expected position
with OpenCV, "expected_fits" fits a blurred target at that position, and "near_expected" does both.
"whole_sharp" searches the whole image with OpenCV, which needs a sharp target, and "whole_blurred"
searches it for a blurred target. "all" combines all of these."""
_SEARCH_WINDOW_MARGIN_TO_TARGET_SIZE_RATIO = 0.25
_MIN_SEARCH_WINDOW_MARGIN_PX = 24
_MIN_SEARCH_WINDOW_SIDE_PX = 16
_MAX_SEARCH_WINDOW_TO_IMAGE_AREA_RATIO = 0.8
_MIN_MARKER_SIDE_TO_SEARCH_HALF_SIZE_IMAGE_PX = 60.0
"""Markers whose sides, px, are longer than this are searched for in an image of half the size,
which takes a quarter of the time."""
_MAX_NESTING_ERROR_TO_PAIR_MARKERS_SMALL_SIDES = 0.35


ImageWindow = tuple[slice, slice]
"""Rows and columns of a part of the image."""


@dataclass(frozen=True, eq=False)
class MarkerSearchResult:
    """Result of a search with OpenCV's detector.

    Attributes:
        corners_px: raw corners (4, 2), in the distorted image, of at most one large and one small
            marker; empty if none was found.
        is_mirrored_marker_seen: True if a marker was decoded as its mirror image, which means that
            the camera image is mirrored.
        target_count: number of complete targets found, each a large marker around a small one.
    """

    corners_px: dict[MarkerName, Array] = field(default_factory=dict)
    is_mirrored_marker_seen: bool = False
    target_count: int = 0


def search_for_markers(
    detector_input: DetectorInput,
    expected_corners_px: Mapping[MarkerName, Array],
    search_mode: SearchMode = "all",
    measure_marker_to_own_target_distance_m: MarkerToOwnTargetDistanceFunction | None = None,
) -> MarkerSearchResult:
    """Search for the target's markers with OpenCV's detector, and return at most one large and one
    small marker, chosen by `choose_markers`.

    - If no marker is expected, with the `search_mode` "whole_sharp", or if line fits are disabled,
      the whole image is searched.
    - With "near_expected" or "expected_window", only a window around the expected markers is
      searched. These two modes differ in the fits to blurred markers that follow.
    - With any other mode, the window is searched first, and then the whole image if no marker was
      found in the window.

    If the window would cover nearly the whole image or be narrower than 16 px, the whole image is
    searched instead of it (`make_search_window`).

    `measure_marker_to_own_target_distance_m` returns the horizontal distance of a marker from the
    position of this vehicle's own target, m, or infinity if it is too far away. If no marker is
    expected, the closest candidates are chosen. It is None if this position is not to be taken into
    account.
    """
    setup, image_shape = detector_input.setup, detector_input.image.shape
    whole = slice(0, image_shape[0]), slice(0, image_shape[1])

    def search_part(
        part: ImageWindow, threshold_windows_px: ThresholdWindowRange
    ) -> MarkerSearchResult:
        return _search_window(
            detector_input,
            part,
            expected_corners_px,
            threshold_windows_px,
            measure_marker_to_own_target_distance_m,
        )

    if setup.is_line_fit_enabled and expected_corners_px and search_mode != "whole_sharp":
        quickly = search_half_size_image(
            detector_input, expected_corners_px, measure_marker_to_own_target_distance_m
        )
        if quickly is not None:
            return quickly
        window = (
            make_search_window(expected_corners_px, setup.small_to_large_side_ratio, image_shape)
            or whole
        )
        found = MarkerSearchResult()
        if len(expected_corners_px) == 2:
            found = search_part(window, QUICK_SEARCH_THRESHOLD_WINDOW_RANGE_PX)
        if len(found.corners_px) < 2 and window != whole:
            found = search_part(window, OPENCV_DEFAULT_THRESHOLD_WINDOW_RANGE_PX)
        if len(found.corners_px) >= (2 if window == whole else 1) or (
            search_mode in ("near_expected", "expected_window") and window != whole
        ):
            return found
    return search_part(whole, OPENCV_DEFAULT_THRESHOLD_WINDOW_RANGE_PX)


def search_half_size_image(
    detector_input: DetectorInput,
    expected_corners_px: Mapping[MarkerName, Array],
    measure_marker_to_own_target_distance_m: MarkerToOwnTargetDistanceFunction | None = None,
) -> MarkerSearchResult | None:
    """Search the window around the expected markers in an image of half the size, which takes 1 ms.
    Return the markers found, with corners in pixels of the full-size image. The arguments are those
    of `search_for_markers`.

    Return None without a search unless both markers are expected, at least one of them completely
    in view, and the mean side of each one completely in view is longer than 60 px
    (`_MIN_MARKER_SIDE_TO_SEARCH_HALF_SIZE_IMAGE_PX`). Also return None if fewer markers are found
    than are expected to be completely in view.
    """
    image_shape = detector_input.image.shape
    in_view = [quad for quad in expected_corners_px.values() if is_inside_image(quad, image_shape)]
    if (
        len(expected_corners_px) < 2
        or not in_view
        or min(map(mean_side_px, in_view)) <= _MIN_MARKER_SIDE_TO_SEARCH_HALF_SIZE_IMAGE_PX
    ):
        return None
    window = make_search_window(
        expected_corners_px, detector_input.setup.small_to_large_side_ratio, image_shape
    )
    window = window or (slice(0, image_shape[0]), slice(0, image_shape[1]))
    found = _search_window(
        detector_input,
        window,
        expected_corners_px,
        QUICK_SEARCH_THRESHOLD_WINDOW_RANGE_PX,
        measure_marker_to_own_target_distance_m,
        must_halve_image=True,
    )
    return found if len(found.corners_px) >= len(in_view) else None


def make_search_window(
    expected_corners_px: Mapping[MarkerName, Array],
    small_to_large_side_ratio: float,
    image_shape: tuple[int, ...],
) -> ImageWindow | None:
    """Return the part of an image with the given `image_shape` (h, w) to search for the expected
    markers. If it is nearly the whole image or too narrow, return None; the caller then searches
    the whole image. The window contains the complete large marker if it may be completely in the
    image. `small_to_large_side_ratio` is the side of the small marker divided by the side of the
    large one."""
    h, w = image_shape[:2]
    if "large" in expected_corners_px:
        corners = expected_corners_px["large"]
    else:
        small = expected_corners_px["small"]
        centre = small.mean(axis=0)
        whole = centre + (small - centre) / small_to_large_side_ratio
        inside = (whole >= 0).all() and (whole < (w, h)).all()
        corners = whole if inside else centre + 1.6 * (small - centre)
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = np.maximum(
        _SEARCH_WINDOW_MARGIN_TO_TARGET_SIZE_RATIO * (high - low).max(),
        _MIN_SEARCH_WINDOW_MARGIN_PX,
    )
    left, top = np.clip(np.floor(low - margin), 0, (w, h)).astype(int)
    right, bottom = np.clip(np.ceil(high + margin), 0, (w, h)).astype(int)
    width, height = int(right - left), int(bottom - top)
    if (
        min(width, height) < _MIN_SEARCH_WINDOW_SIDE_PX
        or width * height > _MAX_SEARCH_WINDOW_TO_IMAGE_AREA_RATIO * w * h
    ):
        return None
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def _search_window(
    detector_input: DetectorInput,
    window: ImageWindow,
    expected_corners_px: Mapping[MarkerName, Array],
    threshold_windows_px: ThresholdWindowRange,
    measure_marker_to_own_target_distance_m: MarkerToOwnTargetDistanceFunction | None,
    must_halve_image: bool = False,
) -> MarkerSearchResult:
    setup, part = detector_input.setup, detector_input.image[window]
    if must_halve_image:
        part = np.asarray(cv2.resize(part, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    detector = make_aruco_detector(setup, (part.shape[1], part.shape[0]), threshold_windows_px)
    corners, ids, _, which = detector.detectMarkersMultiDict(part)
    if ids is None or len(corners) == 0:
        return MarkerSearchResult()
    rows, columns = window
    first = np.array([columns.start, rows.start], dtype=np.float64)
    candidates: dict[MarkerName, list[Array]] = {"large": [], "small": []}
    is_mirrored_marker_seen = False
    for quad, index, dictionary in zip(corners, ids.ravel(), which.ravel(), strict=True):
        if index == MIRRORED_MARKER_ID:
            is_mirrored_marker_seen = True
            continue
        name = MARKERS[int(dictionary)]
        at = np.asarray(quad, dtype=np.float64).reshape(4, 2)
        # The centre of a pixel at half size is between two pixels of the full-size image.
        candidates[name].append((2.0 * at + 0.5 if must_halve_image else at) + first)
    targets = len(_pair_markers(candidates, setup.small_to_large_side_ratio))
    chosen = choose_markers(
        candidates,
        expected_corners_px,
        setup.small_to_large_side_ratio,
        measure_marker_to_own_target_distance_m,
    )
    return MarkerSearchResult(chosen, is_mirrored_marker_seen, targets)


def choose_markers(
    candidates: Mapping[MarkerName, list[Array]],
    expected_corners_px: Mapping[MarkerName, Array],
    small_to_large_side_ratio: float,
    measure_marker_to_own_target_distance_m: MarkerToOwnTargetDistanceFunction | None = None,
) -> dict[MarkerName, Array]:
    """Choose the target's markers from the decoded `candidates`, which contain a list of corners
    (4, 2) px for each marker. Return the corners of at most one large and one small marker. The
    first of these cases that applies determines the result:

    - A small marker has the right place, size and rotation inside a large one
      (`nesting_error_to_tolerance_ratio`): this pair, unless it is far from the expected position
      and another candidate is near it. Of several pairs, the one closest to the expected position
      is chosen; if no position is expected, the one closest to this vehicle's own target; if that
      is not known either, the one that fits best.
    - A large marker is near its expected position: this one. Otherwise, a small one near its own.
    - No position is expected, and `measure_marker_to_own_target_distance_m` is not None: the large
      marker closest to this vehicle's own target, or the closest small one if there is no large
      one.
    - There is only one large marker, or no large and only one small marker: this one.
    - Otherwise, the result is empty because it is not clear which candidates belong to the target.

    `expected_corners_px` contains the expected corners (4, 2) px, if any.
    `small_to_large_side_ratio` is the side of the small marker divided by the side of the large
    one.
    """
    if measure_marker_to_own_target_distance_m is not None and not expected_corners_px:
        candidates = _sort_by_own_target_distance(
            candidates, measure_marker_to_own_target_distance_m
        )
    large, small = candidates["large"], candidates["small"]
    wholes = _pair_markers(candidates, small_to_large_side_ratio)
    near_large = _find_candidate_near_expected(
        "large", large, expected_corners_px, small_to_large_side_ratio
    )
    near_small = _find_candidate_near_expected(
        "small", small, expected_corners_px, small_to_large_side_ratio
    )
    if wholes:
        _, i, j = wholes[0]
        if expected_corners_px:
            centre = next(iter(expected_corners_px.values())).mean(axis=0)
            distances_px = [
                float(np.linalg.norm(large[i].mean(axis=0) - centre)) for _, i, _ in wholes
            ]
            _, i, j = wholes[int(np.argmin(distances_px))]
        elif measure_marker_to_own_target_distance_m is not None:
            _, i, j = min(wholes, key=lambda whole: whole[1])
        elsewhere = (
            _find_candidate_near_expected(
                "large", [large[i]], expected_corners_px, small_to_large_side_ratio
            )
            is None
        )
        if not (elsewhere and (near_large is not None or near_small is not None)):
            return {"large": large[i], "small": small[j]}
    if near_large is not None:
        return {"large": near_large}
    if near_small is not None:
        return {"small": near_small}
    if measure_marker_to_own_target_distance_m is not None and not expected_corners_px:
        large, small = large[:1], small[:1]
    # A small marker next to a complete large one does not belong to the target.
    if len(large) == 1:
        return {"large": large[0]}
    if len(small) == 1 and not large:
        return {"small": small[0]}
    return {}


def _sort_by_own_target_distance(
    candidates: Mapping[MarkerName, list[Array]],
    measure_marker_to_own_target_distance_m: MarkerToOwnTargetDistanceFunction,
) -> Mapping[MarkerName, list[Array]]:
    """Return the candidates for each marker, closest to the position of this vehicle's own target
    first, without those that are too far away to be this target. The given function returns a
    candidate's horizontal distance from this position, m, or infinity if it is too far away.

    If there is only one candidate in total, or if all are too far away, the candidates are returned
    unchanged: the pipeline rejects them later and reports the reason.
    """
    if sum(map(len, candidates.values())) < 2:
        return candidates
    kept: dict[MarkerName, list[Array]] = {}
    for name, quads in candidates.items():
        distances_m = [measure_marker_to_own_target_distance_m(name, quad) for quad in quads]
        order = np.argsort(distances_m, kind="stable").tolist()
        kept[name] = [quads[k] for k in order if math.isfinite(distances_m[k])]
    return kept if any(kept.values()) else candidates


def _pair_markers(
    candidates: Mapping[MarkerName, list[Array]], small_to_large_side_ratio: float
) -> list[tuple[float, int, int]]:
    """Return the pairs of a large and a small marker in `candidates` that form a target, best
    first, at most one for each large marker. Each pair consists of the distance of the small marker
    from its expected place inside the large one, as a fraction of the allowed distance, 0 to 1
    (`nesting_error_to_tolerance_ratio`), the index of the large marker in its list, and the index
    of the small marker in its list. `small_to_large_side_ratio` is the side of the small marker
    divided by the side of the large one."""
    large, small = candidates["large"], candidates["small"]
    pairs = [
        (nesting_error_to_tolerance_ratio(a, b, small_to_large_side_ratio), i, j)
        for i, a in enumerate(large)
        for j, b in enumerate(small)
    ]
    best: dict[int, tuple[float, int, int]] = {}
    for pair in sorted(pairs):
        if pair[0] <= 1.0:
            best.setdefault(pair[1], pair)
    return list(best.values())


def nesting_error_to_tolerance_ratio(
    large_corners_px: Array, small_corners_px: Array, small_to_large_side_ratio: float
) -> float:
    """Return the largest distance of the small marker's corners from their expected positions
    inside the large one, divided by the allowed distance,
    `_MAX_NESTING_ERROR_TO_PAIR_MARKERS_SMALL_SIDES` sides of the small marker, but at least 2.5 px.
    The two markers form a target if the result is at most 1. `small_to_large_side_ratio` is the
    side of the small marker divided by the side of the large one."""
    mapped = scale_square(large_corners_px, small_to_large_side_ratio)
    side_px = mean_side_px(mapped)
    allowed_px = max(_MAX_NESTING_ERROR_TO_PAIR_MARKERS_SMALL_SIDES * side_px, 2.5)
    return float(np.linalg.norm(mapped - small_corners_px, axis=1).max()) / allowed_px


def _find_candidate_near_expected(
    name: MarkerName,
    quads: list[Array],
    expected_corners_px: Mapping[MarkerName, Array],
    small_to_large_side_ratio: float,
) -> Array | None:
    if not expected_corners_px or not quads:
        return None
    if name in expected_corners_px:
        guess = expected_corners_px[name]
    else:
        other = next(iter(expected_corners_px.values()))
        centre = other.mean(axis=0)
        guess = centre + (
            small_to_large_side_ratio if name == "small" else 1.0 / small_to_large_side_ratio
        ) * (other - centre)
    side_px = max(mean_side_px(guess), 1e-6)
    reach_px = max(2.0 * side_px * (1.0 if name == "small" else small_to_large_side_ratio), 40.0)
    best: Array | None = None
    for quad in quads:
        distance_px = float(np.linalg.norm(quad.mean(axis=0) - guess.mean(axis=0)))
        growth = mean_side_px(quad) / side_px
        if distance_px < reach_px and 0.6 < growth < 1.7:
            best, reach_px = quad, distance_px
    return best
