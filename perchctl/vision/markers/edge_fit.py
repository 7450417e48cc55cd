"""Edge fit: fit lines to a marker's four sides and intersect them.

On each of 24 profiles across a side, the edge is the centroid of the grey gradient g, at the
positions u, under a Gaussian window w around the side's line. A blur that is symmetric across the
edge does not move the centroid:

    e = sum(w g u) / sum(w g)

The window pulls the centroid towards the window's middle by a known factor, and a neighbouring edge
one cell away contributes a known share to it. The effects of the window and of the neighbouring
edge are corrected. The edge points x of a side are undistorted, a line n.x = c is fitted to them by
total least squares with Tukey's weights, and neighbouring lines are intersected:

    min over |n| = 1 of sum w_k (n.x_k - c)^2,    n_a.p = c_a,  n_b.p = c_b

Clipping, glare and a gamma curve make white areas grow: all edges move towards black by the same
number of pixels, d. The border's outer edges move inwards, and its inner edges move outwards. On
the scale of the measured outer square, an inner edge at the fraction r of its size appears d (1 +
r) too far out. The border is known to be one cell wide, so its measured width determines d, and the
lines are moved back by d.

    profiles -> edges -> lines -> shift of all edges -> corners -> gates

The result is wrong if the white of only some sides is clipped, if a cell is only two or three times
as wide as the blur and its neighbours bend the sides, or if the sheet is curled. The standard
deviation of the corners allows for partial clipping and for narrow cells. `refine_corners_by_lines`
returns None for a marker if a corner moved by more than 0.6 cells (and by more than 1.6 px), if the
edge points deviate from their line by 0.6 px, if fewer than half of the profiles are inliers, or if
the blur fills the window.

Lengths are in image pixels; lines and points are in normalised image coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, is_finite
from perchctl.vision.lens import distort_to_px, undistort_to_normalised
from perchctl.vision.markers.corners import (
    CENTRED_SQUARE,
    NEXT_CORNER,
    PREVIOUS_CORNER,
    SIDE_OUTWARD_NORMALS,
    RefinedCorners,
    apply_homography,
    homography_from_centred_square,
    homography_to_centred_square,
    side_lengths_px,
    signed_double_area_clockwise,
)
from perchctl.vision.markers.pattern import CellsAlongBorder
from perchctl.vision.types import CameraModel, EdgeShiftEstimate

# --- Grey profiles across the sides of markers ---


PROFILES_PER_SIDE = 24
GRADIENT_SAMPLES_PER_PROFILE = 16  # number of gradient samples; there is one more grey sample
Floats = NDArray[np.float32]

# Positions of the profiles along a side, from -1 to 1 between the margins at its ends.
PROFILE_POSITIONS_ALONG_SIDE: Array = np.linspace(-1.0, 1.0, PROFILES_PER_SIDE)
_SAMPLE_POSITIONS_ALONG_PROFILE_HALF_LENGTHS: Floats = np.linspace(
    -1.0, 1.0, GRADIENT_SAMPLES_PER_PROFILE + 1
).astype(np.float32)
_CENTRE_AND_DIRECTION_TO_PROFILE_SAMPLES: Floats = np.stack(
    [
        np.ones_like(_SAMPLE_POSITIONS_ALONG_PROFILE_HALF_LENGTHS),
        _SAMPLE_POSITIONS_ALONG_PROFILE_HALF_LENGTHS,
    ]
)
# Positions of the gradient samples along a profile.
GRADIENT_POSITIONS_ALONG_PROFILE_HALF_LENGTHS: Floats = (
    _SAMPLE_POSITIONS_ALONG_PROFILE_HALF_LENGTHS[1:]
    + _SAMPLE_POSITIONS_ALONG_PROFILE_HALF_LENGTHS[:-1]
) * np.float32(0.5)
# The two matrices evaluate the polynomial through the nodes, and its slope, at the profiles.
_LENS_DISTORTION_NODES_ALONG_SIDE: Array = np.array([-1.0, -0.7, 0.0, 0.7, 1.0])
_INVERSE_VANDERMONDE: Array = np.linalg.inv(
    _LENS_DISTORTION_NODES_ALONG_SIDE[:, None] ** np.arange(5.0)
)
_DISTORTED_NODES_TO_PROFILE_CENTRES: Array = (
    PROFILE_POSITIONS_ALONG_SIDE[:, None] ** np.arange(5)
) @ _INVERSE_VANDERMONDE
_DISTORTED_NODES_TO_SIDE_TANGENTS: Array = (
    np.arange(1, 5) * PROFILE_POSITIONS_ALONG_SIDE[:, None] ** np.arange(4)
) @ _INVERSE_VANDERMONDE[1:]


_ROTATE_90_LEFT = np.array(-1j)


def profile_fractions_along_side(lengths_px: Array) -> Array:
    """Return the positions (rows, n), as fractions of each side, at which profiles (short scan
    lines across the edge) cross the sides with lengths `lengths_px` (rows,). The profiles keep a
    margin from the corners, where the next side blurs the edge."""
    margin = np.minimum(np.maximum(2.5 / lengths_px, 0.04), 0.25)[:, None]
    return np.asarray(margin + (0.5 - margin) * (1.0 + PROFILE_POSITIONS_ALONG_SIDE))


def make_profile_centres_and_normals(
    side_starts_normalised: Array,
    side_ends_normalised: Array,
    fractions_along_side: Array,
    camera: CameraModel,
) -> tuple[Array, Array]:
    """Return the points, px in the distorted image, at which the profiles (short scan lines across
    the edge) cross the sides, and the sides' unit normals at these points, in the same image; both
    (rows, n, 2). Seen from the start of a side towards its end, the normals point to the left,
    which is outwards for a marker with clockwise corners.

    `side_starts_normalised`, `side_ends_normalised` (rows, 2) are the ends of the sides in
    normalised image coordinates; `fractions_along_side` (rows, n) come from
    `profile_fractions_along_side`. The image of a side through the lens is a smooth curve, so it is
    computed at five points and interpolated."""
    first, last = fractions_along_side[:, :1], fractions_along_side[:, -1:]
    at = (0.5 * (first + last) + (0.5 * (last - first)) * _LENS_DISTORTION_NODES_ALONG_SIDE)[
        ..., None
    ]
    points = (
        side_starts_normalised[:, None]
        + at * (side_ends_normalised - side_starts_normalised)[:, None]
    )
    nodes = distort_to_px(points.reshape(-1, 2), camera).reshape(points.shape)
    origin = np.matmul(_DISTORTED_NODES_TO_PROFILE_CENTRES, nodes)
    # With complex numbers x + iy, a rotation by 90 degrees is a single multiplication.
    tangent = np.matmul(_DISTORTED_NODES_TO_SIDE_TANGENTS, nodes).view(np.complex128)
    normal = tangent * (_ROTATE_90_LEFT / np.maximum(np.abs(tangent), 1e-12))
    return origin, normal.view(np.float64)


def sample_profiles(
    image: NDArray[np.uint8],
    profile_centre_px: Array,
    profile_direction: Array,
    profile_half_length_px: Array,
) -> Floats:
    """Return the grey values (rows, n, 17) at 17 equally spaced points on each profile, a short
    scan line across an edge, interpolated bilinearly. A profile begins `profile_half_length_px`
    (rows,) before its `profile_centre_px` (rows, n, 2) and ends the same distance behind it, along
    its `profile_direction`, a unit vector (rows, n, 2), all in the given image. Outside the image,
    the border pixels are repeated.

    The image is converted to float because OpenCV 5 interpolates float images at the exact
    position. For 8-bit images, OpenCV rounds positions to 1/32 px. The rounding error would be as
    large as the intended standard deviation of the edge positions.
    """
    h, w = image.shape
    reach = float(profile_half_length_px.max()) + 2.0
    flat = profile_centre_px.reshape(-1, 2)
    (x0, y0), (x1, y1) = flat.min(axis=0).tolist(), flat.max(axis=0).tolist()
    left, top = min(max(int(x0 - reach), 0), w - 2), min(max(int(y0 - reach), 0), h - 2)
    right, bottom = min(int(x1 + reach) + 1, w), min(int(y1 + reach) + 1, h)
    right, bottom = max(right, left + 2), max(bottom, top + 2)
    patch = image[top:bottom, left:right].astype(np.float32)
    rows, n = profile_centre_px.shape[:2]
    # x, y; then for each profile: origin, direction
    lines = np.empty((2, rows, n, 2), dtype=np.float32)
    np.subtract(profile_centre_px[..., 0], left, out=lines[0, ..., 0], casting="same_kind")
    np.subtract(profile_centre_px[..., 1], top, out=lines[1, ..., 0], casting="same_kind")
    np.multiply(
        profile_direction[..., 0],
        profile_half_length_px[:, None],
        out=lines[0, ..., 1],
        casting="same_kind",
    )
    np.multiply(
        profile_direction[..., 1],
        profile_half_length_px[:, None],
        out=lines[1, ..., 1],
        casting="same_kind",
    )
    x, y = (lines.reshape(-1, 2) @ _CENTRE_AND_DIRECTION_TO_PROFILE_SAMPLES).reshape(
        2, rows, n * (GRADIENT_SAMPLES_PER_PROFILE + 1)
    )
    profile_greys = cv2.remap(patch, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(profile_greys, dtype=np.float32).reshape(
        rows, n, GRADIENT_SAMPLES_PER_PROFILE + 1
    )


# --- Lines fitted to a marker's sides, and their intersections ---


FITTED_LINE_SIGMA_LOWER_BOUND_PX = 0.015
"""Lower bound of a fitted line's standard deviation, px."""

