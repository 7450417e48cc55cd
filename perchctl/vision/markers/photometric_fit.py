"""Photometric fit: fit a marker's drawing to the image if its edges and bits are no longer visible.

If blur has merged the cells, or if cells are only a few pixels wide, the image still shows the
marker's whole drawing D, blurred and illuminated. Gauss-Newton finds the homography H together with
the standard deviation of the blur and the illumination, at the nodes u of a grid over the marker:

    min sum (I(lens(H u)) - [a + b.u + (c + e.u) D + f D (1 - D)])^2,    D blurred by sigma

a, b: black level and its slope; c, e: gain and its slope; f: bend of the tone curve. If the sheet
ends within the grid, the grey beyond the sheet is one more unknown. If any cell still deviates from
the drawing after the fit, the image does not show the marker.

The result is wrong if the blur is anisotropic (fast motion), if something covers a part of the
marker but leaves the cells readable, or if white is clipped. The fit itself does not notice if
another codeword looks the same after this blur;
`DrawingAlignment.worst_cell_opposite_colour_likeness` is a measure of how close another codeword
is.

The coordinates u are the marker's own (see `perchctl.vision.markers.corners`). Grey values are 0 to
255. Grids have (n, n) nodes, which are stored as rows of n * n values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.values import cached_property
from perchctl.vision.lens import distort_to_px, undistort_px
from perchctl.vision.markers.corners import (
    CENTRED_SQUARE,
    apply_homography,
    corners_jacobian_wrt_homography_increment,
    homography_from_centred_square,
    increment_homography,
)
from perchctl.vision.markers.pattern import (
    GRID_MARGIN_FOR_BLUR_NODES,
    MarkerDrawing,
    blur_node_values,
    blurred_cell_coverage,
    render_black_square,
    render_whiteness_and_off_paper_fraction,
)
from perchctl.vision.types import CameraModel

_MAX_GRID_NODES_PER_SIDE, _MIN_GRID_NODES_PER_SIDE = 44, 18
_NOMINAL_NODE_SPACING_PX = 0.8
_MAX_PHOTOMETRIC_FIT_ITERATIONS = 12
_ITERATIONS_BEFORE_CORRELATION_CHECK, _MIN_CORRELATION_TO_CONTINUE_FIT = 4, 0.7
"""Number of iterations after which the fit fails unless its correlation has reached
`_MIN_CORRELATION_TO_CONTINUE_FIT`. The correlation of a marker is above 0.9 after two
iterations."""
# After a step this small, the next one is usually a tenth of it.
_MAX_STEP_TO_COUNT_AS_CONVERGED_PX = 0.05
# After a larger motion, the lens distortion is computed again.
_MAX_MARKER_MOTION_TO_REUSE_DISTORTION_PX = 0.3
_MAX_HOMOGRAPHY_INCREMENT_PER_ITERATION = 0.5  # With a larger increment, the fit has diverged.
# Standard deviations of the change of shape since the start, in half sides: of rotations and
# scales, and of the perspective.
_ROTATION_AND_SCALE_CHANGE_PRIOR_SIGMA, _PERSPECTIVE_CHANGE_PRIOR_SIGMA = 0.2, 0.03
# Standard deviation of the bend of the tone curve, relative to the gain.
_TONE_CURVE_BEND_TO_GAIN_PRIOR_SIGMA = 0.5
_MIN_FITTED_BLUR_SIGMA_PX, _MAX_FITTED_BLUR_SIGMA_CELLS = 0.35, 1.6
# In one iteration, the variance of the blur changes at most by this fraction of itself, or by one
# squared node spacing if that is larger.
_MAX_BLUR_VARIANCE_CHANGE_FRACTION_PER_ITERATION = 0.5
_MIN_BLUR_CHANGE_TO_RERENDER_FRACTION, _MIN_BLUR_CHANGE_TO_RERENDER_CELLS = 0.05, 0.02
"""The drawing is not rendered again for a change of the blur that is below both limits: a fraction
of the blur, and a fraction of a cell."""
_MIN_CONTRAST_TO_CONTINUE_FIT_GREY = 10.0
_MIN_START_SIDE_TO_FIT_PX, _MAX_START_SIDE_TO_FIT_PX = 4.0, 2000.0
# Indices of the unknowns: homography increment, blur, illumination.
_HOMOGRAPHY_SLICE, _BLUR_VARIANCE_INDEX, _FIRST_ILLUMINATION_INDEX = slice(0, 8), 8, 9
_HOMOGRAPHY_INCREMENT_PRIOR_INFORMATION: Array = (
    np.array(
        [
            _ROTATION_AND_SCALE_CHANGE_PRIOR_SIGMA,
            _ROTATION_AND_SCALE_CHANGE_PRIOR_SIGMA,
            1e3,
            _ROTATION_AND_SCALE_CHANGE_PRIOR_SIGMA,
            _ROTATION_AND_SCALE_CHANGE_PRIOR_SIGMA,
            1e3,
            _PERSPECTIVE_CHANGE_PRIOR_SIGMA,
            _PERSPECTIVE_CHANGE_PRIOR_SIGMA,
        ]
    )
    ** -2.0
)  # One value per element of the increment; the position is practically unconstrained.


@dataclass(frozen=True, eq=False)
class DrawingAlignment:
    """Result of fitting a drawing to the image, with measures of the fit's quality.

    Attributes:
        corners_px: the marker's corners (4, 2) in the distorted image.
        corner_sigma_px: standard deviation of a corner's x or y, the root mean square over the four
            corners.
        fit_correlation: correlation, 0 to 1, of the image's grey values with those of the whole
            fitted drawing.
        inner_pattern_correlation: correlation, -1 to 1, of the image with the inner pattern alone:
            the best-fitting plain black square is first subtracted from both the image and the
            drawing.
        pattern_to_border_contrast_ratio: contrast of the inner pattern in the image, divided by the
            contrast between black and white of the whole fitted drawing.
        largest_cell_grey_residual_to_contrast_ratio: largest deviation of a cell's mean grey from
            its mean grey in the fitted drawing, relative to the contrast of black and white.
        worst_cell_opposite_colour_likeness: how much the worst cell looks like the opposite colour,
            from 0 (as drawn) to 1 (flipped bit).
        largest_opposite_colour_likeness_sigma: standard deviation of this measure for the cell in
            which it is least certain.
        blur_sigma_px: standard deviation of the fitted blur.
        largest_corner_motion_from_start_px: largest change, in x or y, of a fitted corner from the
            position at which the fit started.
    """

    corners_px: Array
    corner_sigma_px: float
    fit_correlation: float
    inner_pattern_correlation: float
    pattern_to_border_contrast_ratio: float
    largest_cell_grey_residual_to_contrast_ratio: float
    worst_cell_opposite_colour_likeness: float
    largest_opposite_colour_likeness_sigma: float
    blur_sigma_px: float
    largest_corner_motion_from_start_px: float


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """The normal equations of one Gauss-Newton iteration for a drawing at n by n nodes. The k
    unknowns are the increment of the homography (8), the variance of the blur (1), and the
    coefficients of the illumination (7 or 8).

    Attributes:
        contrast_grey: difference between white and black, in grey levels.
        grey_residual: grey values of the image minus those of the drawing under the best-fitting
            illumination, (n * n,).
        grey_jacobian: derivatives (k, n * n) of the drawing's grey values with respect to the
            unknowns.
        noise_variance_grey2: variance of a residual.
        normal_matrix, right_hand_side: N (k, k) and g (k,) of the normal equations N x = g for the
            next increment x of the unknowns, both divided by that variance.
    """

    contrast_grey: float
    grey_residual: Array
    grey_jacobian: Array
    noise_variance_grey2: float
    normal_matrix: Array
    right_hand_side: Array


def align_drawing(
    image: NDArray[np.uint8],
    start_corners_px: Array,
    drawing: MarkerDrawing,
    camera: CameraModel,
    initial_blur_sigma_px: float = 1.0,
) -> DrawingAlignment | None:
    """Fit the drawing to the image by Gauss-Newton iterations, starting at `start_corners_px` (4,
    2) in the distorted image and at a blur with the standard deviation `initial_blur_sigma_px`. The
    unknowns are the homography of the marker, the variance of the blur, and the illumination that
    converts the drawing to grey values.

    Returns None if a part of the marker is outside the image, if the image does not resemble the
    drawing, or if the fit diverges.
    """
    start = undistort_px(start_corners_px, camera)
    if not np.isfinite(start).all():
        return None
    sides = np.hypot(*(start - np.roll(start, 1, axis=0)).T)
    side_px, reach = float(sides.mean()), drawing.photometric_fit_half_width_half_sides
    if float(sides.min()) < _MIN_START_SIDE_TO_FIT_PX or side_px > _MAX_START_SIDE_TO_FIT_PX:
        return None
    n = int(
        np.clip(
            math.ceil(reach * side_px / _NOMINAL_NODE_SPACING_PX),
            _MIN_GRID_NODES_PER_SIDE,
            _MAX_GRID_NODES_PER_SIDE,
        )
    )
    node_px, cell_size_px = reach * side_px / n, side_px / len(drawing.cell_whiteness)
    grid, H_pinhole_marker = make_sampling_grid(n, reach), homography_from_centred_square(start)
    node_distortion_shift_px = lens_distortion_shift_px(grid, H_pinhole_marker, camera)
    patch = _extract_patch(image, grid, H_pinhole_marker, node_distortion_shift_px)
    if patch is None:
        return None
    around, first = patch

    def drawn(blur_px: float) -> RenderedDrawing:
        return render_blurred(drawing, n, round(math.log(blur_px / node_px) / _LOG_BLUR_TABLE_STEP))

    def limit_blur_px(blur_px: float) -> float:
        return min(
            max(blur_px, _MIN_FITTED_BLUR_SIGMA_PX), _MAX_FITTED_BLUR_SIGMA_CELLS * cell_size_px
        )

    rendered_drawing = drawn(limit_blur_px(initial_blur_sigma_px))
    distortion_shift_minus_patch_corner_px, since_lens_px, homography_increment_from_start = (
        node_distortion_shift_px - first,
        0.0,
        np.zeros(8),
    )
    for k in range(_MAX_PHOTOMETRIC_FIT_ITERATIONS):
        if since_lens_px > _MAX_MARKER_MOTION_TO_REUSE_DISTORTION_PX:
            distortion_shift_minus_patch_corner_px, since_lens_px = (
                lens_distortion_shift_px(grid, H_pinhole_marker, camera) - first,
                0.0,
            )
        grey = _sample_patch(around, grid, H_pinhole_marker, distortion_shift_minus_patch_corner_px)
        equations = _make_normal_equations(grey, rendered_drawing, homography_increment_from_start)
        if equations is None:
            return None
        if (
            k == _ITERATIONS_BEFORE_CORRELATION_CHECK
            and correlation_from_residual(grey, equations.grey_residual)
            < _MIN_CORRELATION_TO_CONTINUE_FIT
        ):
            return None
        step = np.asarray(
            np.linalg.solve(equations.normal_matrix, equations.right_hand_side), dtype=np.float64
        )
        p = step[_HOMOGRAPHY_SLICE]
        if not (
            np.isfinite(p).all() and np.abs(p).max() <= _MAX_HOMOGRAPHY_INCREMENT_PER_ITERATION
        ):
            return None
        H_pinhole_marker, homography_increment_from_start = (
            increment_homography(H_pinhole_marker, p),
            homography_increment_from_start + p,
        )
        motion_px = 0.5 * side_px * float(np.abs(p[:6]).max())
        since_lens_px += motion_px
        sigma2 = rendered_drawing.blur_sigma_nodes**2
        most = max(1.0, _MAX_BLUR_VARIANCE_CHANGE_FRACTION_PER_ITERATION * sigma2)
        squared = sigma2 + float(np.clip(step[_BLUR_VARIANCE_INDEX], -most, most))
        wanted_px = limit_blur_px(math.sqrt(max(squared, 1e-3)) * node_px)
        drawn_px = rendered_drawing.blur_sigma_nodes * node_px
        if abs(wanted_px - drawn_px) > min(
            _MIN_BLUR_CHANGE_TO_RERENDER_FRACTION * drawn_px,
            _MIN_BLUR_CHANGE_TO_RERENDER_CELLS * cell_size_px,
        ):
            rendered_drawing = drawn(wanted_px)
        elif (
            motion_px < _MAX_STEP_TO_COUNT_AS_CONVERGED_PX
            and since_lens_px <= _MAX_MARKER_MOTION_TO_REUSE_DISTORTION_PX
        ):
            break
    assert equations is not None
    # These are the residuals of the last iteration, whose step was negligible.
    contrast_grey, grey_residual = equations.contrast_grey, equations.grey_residual
    corners_px = distort_px(apply_homography(H_pinhole_marker, CENTRED_SQUARE).T, camera).T
    inner_pattern_correlation, pattern_to_border_contrast_ratio = _measure_inner_pattern_match(
        rendered_drawing, grey, contrast_grey
    )
    nodes_per_independent_sample = _estimate_nodes_per_independent_sample(
        grey_residual.reshape(n, n)
    )
    inverse_normal_matrix = np.asarray(np.linalg.inv(equations.normal_matrix))
    worst_cell_opposite_colour_likeness, largest_opposite_colour_likeness_sigma = (
        _measure_opposite_colour_likeness(
            rendered_drawing, equations, inverse_normal_matrix, nodes_per_independent_sample
        )
    )
    J = corners_jacobian_wrt_homography_increment(H_pinhole_marker)
    variance = (
        float(
            np.trace(
                J
                @ (
                    inverse_normal_matrix[_HOMOGRAPHY_SLICE, _HOMOGRAPHY_SLICE]
                    * nodes_per_independent_sample
                )
                @ J.T
            )
        )
        / 8.0
    )
    return DrawingAlignment(
        corners_px=corners_px,
        corner_sigma_px=math.sqrt(max(variance, 0.0)),
        fit_correlation=correlation_from_residual(grey, grey_residual),
        inner_pattern_correlation=inner_pattern_correlation,
        pattern_to_border_contrast_ratio=pattern_to_border_contrast_ratio,
        largest_cell_grey_residual_to_contrast_ratio=_largest_cell_grey_residual(
            grey_residual / contrast_grey, grid, len(drawing.cell_whiteness)
        ),
        worst_cell_opposite_colour_likeness=worst_cell_opposite_colour_likeness,
        largest_opposite_colour_likeness_sigma=largest_opposite_colour_likeness_sigma,
        blur_sigma_px=rendered_drawing.blur_sigma_nodes * node_px,
        largest_corner_motion_from_start_px=float(np.abs(corners_px - start_corners_px).max()),
    )


def _make_normal_equations(
    grey: Array, rendered_drawing: RenderedDrawing, homography_increment_from_start: Array
) -> _NormalEquations | None:
    """Linearise the fit to the image's grey values `grey` (n * n,) at the nodes, and return its
    normal equations; None if there is no contrast. The illumination is first fitted in closed form;
    the equations then cover the homography increment, the blur and the illumination together.
    `homography_increment_from_start` (8,) is the sum of the increments so far, which a prior pulls
    towards zero."""
    rows, products = rendered_drawing.illumination_basis
    A = products + 1e-6 * np.eye(len(products))
    A[ILLUMINATION_TONE_CURVE_BEND_INDEX, ILLUMINATION_TONE_CURVE_BEND_INDEX] += 1e-3 * len(
        grey
    )  # keeps the bend at zero unless it is visible
    illumination = np.asarray(np.linalg.solve(A, np.einsum("kn,n->k", rows, grey)))
    contrast_grey = float(illumination[ILLUMINATION_GAIN_INDEX])
    if contrast_grey < _MIN_CONTRAST_TO_CONTINUE_FIT_GREY:
        return None
    grey_residual = grey - np.einsum("kn,k->n", rows, illumination)
    J = np.concatenate(
        [
            _grey_jacobian_under_illumination(rendered_drawing, illumination),
            rows,
            grey_residual[None],
        ]
    )
    noise = max(float((grey_residual**2).mean()), 1.0)
    products = gram_matrix(J) / noise
    J, N, g = J[:-1], products[:-1, :-1], products[:-1, -1]
    bend = _FIRST_ILLUMINATION_INDEX + ILLUMINATION_TONE_CURVE_BEND_INDEX
    N[_BLUR_VARIANCE_INDEX, _BLUR_VARIANCE_INDEX] += 1.0  # limits the step to about a node's width
    N[bend, bend] += (_TONE_CURVE_BEND_TO_GAIN_PRIOR_SIGMA * contrast_grey) ** -2.0
    g[bend] -= (
        illumination[ILLUMINATION_TONE_CURVE_BEND_INDEX]
        * (_TONE_CURVE_BEND_TO_GAIN_PRIOR_SIGMA * contrast_grey) ** -2.0
    )
    N[range(_FIRST_ILLUMINATION_INDEX, len(g)), range(_FIRST_ILLUMINATION_INDEX, len(g))] += 1e-6
    N[range(8), range(8)] += _HOMOGRAPHY_INCREMENT_PRIOR_INFORMATION
    g[_HOMOGRAPHY_SLICE] -= (
        _HOMOGRAPHY_INCREMENT_PRIOR_INFORMATION * homography_increment_from_start
    )
    return _NormalEquations(contrast_grey, grey_residual, J, noise, N, g)


# --- How well the image matches a fitted drawing ---


def correlation_from_residual(grey: Array, grey_residual: Array) -> float:
    """Return the correlation of grey values (k,) with their fitted values: the square root of the
    explained fraction of their variance, 0 if none is explained. `grey_residual` (k,) is the
    difference between the two."""
    spread = grey - grey.mean()
    explained = 1.0 - float((grey_residual**2).sum()) / max(float((spread**2).sum()), 1e-9)
    return math.sqrt(max(explained, 0.0))


def _measure_opposite_colour_likeness(
    rendered_drawing: RenderedDrawing,
    equations: _NormalEquations,
    inverse_normal_matrix: Array,
    nodes_per_independent_sample: float,
) -> tuple[float, float]:
    """Return how much the worst cell looks like the opposite colour, from 0 (as drawn) to 1
    (flipped bit), and the standard deviation of this measure for the cell in which it is least
    certain.

    Each cell's residual is projected onto the change that a flipped bit would cause: the blurred
    cell, minus the part that the unknowns of the fit can absorb. `inverse_normal_matrix` is the
    inverse of the normal matrix in `equations`. `nodes_per_independent_sample` is the number of
    neighbouring nodes that share one independent residual, by which the variance is multiplied.
    """
    soft, noise, contrast_grey = (
        rendered_drawing.blurred_cell_coverage,
        equations.noise_variance_grey2,
        equations.contrast_grey,
    )
    n, m = soft.shape
    found = contrast_grey * (soft.T @ equations.grey_residual.reshape(n, n) @ soft).ravel()
    shared = contrast_grey * (soft.T @ equations.grey_jacobian.reshape(-1, n, n) @ soft).reshape(
        -1, m * m
    )
    squared = (soft**2).sum(axis=0)
    energy = contrast_grey**2 * np.outer(squared, squared).ravel()
    taken = np.einsum("ij,ij->j", shared, (inverse_normal_matrix / noise).dot(shared))
    own = np.maximum(energy - taken, 1e-9 * energy + 1e-12)
    flips = np.where(rendered_drawing.drawing.cell_whiteness.ravel() > 0.5, -1.0, 1.0) * found / own
    return float(flips.max()), math.sqrt(nodes_per_independent_sample * noise / float(own.min()))


def _measure_inner_pattern_match(
    drawing: RenderedDrawing, grey: Array, contrast_grey: float
) -> tuple[float, float]:
    """Return the correlation and the contrast of the inner pattern in `grey` (n * n,). The inner
    pattern is what remains of the drawing, and of the image, after subtracting the best-fitting
    plain black square. The contrast is relative to `contrast_grey`, the contrast between black and
    white. Both are 0 if nothing remains."""
    rows, products = drawing.black_square_illumination_basis
    A = products + 1e-9 * np.eye(len(products))
    both = drawing.illumination_basis[0][ILLUMINATION_GAIN_INDEX], grey
    b = np.stack([np.einsum("kn,n->k", rows, each) for each in both], axis=1)
    shares = np.linalg.solve(A, b)
    bits, seen = (each - np.einsum("kn,k->n", rows, shares[:, k]) for k, each in enumerate(both))
    energy, product = float((bits * bits).sum()), float((bits * seen).sum())
    scale = math.sqrt(energy * float((seen * seen).sum()))
    if scale < 1e-9:
        return 0.0, 0.0
    return product / scale, product / max(energy, 1e-9) / contrast_grey


def _estimate_nodes_per_independent_sample(grey_residual: Array) -> float:
    """Return the number of neighbouring nodes per independent residual, estimated from the
    correlation between neighbours in `grey_residual` (n, n). The correlation makes the variance of
    a fit larger by this factor."""
    energy = max(float((grey_residual * grey_residual).mean()), 1e-9)
    factor = 1.0
    for a, b in (
        (grey_residual[1:], grey_residual[:-1]),
        (grey_residual[:, 1:], grey_residual[:, :-1]),
    ):
        r = min(max(float((a * b).mean()) / energy, 0.0), 0.9)
        factor *= (1.0 + r) / (1.0 - r)
    return factor


def _largest_cell_grey_residual(
    residual_per_contrast: Array, grid: SamplingGrid, cells_per_side: int
) -> float:
    index, count = _assign_nodes_to_cells(grid, cells_per_side)
    total = np.bincount(index, weights=residual_per_contrast, minlength=cells_per_side**2 + 1)[:-1]
    return float(np.abs(total / count).max())


@lru_cache(maxsize=32)
def _assign_nodes_to_cells(
    grid: SamplingGrid, cells_per_side: int
) -> tuple[NDArray[np.intp], Array]:
    """Return the index (n * n,) of the cell that contains each node, and the number of nodes in
    each cell, (cells,), but at least 1. Cells are numbered row by row; a node outside the marker
    has the number of cells as its index. `cells_per_side` includes the border."""
    x, y = (grid.node_uv1[:2] + 1.0) * 0.5 * cells_per_side
    inside = (x >= 0) & (x < cells_per_side) & (y >= 0) & (y < cells_per_side)
    own = y.astype(np.intp) * cells_per_side + x.astype(np.intp)
    index = np.where(inside, own, cells_per_side**2)
    count = np.bincount(index, minlength=cells_per_side**2 + 1)[:-1]
    return index, np.maximum(count, 1.0)


# --- The illumination of a marker, which converts its drawing to grey values ---
# Offset, gain, their slopes, the bend of the tone curve and the grey beyond the sheet all shift
# edges.


def _grey_jacobian_under_illumination(drawing: RenderedDrawing, illumination: Array) -> Array:
    """Return the derivatives (9, n * n) of the drawing's grey values at the nodes with respect to
    the increment of the homography (8) and the variance of the blur (1), in squared node spacings.
    `illumination` (7 or 8,) contains the coefficients of the illumination, which converts the
    drawing to grey values, one per row of `RenderedDrawing.illumination_basis`."""
    contrast_grey, (u, v, _) = float(illumination[ILLUMINATION_GAIN_INDEX]), drawing.grid.node_uv1
    (white, changes), *others = drawing.blurred_whiteness_and_off_paper_fraction
    bend = min(
        max(float(illumination[ILLUMINATION_TONE_CURVE_BEND_INDEX]) / contrast_grey, -0.9), 0.9
    )
    slope = (
        contrast_grey
        + illumination[ILLUMINATION_GAIN_SLOPE_U_INDEX] * u
        + illumination[ILLUMINATION_GAIN_SLOPE_V_INDEX] * v
    )
    slope = slope * (1.0 + bend * (1.0 - 2.0 * white))
    change: Array = changes * slope
    for (_, more), height in zip(
        others, illumination[ILLUMINATION_OFF_PAPER_GREY_INDEX:], strict=True
    ):
        change += more * height
    return change


# --- A grid over a marker in its own coordinates, and the image at its nodes ---


_DISTORTION_CHEBYSHEV_NODES_PER_AXIS = 9


@dataclass(frozen=True, eq=False)
class SamplingGrid:
    """Sampling grid on the marker: n by n nodes at `node_positions_half_sides` (n,) in both
    directions, in half sides from the marker's centre. `node_uv1` (3, n * n) contains the
    homogeneous coordinates (u, v, 1) of each node."""

    nodes_per_side: int
    node_positions_half_sides: Array
    node_uv1: Array


@lru_cache(maxsize=64)
def make_sampling_grid(nodes_per_side: int, grid_half_width_half_sides: float) -> SamplingGrid:
    """Return a grid over the square from -grid_half_width_half_sides to grid_half_width_half_sides
    around the marker's centre, with one node in the middle of each of its n by n equal parts
    (`nodes_per_side`)."""
    node_positions_half_sides = grid_half_width_half_sides * (
        (2.0 * np.arange(nodes_per_side) + 1.0) / nodes_per_side - 1.0
    )
    return SamplingGrid(
        nodes_per_side, node_positions_half_sides, _make_node_uv1(node_positions_half_sides)
    )


def _make_node_uv1(node_positions_half_sides: Array) -> Array:
    """Return the homogeneous coordinates (u, v, 1) of all nodes, row by row, (3, n * n), of a grid
    with `node_positions_half_sides` (n,) along both axes."""
    u, v = np.meshgrid(node_positions_half_sides, node_positions_half_sides)
    return np.stack([u.ravel(), v.ravel(), np.ones(u.size)])


def project_nodes(H_pinhole_marker: Array, node_uv1: Array) -> Array:
    """Map homogeneous marker coordinates (3, n), in half sides from the marker's centre, with
    `H_pinhole_marker` (3, 3) to pixels, x and y (2, n), of a pinhole camera."""
    q = H_pinhole_marker.dot(node_uv1)
    return np.asarray(q[:2] / q[2])


def distort_px(pinhole_px: Array, camera: CameraModel) -> Array:
    """Convert pixels (2, n) of a pinhole camera to pixels (2, n) of the distorted image."""
    K = camera.K
    rays = np.empty((pinhole_px.shape[1], 2))
    rays[:, 1] = (pinhole_px[1] - K[1, 2]) / K[1, 1]
    rays[:, 0] = (pinhole_px[0] - K[0, 2] - K[0, 1] * rays[:, 1]) / K[0, 0]
    return distort_to_px(rays, camera).T


def lens_distortion_shift_px(
    grid: SamplingGrid, H_pinhole_marker: Array, camera: CameraModel
) -> Array:
    """Return the shift of each node due to lens distortion, distorted minus pinhole position, px
    (2, n * n). `H_pinhole_marker` (3, 3) projects the marker's coordinates, in half sides from its
    centre, to pixels of a pinhole camera. The shift is computed at a few Chebyshev nodes and
    interpolated."""
    node_uv1, between = _make_chebyshev_nodes(grid)
    pin = project_nodes(H_pinhole_marker, node_uv1)
    shift = (distort_px(pin, camera) - pin).reshape(
        2, _DISTORTION_CHEBYSHEV_NODES_PER_AXIS, _DISTORTION_CHEBYSHEV_NODES_PER_AXIS
    )
    return np.asarray((between @ shift @ between.T).reshape(2, -1))


@lru_cache(maxsize=64)
def _make_chebyshev_nodes(grid: SamplingGrid) -> tuple[Array, Array]:
    """Return the homogeneous coordinates (3, _DISTORTION_CHEBYSHEV_NODES_PER_AXIS^2) of Chebyshev
    nodes over the grid, in half sides from the marker's centre, and the weights (n,
    _DISTORTION_CHEBYSHEV_NODES_PER_AXIS) with which values at these nodes are interpolated at the
    grid's own nodes."""
    reach = float(grid.node_positions_half_sides[-1])
    x = chebyshev.chebpts2(_DISTORTION_CHEBYSHEV_NODES_PER_AXIS)
    degree = _DISTORTION_CHEBYSHEV_NODES_PER_AXIS - 1
    through = np.linalg.inv(chebyshev.chebvander(x, degree))
    return _make_node_uv1(reach * x), chebyshev.chebvander(
        grid.node_positions_half_sides / reach, degree
    ) @ through


