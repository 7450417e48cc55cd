"""Partial-view fit: measure a marker that is partly invisible because the image border truncates
it, light glares on it, or the vehicle's own gear covers it.

Fitting four separate lines requires that all four sides are visible. This fit instead moves the
whole square at once to match the visible edges: its sides, and the inner edges of its border, which
replace a missing side. Gauss-Newton finds the increment P of the homography H and the shift d of
all edges (white over black) from the distances r_k, px, between the edges of the square and the
edges in the image:

    min sum w_k (r_k - a_k.P - s_k d)^2 + (d - d_0)^2 / sigma_d^2,    H <- H (I + P)

where a_k is the derivative of edge k with respect to P, s_k is -1 for sides and +1 for inner edges,
and d_0 is the previously measured shift (0 if there is none). The position of the invisible part
follows from the visible part. Its accuracy is given by the covariance of the corners (8, 8) px^2,
which is J N^-1 J' times the variance of an edge.

The result is wrong if the boundary of glare or of a shadow runs along a side and is mistaken for
it. The result is None if the standard deviation of a corner is above 2 % of the side, or if the
cells in view do not match the marker.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.lens import (
    distort_to_px,
    normalised_to_pinhole_px,
    undistort_px,
    undistort_to_normalised,
)
from perchctl.vision.markers.corners import (
    CENTRED_SQUARE,
    NEXT_CORNER,
    PREVIOUS_CORNER,
    SIDE_OUTWARD_NORMALS,
    RefinedCorners,
    apply_homography,
    corners_jacobian_wrt_homography_increment,
    homography_from_centred_square,
    increment_homography,
    is_inside_image,
    mean_side_px,
    side_lengths_px,
    signed_double_area_clockwise,
)
from perchctl.vision.markers.detector import DetectorInput, is_any_marker_part_hidden
from perchctl.vision.markers.edge_fit import (
    FITTED_LINE_SIGMA_LOWER_BOUND_PX,
    GRADIENT_SAMPLES_PER_PROFILE,
    PROFILES_PER_SIDE,
    Floats,
    NeighbourEdges,
    edge_shift_prior_sigma_px,
    find_neighbour_edges,
    locate_edges,
    make_profile_centres_and_normals,
    profile_fractions_along_side,
    sample_profiles,
    window_and_profile_half_lengths_px,
)
from perchctl.vision.markers.pattern import (
    MIN_CELL_MARGIN_FROM_THRESHOLD_TO_CONTRAST_RATIO,
    MIN_CONTRAST_TO_COMPARE_CELLS_GREY,
    MIN_MATCHING_CELL_FRACTION,
    MarkerPattern,
)
from perchctl.vision.types import CameraModel, EdgeShiftEstimate, MarkerName

# With smaller cells, a part of a side carries no information.
MIN_CELL_SIZE_TO_TRY_PARTIAL_FIT_PX = 4.0
_MAX_PARTIAL_FIT_ITERATIONS, _MAX_STEP_TO_COUNT_AS_CONVERGED_PX = 5, 0.05
_MAX_EDGE_FIT_RMS_RESIDUAL_PX = 0.6
_MAX_BLUR_SIGMA_TO_WINDOW_HALF_LENGTH_RATIO = 0.9
# Corners with a larger standard deviation are rejected.
_MAX_CORNER_SIGMA_TO_ACCEPT_PARTIAL_FIT_SIDES = 0.02
_BLOOMING_EDGE_SHIFT_SIGMA_LOWER_BOUND_PX = 0.01
# Robust weights make the squared residuals smaller; this factor compensates for that.
_ROBUST_WEIGHT_VARIANCE_CORRECTION_FACTOR = 1.3
_MAX_HOMOGRAPHY_INCREMENT_PER_ITERATION = 0.5
# Three times the reach of a search window; the edges cannot move a fit further from its start.
_ASSUMED_MAX_MARKER_MOTION_DURING_FIT_PX = 20.0


def fit_partly_visible_marker(
    detector_input: DetectorInput,
    name: MarkerName,
    start_corners_px: Array,
    identified_by: IdentificationEvidence,
    known_edge_shift: EdgeShiftEstimate | None = None,
) -> RefinedCorners | None:
    """Fit a marker to its visible part, starting at `start_corners_px` (4, 2) in the distorted
    image. Corners may be outside the image.

    `identified_by` is the evidence for the marker's identity: its own cells alone ("bits"), the
    predicted position ("track") or the other marker ("other_marker"). This evidence determines how
    many visible cells must match. `known_edge_shift` is how far white has grown over black, px, and
    its standard deviation, or None if it has not been measured. Returns None if the visible part
    does not determine the corners, or if its cells do not match the marker.
    """
    pattern, camera = detector_input.setup.patterns[name], detector_input.camera
    if (
        not mean_side_px(start_corners_px) / pattern.cells_along_border.cells_per_side
        >= MIN_CELL_SIZE_TO_TRY_PARTIAL_FIT_PX
    ):
        return None
    # Enough cells must be in the image wherever the fit may converge.
    in_picture = _is_point_in_image(
        _project_sample_points_px(start_corners_px, pattern, camera),
        detector_input.image.shape,
        _ASSUMED_MAX_MARKER_MOTION_DURING_FIT_PX,
    )
    if not _are_enough_cells_visible(_is_cell_visible(in_picture, pattern), pattern, identified_by):
        return None
    start = undistort_px(start_corners_px, camera)
    if not np.isfinite(start).all() or side_lengths_px(start).min() < 1.0:
        return None
    H_pinhole_marker = homography_from_centred_square(start)
    for k in range(_MAX_PARTIAL_FIT_ITERATIONS):
        visible_edges = find_visible_edges(detector_input, H_pinhole_marker, pattern)
        if visible_edges is None:
            return None
        A, N, g = _make_edge_normal_equations(
            visible_edges,
            known_edge_shift
            or EdgeShiftEstimate(0.0, edge_shift_prior_sigma_px(visible_edges.white_grey)),
        )
        step = np.asarray(np.linalg.solve(N, g), dtype=np.float64)
        p = step[:8]
        if not (np.isfinite(p).all() and np.abs(p).max() < _MAX_HOMOGRAPHY_INCREMENT_PER_ITERATION):
            return None
        H_pinhole_marker = increment_homography(H_pinhole_marker, p)
        if (
            k > 0
            and float(np.abs(p[:6]).max() * visible_edges.px_per_half_side.mean())
            < _MAX_STEP_TO_COUNT_AS_CONVERGED_PX
        ):
            break
    assert visible_edges is not None
    residual_px = visible_edges.outward_offset_from_predicted_edge_px - (step @ A).reshape(
        visible_edges.outward_offset_from_predicted_edge_px.shape
    )
    found = _make_refined_corners(H_pinhole_marker, visible_edges, residual_px, N, pattern, camera)
    if found is None or not _has_matching_visible_cells(
        detector_input, found.corners_px, pattern, identified_by
    ):
        return None
    return found


def is_fully_visible(detector_input: DetectorInput, corners: RefinedCorners) -> bool:
    """True if no part of the marker is hidden, and all its corners are inside the image and far
    enough from the image border: at least `MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX` plus the
    standard deviation, px, of the blur of the marker's blurriest side."""
    margin_px = MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX + corners.blurriest_side_blur_sigma_px
    return is_inside_image(
        corners.corners_px, detector_input.image.shape, margin_px
    ) and not is_any_marker_part_hidden(detector_input.hidden_mask, corners.corners_px)