_MIN_CELL_SIZE_TO_ACCEPT_LINE_FIT_PX = 1.0  # smaller cells blend into one grey
_MAX_EDGE_FIT_RMS_RESIDUAL_PX = 0.6
_MIN_INLIER_PROFILE_FRACTION_PER_SIDE = 0.5
# Robust weights reduce the squared residuals and the number of samples; this factor compensates.
_TUKEY_LINE_VARIANCE_CORRECTION_FACTOR = 1.7
# Size and range, in units of the blur, of the error that a neighbouring edge one cell away causes.
_NEIGHBOUR_EDGE_ERROR_SIGMA_TO_BLUR_RATIO, _NEIGHBOUR_EDGE_ERROR_DECAY_LENGTH_BLUR_SIGMAS = 0.6, 2.0
# Profiles are too short for wide edges. The error, px, grows with the cube of the blur.
_CORNER_SIGMA_PER_BLUR_SIGMA_CUBED_PER_PX2 = 0.0022
# If white is clipped, edges move by different amounts.
EXTRA_CORNER_SIGMA_IF_WHITE_CLIPPED_PX = 0.1
# White counts as clipped if more than this fraction of the profiles (or pixels) is clipped.
MIN_CLIPPED_FRACTION_TO_COUNT_WHITE_AS_CLIPPED = 0.05
# A wide edge that is off centre extends beyond its profile.
_MIN_BLUR_SIGMA_TO_COUNT_AS_WIDE_EDGE_PX, _MAX_WIDE_EDGE_CORNER_MOTION_WITHOUT_REFIT_PX = 2.2, 0.5
# Profiles reach at most 7 px to each side. An edge 6 px off the centre extended beyond its profile
# and moved by up to 0.3 px.
_MAX_CORNER_MOTION_WITHOUT_REFIT_PX = 4.0
# A larger ratio of the two variances shows that the image rows jitter.
_MIN_VERTICAL_TO_HORIZONTAL_SIDE_VARIANCE_FOR_ROW_JITTER = 2.0
# Vertical and horizontal sides can only be separated if their orientations (0 to 1) vary enough.
_MIN_SIDE_ORIENTATION_VARIANCE_FOR_ROW_JITTER = 0.05
# Contrast between the dark and the bright side of an edge.
_MIN_MEAN_EDGE_CONTRAST_TO_ACCEPT_SIDE_GREY = 6.0
_BLOOMING_EDGE_SHIFT_SIGMA_LOWER_BOUND_PX = 0.01
_MAX_INNER_EDGE_OFFSET_TO_MEASURE_BLOOMING_PX = 1.0
# With more blur, the two edges of a border merge.
_MAX_INNER_EDGE_BLUR_TO_MEASURE_BLOOMING_CELLS = 0.45
_MIN_PROFILE_WEIGHT_SUM_TO_USE_SIDE = 3.0
_BLOOMING_EDGE_SHIFT_PRIOR_SIGMA_PX = 0.15  # The shift is due to glare and gamma.
_BLOOMING_EDGE_SHIFT_PRIOR_SIGMA_IF_CLIPPED_PX = 0.4  # The shift is due to clipping.
MIN_GREY_TO_COUNT_AS_CLIPPED = 248.0
"""Grey level above which white counts as clipped."""
_ONES_TO_SUM_PROFILES: Array = np.ones(PROFILES_PER_SIDE)
_ONES_TO_SUM_PROFILES_F32: Floats = np.ones(PROFILES_PER_SIDE, dtype=np.float32)
_MEAN_OF_FOUR_WEIGHTS: Array = np.full(4, 0.25)
_ZERO_MEAN_PARABOLA_ALONG_SIDE: Array = (
    PROFILE_POSITIONS_ALONG_SIDE**2 - (PROFILE_POSITIONS_ALONG_SIDE**2).mean()
)
_MIN_SIDE_BOW_TO_COUNT_AS_SIGNIFICANT_SIGMAS = 3.0


def refine_corners_by_lines(
    image: NDArray[np.uint8],
    raw_corners_px: Array,
    cells_along_border: Sequence[CellsAlongBorder],
    camera: CameraModel,
    known_edge_shift: EdgeShiftEstimate | None = None,
) -> list[RefinedCorners | None]:
    """Fit lines to the sides of m markers with corners (m, 4, 2) px in the distorted image and
    intersect them to get refined corners. Return one result for each marker, in the same order.

    `cells_along_border` describes the cells just inside each marker's border. White grows over
    black at all edges of an image by the same distance, and the corners are corrected for it. This
    distance is `known_edge_shift` if the caller passes it and white is not clipped; otherwise, it
    is measured in the image. If the refined corners are so far from the given ones that edges may
    extend beyond the profiles on which they are located, the fit is repeated from the refined
    corners.

    The result for a marker is None if a side has too few inliers, too little contrast, too large
    residuals or too much blur, if the marker's cells are smaller than 1 px, or if a corner moved by
    more than 0.6 cells and by more than 1.6 px. All results are None if the corners of any marker
    are degenerate or outside the range of the lens model.
    """
    found = _refine_corners_by_lines_once(
        image, raw_corners_px, cells_along_border, camera, known_edge_shift
    )
    centred = raw_corners_px.copy()
    for i, each in enumerate(found):
        if each is None:
            continue
        off_px = float(np.abs(each.corners_px - raw_corners_px[i]).max())
        if off_px > (
            _MAX_WIDE_EDGE_CORNER_MOTION_WITHOUT_REFIT_PX
            if each.blurriest_side_blur_sigma_px > _MIN_BLUR_SIGMA_TO_COUNT_AS_WIDE_EDGE_PX
            else _MAX_CORNER_MOTION_WITHOUT_REFIT_PX
        ):
            centred[i] = each.corners_px
    if (centred == raw_corners_px).all():
        return found
    again = _refine_corners_by_lines_once(
        image, centred, cells_along_border, camera, known_edge_shift
    )
    return [second or first for first, second in zip(found, again, strict=True)]