def _extract_patch(
    image: NDArray[np.uint8],
    grid: SamplingGrid,
    H_pinhole_marker: Array,
    node_distortion_shift_px: Array,
) -> tuple[NDArray[np.float32], Array] | None:
    """Return the part of the image that contains all nodes, with room for their motion during the
    fit, and the position (2, 1) of the top-left pixel of this part. The nodes are projected to a
    pinhole camera by `H_pinhole_marker` (3, 3) and shifted by the lens distortion
    `node_distortion_shift_px` (2, n * n). None if a node is outside the image."""
    h, w = image.shape
    x, y = project_nodes(H_pinhole_marker, grid.node_uv1) + node_distortion_shift_px
    least, most = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    if not (least.min() >= -1.0 and (most <= (w, h)).all()):
        return None
    room = 0.15 * float((most - least).max()) + 3.0
    low = np.clip(least - room, 0, (w - 2, h - 2)).astype(np.intp)
    high = np.clip(most + room + 1.0, low + 2, (w, h)).astype(np.intp)
    part = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    return part, low[:, None].astype(np.float64)


def _sample_patch(
    patch: NDArray[np.float32],
    grid: SamplingGrid,
    H_pinhole_marker: Array,
    distortion_shift_minus_patch_corner_px: Array,
) -> Array:
    """Return the grey values (n * n,) of the patch at the nodes projected by `H_pinhole_marker` and
    shifted by `distortion_shift_minus_patch_corner_px` (2, n * n): the lens distortion at each node
    minus the position of the patch's top-left pixel. The patch is the part of the image around the
    marker that the fit uses."""
    at = (
        project_nodes(H_pinhole_marker, grid.node_uv1) + distortion_shift_minus_patch_corner_px
    ).astype(np.float32)
    x, y = at.reshape(2, grid.nodes_per_side, grid.nodes_per_side)
    grey = cv2.remap(patch, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, dtype=np.float64).ravel()


