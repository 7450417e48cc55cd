"""Blurred search: find markers that are too blurred for any other search to decode.

Near an expected marker, the fit starts at the shift s at which a blurred template T of the marker's
drawing correlates best with the image I:

    max of  sum (I(x+s) - mean I) (T(x) - mean T) / (|I - mean I| |T - mean T|)

Without an expected marker, the fits start at the quadrilaterals whose cells correlate best with the
drawing. Any start is safe because the photometric fit measures the corners and verifies the marker
(`is_alignment_confirmed`, `are_other_codewords_excluded`).

The result is wrong whenever the photometric fit is wrong
(`perchctl.vision.markers.photometric_fit`). The result is empty if another codeword would look the
same, or if the marker is further from its expected position than 0.5 sides or 10 px, whichever is
larger. Corners are arrays (4, 2), px.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.corners import (
    RefinedCorners,
    apply_homography,
    homography_to_centred_square,
    is_inside_image,
    mean_side_px,
    side_lengths_px,
    signed_double_area_clockwise,
)
from perchctl.vision.markers.detector import DetectorInput, make_quad_detector
from perchctl.vision.markers.edge_fit import (
    EXTRA_CORNER_SIGMA_IF_WHITE_CLIPPED_PX,
    MIN_CLIPPED_FRACTION_TO_COUNT_WHITE_AS_CLIPPED,
    MIN_GREY_TO_COUNT_AS_CLIPPED,
)
from perchctl.vision.markers.pattern import (
    MIN_MARKER_SIDE_TO_IDENTIFY_PX,
    MarkerPattern,
    correlate_pattern_rotations,
)
from perchctl.vision.markers.photometric_fit import DrawingAlignment, align_drawing
from perchctl.vision.types import MARKERS, MarkerName

# Initial guesses of the blur: at an expected position, and at a quadrilateral found in the image.
_INITIAL_BLUR_SIGMAS_AT_EXPECTED_POSITION_PX, _INITIAL_BLUR_SIGMA_AT_FOUND_QUAD_PX = (1.5, 3.0), 2.0
# Largest error of a marker's expected position.
_MIN_TEMPLATE_SEARCH_HALF_WIDTH_PX, _TEMPLATE_SEARCH_HALF_WIDTH_SIDES = 10.0, 0.5
_MAX_TEMPLATE_SIZE_PX, _MIN_TEMPLATE_SIZE_PX = 96.0, 6
_MIN_QUAD_CORRELATION_TO_TRY_FIT = 0.5
# Minimum correlation at an expected position. Textures seldom reach this correlation; each texture
# that does costs the time of a fit.
_MIN_EXPECTED_MARKER_CORRELATION_TO_TRY_FIT = 0.45
_MAX_QUADS_TO_FIT = 3
# Whiteness, 0 to 1, of areas with unknown content: inside the marker, and beyond the paper.
_TEMPLATE_SMALL_MARKER_AREA_WHITENESS, _TEMPLATE_OFF_PAPER_WHITENESS = 0.3, 0.6
# Candidates closer to each other than this fraction of a side count as one.
_MAX_CENTRE_DISTANCE_TO_COUNT_AS_DUPLICATE_SIDES = 0.15
# Distance from the marker's centre up to which the surroundings are certainly paper.
_ASSUMED_PAPER_HALF_WIDTH_HALF_SIDES = 1.3


def find_expected_blurred_marker(
    detector_input: DetectorInput,
    expected_corners_px: Mapping[MarkerName, Array],
    blurred_fit_attempt_index: int | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """Find a blurred marker near its expected corners (4, 2) px in the image. Every expected marker
    that is completely in the image and not too small is tried, the large one first: its corners are
    shifted to where its drawing correlates best with the image, and the drawing is then fitted
    (`align_marker`). Return the corners of the first marker that the fit confirms, or an empty dict
    if there is none.

    `blurred_fit_attempt_index` is the number of earlier frames, since the markers were lost, in
    which this function was tried. To save time, the fits start with a blur of 1.5 px (standard
    deviation) if this number is even and of 3 px if it is odd. If it is None, both are tried in
    this frame.
    """
    image, patterns = detector_input.image, detector_input.setup.patterns
    blurs_px = (
        _INITIAL_BLUR_SIGMAS_AT_EXPECTED_POSITION_PX
        if blurred_fit_attempt_index is None
        else (
            _INITIAL_BLUR_SIGMAS_AT_EXPECTED_POSITION_PX[
                blurred_fit_attempt_index % len(_INITIAL_BLUR_SIGMAS_AT_EXPECTED_POSITION_PX)
            ],
        )
    )
    for name in MARKERS:
        corners = expected_corners_px.get(name)
        if corners is None or not is_inside_image(corners, image.shape):
            continue
        if mean_side_px(corners) < MIN_MARKER_SIDE_TO_IDENTIFY_PX:
            continue
        start = _align_by_correlation(image, corners, patterns[name])
        if (
            correlate_pattern_rotations(image, start, patterns[name])[0]
            < _MIN_EXPECTED_MARKER_CORRELATION_TO_TRY_FIT
        ):
            continue
        for blur_px in blurs_px:
            seen = align_marker(detector_input, name, start, initial_blur_sigma_px=blur_px)
            if seen is not None:
                return {name: seen}
    return {}


def find_blurred_marker(detector_input: DetectorInput) -> dict[MarkerName, RefinedCorners]:
    """Find a blurred marker anywhere in the image. The photometric fit is tried on the
    quadrilaterals whose cells correlate best with a marker's. Return the first marker that the fit
    confirms, or an empty dict if there is none."""
    image, setup = detector_input.image, detector_input.setup
    corners, _, others, _ = make_quad_detector(setup).detectMarkersMultiDict(image)
    quads = np.array((*corners, *others), dtype=np.float64).reshape(-1, 4, 2)
    for name, corners_px in _rank_quads(image, quads, setup.patterns):
        seen = align_marker(
            detector_input,
            name,
            corners_px,
            initial_blur_sigma_px=_INITIAL_BLUR_SIGMA_AT_FOUND_QUAD_PX,
        )
        if seen is not None:
            return {name: seen}
    return {}


def _rank_quads(
    image: NDArray[np.uint8], quads: Array, patterns: Mapping[MarkerName, MarkerPattern]
) -> list[tuple[MarkerName, Array]]:
    """Return at most `_MAX_QUADS_TO_FIT` of the quadrilaterals `quads` (m, 4, 2) px: those whose
    cells in the image have a correlation above `_MIN_QUAD_CORRELATION_TO_TRY_FIT` with a marker's,
    best first and without duplicates. Each is returned with the marker's name; its corners are in
    the same order as the marker's."""
    quads = quads[side_lengths_px(quads).min(axis=1) >= MIN_MARKER_SIDE_TO_IDENTIFY_PX]
    if len(quads) == 0:
        return []
    found: list[tuple[float, MarkerName, Array]] = []
    for name in MARKERS:
        like = np.array(
            [correlate_pattern_rotations(image, quad, patterns[name]) for quad in quads]
        )
        for i in np.flatnonzero(like.max(axis=1) > _MIN_QUAD_CORRELATION_TO_TRY_FIT):
            roll = int(like[i].argmax())
            found.append((float(like[i, roll]), name, np.roll(quads[i], roll, axis=0)))
    chosen: list[tuple[MarkerName, Array]] = []
    for _, name, corners_px in sorted(found, key=lambda each: -each[0]):
        middle, room_px = (
            corners_px.mean(axis=0),
            _MAX_CENTRE_DISTANCE_TO_COUNT_AS_DUPLICATE_SIDES * mean_side_px(corners_px),
        )
        if not any(
            name == other and float(np.abs(there.mean(axis=0) - middle).max()) < room_px
            for other, there in chosen
        ):
            chosen.append((name, corners_px))
    return chosen[:_MAX_QUADS_TO_FIT]