def _make_edge_normal_equations(
    visible_edges: MeasuredVisibleEdges, edge_shift_prior: EdgeShiftEstimate
) -> tuple[Array, Array, Array]:
    """Set up one Gauss-Newton step that moves the square to the visible edges, each of which is
    measured on n profiles (short lines across it, along which the image is sampled). The nine
    unknowns x are the increment of the homography (8) and the distance by which white has grown
    over black at all edges, px. `edge_shift_prior` is the expected value of this distance and its
    standard deviation.

    Returns three arrays: the derivatives (9, edges * n) of the edges' outward offsets, px, with
    respect to x, and the normal matrix N (9, 9) and the right-hand side g (9,) of the normal
    equations N x = g. The covariance of x is the inverse of N times the variance of an edge, px^2.
    """
    u, v = (
        visible_edges.measured_points_half_sides[..., 0],
        visible_edges.measured_points_half_sides[..., 1],
    )
    nx, ny = (
        SIDE_OUTWARD_NORMALS[visible_edges.side_index].T[..., None]
        * visible_edges.px_per_half_side[:, None]
    )
    A = np.empty((9, *u.shape))
    A[0], A[1], A[2] = nx * u, nx * v, nx
    A[3], A[4], A[5] = ny * u, ny * v, ny
    across = A[0] + A[4]
    A[6], A[7] = -u * across, -v * across
    # The increment moves the edge of the model, whereas the shift moves the observed edge.
    A[8] = np.where(visible_edges.edge_distance_from_centre_half_sides < 1.0, 1.0, -1.0)[:, None]
    A = A.reshape(9, -1)
    # Profiles that are less than a pixel apart measure the same part of the edge.
    worth = np.minimum(
        1.0,
        2.0
        * visible_edges.px_per_half_side
        * visible_edges.edge_distance_from_centre_half_sides
        / PROFILES_PER_SIDE,
    )
    weighted = A * (visible_edges.profile_weight * worth[:, None]).ravel()
    N, g = (
        weighted.dot(A.T),
        weighted.dot(visible_edges.outward_offset_from_predicted_edge_px.ravel()),
    )
    # The standard deviation of an edge is not known yet, so it is assumed to be a tenth of a pixel.
    certain = (0.1 / edge_shift_prior.sigma_px) ** 2
    N[8, 8] += certain
    g[8] += certain * edge_shift_prior.white_growth_per_edge_px
    N[range(8), range(8)] += 1e-6
    return A, N, g