# --- Products of long rows with a value for each node of a square grid ---
# They are computed block by block, because large products start threads, which cost more time than
# they save.


_GRAM_BLOCK_SIZE = 256  # number of values per row in a block


def gram_matrix(rows: Array) -> Array:
    """Return the Gram matrix (k, k), ``rows @ rows.T``, of rows (k, n)."""
    k, n = rows.shape
    whole = n - n % _GRAM_BLOCK_SIZE
    blocks = rows[:, :whole].reshape(k, -1, _GRAM_BLOCK_SIZE).transpose(1, 0, 2)
    rest = rows[:, whole:]
    total = np.matmul(blocks, blocks.transpose(0, 2, 1)).sum(axis=0)
    return np.asarray(total + rest.dot(rest.T))


# --- A marker's drawing at the nodes of a grid, blurred ---


_LOG_BLUR_TABLE_STEP = 0.02  # Relative step between the blurs in the table.
# Rows of the illumination basis: offset and its slopes, gain and its slopes, bend of the tone
# curve, grey beyond the sheet.
(
    ILLUMINATION_BLACK_LEVEL_INDEX,
    ILLUMINATION_BLACK_LEVEL_SLOPE_U_INDEX,
    ILLUMINATION_BLACK_LEVEL_SLOPE_V_INDEX,
    ILLUMINATION_GAIN_INDEX,
    ILLUMINATION_GAIN_SLOPE_U_INDEX,
    ILLUMINATION_GAIN_SLOPE_V_INDEX,
    ILLUMINATION_TONE_CURVE_BEND_INDEX,
    ILLUMINATION_OFF_PAPER_GREY_INDEX,
) = range(8)