def _refine_corners_by_lines_once(
    image: NDArray[np.uint8],
    raw_corners_px: Array,
    cells_along_border: Sequence[CellsAlongBorder],
    camera: CameraModel,
    known_edge_shift: EdgeShiftEstimate | None,
) -> list[RefinedCorners | None]:
    found: list[RefinedCorners | None] = [None] * len(raw_corners_px)
    markers = prepare_marker_sides(raw_corners_px, cells_along_border, camera)
    if markers is None:
        return found
    outer_edges, inner_edges = measure_edges(
        image, markers, camera, must_measure_inner_edges=known_edge_shift is None
    )
    glaring = (
        np.count_nonzero(outer_edges.profile_greys[:, :, -1] > MIN_GREY_TO_COUNT_AS_CLIPPED, axis=1)
        / PROFILES_PER_SIDE
    )
    is_white_clipped = (
        glaring.reshape(-1, 4) @ _MEAN_OF_FOUR_WEIGHTS
        > MIN_CLIPPED_FRACTION_TO_COUNT_WHITE_AS_CLIPPED
    )
    if known_edge_shift is not None and is_white_clipped.any():
        # The edge shift due to clipping changes with the light, so it is measured again.
        return _refine_corners_by_lines_once(
            image, raw_corners_px, cells_along_border, camera, None
        )
    line_nx_ny_c, rms_residual_px = _fit_lines(markers, outer_edges)
    shift = known_edge_shift
    if shift is None:
        corners = _intersect_adjacent_sides(line_nx_ny_c)
        if not is_finite(corners):
            return found
        shift = _measure_edge_shift(
            markers, outer_edges, inner_edges, line_nx_ny_c, rms_residual_px, corners
        )
    applied = shift or EdgeShiftEstimate(
        0.0, edge_shift_prior_sigma_px(float(outer_edges.profile_greys[:, :, -1].mean()))
    )
    if applied.white_growth_per_edge_px != 0.0:
        line_nx_ny_c = line_nx_ny_c.copy()
        line_nx_ny_c[:, 2] += _line_normal_outward_signs(markers, line_nx_ny_c) * (
            applied.white_growth_per_edge_px / markers.px_per_normalised_unit_per_side
        )
    corners = _intersect_adjacent_sides(line_nx_ny_c)
    if not is_finite(corners):
        return found
    corners_px = distort_to_px(corners.reshape(-1, 2), camera).reshape(raw_corners_px.shape)
    accepted = _are_markers_accepted(markers, outer_edges, rms_residual_px, corners_px)
    # The standard deviation of a line fitted to n samples is twice as large at its ends as in its
    # middle.
    independent = np.maximum(
        np.minimum(
            outer_edges.edge_point_weight.dot(_ONES_TO_SUM_PROFILES),
            markers.side_lengths_px.ravel(),
        ),
        4.0,
    )
    line_end_variances_px2 = (
        4.0
        * _TUKEY_LINE_VARIANCE_CORRECTION_FACTOR
        * rms_residual_px
        * rms_residual_px
        / independent
    ).tolist()
    blurs_px, side_normals_x = outer_edges.blur_sigma_px.tolist(), line_nx_ny_c[:, 0].tolist()
    for i, rim in enumerate(cells_along_border):
        if not accepted[i]:
            continue
        four = slice(4 * i, 4 * i + 4)
        ends, blurs = line_end_variances_px2[four], blurs_px[four]
        cell_size_px, blur_px = float(markers.mean_cell_size_per_marker_px[i]), sum(blurs) / 4.0
        found[i] = RefinedCorners(
            corners_px=corners_px[i],
            sigma_px=_corner_sigma_px(
                cell_size_px,
                blur_px,
                sum(ends) / 4.0,
                bool(is_white_clipped[i]),
                rim.printed_edge_position_sigma_cells,
            ),
            are_corners_fitted=True,
            remaining_edge_shift_sigma_px=applied.sigma_px,
            blurriest_side_blur_sigma_px=max(blurs),
            removed_edge_shift=shift,
            row_jitter_sigma_px=_row_jitter_sigma_px(side_normals_x[four], ends),
            sharpest_side_blur_sigma_px=min(blurs),
        )
    return found


def _fit_lines(markers: UnfittedMarkerSides, outer_edges: MeasuredEdges) -> tuple[Array, Array]:
    """Fit a line to the edge points of each side of m markers by weighted total least squares.
    Return the coefficients (nx, ny, c) of each line, (4m, 3), with n.x = c and |n| = 1 in
    normalised image coordinates, and the weighted RMS distance of the points from each line, px
    (4m,)."""
    w = (
        outer_edges.edge_point_weight
        / np.maximum(outer_edges.edge_point_weight.dot(_ONES_TO_SUM_PROFILES), 1e-9)[:, None]
    )
    x, y = outer_edges.edge_points_normalised[..., 0], outer_edges.edge_points_normalised[..., 1]
    cx, cy = (w * x).dot(_ONES_TO_SUM_PROFILES), (w * y).dot(_ONES_TO_SUM_PROFILES)
    dx, dy = x - cx[:, None], y - cy[:, None]
    wx = w * dx
    sxx, sxy, syy = (
        (wx * dx).dot(_ONES_TO_SUM_PROFILES),
        (wx * dy).dot(_ONES_TO_SUM_PROFILES),
        (w * dy * dy).dot(_ONES_TO_SUM_PROFILES),
    )
    direction = 0.5 * np.arctan2(2.0 * sxy, sxx - syy)
    nx, ny = -np.sin(direction), np.cos(direction)
    residual2 = nx * nx * sxx + 2.0 * nx * ny * sxy + ny * ny * syy
    line_nx_ny_c = np.empty((len(w), 3))
    line_nx_ny_c[:, 0], line_nx_ny_c[:, 1], line_nx_ny_c[:, 2] = (
        nx,
        ny,
        nx * cx + ny * cy,
    )
    return line_nx_ny_c, np.sqrt(
        np.maximum(residual2, 0.0)
    ) * markers.px_per_normalised_unit_per_side


def _intersect_adjacent_sides(line_nx_ny_c: Array) -> Array:
    """Return the corners (m, 4, 2) of m markers in normalised image coordinates. Corner i is the
    intersection of side i - 1 and side i, and NaN if these are parallel. `line_nx_ny_c` (4m, 3)
    contains nx, ny, c of each side's line n.x = c, as returned by `_fit_lines`."""
    sides = line_nx_ny_c.reshape(-1, 4, 3)
    before = sides.take(PREVIOUS_CORNER, axis=1)
    ax, ay, ac = before[..., 0], before[..., 1], before[..., 2]
    bx, by, bc = sides[..., 0], sides[..., 1], sides[..., 2]
    det = ax * by - ay * bx
    det = np.where(np.abs(det) < 1e-9, np.nan, det)
    corners = np.empty((len(sides), 4, 2))
    corners[..., 0] = (ac * by - ay * bc) / det
    corners[..., 1] = (ax * bc - ac * bx) / det
    return corners


def edge_shift_prior_sigma_px(white_grey: float) -> float:
    """Return the standard deviation, px, of the distance by which white grows over black at each
    edge of an image in which this distance has not been measured: 0.4 px if `white_grey`, the mean
    grey level of the white paper, is so high that white is clipped (above 248), otherwise 0.15
    px."""
    return (
        _BLOOMING_EDGE_SHIFT_PRIOR_SIGMA_IF_CLIPPED_PX
        if white_grey > MIN_GREY_TO_COUNT_AS_CLIPPED
        else _BLOOMING_EDGE_SHIFT_PRIOR_SIGMA_PX
    )