def _make_refined_corners(
    H_pinhole_marker: Array,
    visible_edges: MeasuredVisibleEdges,
    residual_px: Array,
    normal_matrix: Array,
    pattern: MarkerPattern,
    camera: CameraModel,
) -> RefinedCorners | None:
    """Return the result of a converged fit: the marker's corners (4, 2) px in the distorted image,
    with their covariance (8, 8) in pixels^2 of a pinhole camera. Returns None if an edge is so
    blurred that the window in which it was located does not contain it completely, if the RMS
    residual is above `_MAX_EDGE_FIT_RMS_RESIDUAL_PX`, or if the standard deviation of a corner is
    above `_MAX_CORNER_SIGMA_TO_ACCEPT_PARTIAL_FIT_SIDES` side lengths.

    Args:
        H_pinhole_marker: homography (3, 3) that projects the marker's coordinates, in half sides
            from its centre, to pixels of that pinhole camera.
        visible_edges: the measured edges.
        residual_px: distances (edges, n) of the n measured points of each edge from the fitted
            square, positive away from the square's centre.
        normal_matrix: normal matrix (9, 9) of the last step (`_make_edge_normal_equations`).
        pattern: the marker's pattern.
        camera: camera model, including lens distortion.
    """
    w = visible_edges.profile_weight
    mass = w.sum(axis=1)
    used = mass > 0.0
    if (
        not used.any()
        or (
            visible_edges.blur_sigma_to_window_half_length_ratio[used]
            > _MAX_BLUR_SIGMA_TO_WINDOW_HALF_LENGTH_RATIO
        ).any()
    ):
        return None
    if float((w * residual_px**2).sum() / w.sum()) > _MAX_EDGE_FIT_RMS_RESIDUAL_PX**2:
        return None
    mean = (w * residual_px).sum(axis=1) / np.maximum(mass, 1e-9)
    scatter = float((w * (residual_px - mean[:, None]) ** 2).sum() / w.sum())
    chi2 = float((mean**2 * mass).sum()) / max(scatter, FITTED_LINE_SIGMA_LOWER_BOUND_PX**2)
    freedom = max(2.0 * np.count_nonzero(used) - 9.0, 1.0)
    noise2 = max(
        _ROBUST_WEIGHT_VARIANCE_CORRECTION_FACTOR * scatter * max(chi2 / freedom, 1.0),
        FITTED_LINE_SIGMA_LOWER_BOUND_PX**2,
    )
    pinhole = apply_homography(H_pinhole_marker, CENTRED_SQUARE)
    corners_px = distort_to_px(
        apply_homography(np.asarray(np.linalg.inv(camera.K)), pinhole), camera
    )
    side_px = mean_side_px(pinhole)
    cell_size_px = side_px / pattern.cells_along_border.cells_per_side
    # This is the covariance of the square alone; `remaining_edge_shift_sigma_px` covers the
    # uncertainty of the shift of all edges.
    J = corners_jacobian_wrt_homography_increment(H_pinhole_marker)
    cov_px2: Array = J @ np.linalg.inv(normal_matrix[:8, :8]) @ J.T * noise2
    floor2 = (
        FITTED_LINE_SIGMA_LOWER_BOUND_PX**2
        + (pattern.cells_along_border.printed_edge_position_sigma_cells * cell_size_px) ** 2
    )
    cov_px2 = cov_px2 + np.eye(8) * (floor2 + 0.25 * np.exp(cell_size_px * (-2.0 / 1.8)))
    vaguest_px = math.sqrt(float(np.diagonal(cov_px2).max()))
    if not (
        vaguest_px < _MAX_CORNER_SIGMA_TO_ACCEPT_PARTIAL_FIT_SIDES * side_px
        and np.isfinite(corners_px).all()
    ):
        return None
    shift_sigma_px = math.sqrt(noise2 * float(np.linalg.inv(normal_matrix)[8, 8]))
    return RefinedCorners(
        corners_px=corners_px,
        sigma_px=math.sqrt(float(np.trace(cov_px2)) / 8.0),
        are_corners_fitted=True,
        remaining_edge_shift_sigma_px=min(
            max(shift_sigma_px, _BLOOMING_EDGE_SHIFT_SIGMA_LOWER_BOUND_PX),
            edge_shift_prior_sigma_px(visible_edges.white_grey),
        ),
        cov_px2=cov_px2,
    )