def _align_by_correlation(
    image: NDArray[np.uint8], corners_px: Array, pattern: MarkerPattern
) -> Array:
    """Return `corners_px` (4, 2), translated in the image to the position at which the marker's
    ideal black-and-white pattern (its drawing) correlates best with the image. The search covers 10
    px or half a side in each direction, whichever is larger. If the image leaves no room for a
    search, the corners are returned unchanged."""
    side_px = mean_side_px(corners_px)
    scale = min(1.0, _MAX_TEMPLATE_SIZE_PX / (2.0 * side_px))
    reach = max(_MIN_TEMPLATE_SEARCH_HALF_WIDTH_PX, _TEMPLATE_SEARCH_HALF_WIDTH_SIDES * side_px)
    centre = corners_px.mean(axis=0)
    half = float(np.abs(corners_px - centre).max()) * _ASSUMED_PAPER_HALF_WIDTH_HALF_SIDES
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
    if min(patch.shape) <= size or size < _MIN_TEMPLATE_SIZE_PX:
        return corners_px
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).astype(np.float64)
    template = _render_template(
        pattern,
        apply_homography(homography_to_centred_square(local - first), grid),
        side_px * scale,
    )
    score = cv2.matchTemplate(patch.astype(np.float32), template, cv2.TM_CCOEFF_NORMED)
    _, _, _, peak = cv2.minMaxLoc(score)
    return np.asarray(corners_px + (np.array(peak) - first) / scale, dtype=np.float64)