def _measure_edge_shift(
    markers: UnfittedMarkerSides,
    outer_edges: MeasuredEdges,
    inner_edges: MeasuredEdges | None,
    line_nx_ny_c: Array,
    rms_residual_px: Array,
    corners_normalised: Array,
) -> EdgeShiftEstimate | None:
    """Measure by how many pixels white has grown over black, from the width of the black border of
    the marker with the widest cells. `line_nx_ny_c` (4m, 3) and `rms_residual_px` (4m,) are the
    results of `_fit_lines`; `corners_normalised` (m, 4, 2) are the intersections of these lines.
    Returns None if `inner_edges`, the border's inner edges, were not measured (None). If none of
    them is usable, the result is a growth of 0 with the standard deviation of
    `edge_shift_prior_sigma_px`.

    A growth by d moves the border's outer edges inwards, and its inner edges outwards, by d. If
    positions are divided by the measured distance of the outer edges from the marker's centre, an
    inner edge whose true position is r appears at r + d (1 + r), with d on the same scale. The
    function solves this equation for d, after a correction for a curled sheet, and combines the
    result with a prior with mean 0 and this standard deviation.
    """
    if inner_edges is None:
        return None
    k, prior_px = (
        markers.index_of_marker_with_widest_cells,
        edge_shift_prior_sigma_px(float(outer_edges.profile_greys[:, :, -1].mean())),
    )
    rim, depth_px, cell_size_px = (
        markers.cells_along_border[k],
        markers.cell_width_across_side_px[k],
        float(markers.mean_cell_size_per_marker_px[k]),
    )
    r = 1.0 - 2.0 / rim.cells_per_side
    own = apply_homography(
        homography_to_centred_square(corners_normalised[k]), inner_edges.edge_points_normalised
    )
    far = np.matmul(own, SIDE_OUTWARD_NORMALS[:, :, None])[..., 0] - r
    far_px = far * (depth_px / (1.0 - r * r))[:, None]
    w = (
        inner_edges.edge_point_weight
        * (inner_edges.blur_sigma_px < _MAX_INNER_EDGE_BLUR_TO_MEASURE_BLOOMING_CELLS * depth_px)[
            :, None
        ]
    )
    w *= np.abs(far_px) < _MAX_INNER_EDGE_OFFSET_TO_MEASURE_BLOOMING_PX
    mass = w.sum(axis=1)
    some = mass > _MIN_PROFILE_WEIGHT_SUM_TO_USE_SIDE
    if not some.any():
        return EdgeShiftEstimate(0.0, prior_px)
    # If the sheet is curled, the outer edges move further than the inner ones, and the ends of a
    # side move further than its middle.
    bent_px = (
        8.0
        * r
        / (3.0 * rim.cells_per_side)
        * _measure_outward_bow_of_side_ends_px(markers, outer_edges, line_nx_ny_c, rms_residual_px)
    )
    far_px = far_px + bent_px
    share = w / np.maximum(mass, 1e-9)[:, None]
    mean = (share * far_px).sum(axis=1)
    scatter = (share * (far_px - mean[:, None]) ** 2).sum(axis=1)
    least = _BLOOMING_EDGE_SHIFT_SIGMA_LOWER_BOUND_PX**2 + bent_px**2
    information = some / (2.0 * scatter / np.maximum(mass, 1.0) + least)
    total = float(information.sum())
    shift = float(information @ mean) / total
    # If the sides disagree, the measurement gets less weight.
    chi2 = float(information @ (mean - shift) ** 2) / max(int(np.count_nonzero(some)) - 1, 1)
    variance = max(chi2, 1.0) / total
    # Errors that averaging does not reduce: the neighbours' blur and the print.
    variance += (2.0 * math.exp(-cell_size_px / 2.2)) ** 2 + (
        rim.printed_edge_position_sigma_cells * cell_size_px
    ) ** 2
    prior = prior_px**2
    return EdgeShiftEstimate(
        white_growth_per_edge_px=shift * prior / (prior + variance),
        sigma_px=(1.0 / variance + 1.0 / prior) ** -0.5,
    )


def _measure_outward_bow_of_side_ends_px(
    markers: UnfittedMarkerSides,
    outer_edges: MeasuredEdges,
    line_nx_ny_c: Array,
    rms_residual_px: Array,
) -> float:
    """Return by how many pixels the ends of the sides of the marker with the widest cells are
    further out than their middles, as on a curled sheet; negative if the middles are further out. A
    parabola is fitted to the distances of each side's edge points from its line, and the result is
    the mean over the four sides; 0 if it is not significant compared with the noise. `line_nx_ny_c`
    (4m, 3) and `rms_residual_px` (4m,) are the results of `_fit_lines`."""
    four = slice(
        4 * markers.index_of_marker_with_widest_cells,
        4 * markers.index_of_marker_with_widest_cells + 4,
    )
    away = (
        np.matmul(outer_edges.edge_points_normalised[four], line_nx_ny_c[four, :2, None])[..., 0]
        - line_nx_ny_c[four, 2:]
    )
    scale = (
        _line_normal_outward_signs(markers, line_nx_ny_c)[four]
        * markers.px_per_normalised_unit_per_side[four]
    )
    mass = np.maximum(
        outer_edges.edge_point_weight[four]
        @ (_ZERO_MEAN_PARABOLA_ALONG_SIDE * _ZERO_MEAN_PARABOLA_ALONG_SIDE),
        1e-9,
    )
    bow_px = (
        scale
        * ((outer_edges.edge_point_weight[four] * away) @ _ZERO_MEAN_PARABOLA_ALONG_SIDE)
        / mass
    )
    mean_px = float(bow_px @ _MEAN_OF_FOUR_WEIGHTS)
    noise_px = 0.25 * math.sqrt(float((rms_residual_px[four] ** 2 / mass).sum()))
    return (
        mean_px if abs(mean_px) > _MIN_SIDE_BOW_TO_COUNT_AS_SIGNIFICANT_SIGMAS * noise_px else 0.0
    )


def _line_normal_outward_signs(markers: UnfittedMarkerSides, line_nx_ny_c: Array) -> Array:
    """Return a sign (4m,) for each line: +1 if its normal, the first two columns of `line_nx_ny_c`
    (4m, 3), points out of its marker, -1 if it points into it. A line can have either sign because
    (n, c) and (-n, -c) describe the same line."""
    corners = markers.corners_normalised
    out = (corners - (_MEAN_OF_FOUR_WEIGHTS @ corners)[:, None]).reshape(-1, 2)
    return np.asarray(np.sign(line_nx_ny_c[:, 0] * out[:, 0] + line_nx_ny_c[:, 1] * out[:, 1]))


def _are_markers_accepted(
    markers: UnfittedMarkerSides,
    outer_edges: MeasuredEdges,
    rms_residual_px: Array,
    corners_px: Array,
) -> NDArray[np.bool_]:
    inliers = np.count_nonzero(outer_edges.edge_point_weight > 0.0, axis=1)
    # Contrast between two samples near the ends of each profile: dark inside, white outside.
    contrast = np.abs(outer_edges.profile_greys[:, :, -3] - outer_edges.profile_greys[:, :, 2]).dot(
        _ONES_TO_SUM_PROFILES_F32
    )
    lines = (rms_residual_px < _MAX_EDGE_FIT_RMS_RESIDUAL_PX) & (
        inliers >= _MIN_INLIER_PROFILE_FRACTION_PER_SIDE * PROFILES_PER_SIDE
    )
    lines &= (contrast > _MIN_MEAN_EDGE_CONTRAST_TO_ACCEPT_SIDE_GREY * PROFILES_PER_SIDE) & (
        outer_edges.blur_sigma_px < 0.9 * outer_edges.window_half_length_px
    )
    displacement = corners_px - markers.raw_corners_px
    moved_px = np.hypot(displacement[..., 0], displacement[..., 1]).max(axis=1)
    good = lines.reshape(-1, 4).all(axis=1) & (
        markers.mean_cell_size_per_marker_px > _MIN_CELL_SIZE_TO_ACCEPT_LINE_FIT_PX
    )
    return np.asarray(
        good & (moved_px < np.maximum(1.6, 0.6 * markers.mean_cell_size_per_marker_px))
    )