# --- Identify a marker from its visible cells ---


IdentificationEvidence = Literal["bits", "track", "other_marker"]
"""What identifies a marker: its cells alone ("bits"), the position predicted for it ("track"), or
the other marker."""
_MIN_VISIBLE_CELL_FRACTION_TO_IDENTIFY = 0.6
# A sample counts as glare if it is brighter than white by more than this fraction of the contrast,
# or if it is at least as bright as this grey level although white is not.
_MIN_GLARE_ABOVE_WHITE_TO_CONTRAST_RATIO, _MIN_GREY_TO_COUNT_AS_SATURATED = 0.25, 250.0
# Other codewords differ from the marker's in two bits.
_MAX_INVISIBLE_BITS_BY_EVIDENCE: dict[IdentificationEvidence, int] = {"bits": 1, "track": 4}
_MAX_LENS_MODEL_ROUND_TRIP_ERROR_PX = 0.5  # The lens model is valid where its inverse exists.


def _has_matching_visible_cells(
    detector_input: DetectorInput,
    corners_px: Array,
    pattern: MarkerPattern,
    identified_by: IdentificationEvidence,
) -> bool:
    """True if the visible cells of a marker with corners (4, 2) px in the distorted image, apart
    from those with glare, have the right colours. The number of inner cells that may be invisible
    depends on `identified_by`: one for "bits", four for "track", any number for "other_marker". For
    "other_marker", a fifth of the visible inner cells may also have the wrong colour. False if the
    contrast is too low or too few cells are visible."""
    image, hidden_mask = detector_input.image, detector_input.hidden_mask
    h, w = image.shape
    at = _project_sample_points_px(corners_px, pattern, detector_input.camera)
    near = np.rint(np.clip(np.nan_to_num(at), 0.0, (w - 1, h - 1))).astype(np.intp)
    is_sample_visible = _is_point_in_image(at, image.shape, 0.0)
    if hidden_mask is not None:
        is_sample_visible &= ~hidden_mask[near[:, 1], near[:, 0]]
    grey = image[near[:, 1], near[:, 0]].astype(np.float64)
    white_samples = pattern.is_cell_white[pattern.sample_cell_index]
    if not (
        (is_sample_visible & white_samples).any() and (is_sample_visible & ~white_samples).any()
    ):
        return False
    high = float(np.median(grey[is_sample_visible & white_samples]))
    low = float(np.median(grey[is_sample_visible & ~white_samples]))
    contrast = high - low
    if contrast < MIN_CONTRAST_TO_COMPARE_CELLS_GREY:
        return False
    is_sample_visible &= grey <= high + _MIN_GLARE_ABOVE_WHITE_TO_CONTRAST_RATIO * contrast
    if high < _MIN_GREY_TO_COUNT_AS_SATURATED - _MIN_GLARE_ABOVE_WHITE_TO_CONTRAST_RATIO * contrast:
        is_sample_visible &= grey < _MIN_GREY_TO_COUNT_AS_SATURATED
    count = np.bincount(pattern.sample_cell_index, weights=is_sample_visible)
    means = np.bincount(pattern.sample_cell_index, weights=grey * is_sample_visible) / np.maximum(
        count, 1.0
    )
    is_cell_visible = _is_cell_visible(is_sample_visible, pattern)
    share = (means - 0.5 * (high + low)) / contrast * np.where(pattern.is_cell_white, 1.0, -1.0)
    wrong = np.count_nonzero(
        is_cell_visible & (share < MIN_CELL_MARGIN_FROM_THRESHOLD_TO_CONTRAST_RATIO)
    )
    most_wrong = 0
    if identified_by == "other_marker":
        most_wrong = math.floor(
            (1.0 - MIN_MATCHING_CELL_FRACTION)
            * np.count_nonzero(is_cell_visible & pattern.is_cell_inside_border)
        )
    return bool(wrong <= most_wrong) and _are_enough_cells_visible(
        is_cell_visible, pattern, identified_by
    )