@dataclass(frozen=True, eq=False)
class RenderedDrawing:
    """A marker's `drawing` rendered at the nodes of `grid`, which lies in the marker's plane, after
    a Gaussian blur with the standard deviation `blur_sigma_nodes`, in node spacings.

    The properties are computed when they are first used: the blurred whiteness of each node with
    its derivatives, the basis from which grey values under any illumination are combined, the same
    basis for a plain black square, and how much each row of cells covers each node.
    """

    drawing: MarkerDrawing
    grid: SamplingGrid
    blur_sigma_nodes: float

    @cached_property
    def blurred_whiteness_and_off_paper_fraction(self) -> tuple[tuple[Array, Array], ...]:
        """The blurred drawing: the whiteness of each node (0 black, 1 white) and, if the size of
        the paper is known, the fraction of each node that is beyond the paper. Each of the two is a
        pair: the values (n * n,) at the nodes, and their derivatives (9, n * n) with respect to the
        increment of the homography (8) and the variance of the blur, in squared node spacings."""
        sharp_node_values = render_whiteness_and_off_paper_fraction(
            self.drawing, self.grid.nodes_per_side
        )
        return tuple(
            _blur_with_jacobian(each, self.blur_sigma_nodes, self.grid.node_positions_half_sides)
            for each in sharp_node_values
        )

    @cached_property
    def illumination_basis(self) -> tuple[Array, Array]:
        """Basis of the drawing's grey values, and the Gram matrix of its rows. Under any
        illumination, the grey values at the nodes are a weighted sum of the rows (7 or 8, n * n).
        The weights are the black level and its slopes in x and y, the contrast (gain) and its
        slopes, and the bend of the tone curve. The eighth row, whose weight is the change of grey
        beyond the paper, only exists if the size of the paper is known
        (`MarkerDrawing.paper_half_width_half_sides`)."""
        u, v, one = self.grid.node_uv1
        (white, _), *others = self.blurred_whiteness_and_off_paper_fraction
        rows = [one, u, v, white, white * u, white * v, white * (1.0 - white)]
        stacked = np.stack(rows + [beyond for beyond, _ in others])
        return stacked, gram_matrix(stacked)

    @cached_property
    def black_square_illumination_basis(self) -> tuple[Array, Array]:
        """Basis of the grey values of a plain black square in place of the marker, to separate the
        inner pattern from the border: the rows (4 or 5, n * n), and their Gram matrix. The rows
        correspond to those of `illumination_basis`, without the slopes of the gain and the bend of
        the tone curve."""
        soft = blur_node_values(
            render_black_square(len(self.drawing.cell_whiteness), self.grid.nodes_per_side),
            self.blur_sigma_nodes,
        )
        black = soft[
            GRID_MARGIN_FOR_BLUR_NODES:-GRID_MARGIN_FOR_BLUR_NODES,
            GRID_MARGIN_FOR_BLUR_NODES:-GRID_MARGIN_FOR_BLUR_NODES,
        ].reshape(1, -1)
        lit, _ = self.illumination_basis
        rows = np.concatenate(
            [lit[:ILLUMINATION_GAIN_INDEX], black, lit[ILLUMINATION_OFF_PAPER_GREY_INDEX:]]
        )
        return rows, gram_matrix(rows)

    @cached_property
    def blurred_cell_coverage(self) -> Array:
        """Fraction of each node's width that each row (or column) of cells covers, along one axis
        and after the blur: (n, m) for n nodes and m cells per side."""
        half_node = self.drawing.photometric_fit_half_width_half_sides / self.grid.nodes_per_side
        return blurred_cell_coverage(
            self.drawing, self.grid.node_positions_half_sides, half_node, self.blur_sigma_nodes
        )