def _render_template(
    pattern: MarkerPattern, sample_points_half_sides: Array, side_px: float
) -> NDArray[np.float32]:
    """Return the whiteness (n, n), 0 to 1, of the marker's drawing at `sample_points_half_sides`
    (n, n, 2), in half sides from the marker's centre, blurred by half a cell, but at least 1 px.
    `side_px` is the marker's side in the template. Areas with unknown content, the centre of the
    large marker and the surroundings of the paper, are grey."""
    n = len(pattern.drawing.cell_whiteness)
    cell = np.floor((sample_points_half_sides + 1.0) * 0.5 * n).astype(np.intp)
    inside = ((cell >= 0) & (cell < n)).all(axis=2)
    cell = np.clip(cell, 0, n - 1)
    white = np.where(inside, pattern.drawing.cell_whiteness[cell[..., 1], cell[..., 0]], 1.0)
    if pattern.drawing.small_marker_cell_whiteness is not None:
        white[
            np.abs(sample_points_half_sides).max(axis=2) < pattern.drawing.small_to_large_side_ratio
        ] = _TEMPLATE_SMALL_MARKER_AREA_WHITENESS
    white[np.abs(sample_points_half_sides).max(axis=2) > _ASSUMED_PAPER_HALF_WIDTH_HALF_SIDES] = (
        _TEMPLATE_OFF_PAPER_WHITENESS
    )
    sigma = max(1.0, 0.5 * side_px / n)
    return np.asarray(cv2.GaussianBlur(white.astype(np.float32), (0, 0), sigma))


# --- Fit a marker's drawing, and accept the marker only if the image matches beyond doubt ---


_FITTED_CORNER_SIGMA_LOWER_BOUND_PX = 0.015
# The error of the corners grows with the blur, because no image equals its drawing with a uniform
# blur.
_EXTRA_CORNER_SIGMA_PER_BLUR_SIGMA = 0.012
_MIN_INNER_PATTERN_CORRELATION_TO_CONFIRM_MARKER, _MIN_FIT_CORRELATION_TO_CONFIRM_MARKER = 0.9, 0.9
_MIN_PATTERN_TO_BORDER_CONTRAST_RATIO, _MAX_PATTERN_TO_BORDER_CONTRAST_RATIO = 0.6, 1.6
_MAX_CELL_GREY_RESIDUAL_TO_CONTRAST_RATIO = 0.3
_MAX_WORST_CELL_OPPOSITE_COLOUR_LIKENESS, _MAX_CELL_OPPOSITE_COLOUR_LIKENESS_SIGMA = 0.4, 0.35
_MAX_CORNER_SIGMA_TO_ACCEPT_FIT_SIDES = 0.06
_ALWAYS_ALLOWED_CORNER_MOTION_FROM_START_PX = 3.0
# Limits of the mean side after the fit, divided by the mean side at its start.
_MIN_FITTED_TO_START_SIDE_RATIO, _MAX_FITTED_TO_START_SIDE_RATIO = 0.6, 1.6
_MIN_SHORTEST_TO_LONGEST_SIDE_RATIO = 0.6