def _project_sample_points_px(
    corners_px: Array, pattern: MarkerPattern, camera: CameraModel
) -> Array:
    """Return the pattern's sample points (n, 2) for a marker with `corners_px` (4, 2), both in
    pixels of the distorted image; NaN outside the valid range of the lens model. The distortion
    matters here because a marker that fills the image does not appear as a quadrilateral."""
    rays = undistort_to_normalised(corners_px, camera)
    if not np.isfinite(rays).all():
        return np.full((len(pattern.sample_points_half_sides), 2), np.nan)
    undistorted = apply_homography(
        homography_from_centred_square(rays), pattern.sample_points_half_sides
    )
    at = distort_to_px(undistorted, camera)
    near = (
        np.abs(undistort_to_normalised(at, camera) - undistorted).max(axis=1) * camera.K[0, 0]
        < _MAX_LENS_MODEL_ROUND_TRIP_ERROR_PX
    )
    return np.where(near[:, None], at, np.nan)


def _is_point_in_image(
    points_px: Array, shape: tuple[int, ...], max_distance_outside_px: float
) -> NDArray[np.bool_]:
    """Return for each point (n, 2) whether it is in an image with the given `shape` (h, w), or
    outside it by at most `max_distance_outside_px`."""
    h, w = shape[:2]
    inside = (points_px >= -max_distance_outside_px) & (
        points_px <= (w - 1 + max_distance_outside_px, h - 1 + max_distance_outside_px)
    )
    return np.asarray(inside.all(axis=1))