def _corner_sigma_px(
    cell_size_px: float,
    blur_sigma_px: float,
    line_end_variance_px2: float,
    is_white_clipped: bool,
    print_tolerance_cells: float,
) -> float:
    blur_sigma_px = max(blur_sigma_px, 1e-3)
    # If cells are only a few pixels wide, the blur of the inner pattern reaches the border's outer
    # edge.
    bend_px = (
        _NEIGHBOUR_EDGE_ERROR_SIGMA_TO_BLUR_RATIO
        * blur_sigma_px
        * math.exp(-cell_size_px / (_NEIGHBOUR_EDGE_ERROR_DECAY_LENGTH_BLUR_SIGMAS * blur_sigma_px))
    )
    reach_px = _CORNER_SIGMA_PER_BLUR_SIGMA_CUBED_PER_PX2 * blur_sigma_px**3
    clipped_px = EXTRA_CORNER_SIGMA_IF_WHITE_CLIPPED_PX if is_white_clipped else 0.0
    # Printed edges deviate from their nominal positions.
    print_px = print_tolerance_cells * cell_size_px
    noise_px = max(math.sqrt(line_end_variance_px2), FITTED_LINE_SIGMA_LOWER_BOUND_PX)
    return math.hypot(noise_px, bend_px, reach_px, clipped_px, print_px)


def _row_jitter_sigma_px(
    side_normals_x: Sequence[float], line_end_variances_px2: Sequence[float]
) -> float:
    """Return the standard deviation of the corners, px, due to row jitter in analogue video; 0 if
    it is not significant. Jitter displaces image rows horizontally, which moves the edge points of
    vertical sides only, so they scatter more than those of horizontal sides. The variance due to
    jitter is the slope of a line fitted to the variances of the four sides as a function of nx^2.

    `side_normals_x` contains nx, the x component of each side's unit normal: 1 or -1 for a vertical
    side, 0 for a horizontal one. `line_end_variances_px2` contains the variance of the position of
    each fitted line at its ends.
    """
    upright = [x * x for x in side_normals_x]
    mean = sum(upright) / 4.0
    aspect = sum((each - mean) ** 2 for each in upright) / 4.0
    if aspect <= _MIN_SIDE_ORIENTATION_VARIANCE_FOR_ROW_JITTER:
        return 0.0
    both = zip(line_end_variances_px2, upright, strict=True)
    slope = sum(end * (each - mean) for end, each in both) / 4.0 / aspect
    still = sum(line_end_variances_px2) / 4.0 - slope * mean
    return (
        math.sqrt(slope)
        if slope
        > (_MIN_VERTICAL_TO_HORIZONTAL_SIDE_VARIANCE_FOR_ROW_JITTER - 1.0) * max(still, 0.0)
        else 0.0
    )


# --- Measurement of the markers' sides: position of the edge on profiles across each side ---
# Rows 4 i to 4 i + 3 belong to marker i. The inner edges of one marker's border may follow as four
# more rows.


# With smaller cells, the border's inner edge is not measured.
_MIN_CELL_SIZE_TO_MEASURE_BLOOMING_PX = 6.0
_SIDE_INDICES = np.arange(4)[:, None]


@dataclass(frozen=True, eq=False)
class UnfittedMarkerSides:
    """The sides of m markers before their edges are measured. Side k runs from corner k to corner
    k + 1.

    Attributes:
        raw_corners_px: corners (m, 4, 2), px in the distorted image, before any refinement.
        cells_along_border: the cells just inside the border of each of the m markers.
        corners_normalised: the same corners (m, 4, 2) in normalised image coordinates.
        side_lengths_px: length of each side (m, 4).
        cell_width_across_side_px: width (m, 4) of the border, which is one cell wide, perpendicular
            to each side.
        mean_cell_size_per_marker_px: mean side length divided by the number of cells per side,
            (m,).
        index_of_marker_with_widest_cells: index of the marker with the widest cells.
        clockwise_sign_per_marker: +1 if the corners are in clockwise order, -1 if counterclockwise,
            (m,).
        px_per_normalised_unit_per_side: pixels per unit of normalised coordinates along each side,
            (4m,).
    """

    raw_corners_px: Array
    cells_along_border: Sequence[CellsAlongBorder]
    corners_normalised: Array
    side_lengths_px: Array
    cell_width_across_side_px: Array
    mean_cell_size_per_marker_px: Array
    index_of_marker_with_widest_cells: int
    clockwise_sign_per_marker: Array
    px_per_normalised_unit_per_side: Array


@dataclass(frozen=True, eq=False)
class MeasuredEdges:
    """Edges measured on n profiles (short scan lines) across each side. Each row of the arrays is
    one side of a marker.

    Attributes:
        profile_greys: grey values at 17 points along each profile, from its dark end to its bright
            end, (rows, n, 17).
        window_half_length_px: half length of the window in which the edge is located, (rows,).
        edge_points_normalised: position of the edge on each profile, in normalised image
            coordinates, (rows, n, 2).
        edge_point_weight: robust weight of each edge point in the line fit, 0 to 1; 0 for outliers,
            (rows, n).
        blur_sigma_px: standard deviation of the Gaussian blur of each side's edge, (rows,).
    """

    profile_greys: Floats
    window_half_length_px: Array
    edge_points_normalised: Array
    edge_point_weight: Array
    blur_sigma_px: Array


def prepare_marker_sides(
    raw_corners_px: Array, cells_along_border: Sequence[CellsAlongBorder], camera: CameraModel
) -> UnfittedMarkerSides | None:
    """Return the sides of m markers with corners (m, 4, 2) px in the distorted image.
    `cells_along_border` describes the cells just inside each marker's border. Returns None if the
    corners of any marker are degenerate (two coincide, or the area is zero), or if the lens model
    has no solution for a corner."""
    sides_px = side_lengths_px(raw_corners_px)
    cells = np.array([rim.cells_per_side for rim in cells_along_border], dtype=np.float64)
    corners = undistort_to_normalised(raw_corners_px.reshape(-1, 2), camera).reshape(
        raw_corners_px.shape
    )
    turn = np.sign(signed_double_area_clockwise(raw_corners_px))
    is_square = turn.all() and sides_px.min() > 1e-6
    if not (is_square and is_finite(corners)):
        return None
    along = corners.take(NEXT_CORNER, axis=1) - corners
    across_px = sides_px.take(PREVIOUS_CORNER, axis=1) + sides_px.take(NEXT_CORNER, axis=1)
    cell_size_px = sides_px @ _MEAN_OF_FOUR_WEIGHTS / cells
    return UnfittedMarkerSides(
        raw_corners_px=raw_corners_px,
        cells_along_border=cells_along_border,
        corners_normalised=corners,
        side_lengths_px=sides_px,
        # The inner edge is one cell further in, measured along the neighbouring sides.
        cell_width_across_side_px=0.5 * across_px / cells[:, None],
        mean_cell_size_per_marker_px=cell_size_px,
        index_of_marker_with_widest_cells=int(cell_size_px.argmax()),
        clockwise_sign_per_marker=turn,
        px_per_normalised_unit_per_side=(sides_px / np.hypot(along[..., 0], along[..., 1])).ravel(),
    )