def align_marker(
    detector_input: DetectorInput,
    name: MarkerName,
    start_corners_px: Array,
    max_motion_from_start_sides: float = 0.6,
    initial_blur_sigma_px: float = 1.5,
    max_corner_sigma_sides: float = _MAX_CORNER_SIGMA_TO_ACCEPT_FIT_SIDES,
    must_exclude_other_codewords: bool = True,
) -> RefinedCorners | None:
    """Fit a marker's drawing to the image and return its corners; None if the image does not match
    the drawing, or if the fit exceeds one of the limits below.

    The fit starts at `start_corners_px` (4, 2) in the distorted image with the initial blur
    `initial_blur_sigma_px` (standard deviation). The fitted corners may be at most
    `max_motion_from_start_sides` side lengths away from the start (or 3 px, if that is more), and
    their standard deviation must be below `max_corner_sigma_sides` side lengths. The shape and the
    size of the fitted square must be plausible. If `must_exclude_other_codewords` is True, the
    image must also exclude every other codeword (`are_other_codewords_excluded`); set it to False
    if the other marker already identifies this one.
    """
    side_px = mean_side_px(start_corners_px)
    if not side_px >= MIN_MARKER_SIDE_TO_IDENTIFY_PX:
        return None
    image, drawing = detector_input.image, detector_input.setup.patterns[name].drawing
    alignment = align_drawing(
        image, start_corners_px, drawing, detector_input.camera, initial_blur_sigma_px
    )
    if (
        alignment is None
        or not is_alignment_confirmed(alignment, max_corner_sigma_sides)
        or (must_exclude_other_codewords and not are_other_codewords_excluded(alignment))
        or alignment.largest_corner_motion_from_start_px
        > max(max_motion_from_start_sides * side_px, _ALWAYS_ALLOWED_CORNER_MOTION_FROM_START_PX)
    ):
        return None
    # The fitted marker must still be a square of about the same size and orientation.
    sides_px, areas = (
        side_lengths_px(alignment.corners_px),
        [alignment.corners_px, start_corners_px],
    )
    if (
        sides_px.min() < _MIN_SHORTEST_TO_LONGEST_SIDE_RATIO * sides_px.max()
        or not _MIN_FITTED_TO_START_SIDE_RATIO
        < float(sides_px.mean()) / side_px
        < _MAX_FITTED_TO_START_SIDE_RATIO
        or np.prod(signed_double_area_clockwise(np.stack(areas))) <= 0.0
    ):
        return None
    sigma_px = math.hypot(
        max(alignment.corner_sigma_px, _FITTED_CORNER_SIGMA_LOWER_BOUND_PX),
        _EXTRA_CORNER_SIGMA_PER_BLUR_SIGMA * alignment.blur_sigma_px,
    )
    (left, top), (right, bottom) = (
        alignment.corners_px.min(axis=0),
        alignment.corners_px.max(axis=0),
    )
    part = image[max(int(top), 0) : int(bottom) + 1, max(int(left), 0) : int(right) + 1]
    if (
        int(np.count_nonzero(part > MIN_GREY_TO_COUNT_AS_CLIPPED))
        > MIN_CLIPPED_FRACTION_TO_COUNT_WHITE_AS_CLIPPED * part.size
    ):
        # The illumination model does not explain clipped white.
        sigma_px = math.hypot(sigma_px, EXTRA_CORNER_SIGMA_IF_WHITE_CLIPPED_PX)
    return RefinedCorners(alignment.corners_px, sigma_px, True)


def is_alignment_confirmed(
    alignment: DrawingAlignment,
    max_corner_sigma_sides: float = _MAX_CORNER_SIGMA_TO_ACCEPT_FIT_SIDES,
) -> bool:
    """True if the image matches the fitted drawing, and if the standard deviation of the corners is
    below `max_corner_sigma_sides` side lengths. To match, the image must correlate with the drawing
    and with its inner pattern, the contrast of the pattern must be similar to that of the border,
    and no cell may deviate much from its grey in the drawing. Another marker that differs in one
    bit may still match (`are_other_codewords_excluded`).

    In tests without a marker, the correlation with the inner pattern stayed below 0.72 at any
    plausible contrast; with a marker, it was above 0.95.
    """
    return (
        alignment.inner_pattern_correlation > _MIN_INNER_PATTERN_CORRELATION_TO_CONFIRM_MARKER
        and alignment.fit_correlation > _MIN_FIT_CORRELATION_TO_CONFIRM_MARKER
        and _MIN_PATTERN_TO_BORDER_CONTRAST_RATIO
        < alignment.pattern_to_border_contrast_ratio
        < _MAX_PATTERN_TO_BORDER_CONTRAST_RATIO
        and alignment.largest_cell_grey_residual_to_contrast_ratio
        < _MAX_CELL_GREY_RESIDUAL_TO_CONTRAST_RATIO
        and alignment.corner_sigma_px < max_corner_sigma_sides * mean_side_px(alignment.corners_px)
    )


def are_other_codewords_excluded(alignment: DrawingAlignment) -> bool:
    """True if flipping any single bit of the codeword would make the drawing fit the image clearly
    worse. How much each cell looks like the opposite colour is measured from 0 (as drawn) to 1
    (flipped). This measure must be below `_MAX_WORST_CELL_OPPOSITE_COLOUR_LIKENESS`, and its
    standard deviation below `_MAX_CELL_OPPOSITE_COLOUR_LIKENESS_SIGMA`, for every cell. In tests,
    `is_alignment_confirmed` wrongly accepted 36 markers with other codewords; in each of them, the
    measure was above 0.5 for at least one cell."""
    return (
        alignment.worst_cell_opposite_colour_likeness < _MAX_WORST_CELL_OPPOSITE_COLOUR_LIKENESS
        and alignment.largest_opposite_colour_likeness_sigma
        < _MAX_CELL_OPPOSITE_COLOUR_LIKENESS_SIGMA
    )