def _is_cell_visible(
    is_sample_visible: NDArray[np.bool_], pattern: MarkerPattern
) -> NDArray[np.bool_]:
    """Return for each cell (cells,) whether at least half of its sample points are visible, given
    `is_sample_visible` (n,), one value for each of the pattern's sample points."""
    is_cell_visible: NDArray[np.bool_] = (
        np.bincount(pattern.sample_cell_index, weights=is_sample_visible)
        >= 0.5 * pattern.samples_per_cell
    )
    return is_cell_visible


def _are_enough_cells_visible(
    is_cell_visible: NDArray[np.bool_],
    pattern: MarkerPattern,
    identified_by: IdentificationEvidence,
) -> bool:
    most_unknown = (
        len(is_cell_visible)
        if identified_by == "other_marker"
        else _MAX_INVISIBLE_BITS_BY_EVIDENCE[identified_by]
    )
    return bool(
        np.count_nonzero(pattern.is_cell_inside_border & ~is_cell_visible) <= most_unknown
        and np.count_nonzero(is_cell_visible)
        >= _MIN_VISIBLE_CELL_FRACTION_TO_IDENTIFY * len(is_cell_visible)
    )


# --- The visible edges of a marker: its sides, and the inner edges of its border ---


MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX = 2.0
"""Closer than this to the image border, px, the blur of an edge would extend beyond the image."""
# With smaller cells, the inner and the outer edge of the border are not separate.
_MIN_CELL_TO_MEASURE_INNER_EDGE_PX = 6.0
# A clean profile deviates from black on its dark side, and from white on its bright side, by less
# than these fractions of the contrast.
(
    _MAX_CLEAN_DARK_SIDE_DEVIATION_TO_CONTRAST_RATIO,
    _MAX_CLEAN_BRIGHT_SIDE_DEVIATION_TO_CONTRAST_RATIO,
) = 0.2, 0.5
_MIN_PARTIAL_MARKER_CONTRAST_GREY = 10.0
_MIN_PROFILE_WEIGHT_SUM_TO_USE_EDGE = 3.0
_MIN_VISIBLE_EDGES_TO_FIT = 4  # A square has eight unknowns, and an edge determines two of them.
_MAX_PLAUSIBLE_PROFILE_COORDINATE_PX = 1e6
_HIDDEN_MASK_CHECK_OFFSETS_HALF_LENGTHS: Array = np.linspace(
    -1.0, 1.0, GRADIENT_SAMPLES_PER_PROFILE // 2 + 1
)[:, None]


@dataclass(frozen=True, eq=False)
class MeasuredVisibleEdges:
    """Edges of a marker (its sides and the inner edges of its border) measured in one iteration of
    the fit. Each of the m visible edges is measured on n profiles, which are short lines across it
    along which the image is sampled.

    Attributes:
        measured_points_half_sides: measured point of the edge on each profile (m, n, 2), in half
            sides from the marker's centre.
        outward_offset_from_predicted_edge_px: distance (m, n) of each measured point from the edge
            as predicted by the current homography, positive away from the marker's centre.
        profile_weight: weight (m, n) of each profile in the fit, 0 if it is not used.
        side_index: index (m,) of the side to which the edge is parallel and adjacent, 0 to 3. Side
            k runs from corner k to corner k + 1.
        edge_distance_from_centre_half_sides: distance (m,) of the edge from the marker's centre: 1
            for a side, less for an inner edge of the border.
        px_per_half_side: scale (m,) of the image across the edge.
        blur_sigma_to_window_half_length_ratio: standard deviation of the edge's blur divided by
            half the length of the window in which the edge is located, (m,).
        white_grey: grey level of white paper.
    """

    measured_points_half_sides: Array
    outward_offset_from_predicted_edge_px: Array
    profile_weight: Array
    side_index: NDArray[np.intp]
    edge_distance_from_centre_half_sides: Array
    px_per_half_side: Array
    blur_sigma_to_window_half_length_ratio: Array
    white_grey: float