def measure_edges(
    image: NDArray[np.uint8],
    markers: UnfittedMarkerSides,
    camera: CameraModel,
    must_measure_inner_edges: bool,
) -> tuple[MeasuredEdges, MeasuredEdges | None]:
    """Measure two sets of edges in the image, and return them separately. The first are the outer
    edges of the black borders of all m markers: 4m rows, of which rows 4 i to 4 i + 3 belong to
    marker i. The second are the inner edges of the black border of one marker, the one with the
    widest cells: 4 rows. Their distance from the outer edges shows how far white has grown over
    black.

    The inner edges are None if `must_measure_inner_edges` is False or if that marker's cells are
    not wider than 6 px (`_MIN_CELL_SIZE_TO_MEASURE_BLOOMING_PX`).
    """
    starts, lengths_px, depth_px = (
        markers.corners_normalised,
        markers.side_lengths_px,
        markers.cell_width_across_side_px,
    )
    of = np.arange(len(starts)).repeat(4)
    widest = markers.index_of_marker_with_widest_cells
    rim = markers.cells_along_border[widest]
    must_measure_inner_edges = (
        must_measure_inner_edges
        and float(markers.mean_cell_size_per_marker_px[widest])
        > _MIN_CELL_SIZE_TO_MEASURE_BLOOMING_PX
    )
    if must_measure_inner_edges:
        r = 1.0 - 2.0 / rim.cells_per_side
        inner = apply_homography(
            homography_from_centred_square(markers.corners_normalised[widest]), r * CENTRED_SQUARE
        )[None]
        starts = np.concatenate([starts, inner])
        lengths_px = np.concatenate([lengths_px, r * lengths_px[widest : widest + 1]])
        depth_px = np.concatenate([depth_px, depth_px[widest : widest + 1]])
        of = np.append(of, (widest, widest, widest, widest))
    # The normals point out of a marker with clockwise corners. A profile must start on its dark
    # side.
    sign = markers.clockwise_sign_per_marker[of]
    if must_measure_inner_edges:
        sign[-4:] *= -1.0
    s = profile_fractions_along_side(lengths_px.ravel())
    ends = starts.take(NEXT_CORNER, axis=1).reshape(-1, 2)
    origin, normal = make_profile_centres_and_normals(starts.reshape(-1, 2), ends, s, camera)
    normal *= sign[:, None, None]
    window_half_length_px, profile_half_length_px = (
        each[of]
        for each in window_and_profile_half_lengths_px(markers.mean_cell_size_per_marker_px)
    )
    profile_greys = sample_profiles(image, origin, normal, profile_half_length_px)
    around = find_neighbour_edges(s, markers.cells_along_border, rim, depth_px.ravel())
    offset_px, weight, blur_px = locate_edges(
        profile_greys, profile_half_length_px, window_half_length_px, around
    )
    points = undistort_to_normalised(
        (origin + offset_px[..., None] * normal).reshape(-1, 2), camera
    )
    points = points.reshape(-1, PROFILES_PER_SIDE, 2)
    points = points if is_finite(points) else np.nan_to_num(points)
    n = 4 * len(markers.raw_corners_px)
    outer_edges, inner_edges = (
        MeasuredEdges(
            profile_greys[part],
            window_half_length_px[part],
            points[part],
            weight[part],
            blur_px[part],
        )
        for part in (slice(0, n), slice(n, None))
    )
    return outer_edges, inner_edges if must_measure_inner_edges else None


def window_and_profile_half_lengths_px(cell_size_px: Array) -> tuple[Array, Array]:
    """Return two half lengths, px (n,), for the cell sizes `cell_size_px` (n,): 0.85 cells (1.5 to
    7 px) for the window in which an edge is located, and 1.5 cells (1.75 to 7 px) for the profile
    across the edge."""
    window_half_length_px = np.minimum(np.maximum(0.85 * cell_size_px, 1.5), 7.0)
    return window_half_length_px, np.minimum(np.maximum(1.5 * cell_size_px, 1.75), 7.0)


def find_neighbour_edges(
    fractions_along_side: Array,
    cells_along_border: Sequence[CellsAlongBorder],
    cells_along_inner_edges: CellsAlongBorder,
    neighbour_distance_px: Array,
) -> NeighbourEdges:
    """Return for each profile (scan line across an edge) whether a parallel edge, one cell further
    in or out, blurs into the measured edge, so that `locate_edges` can correct for it.
    `fractions_along_side` (rows, n) contains the positions of the profiles as fractions of a side,
    0 to 1; `neighbour_distance_px` (rows,) is the width of a cell across the edge.

    The first rows are the outer edges of the borders, four for each marker in `cells_along_border`.
    Four more rows may follow: the inner edges of one marker's border. `cells_along_inner_edges`
    describes the cells of that marker. An inner edge cannot be located on profiles at which one of
    the next two cells inside it is black.
    """
    has_inner_neighbour_f32, has_outer_neighbour_f32 = (
        np.zeros(fractions_along_side.shape, np.float32),
        np.zeros(fractions_along_side.shape, np.float32),
    )
    is_edge_locatable_per_profile = np.ones(fractions_along_side.shape, np.bool_)
    for i, rim in enumerate(cells_along_border):
        four = slice(4 * i, 4 * i + 4)
        has_inner_neighbour_f32[four] = rim.is_cell_next_to_border_white[
            _SIDE_INDICES, (fractions_along_side[four] * rim.cells_per_side).astype(np.intp)
        ]
    if len(fractions_along_side) > 4 * len(cells_along_border):
        # Position of each profile, in cells from the border's corner.
        at = 1.0 + fractions_along_side[-4:] * (cells_along_inner_edges.cells_per_side - 2)
        # Blur bends the edge if the nearest inner cell, or the cell behind it, is black.
        free = cells_along_inner_edges.are_two_cells_next_to_border_white[
            _SIDE_INDICES, (at - 0.3).astype(np.intp)
        ]
        free = (
            free
            * cells_along_inner_edges.are_two_cells_next_to_border_white[
                _SIDE_INDICES, (at + 0.3).astype(np.intp)
            ]
        )
        is_edge_locatable_per_profile[-4:] = free > 0.0
        has_outer_neighbour_f32[-4:] = 1.0
    return NeighbourEdges(
        neighbour_distance_px,
        has_inner_neighbour_f32,
        has_outer_neighbour_f32,
        is_edge_locatable_per_profile,
    )


# --- Location of black-white edges, accurate to 0.01 px, on grey profiles across them ---
# An edge is located at the windowed centroid of the gradient, first with a wide window and then
# with a narrow window centred on the side's line. Values per side have the shape (rows,), values
# per profile (rows, n).