@lru_cache(maxsize=16)
def render_blurred(
    drawing: MarkerDrawing, nodes_per_side: int, blur_table_index: int
) -> RenderedDrawing:
    """Return the drawing at n by n nodes (`nodes_per_side`) over the square that is compared with
    the image. Its blur has the standard deviation ``exp(_LOG_BLUR_TABLE_STEP * blur_table_index)``,
    in node spacings. Only blurs from this table are rendered, so that the results can be cached."""
    return RenderedDrawing(
        drawing,
        make_sampling_grid(nodes_per_side, drawing.photometric_fit_half_width_half_sides),
        math.exp(_LOG_BLUR_TABLE_STEP * blur_table_index),
    )


def _blur_with_jacobian(
    sharp_node_values: NDArray[np.float32],
    blur_sigma_nodes: float,
    node_positions_half_sides: Array,
) -> tuple[Array, Array]:
    soft = blur_node_values(sharp_node_values, blur_sigma_nodes)
    step = float(node_positions_half_sides[1] - node_positions_half_sides[0])
    e, n = GRID_MARGIN_FOR_BLUR_NODES, len(node_positions_half_sides)
    middle = slice(e, e + n)
    left, right = soft[middle, e - 1 : e + n - 1], soft[middle, e + 1 : e + n + 1]
    up, down = soft[e - 1 : e + n - 1, middle], soft[e + 1 : e + n + 1, middle]
    value = soft[middle, middle]
    du, dv = np.float32(0.5 / step) * (right - left), np.float32(0.5 / step) * (down - up)
    laplace = left + right + up + down - 4.0 * value
    u, v = (
        node_positions_half_sides.astype(np.float32),
        node_positions_half_sides.astype(np.float32)[:, None],
    )
    along = u * du + v * dv
    changes = np.empty((9, n, n))
    for part, one, other in (
        (0, u, du),
        (1, v, du),
        (3, u, dv),
        (4, v, dv),
        (6, -u, along),
        (7, -v, along),
    ):
        np.multiply(-one, other, out=changes[part])
    changes[2], changes[5], changes[8] = -du, -dv, 0.5 * laplace
    return value.ravel().astype(np.float64), changes.reshape(9, n * n)