def find_visible_edges(
    detector_input: DetectorInput, H_pinhole_marker: Array, pattern: MarkerPattern
) -> MeasuredVisibleEdges | None:
    """Measure the visible edges of a marker: its sides and, if its cells are large enough, the
    inner edges of its border. `H_pinhole_marker` (3, 3) projects the marker's coordinates, in half
    sides from its centre, to pixels of a pinhole camera. Returns None if fewer than
    `_MIN_VISIBLE_EDGES_TO_FIT` edges are visible, or if they have too little contrast."""
    camera, cells, corners = (
        detector_input.camera,
        pattern.cells_along_border.cells_per_side,
        apply_homography(H_pinhole_marker, CENTRED_SQUARE),
    )
    sides_px = side_lengths_px(corners)
    if not (np.isfinite(corners).all() and sides_px.min() > 1.0):
        return None
    cell_size_px = float(sides_px.mean()) / cells
    rings = (
        (1.0, 1.0 - 2.0 / cells) if cell_size_px > _MIN_CELL_TO_MEASURE_INNER_EDGE_PX else (1.0,)
    )
    at = np.repeat(rings, 4)
    side = np.arange(len(at)) % 4
    to_rays: Array = np.linalg.inv(camera.K) @ H_pinhole_marker
    starts = np.stack([apply_homography(to_rays, r * CENTRED_SQUARE) for r in rings])
    scale_px = (0.25 * (sides_px[PREVIOUS_CORNER] + sides_px[NEXT_CORNER]))[side]
    s = profile_fractions_along_side(sides_px[side] * at)
    ends = starts[:, NEXT_CORNER].reshape(-1, 2)
    origin, normal = make_profile_centres_and_normals(starts.reshape(-1, 2), ends, s, camera)
    # Far outside the image, a lens model may return any position, even NaN.
    if not (np.abs(origin) < _MAX_PLAUSIBLE_PROFILE_COORDINATE_PX).all():
        return None
    # The paper is white outside the marker and, for the inner edges, inside the border.
    turn = float(np.sign(signed_double_area_clockwise(corners[None])[0]))
    normal *= (turn * np.where(at < 1.0, -1.0, 1.0))[:, None, None]
    window_half_length_px, profile_half_length_px = window_and_profile_half_lengths_px(
        np.full(len(at), cell_size_px)
    )
    depth_px = 2.0 * scale_px / cells
    around = find_neighbour_edges(
        s, [pattern.cells_along_border], pattern.cells_along_border, depth_px
    )
    is_unobstructed = around.is_edge_locatable_per_profile & _is_profile_in_view(
        detector_input, origin, normal, window_half_length_px
    )
    kept = np.flatnonzero(
        np.count_nonzero(is_unobstructed, axis=1) >= _MIN_PROFILE_WEIGHT_SUM_TO_USE_EDGE
    )
    if len(kept) < _MIN_VISIBLE_EDGES_TO_FIT:
        return None
    side, at, scale_px = side[kept], at[kept], scale_px[kept]
    origin, normal, is_unobstructed = origin[kept], normal[kept], is_unobstructed[kept]
    window_half_length_px, profile_half_length_px = (
        window_half_length_px[kept],
        profile_half_length_px[kept],
    )
    profile_greys = sample_profiles(detector_input.image, origin, normal, profile_half_length_px)
    lit = _find_clean_edge_profiles(
        profile_greys, is_unobstructed, window_half_length_px, profile_half_length_px
    )
    if lit is None:
        return None
    good, white = lit
    around = NeighbourEdges(
        depth_px[kept],
        around.has_inner_neighbour_f32[kept],
        around.has_outer_neighbour_f32[kept],
        good,
    )
    offset_px, weight, blur_px = locate_edges(
        profile_greys, profile_half_length_px, window_half_length_px, around
    )
    weight = np.where(good, weight, 0.0)
    weight[weight.sum(axis=1) < _MIN_PROFILE_WEIGHT_SUM_TO_USE_EDGE] = 0.0
    found = undistort_to_normalised((origin + offset_px[..., None] * normal).reshape(-1, 2), camera)
    own = apply_homography(
        np.asarray(np.linalg.inv(H_pinhole_marker)), normalised_to_pinhole_px(found, camera)
    ).reshape(origin.shape)
    if not np.isfinite(own).all():
        return None
    far = np.einsum("rni,ri->rn", own, SIDE_OUTWARD_NORMALS[side]) - at[:, None]
    return MeasuredVisibleEdges(
        measured_points_half_sides=own,
        outward_offset_from_predicted_edge_px=far * scale_px[:, None],
        profile_weight=weight,
        side_index=side,
        edge_distance_from_centre_half_sides=at,
        px_per_half_side=scale_px,
        blur_sigma_to_window_half_length_ratio=blur_px / window_half_length_px,
        white_grey=white,
    )