_PROFILE_POSITIONS_ALONG_SIDE_F32 = PROFILE_POSITIONS_ALONG_SIDE.astype(np.float32)
# Variance of the window relative to the blur's variance, and its lower limit.
_NARROW_WINDOW_TO_BLUR_VARIANCE_RATIO, _MIN_NARROW_WINDOW_VARIANCE_PX2 = 2.25, 0.81
# Neighbouring edges are assumed to cause at most this fraction of the gradient.
_MAX_GRADIENT_FRACTION_FROM_NEIGHBOUR_EDGES = 0.9
# Limits of an edge's second moment; the upper one is relative to the window's variance.
_MIN_GRADIENT_SECOND_MOMENT_PX2, _MAX_GRADIENT_SECOND_MOMENT_TO_WINDOW_VARIANCE_RATIO = 0.01, 0.8
# Half length of the wide window, in units of its standard deviation.
_WIDE_WINDOW_HALF_LENGTH_TO_SIGMA_RATIO = 1.0 / 0.6
_TUKEY_CUTOFF_TO_MEDIAN_RESIDUAL_RATIO = 3.5 * 1.4826
_PROFILE_POSITION_POWERS: Floats = (PROFILE_POSITIONS_ALONG_SIDE[:, None] ** np.arange(3)).astype(
    np.float32
)
_ONES_TO_SUM_SAMPLES: Floats = np.ones(GRADIENT_SAMPLES_PER_PROFILE, dtype=np.float32)
# A profile is usable if its gradient is at least this fraction of the mean gradient in its row.
_MIN_GRADIENT_TO_MEAN_RATIO_TO_USE_PROFILE = 0.3
_MIN_TUKEY_CUTOFF_PX = 3.5 * 0.05  # A smaller cutoff would reject ordinary noise.
# If the wide window is off by less than this, one iteration with the narrow window is enough.
_MAX_LINE_MOTION_TO_SKIP_SECOND_ITERATION_PX = 0.2
_MAX_LINE_MOTION_TO_COUNT_AS_CONVERGED_PX = 0.06
_MAX_LINE_FIT_ITERATIONS = 3
_PLACEHOLDER_OFFSET_FOR_UNUSABLE_PROFILE_PX = 1e6
_PROFILES_PER_QUARTER_SIDE = PROFILES_PER_SIDE // 4
_ONES_TO_SUM_QUARTER_SIDE: Floats = np.ones(_PROFILES_PER_QUARTER_SIDE, dtype=np.float32)
# Matrix (2, n) that maps the midmeans in both halves of a side to the line through them.
_HALF_SIDE_MIDMEANS_TO_SLOPE: Floats = _PROFILE_POSITIONS_ALONG_SIDE_F32 * (
    0.5 / float(PROFILE_POSITIONS_ALONG_SIDE[PROFILES_PER_SIDE // 2 :].mean())
)
_HALF_SIDE_MIDMEANS_TO_LINE: Floats = np.stack(
    [0.5 - _HALF_SIDE_MIDMEANS_TO_SLOPE, 0.5 + _HALF_SIDE_MIDMEANS_TO_SLOPE]
)
_MEDIAN_PRESERVING_PLACEHOLDER_OFFSETS_PX: Floats = np.where(
    np.arange(PROFILES_PER_SIDE) % 2,
    _PLACEHOLDER_OFFSET_FOR_UNUSABLE_PROFILE_PX,
    -_PLACEHOLDER_OFFSET_FOR_UNUSABLE_PROFILE_PX,
).astype(np.float32)


@dataclass(frozen=True, eq=False)
class NeighbourEdges:
    """Neighbouring edges, parallel to the measured ones, that blur into them. Each row of the
    arrays is one measured edge, the outer or inner edge of the black border at one side of a
    marker, with n profiles (scan lines) across it.

    Attributes:
        neighbour_distance_px: distance of a neighbouring edge from the measured edge: the width of
            a cell across the edge, (rows,).
        has_inner_neighbour_f32, has_outer_neighbour_f32: 1.0 for each profile that has a
            neighbouring edge, of opposite contrast, one cell further in or one cell further out,
            and 0.0 for each other profile, (rows, n).
        is_edge_locatable_per_profile: False for profiles that must not be used because black cells
            next to an inner edge interrupt or bend it, (rows, n).
    """

    neighbour_distance_px: Array
    has_inner_neighbour_f32: Floats
    has_outer_neighbour_f32: Floats
    is_edge_locatable_per_profile: NDArray[np.bool_]


def locate_edges(
    profile_greys: Floats,
    profile_half_length_px: Array,
    window_half_length_px: Array,
    neighbours: NeighbourEdges,
) -> tuple[Array, Array, Array]:
    """Locate the dark-to-bright edge on each profile. Return each edge's offset from the middle of
    the profile, px (rows, n), positive towards the bright end; its weight (rows, n), 0 for
    outliers; and the standard deviation of the blur in each row, px (rows,).

    An edge is the centroid of the grey gradient under a Gaussian window, first a wide one around
    the middle of the profile and then a narrow one around the line fitted to all profiles of a row.

    Args:
        profile_greys: grey values (rows, n, 17) at 17 equally spaced points on each profile, a
            scan line across the edge, from its dark end to its bright end.
        profile_half_length_px, window_half_length_px: half lengths of the profiles and of the wide
            windows in each row, (rows,).
        neighbours: parallel edges whose blur moves the measured edges; this is corrected.
    """
    profiles = _EdgeProfiles(
        profile_greys, profile_half_length_px, window_half_length_px, neighbours
    )
    edge_offsets_px, is_usable = profiles.locate_in_wide_window()
    blur_variance_px2 = np.ones(len(window_half_length_px), dtype=np.float32)
    line = weight = _fit_line_to_half_side_midmeans(edge_offsets_px, is_usable)
    moved_px = np.inf
    for k in range(_MAX_LINE_FIT_ITERATIONS):
        if k == 1 and moved_px < _MAX_LINE_MOTION_TO_SKIP_SECOND_ITERATION_PX:
            continue
        edge_offsets_px, is_usable, blur_variance_px2 = profiles.locate_in_narrow_window(
            line, blur_variance_px2
        )
        centre, weight = _fit_robust_line(
            edge_offsets_px, is_usable, 2 if k == _MAX_LINE_FIT_ITERATIONS - 1 else 1
        )
        moved_px, line = float(np.abs(centre - line).max()), centre
        if moved_px < _MAX_LINE_MOTION_TO_COUNT_AS_CONVERGED_PX:
            break
    return (
        edge_offsets_px.astype(np.float64),
        weight.astype(np.float64),
        np.sqrt(blur_variance_px2).astype(np.float64),
    )


class _EdgeProfiles:
    """The grey gradients along all profiles (scan lines across the edges), with methods that locate
    the edge on each profile: first in a wide window, and then more accurately in a narrow one."""

    def __init__(
        self,
        profile_greys: Floats,
        profile_half_length_px: Array,
        window_half_length_px: Array,
        neighbours: NeighbourEdges,
    ) -> None:
        self.gradient = profile_greys[:, :, 1:] - profile_greys[:, :, :-1]
        # positions of the gradient samples, px (rows, steps)
        self.sample_positions_px = (
            profile_half_length_px.astype(np.float32)[:, None]
            * GRADIENT_POSITIONS_ALONG_PROFILE_HALF_LENGTHS
        )
        self.window_half_length_px, self.neighbour_distance_px = (
            window_half_length_px.astype(np.float32),
            neighbours.neighbour_distance_px.astype(np.float32),
        )
        self.max_window_variance_px2 = (
            0.25 * self.window_half_length_px * self.window_half_length_px
        )  # Maximum variance of a window.
        # Number of neighbouring edges on both sides, and the difference outside minus inside.
        self.neighbour_count, self.outer_minus_inner_neighbour_f32 = (
            neighbours.has_inner_neighbour_f32 + neighbours.has_outer_neighbour_f32,
            neighbours.has_outer_neighbour_f32 - neighbours.has_inner_neighbour_f32,
        )
        self.edge_locatable_f32 = neighbours.is_edge_locatable_per_profile.astype(np.float32)
        # The sum over a row's profiles times this factor is the minimum gradient of a usable one.
        self.min_gradient_to_row_sum_ratio = (
            _MIN_GRADIENT_TO_MEAN_RATIO_TO_USE_PROFILE
            / np.maximum(self.edge_locatable_f32.dot(_ONES_TO_SUM_PROFILES_F32), 1.0)
        )

    def locate_in_wide_window(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Locate the edge on each profile at the centroid of the grey gradient under a wide
        Gaussian window around the middle of the profile. Return the edge offsets from the middle,
        px (rows, n), positive towards the bright end, and whether each profile is usable (rows, n):
        whether its gradient is strong enough."""
        spread = (
            self.sample_positions_px
            * (_WIDE_WINDOW_HALF_LENGTH_TO_SIGMA_RATIO / self.window_half_length_px)[:, None]
        )
        spread *= spread
        window = np.empty((*self.sample_positions_px.shape, 2), dtype=np.float32)
        np.exp(-0.5 * spread, out=window[..., 0])
        np.multiply(window[..., 0], self.sample_positions_px, out=window[..., 1])
        moments: Floats = np.maximum(self.gradient, 0.0) @ window
        total = moments[..., 0] * self.edge_locatable_f32
        is_usable = (
            total
            > (total.dot(_ONES_TO_SUM_PROFILES_F32) * self.min_gradient_to_row_sum_ratio)[:, None]
        )
        return np.divide(moments[..., 1], np.where(is_usable, total, 1.0)), is_usable

    def locate_in_narrow_window(
        self, line_offsets_px: Floats, blur_variance_px2: Floats
    ) -> tuple[Floats, NDArray[np.bool_], Floats]:
        """Locate the edge on each profile again, with a narrow Gaussian window around the side's
        line at `line_offsets_px` (rows, n) from the middle of the profiles. `blur_variance_px2`
        (rows,), the previous estimate of the blur, sets the width of the window. The centroid of
        the gradient is corrected for the window and for neighbouring edges. Return the edge offsets
        from the middle, px (rows, n), positive towards the bright end, whether each profile is
        usable (rows, n), and the variance of the blur, px^2 (rows,)."""
        relative = self.sample_positions_px[:, None, :] - line_offsets_px[:, :, None]
        # The second moment under a Gaussian window w is m2 with 1/m2 = 1/blur^2 + 1/w^2.
        w2 = np.minimum(
            np.maximum(
                _NARROW_WINDOW_TO_BLUR_VARIANCE_RATIO * blur_variance_px2,
                _MIN_NARROW_WINDOW_VARIANCE_PX2,
            ),
            self.max_window_variance_px2,
        )
        squared = relative * relative
        mass = squared * (-0.5 / w2)[:, None, None]
        np.exp(mass, out=mass)
        mass *= self.gradient
        total = (mass @ _ONES_TO_SUM_SAMPLES) * self.edge_locatable_f32
        is_usable = (
            total
            > np.maximum(
                total.dot(_ONES_TO_SUM_PROFILES_F32) * self.min_gradient_to_row_sum_ratio, 1e-9
            )[:, None]
        )
        # Share of the gradient, position and spread of a neighbouring edge, as seen through the
        # window.
        wide2 = w2 + blur_variance_px2
        place = self.neighbour_distance_px * w2 / wide2
        lost = np.exp(-0.5 * self.neighbour_distance_px * self.neighbour_distance_px / wide2)
        share = np.minimum(
            self.neighbour_count * lost[:, None], _MAX_GRADIENT_FRACTION_FROM_NEIGHBOUR_EDGES
        )
        total = np.where(is_usable, total / (1.0 - share), 1.0)
        relative *= mass
        first = (
            relative @ _ONES_TO_SUM_SAMPLES
            + total * self.outer_minus_inner_neighbour_f32 * (lost * place)[:, None]
        )
        mass *= squared
        second = (
            mass @ _ONES_TO_SUM_SAMPLES
            + total * share * (place * place + w2 * blur_variance_px2 / wide2)[:, None]
        )
        moment = (second * is_usable).dot(_ONES_TO_SUM_PROFILES_F32)
        moment /= np.maximum((total * is_usable).dot(_ONES_TO_SUM_PROFILES_F32), 1e-9)
        moment = np.minimum(
            np.maximum(moment, _MIN_GRADIENT_SECOND_MOMENT_PX2),
            _MAX_GRADIENT_SECOND_MOMENT_TO_WINDOW_VARIANCE_RATIO * w2,
        )
        found2 = moment * w2 / (w2 - moment)
        # Correct for the window, which pulls the centroid towards its middle.
        centroid = first / total * (1.0 + found2 / w2)[:, None]
        limit = self.window_half_length_px[:, None]
        return line_offsets_px + np.minimum(np.maximum(centroid, -limit), limit), is_usable, found2


def _fit_line_to_half_side_midmeans(
    edge_offsets_px: Floats, is_usable: NDArray[np.bool_]
) -> Floats:
    """Fit a line to each side through the midmeans (the means of the middle 50 %) of the usable
    edge offsets, px (rows, n), in both halves of its profiles. Up to a quarter of the profiles in
    each half may be outliers. Returns the line's offset on each profile, px (rows, n)."""
    halves = np.where(
        is_usable, edge_offsets_px, _MEDIAN_PRESERVING_PLACEHOLDER_OFFSETS_PX
    ).reshape(-1, 2, 2 * _PROFILES_PER_QUARTER_SIDE)
    halves.sort(axis=2)
    first = _PROFILES_PER_QUARTER_SIDE // 2
    middle = halves[:, :, first : first + _PROFILES_PER_QUARTER_SIDE]
    # Exclude fill values before the sum: added to such large values, the edge positions would be
    # lost to rounding.
    shown = np.abs(middle) < _PLACEHOLDER_OFFSET_FOR_UNUSABLE_PROFILE_PX
    count = shown @ _ONES_TO_SUM_QUARTER_SIDE
    mean = (middle * shown) @ _ONES_TO_SUM_QUARTER_SIDE / np.maximum(count, 1.0)
    return np.asarray(np.where(count, mean, mean[:, ::-1]) @ _HALF_SIDE_MIDMEANS_TO_LINE)


def _fit_robust_line(
    edge_offsets_px: Floats, is_usable: NDArray[np.bool_], iterations: int
) -> tuple[Floats, Floats]:
    """Fit a straight line to the usable edge offsets of each side, px (rows, n), by least squares
    with Tukey's biweight: starting at the median, the line is fitted `iterations` times. Return the
    line's offset on each profile, px (rows, n), and the weight of each profile in the last fit, 0
    to 1, (rows, n)."""
    line = median_per_row(edge_offsets_px, is_usable)[:, None]
    for _ in range(iterations):
        size = np.abs(edge_offsets_px - line)
        size /= np.maximum(
            _TUKEY_CUTOFF_TO_MEDIAN_RESIDUAL_RATIO * median_per_row(size, is_usable),
            _MIN_TUKEY_CUTOFF_PX,
        )[:, None]
        size *= size
        weight = np.maximum(1.0 - size, 0.0)
        weight *= weight
        weight *= is_usable
        w = weight.dot(_PROFILE_POSITION_POWERS)
        e = (weight * edge_offsets_px).dot(_PROFILE_POSITION_POWERS)
        w0, w1 = np.maximum(w[:, 0], 1e-9), w[:, 1]
        mean, middle = e[:, 0] / w0, w1 / w0
        slope = (e[:, 1] - mean * w1) / np.maximum(w[:, 2] - middle * w1, 1e-9)
        line = slope[:, None] * (_PROFILE_POSITIONS_ALONG_SIDE_F32 - middle[:, None])
        line += mean[:, None]
    return line, weight


def median_per_row(values: Floats, is_usable: NDArray[np.bool_]) -> Floats:
    """Return approximately the median (rows,) of the usable values in each row; 0 for a row without
    usable values, or without any in an odd column.

    `values` and `is_usable` have the shape (rows, 24), with one column for each profile of a side.
    For speed, unusable values are not removed but replaced by huge ones, negative in even columns
    and positive in odd columns. If as many are negative as positive, the result is the upper
    median. Otherwise, it is a usable value near the median.
    """
    values = np.where(is_usable, values, _MEDIAN_PRESERVING_PLACEHOLDER_OFFSETS_PX)
    values.partition(PROFILES_PER_SIDE // 2, axis=1)
    found = values[:, PROFILES_PER_SIDE // 2]
    return np.asarray(
        np.where(np.abs(found) < _PLACEHOLDER_OFFSET_FOR_UNUSABLE_PROFILE_PX, found, 0.0)
    )