def _is_profile_in_view(
    detector_input: DetectorInput,
    profile_centre_px: Array,
    profile_direction: Array,
    window_half_length_px: Array,
) -> NDArray[np.bool_]:
    hidden_mask, (h, w) = detector_input.hidden_mask, detector_input.image.shape
    # A profile is in the image if both of its ends are in the image.
    reach, last = (
        window_half_length_px[:, None, None] * np.abs(profile_direction),
        (
            w - 1 - MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX,
            h - 1 - MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX,
        ),
    )
    x_and_y = (profile_centre_px - reach >= MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX) & (
        profile_centre_px + reach <= last
    )
    seen = x_and_y[..., 0] & x_and_y[..., 1]
    if hidden_mask is not None and seen.any():
        at = (
            profile_centre_px[:, :, None]
            + window_half_length_px[:, None, None, None]
            * _HIDDEN_MASK_CHECK_OFFSETS_HALF_LENGTHS
            * profile_direction[:, :, None]
        )
        pixel = np.rint(np.clip(np.nan_to_num(at), 0.0, (w - 1, h - 1))).astype(np.intp)
        seen &= ~hidden_mask[pixel[..., 1], pixel[..., 0]].any(axis=2)
    return np.asarray(seen)


def _find_clean_edge_profiles(
    profile_greys: Floats,
    is_unobstructed: NDArray[np.bool_],
    window_half_length_px: Array,
    profile_half_length_px: Array,
) -> tuple[NDArray[np.bool_], float] | None:
    """Return two values: for each of the n profiles across each of the m edges, whether it shows a
    clean step from black to white (m, n), and the grey level of white paper. Returns None if the
    contrast is too low.

    Black and white are the medians, over the unobstructed profiles, of the greys at 0.6 times
    `window_half_length_px` on the dark and on the bright side of the profile's middle. A clean
    profile has nearly these greys there.

    Args:
        profile_greys: grey values (m, n, samples) along each profile, from -profile_half_length_px
            on the dark side to +profile_half_length_px on the bright side of its middle.
        is_unobstructed: whether the profile (m, n) is in view and crosses a printed edge.
        window_half_length_px: half the length (m,) of the window in which an edge is located.
        profile_half_length_px: half the length (m,) of the profiles.
    """
    # At 0.6 times the half length of the window, the blur of the edge has faded and that of a
    # neighbouring edge has not begun.
    off = max(
        1,
        round(
            0.5
            * GRADIENT_SAMPLES_PER_PROFILE
            * float((0.6 * window_half_length_px / profile_half_length_px)[0])
        ),
    )
    dark, bright = (
        profile_greys[:, :, GRADIENT_SAMPLES_PER_PROFILE // 2 - off],
        profile_greys[:, :, GRADIENT_SAMPLES_PER_PROFILE // 2 + off],
    )
    black, white = (float(np.median(each[is_unobstructed])) for each in (dark, bright))
    contrast = white - black
    if contrast < _MIN_PARTIAL_MARKER_CONTRAST_GREY:
        return None
    good = (dark < black + _MAX_CLEAN_DARK_SIDE_DEVIATION_TO_CONTRAST_RATIO * contrast) & (
        bright > white - _MAX_CLEAN_BRIGHT_SIDE_DEVIATION_TO_CONTRAST_RATIO * contrast
    )
    return is_unobstructed & good, white
