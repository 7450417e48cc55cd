"""Cut-view fit: measure a target that is so close, or so far off the axis, that no marker is
completely in the image.

The fit looks for all edges of the drawing, which contains both markers, across their predicted
positions. A part of a drawing does not determine the eight elements of a homography, so the
unknowns are those of a rigid body's pose. Gauss-Newton finds the rotation w and the translation t,
together with the shift d of all edges (white over black), from the distances r_k, px, between the
drawing's edges and the image's:

    min sum v_k (r_k - J_k (w, t, d))^2 / sigma^2 + sum ((w, t, d)_j / sigma_j)^2

with Tukey's weights v. The second sum keeps unobserved unknowns at their predicted values. The
fitted pose then yields the corners of one marker and their covariance (8, 8) px^2.

The result is wrong if the error of the predicted tilt is much larger than its standard deviation, 2
deg, and no edge reveals the error. Many other objects resemble a part of the drawing. This fit
therefore never starts a track. Its result is only used if the image matches the drawing everywhere
(correlation above 0.9) and three quarters of the edges in view are found.

The unit of length is half the side of the large marker.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, TargetConfig
from perchctl.vision.lens import distort_to_px, undistort_to_normalised
from perchctl.vision.markers.corners import (
    CENTRED_SQUARE,
    RefinedCorners,
    apply_homography,
    is_inside_image,
)
from perchctl.vision.markers.detector import (
    DetectorInput,
    HiddenMask,
    is_any_marker_part_hidden,
    make_detector_setup,
)
from perchctl.vision.markers.edge_fit import (
    GRADIENT_POSITIONS_ALONG_PROFILE_HALF_LENGTHS,
    sample_profiles,
)
from perchctl.vision.markers.pattern import MarkerDrawing, MarkerPattern, render_cells
from perchctl.vision.markers.photometric_fit import correlation_from_residual, make_sampling_grid
from perchctl.vision.types import CameraModel, MarkerName

MAX_TARGET_MEASUREMENT_AGE_TO_TRY_TRUNCATED_FIT_S = 0.5
"""Maximum time since the target was last measured, s. After a longer time, a part of the target is
not sufficient evidence of the target."""
# Distance from the image border within which an expected marker may or may not be truncated.
_ASSUMED_MAX_CORNER_PREDICTION_ERROR_PX = 40
# If the cells of the small marker are smaller, the large marker is in view.
_MIN_SMALL_MARKER_CELL_SIZE_TO_TRY_FIT_PX = 8.0
# Correlation required after the predicted pose has been shifted.
_MIN_COARSE_CORRELATION_TO_START_FIT = 0.6
# Correlation above which no other range is tried.
_MIN_COARSE_CORRELATION_TO_STOP_SEARCH = 0.95
# Sizes of the target in the image that are tried, relative to its predicted size.
_TARGET_SCALES_TO_TRY_RELATIVE_TO_PREDICTION = (1.0, 0.94, 1.06)
_MIN_DRAWING_CORRELATION_TO_ACCEPT_FIT, _MIN_DRAWING_CONTRAST_TO_ACCEPT_FIT_GREY = 0.9, 20.0
# Fraction of the edge points in view that must be found.
_MIN_FOUND_EDGE_POINT_FRACTION_TO_ACCEPT_FIT = 0.75
_MAX_TRUNCATED_FIT_RMS_RESIDUAL_PX = 1.2
_MAX_TRANSLATION_SIGMA_TO_ACCEPT_FIT_HALF_SIDES = 0.04
_CORNER_SIGMA_ADDED_IN_QUADRATURE_PX = 0.02
# The small marker is reported if at least this number of its edge points is found.
_MIN_EDGE_POINTS_TO_REPORT_SMALL_MARKER = 12
# The lens model is valid where its inverse exists.
_MAX_LENS_MODEL_ROUND_TRIP_ERROR_NORMALISED = 1e-3
# Rotation from the coordinates of the drawing to the axes of the marker.
_R_MARKER_DRAWING = np.diag([1.0, -1.0, -1.0])


def warm_up_truncated_marker_fit(
    patterns: Mapping[MarkerName, MarkerPattern], camera: CameraModel
) -> None:
    """Fill the caches of `fit_truncated_markers` for these marker patterns and this camera before
    the flight, so that its first call is fast."""
    (
        _make_target_outline(patterns),
        make_drawing_texture(patterns["large"].drawing),
        make_coarse_lattice(camera),
    )


def is_target_possibly_truncated(
    expected_corners_px: Mapping[MarkerName, Array],
    image_shape: tuple[int, ...],
    hidden_mask: HiddenMask | None = None,
) -> bool:
    """True if no expected marker is certain to be completely visible: for each of them, a corner is
    outside the image or close to its border (`_ASSUMED_MAX_CORNER_PREDICTION_ERROR_PX`, 40 px), or
    the vehicle's gear hides a part of the marker. False if no marker is expected.

    `expected_corners_px` contains the predicted corners of each marker, (4, 2) px.
    `image_shape` (h, w) is that of the image. `hidden_mask` (h, w) is True for pixels that the
    gear hides.
    """
    whole = [
        corners
        for corners in expected_corners_px.values()
        if is_inside_image(corners, image_shape, _ASSUMED_MAX_CORNER_PREDICTION_ERROR_PX)
    ]
    return bool(expected_corners_px) and all(
        is_any_marker_part_hidden(hidden_mask, c) for c in whole
    )


def can_complete_marker_be_in_view(
    expected_corners_px: Mapping[MarkerName, Array], image_shape: tuple[int, ...]
) -> bool:
    """True if at least one expected marker, with corners (4, 2) px, may be completely in an image
    with the given `image_shape` (h, w). Because predictions are uncertain, a marker counts even if
    its predicted corners are up to 40 px (`_ASSUMED_MAX_CORNER_PREDICTION_ERROR_PX`) outside the
    image."""
    return any(
        is_inside_image(corners, image_shape, -_ASSUMED_MAX_CORNER_PREDICTION_ERROR_PX)
        for corners in expected_corners_px.values()
    )


def fit_truncated_markers(
    detector_input: DetectorInput, expected_corners_px: Mapping[MarkerName, Array]
) -> dict[MarkerName, RefinedCorners]:
    """Fit the pose of the target to its visible part, starting at `expected_corners_px`, the
    predicted corners of each marker, (4, 2) px in the distorted image. Return the corners of one
    marker, projected from the fitted pose: of the small marker if enough of its edge points were
    found, otherwise of the large one.

    The result is empty if the target has no small marker, if the small marker's cells are narrower
    than 8 px (`_MIN_SMALL_MARKER_CELL_SIZE_TO_TRY_FIT_PX`) in the image, if the image does not
    match the target, or if it does not determine the target's position accurately enough.
    """
    image, camera, patterns = (
        detector_input.image,
        detector_input.camera,
        detector_input.setup.patterns,
    )
    drawing = patterns["large"].drawing
    small_to_large_side_ratio, centre = (
        drawing.small_to_large_side_ratio,
        drawing.small_marker_cell_whiteness,
    )
    start = _estimate_initial_pose(expected_corners_px, small_to_large_side_ratio, camera)
    if start is None or centre is None:
        return {}
    if (
        2.0
        * small_to_large_side_ratio
        / len(centre)
        * camera.K[0, 0]
        / start.t_cam_drawing_half_sides[2]
        < _MIN_SMALL_MARKER_CELL_SIZE_TO_TRY_FIT_PX
    ):
        return {}
    covered = (
        None if detector_input.hidden_mask is None else detector_input.hidden_mask.astype(np.uint8)
    )
    coarse_image, texture = make_coarse_image(image, camera, covered), make_drawing_texture(drawing)
    near = _search_near_pose(start, texture, coarse_image)
    if near is None:
        return {}
    pose_fit = fit_pose(image, near, _make_target_outline(patterns), camera, covered)
    if pose_fit is None or not _is_pose_fit_reliable(pose_fit):
        return {}
    like, gain = correlate_drawing(pose_fit.pose.H_normalised_drawing, texture, coarse_image)
    if (
        like < _MIN_DRAWING_CORRELATION_TO_ACCEPT_FIT
        or gain < _MIN_DRAWING_CONTRAST_TO_ACCEPT_FIT_GREY
    ):
        return {}
    name = _select_marker_to_report(pose_fit)
    corners = _project_marker_corners(
        pose_fit, small_to_large_side_ratio if name == "small" else 1.0, camera
    )
    return {} if corners is None else {name: corners}


def can_fit_truncated_target(
    R_cam_marker: Array, t_cam_marker_m: Array, target: TargetConfig, camera: CameraModel
) -> bool:
    """True if the visible part of the target is large enough for a measurement: if the fit of
    `fit_truncated_markers` to an ideal image would be reliable. Gear that hides the target is not
    taken into account.

    `R_cam_marker` (3, 3) and `t_cam_marker_m` (3,) are the pose of the large marker in the camera
    frame. The marker's axes are x right and y up on the paper, and z out of the paper.
    """
    patterns = _make_patterns(target)
    pose = RigidPose(R_cam_marker @ _R_MARKER_DRAWING, t_cam_marker_m / (target.large.side_m / 2.0))
    pose_fit = predict_fit_accuracy(pose, _make_target_outline(patterns), camera)
    if pose_fit is None or not _is_pose_fit_reliable(pose_fit):
        return False
    side_to_large_side_ratio = (
        patterns["large"].drawing.small_to_large_side_ratio
        if _select_marker_to_report(pose_fit) == "small"
        else 1.0
    )
    return _project_marker_corners(pose_fit, side_to_large_side_ratio, camera) is not None


@lru_cache(maxsize=4)
def _make_patterns(target: TargetConfig) -> dict[MarkerName, MarkerPattern]:
    return make_detector_setup(DetectorConfig(), target).patterns


def _make_target_outline(patterns: Mapping[MarkerName, MarkerPattern]) -> TargetOutline:
    large, small = patterns["large"], patterns["small"]
    return make_outline(
        large.drawing,
        large.cells_along_border.printed_edge_position_sigma_cells,
        small.cells_along_border.printed_edge_position_sigma_cells,
    )


def _select_marker_to_report(pose_fit: PoseFit) -> MarkerName:
    """Return which marker's corners are the result of `fit_truncated_markers`: the small marker if
    at least 12 of its edge points were found (`_MIN_EDGE_POINTS_TO_REPORT_SMALL_MARKER`), otherwise
    the large marker."""
    return (
        "small"
        if pose_fit.found_small_marker_edge_point_count >= _MIN_EDGE_POINTS_TO_REPORT_SMALL_MARKER
        else "large"
    )


def _estimate_initial_pose(
    expected_corners_px: Mapping[MarkerName, Array],
    small_to_large_side_ratio: float,
    camera: CameraModel,
) -> RigidPose | None:
    name: MarkerName = "small" if "small" in expected_corners_px else "large"
    rays = undistort_to_normalised(expected_corners_px[name], camera)
    if not np.isfinite(rays).all():
        return None
    side_to_large_side_ratio = small_to_large_side_ratio if name == "small" else 1.0
    H = cv2.getPerspectiveTransform(
        (side_to_large_side_ratio * CENTRED_SQUARE).astype(np.float32), rays.astype(np.float32)
    )
    scale = 0.5 * float(np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    if not (np.isfinite(H).all() and scale > 1e-9 and H[2, 2] != 0.0):
        return None
    H = np.asarray(H, dtype=np.float64) / math.copysign(scale, H[2, 2])
    U, _, V = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    R = np.asarray(U @ V, dtype=np.float64)
    return RigidPose(R, np.asarray(H[:, 2])) if np.linalg.det(R) > 0.0 else None


def _search_near_pose(
    start: RigidPose, texture: DrawingTexture, coarse_image: CoarseUndistortedImage
) -> RigidPose | None:
    """Return the pose near `start` at which the drawing, rendered from `texture`, correlates best
    with the coarse image; None if no pose has a correlation above 0.6
    (`_MIN_COARSE_CORRELATION_TO_START_FIT`).

    The search moves the drawing by up to 6 pixels of the coarse image
    (`_COARSE_SEARCH_HALF_WIDTH_NODES`) to each side, at the predicted size and at slightly smaller
    and larger sizes (`_TARGET_SCALES_TO_TRY_RELATIVE_TO_PREDICTION`). It does not change the
    rotation, and stops at the first size with a correlation above 0.95
    (`_MIN_COARSE_CORRELATION_TO_STOP_SEARCH`).
    """
    best, pose, lattice = _MIN_COARSE_CORRELATION_TO_START_FIT, None, coarse_image.lattice
    for growth in _TARGET_SCALES_TO_TRY_RELATIVE_TO_PREDICTION:
        t = start.t_cam_drawing_half_sides * (1.0, 1.0, 1.0 / growth)
        wide = render_drawing(
            RigidPose(start.R_cam_drawing, t).H_normalised_drawing,
            texture,
            lattice,
            _COARSE_SEARCH_HALF_WIDTH_NODES,
        )
        mask = coarse_image.is_node_visible.astype(np.float32)
        score = cv2.matchTemplate(wide, coarse_image.grey, cv2.TM_CCOEFF_NORMED, mask=mask)
        score = np.where(np.isfinite(score) & (np.abs(score) <= 1.001), score, -1.0)
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        drift = (
            _COARSE_SEARCH_HALF_WIDTH_NODES - np.array([column, row], dtype=np.float64)
        ) * lattice.node_spacing_normalised
        if score[row, column] > best:
            best = float(score[row, column])
            pose = RigidPose(start.R_cam_drawing, t + np.append(drift * t[2], 0.0))
        if best > _MIN_COARSE_CORRELATION_TO_STOP_SEARCH:
            break
    return pose


def _is_pose_fit_reliable(pose_fit: PoseFit) -> bool:
    """True if at least 75 % of the visible edge points were found
    (`_MIN_FOUND_EDGE_POINT_FRACTION_TO_ACCEPT_FIT`), if their RMS residual is below 1.2 px
    (`_MAX_TRUNCATED_FIT_RMS_RESIDUAL_PX`), and if the standard deviation of the translation along
    its most uncertain direction is below 0.04 half sides of the large marker
    (`_MAX_TRANSLATION_SIGMA_TO_ACCEPT_FIT_HALF_SIDES`)."""
    spread = math.sqrt(
        max(
            float(np.linalg.eigvalsh(pose_fit.rotation_translation_cov_rad_half_sides[3:, 3:])[-1]),
            0.0,
        )
    )
    return (
        pose_fit.found_edge_point_count
        >= _MIN_FOUND_EDGE_POINT_FRACTION_TO_ACCEPT_FIT * pose_fit.visible_edge_point_count
        and pose_fit.rms_residual_px < _MAX_TRUNCATED_FIT_RMS_RESIDUAL_PX
        and spread < _MAX_TRANSLATION_SIGMA_TO_ACCEPT_FIT_HALF_SIDES
    )


def _project_marker_corners(
    pose_fit: PoseFit, side_to_large_side_ratio: float, camera: CameraModel
) -> RefinedCorners | None:
    """Project the corners of a marker at the target's centre from the fitted pose. The marker's
    side is `side_to_large_side_ratio` times that of the large marker. The result contains the
    corners (4, 2), px in the distorted image, and their covariance (8, 8), px^2 in the image of a
    pinhole camera without distortion. It is None if a corner is behind the camera or too far from
    the optical axis for the lens model."""
    r = (
        np.column_stack([side_to_large_side_ratio * CENTRED_SQUARE, np.zeros(4)])
        @ pose_fit.pose.R_cam_drawing.T
    )
    X = r + pose_fit.pose.t_cam_drawing_half_sides
    if X[:, 2].min() <= 0.0:
        return None  # at least one corner is beside or behind the camera
    x = X[:, :2] / X[:, 2:]
    # derivative of pixels in a pinhole camera with respect to rotation and translation
    J = np.zeros((8, 6))
    for k in range(4):
        P = np.array([[1.0, 0.0, -x[k, 0]], [0.0, 1.0, -x[k, 1]]]) / X[k, 2]
        P = camera.K[:2, :2] @ P
        J[2 * k : 2 * k + 2, :3] = np.cross(r[k], P)
        J[2 * k : 2 * k + 2, 3:] = P
    corners_px = distort_to_px(x, camera)
    if (
        not np.abs(undistort_to_normalised(corners_px, camera) - x).max()
        < _MAX_LENS_MODEL_ROUND_TRIP_ERROR_NORMALISED
    ):
        return None
    cov_px2 = (
        J @ pose_fit.rotation_translation_cov_rad_half_sides @ J.T
        + _CORNER_SIGMA_ADDED_IN_QUADRATURE_PX** 2 * np.eye(8)
    )
    sigma_px = math.sqrt(float(np.trace(cov_px2)) / 8.0)
    return RefinedCorners(corners_px, sigma_px, True, cov_px2=cov_px2)


# --- A downsampled image without lens distortion, and the drawing rendered into it ---


FloatImage = NDArray[np.float32]

_COARSE_LATTICE_NODES_ACROSS_IMAGE = 80  # approximate number of nodes across the image
_SAMPLES_PER_LATTICE_NODE_AND_AXIS = 2
_MAX_LATTICE_XY_FROM_OPTICAL_AXIS_NORMALISED = 1.5  # corresponds to 56 degrees off the optical axis
_BORDER_POINTS_TO_UNDISTORT_PER_IMAGE_SIDE = 40
_VALID_LENS_RADIUS_TO_IMAGE_RADIUS_RATIO = 1.02
_COARSE_SEARCH_HALF_WIDTH_NODES = 6  # The search covers this number of nodes to each side.
_MIN_VISIBLE_NODES_ON_PAPER_TO_CORRELATE = 200  # Minimum number of visible nodes on the paper.


@dataclass(frozen=True, eq=False)
class CoarseLattice:
    """A regular grid of points (nodes), in rows and columns, in normalised image coordinates. The
    image's grey values at the nodes make a downsampled image without lens distortion, in which the
    target's drawing is searched for. An image is first reduced in size; the grey value of a node is
    then the mean of two by two samples around it.

    Attributes:
        first_node_xy_normalised: x and y of the node in the first row and column, (2,).
        node_spacing_normalised: distance between neighbouring nodes.
        valid_lens_radius_normalised: distance from the optical axis up to which the lens model is
            used; further out, it may map two directions to the same pixel.
        sample_x_in_reduced_image_px, sample_y_in_reduced_image_px: maps for cv2.remap, each of
            shape (2 * rows, 2 * columns): x and y of each sample, px in the reduced image.
        reduced_image_width_height_px: width and height of the reduced image.
        is_node_in_image: True for nodes inside the camera's image, (rows, columns).
    """

    first_node_xy_normalised: Array
    node_spacing_normalised: float
    valid_lens_radius_normalised: float
    sample_x_in_reduced_image_px: FloatImage
    sample_y_in_reduced_image_px: FloatImage
    reduced_image_width_height_px: tuple[int, int]
    is_node_in_image: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CoarseUndistortedImage:
    """A downsampled image without lens distortion: `grey` (rows, columns) contains its grey values,
    0 to 255, at the nodes of the regular grid `lattice`. `is_node_visible` (rows, columns) is True
    for nodes that are inside the camera image and not hidden by the vehicle."""

    lattice: CoarseLattice
    grey: FloatImage
    is_node_visible: NDArray[np.bool_]


@lru_cache(maxsize=8)
def make_coarse_lattice(camera: CameraModel) -> CoarseLattice:
    """Return the regular grid of points (nodes) at which `make_coarse_image` computes the grey
    values of a downsampled image without lens distortion. The grid covers the camera's field of
    view in normalised image coordinates, but at most 1.5
    (`_MAX_LATTICE_XY_FROM_OPTICAL_AXIS_NORMALISED`) from the optical axis in x and in y. The
    spacing is that of about 80 nodes across the image width
    (`_COARSE_LATTICE_NODES_ACROSS_IMAGE`)."""
    w, h = camera.size_px
    s = np.linspace(0.0, 1.0, _BORDER_POINTS_TO_UNDISTORT_PER_IMAGE_SIDE)
    low, high = np.zeros_like(s), np.ones_like(s)
    rim = np.concatenate([np.stack(p, 1) for p in ((s, low), (s, high), (low, s), (high, s))])
    rays = undistort_to_normalised(rim * (w - 1.0, h - 1.0), camera)
    rays = np.clip(
        np.nan_to_num(rays, nan=0.0),
        -_MAX_LATTICE_XY_FROM_OPTICAL_AXIS_NORMALISED,
        _MAX_LATTICE_XY_FROM_OPTICAL_AXIS_NORMALISED,
    )
    reach = _VALID_LENS_RADIUS_TO_IMAGE_RADIUS_RATIO * float(np.hypot(*rays.T).max())
    step = w / (_COARSE_LATTICE_NODES_ACROSS_IMAGE * float(camera.K[0, 0]))
    nodes = np.maximum(np.ceil(np.ptp(rays, axis=0) / step).astype(int), 1)
    fine = [
        rays.min(axis=0)[k]
        + step
        * (
            (np.arange(_SAMPLES_PER_LATTICE_NODE_AND_AXIS * nodes[k]) + 0.5)
            / _SAMPLES_PER_LATTICE_NODE_AND_AXIS
        )
        for k in (0, 1)
    ]
    x, y = np.meshgrid(*fine)
    at = distort_to_px(np.stack([x.ravel(), y.ravel()], axis=1), camera)
    inside = np.isfinite(at).all(axis=1) & (np.hypot(x, y).ravel() < reach)
    inside &= (at > 0.0).all(axis=1) & (at < (w - 1, h - 1)).all(axis=1)
    at = np.where(inside[:, None], at, -1e3)
    every = max(
        round(w / (_SAMPLES_PER_LATTICE_NODE_AND_AXIS * _COARSE_LATTICE_NODES_ACROSS_IMAGE)), 1
    )
    size = (max(w // every, 1), max(h // every, 1))
    reduced = ((at + 0.5) * (size[0] / w, size[1] / h) - 0.5).astype(np.float32)
    shape = (
        int(nodes[1]),
        _SAMPLES_PER_LATTICE_NODE_AND_AXIS,
        int(nodes[0]),
        _SAMPLES_PER_LATTICE_NODE_AND_AXIS,
    )
    flat = x.shape
    return CoarseLattice(
        first_node_xy_normalised=rays.min(axis=0) + step / 2.0,
        node_spacing_normalised=step,
        valid_lens_radius_normalised=reach,
        sample_x_in_reduced_image_px=np.ascontiguousarray(reduced[:, 0].reshape(flat)),
        sample_y_in_reduced_image_px=np.ascontiguousarray(reduced[:, 1].reshape(flat)),
        reduced_image_width_height_px=size,
        is_node_in_image=inside.reshape(shape).all(axis=(1, 3)),
    )


def make_coarse_image(
    image: NDArray[np.uint8], camera: CameraModel, hidden_mask_u8: NDArray[np.uint8] | None = None
) -> CoarseUndistortedImage:
    """Return the image (h, w) without lens distortion, downsampled to a regular grid of nodes with
    about 80 nodes across the image width (`make_coarse_lattice`). Nodes at which `hidden_mask_u8`
    (h, w) is not zero are marked as not visible; without a mask, all nodes inside the image are
    visible."""
    lattice = make_coarse_lattice(camera)
    seen = lattice.is_node_in_image
    if hidden_mask_u8 is not None:
        covered = (hidden_mask_u8 != 0).astype(np.float32)
        seen = seen & (_sample_image_at_nodes(covered, lattice) < 1e-3)
    return CoarseUndistortedImage(lattice, _sample_image_at_nodes(image, lattice), seen)


def _sample_image_at_nodes(
    image: NDArray[np.uint8] | FloatImage, lattice: CoarseLattice
) -> FloatImage:
    small = cv2.resize(
        image, lattice.reduced_image_width_height_px, interpolation=cv2.INTER_AREA
    ).astype(np.float32)
    fine_image = cv2.remap(
        small,
        lattice.sample_x_in_reduced_image_px,
        lattice.sample_y_in_reduced_image_px,
        cv2.INTER_LINEAR,
    )
    return _average_samples_per_node(np.asarray(fine_image, np.float32))


def _average_samples_per_node(fine_image: FloatImage) -> FloatImage:
    rows, columns = (n // _SAMPLES_PER_LATTICE_NODE_AND_AXIS for n in fine_image.shape)
    return np.asarray(
        cv2.resize(fine_image, (columns, rows), interpolation=cv2.INTER_AREA), np.float32
    )


def render_drawing(
    H_normalised_drawing: Array,
    texture: DrawingTexture,
    lattice: CoarseLattice,
    margin_nodes: int = 0,
) -> FloatImage:
    """Return the whiteness, 0 (black) to 1 (white), of the target's drawing at the lattice's nodes
    and at `margin_nodes` additional nodes on each side: (rows + 2 margin_nodes, columns + 2
    margin_nodes). `H_normalised_drawing` (3, 3) maps the drawing's coordinates, in half sides of
    the large marker from the target's centre, to normalised image coordinates; `texture` is the
    drawing as an image. Beyond the texture, everything is white."""
    step = lattice.node_spacing_normalised / _SAMPLES_PER_LATTICE_NODE_AND_AXIS
    start = (
        lattice.first_node_xy_normalised
        - 0.5 * (lattice.node_spacing_normalised - step)
        - margin_nodes * lattice.node_spacing_normalised
    )
    G = np.array(
        [[1.0 / step, 0.0, -start[0] / step], [0.0, 1.0 / step, -start[1] / step], [0.0, 0.0, 1.0]]
    )
    white, T = texture
    M = G @ H_normalised_drawing @ np.linalg.inv(T)
    rows, columns = lattice.is_node_in_image.shape
    size = (
        _SAMPLES_PER_LATTICE_NODE_AND_AXIS * (columns + 2 * margin_nodes),
        _SAMPLES_PER_LATTICE_NODE_AND_AXIS * (rows + 2 * margin_nodes),
    )
    fine = cv2.warpPerspective(
        white,
        M,
        size,
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=1.0,
    )
    return _average_samples_per_node(np.asarray(fine, np.float32))


class DrawingMatch(NamedTuple):
    """How well the image matches the drawing.

    Attributes:
        correlation: correlation, 0 to 1, of the image with the drawing after the fit of brightness
            and contrast. It does not depend on the sign of the contrast.
        contrast_grey: grey level of white minus grey level of black; negative if the image is
            inverted.
    """

    correlation: float
    contrast_grey: float


def correlate_drawing(
    H_normalised_drawing: Array, texture: DrawingTexture, coarse_image: CoarseUndistortedImage
) -> DrawingMatch:
    """Compare the coarse image with the drawing, given as an image by `texture`, at the visible
    nodes on the paper. `H_normalised_drawing` (3, 3) maps the drawing's coordinates, in half sides
    of the large marker from the target's centre, to normalised image coordinates. The brightness
    and the contrast of the drawing, each with a gradient across the image, are first fitted to the
    image. Correlation and contrast are 0 if fewer than 200 visible nodes are on the paper
    (`_MIN_VISIBLE_NODES_ON_PAPER_TO_CORRELATE`)."""
    lattice = coarse_image.lattice
    rows, columns = np.nonzero(coarse_image.is_node_visible)
    at = lattice.first_node_xy_normalised + lattice.node_spacing_normalised * np.stack(
        [columns, rows], axis=1
    ).astype(np.float64)
    on = (
        np.abs(
            apply_homography(np.asarray(np.linalg.inv(H_normalised_drawing), np.float64), at)
        ).max(axis=1)
        < ASSUMED_PAPER_HALF_WIDTH_LARGE_HALF_SIDES
    )
    if np.count_nonzero(on) < _MIN_VISIBLE_NODES_ON_PAPER_TO_CORRELATE:
        return DrawingMatch(0.0, 0.0)
    white = render_drawing(H_normalised_drawing, texture, lattice)[rows[on], columns[on]].astype(
        np.float64
    )
    grey = coarse_image.grey[rows[on], columns[on]].astype(np.float64)
    x, y = (at[on] - at[on].mean(axis=0)).T
    A = np.stack([np.ones_like(x), x, y, white, white * x, white * y], axis=1)
    light = np.linalg.solve(A.T @ A + 1e-6 * np.eye(6), A.T @ grey)
    return DrawingMatch(correlation_from_residual(grey, grey - A @ light), float(light[3]))


# --- The drawing of the whole target: its edges between black and white, and its texture ---


# Distance from the target's centre up to which there is certainly paper.
ASSUMED_PAPER_HALF_WIDTH_LARGE_HALF_SIDES = 1.25
# Points along the side of a cell of the large and of the small marker.
_OUTLINE_POINTS_PER_LARGE_MARKER_CELL_SIDE, _OUTLINE_POINTS_PER_SMALL_MARKER_CELL_SIDE = 24, 6
# Margin at both ends of a cell's side, where the corner of the next cell blurs the edge.
_OUTLINE_POINT_MARGIN_AT_EDGE_ENDS_CELLS = 0.15
# Distance from the centre, in half sides of the small marker, within which it hides the large one.
_OMIT_LARGE_MARKER_EDGES_WITHIN_SMALL_HALF_SIDES = 1.2
_DRAWING_TEXTURE_SIZE_PX = 320


@dataclass(frozen=True, eq=False)
class TargetOutline:
    """Points along the black-white edges of the target's drawing.

    Attributes:
        points_half_sides, edge_normal_to_white_in_drawing: points (n, 2), in half sides of the
            large marker from the target's centre (x right, y down on the paper), and unit normals
            (n, 2) from black to white.
        printed_line_index_per_point: number (n,) of the straight line that each point is on; points
            with the same number are collinear.
        printed_line_position_sigma_half_sides: standard deviation (n,) of the position of the
            printed line that each point is on, in half sides of the large marker.
        adjacent_cell_width_half_sides: width (n,) of a cell of the marker that the point is on, in
            half sides of the large marker.
        is_on_small_marker: True for edges of the small marker, (n,).
    """

    points_half_sides: Array
    edge_normal_to_white_in_drawing: Array
    printed_line_index_per_point: NDArray[np.intp]
    printed_line_position_sigma_half_sides: Array
    adjacent_cell_width_half_sides: Array
    is_on_small_marker: NDArray[np.bool_]


class DrawingTexture(NamedTuple):
    """The target and its white paper as a texture: `whiteness` (m, m), 0 to 1, and the homography
    `H_texture_px_drawing` (3, 3) from the drawing's coordinates, in half sides of the large marker
    from the target's centre, to the texture's pixels."""

    whiteness: FloatImage
    H_texture_px_drawing: Array


@lru_cache(maxsize=8)
def make_outline(
    drawing: MarkerDrawing, large_print_tolerance_cells: float, small_print_tolerance_cells: float
) -> TargetOutline:
    """Return the black-white edges of both markers as points, in half sides of the large marker
    from the target's centre (x right, y down on the paper). `drawing` is that of the large marker,
    with the small one in it. Edges of the large marker that may be hidden by the small one are
    omitted. The tolerances are standard deviations of the position of a printed edge, in cells of
    the large and of the small marker."""
    hidden = _OMIT_LARGE_MARKER_EDGES_WITHIN_SMALL_HALF_SIDES * drawing.small_to_large_side_ratio
    edges = [
        edge
        for edge in _iterate_cell_edges(
            drawing.cell_whiteness, 1.0, _OUTLINE_POINTS_PER_LARGE_MARKER_CELL_SIDE
        )
        if np.abs(edge.points_half_sides).max(axis=1).min() > hidden
    ]
    large = len(edges)
    if drawing.small_marker_cell_whiteness is not None:
        edges += _iterate_cell_edges(
            drawing.small_marker_cell_whiteness,
            drawing.small_to_large_side_ratio,
            _OUTLINE_POINTS_PER_SMALL_MARKER_CELL_SIDE,
        )
    at, normals, names, cells = zip(*edges, strict=True)
    numbers = {name: k for k, name in enumerate(names)}
    points_per_edge = np.array([len(each) for each in at])
    cell = np.repeat(cells, points_per_edge)
    small = np.repeat(np.arange(len(edges)) >= large, points_per_edge)
    return TargetOutline(
        points_half_sides=np.concatenate(at),
        edge_normal_to_white_in_drawing=np.repeat(normals, points_per_edge, axis=0),
        printed_line_index_per_point=np.repeat([numbers[name] for name in names], points_per_edge),
        printed_line_position_sigma_half_sides=np.where(
            small, small_print_tolerance_cells, large_print_tolerance_cells
        )
        * cell,
        adjacent_cell_width_half_sides=cell,
        is_on_small_marker=small,
    )


@lru_cache(maxsize=8)
def make_drawing_texture(drawing: MarkerDrawing) -> DrawingTexture:
    """Return an image of the target on its white paper, rendered from `drawing`, the drawing of the
    large marker with the small one in it. The image is square and extends at least 1.25 half sides
    of the large marker (`ASSUMED_PAPER_HALF_WIDTH_LARGE_HALF_SIDES`) from the target's centre in x
    and y."""
    axis = make_sampling_grid(
        _DRAWING_TEXTURE_SIZE_PX, ASSUMED_PAPER_HALF_WIDTH_LARGE_HALF_SIDES
    ).node_positions_half_sides
    wide = render_cells(
        drawing, axis, ASSUMED_PAPER_HALF_WIDTH_LARGE_HALF_SIDES / _DRAWING_TEXTURE_SIZE_PX
    )
    more = (len(wide) - _DRAWING_TEXTURE_SIZE_PX) // 2
    scale = _DRAWING_TEXTURE_SIZE_PX / (2.0 * ASSUMED_PAPER_HALF_WIDTH_LARGE_HALF_SIDES)
    first = ASSUMED_PAPER_HALF_WIDTH_LARGE_HALF_SIDES * scale - 0.5 + more
    T = np.array([[scale, 0.0, first], [0.0, scale, first], [0.0, 0.0, 1.0]])
    return DrawingTexture(np.clip(wide, 0.0, 1.0), T)


class _CellEdge(NamedTuple):
    """An edge of one cell, between black and white.

    Attributes:
        points_half_sides: points (n, 2) along the edge, in half sides of the large marker from the
            target's centre (x right, y down on the paper).
        edge_normal_to_white_in_drawing: unit normal of the edge, x and y, from black to white.
        collinear_edges_key: key of the straight line on which the edge is: ratio of the marker's
            side to the large marker's, axis of the normal (0 = x, 1 = y), and index of the cell
            border.
        adjacent_cell_width_half_sides: width of a cell, in half sides of the large marker.
    """

    points_half_sides: Array
    edge_normal_to_white_in_drawing: tuple[float, float]
    collinear_edges_key: tuple[float, int, int]
    adjacent_cell_width_half_sides: float


def _iterate_cell_edges(
    cell_whiteness: Array, side_to_large_side_ratio: float, points_per_edge: int
) -> Iterator[_CellEdge]:
    """Yield the edges between black and white of a marker, one at a time: each side of a cell that
    has a black cell on one side of it and a white cell, or the white paper around the marker, on
    the other. `cell_whiteness` (n, n) is 1 for white cells and 0 for black ones, the border
    included. Each edge is given by `points_per_edge` points. The marker is at the target's centre,
    and its side is `side_to_large_side_ratio` times that of the large marker."""
    width = 2.0 * side_to_large_side_ratio / len(cell_whiteness)
    s = (
        _OUTLINE_POINT_MARGIN_AT_EDGE_ENDS_CELLS
        + (1.0 - 2.0 * _OUTLINE_POINT_MARGIN_AT_EDGE_ENDS_CELLS)
        * (np.arange(points_per_edge) + 0.5)
        / points_per_edge
    )
    for across in (0, 1):
        rows = cell_whiteness if across == 0 else cell_whiteness.T
        padded = np.pad(rows, 1, constant_values=1.0)[1:-1]
        step = padded[:, 1:] - padded[:, :-1]
        for i, j in np.argwhere(step != 0.0).tolist():
            at = np.empty((points_per_edge, 2))
            at[:, across] = width * j - side_to_large_side_ratio
            at[:, 1 - across] = width * (i + s) - side_to_large_side_ratio
            towards = float(np.sign(step[i, j]))
            normal = (towards, 0.0) if across == 0 else (0.0, towards)
            yield _CellEdge(at, normal, (side_to_large_side_ratio, across, j), width)


# --- Pose of the target from the edges in view ---
# Gauss-Newton iterations rotate and move the drawing until its edges match the edges in the image,
# which are located on profiles across them. The unknowns are those of a rigid body's pose: a part
# of a drawing does not determine the eight elements of a homography, and an unobserved tilt stays
# at its prediction. The unit of length is half the side of the large marker.


# Half lengths of the profiles in each iteration. An ascent blurs edges near the image's border by
# several pixels.
_PROFILE_HALF_LENGTH_PER_ITERATION_PX = (14.0, 10.0, 8.0, 8.0, 8.0, 8.0)
_MAX_PROFILE_HALF_LENGTH_CELLS, _MIN_PROFILE_HALF_LENGTH_PX = 0.4, 3.0
# A step below the first limit ends the fit. If the last step exceeds the second limit, the fit has
# failed.
_MAX_TRUNCATED_FIT_STEP_TO_COUNT_AS_CONVERGED_PX, _MAX_FINAL_STEP_TO_ACCEPT_FIT_PX = 0.02, 0.5
# Minimum contrast of an edge: in grey levels, and as a fraction of the median contrast.
_MIN_CONTRAST_TO_COUNT_AS_EDGE_GREY, _MIN_EDGE_TO_MEDIAN_CONTRAST_RATIO = 8.0, 0.35
_MIN_EDGE_POINTS_TO_FIT = 24
_TUKEY_CUTOFF_SIGMAS, _MIN_TUKEY_SCALE_PX = 3.5, 0.15
# Robust weights make the squared residuals smaller; this factor compensates for that.
_TUKEY_VARIANCE_CORRECTION_FACTOR = 1.3
# Error of a whole line, due to the lens and the illumination.
_SYSTEMATIC_LINE_OFFSET_SIGMA_PX = 0.02
# Standard deviations of the predicted pose.
(
    _TILT_PRIOR_SIGMA_RAD,
    _ROTATION_ABOUT_OPTICAL_AXIS_PRIOR_SIGMA_RAD,
    _TRANSLATION_PRIOR_SIGMA_HALF_SIDES,
) = (
    math.radians(2.0),
    math.radians(20.0),
    1.0,
)
_BLOOMING_EDGE_SHIFT_PRIOR_SIGMA_PX = 0.15  # standard deviation of the growth of white over black
_POSE_PRIOR_INFORMATION_DIAGONAL: Array = (
    np.array(
        [
            _TILT_PRIOR_SIGMA_RAD,
            _TILT_PRIOR_SIGMA_RAD,
            _ROTATION_ABOUT_OPTICAL_AXIS_PRIOR_SIGMA_RAD,
            *3 * [_TRANSLATION_PRIOR_SIGMA_HALF_SIDES],
            _BLOOMING_EDGE_SHIFT_PRIOR_SIGMA_PX,
        ]
    )
    ** -2.0
)


@dataclass(frozen=True, eq=False)
class RigidPose:
    """Pose of the drawing in the camera frame: rotation `R_cam_drawing` (3, 3), and translation
    `t_cam_drawing_half_sides` (3,) in half sides of the large marker. The drawing's origin is the
    target's centre; its axes are x right and y down on the paper, and z into the paper."""

    R_cam_drawing: Array
    t_cam_drawing_half_sides: Array

    @property
    def H_normalised_drawing(self) -> Array:
        """Homography (3, 3) from the drawing's coordinates, in half sides of the large marker from
        the target's centre, to normalised image coordinates."""
        return np.column_stack(
            [self.R_cam_drawing[:, 0], self.R_cam_drawing[:, 1], self.t_cam_drawing_half_sides]
        )


@dataclass(frozen=True, eq=False)
class PoseFit:
    """The pose of the target's drawing as fitted to its edges in the image, and the quality of the
    fit.

    Attributes:
        pose: the pose of the drawing in the camera frame.
        rotation_translation_cov_rad_half_sides: covariance (6, 6) of small rotations of the drawing
            about its centre (rad) and of its translation (half sides of the large marker), each
            along the camera's x, y, z.
        visible_edge_point_count: number of edge points of the drawing that are in the image and not
            hidden by the vehicle.
        found_edge_point_count: number of visible edge points at which the image has an edge that
            the robust fit did not reject as an outlier.
        found_small_marker_edge_point_count: number of these found points that are on the small
            marker.
        rms_residual_px: RMS distance of the edges in the image from the edges of the drawing,
            weighted and corrected for the effect of the robust weights; at least 0.03.
    """

    pose: RigidPose
    rotation_translation_cov_rad_half_sides: Array
    visible_edge_point_count: int
    found_edge_point_count: int
    found_small_marker_edge_point_count: int
    rms_residual_px: float


@dataclass(frozen=True, eq=False)
class _ProjectedEdgePoints:
    """The edge points of a target outline that are in the image and not hidden by the vehicle, as
    projected from a pose of the target.

    Attributes:
        points_px: points (n, 2) px in the distorted image.
        edge_normal_to_white_in_image: unit normals (n, 2) of the edges in the distorted image, from
            black to white.
        normal_motion_jacobian_wrt_pose_and_shift: derivative (n, 7) of each point's motion along
            its normal, px, with respect to the rotation of the drawing about its centre (rad) and
            its translation (half sides of the large marker), each along the camera's x, y, z, and
            to the growth of white over black at all edges (px).
        px_per_half_side: image scale (n,) across the edge at each point, in pixels per half side of
            the large marker.
        outline_point_index: index (n,) of each point in the arrays of the `TargetOutline`.
    """

    points_px: Array
    edge_normal_to_white_in_image: Array
    normal_motion_jacobian_wrt_pose_and_shift: Array
    px_per_half_side: Array
    outline_point_index: NDArray[np.intp]


class _GaussNewtonStep(NamedTuple):
    """A Gauss-Newton step for the rotation about the camera's axes (rad), the translation (half
    sides of the large marker) and the common shift of all edges (px, white over black).

    Attributes:
        pose_and_edge_shift_change: change (7,) of these unknowns.
        inverse_normal_matrix: inverse (7, 7) of the normal matrix, which includes the prior.
        robust_point_weight: robust weight (n,) of each edge point, 0 to 1; 0 for outliers and where
            no edge was found.
        point_residual_variance_px2: variance of the distance of one edge point from its edge.
    """

    pose_and_edge_shift_change: Array
    inverse_normal_matrix: Array
    robust_point_weight: Array
    point_residual_variance_px2: float


def fit_pose(
    image: NDArray[np.uint8],
    start: RigidPose,
    outline: TargetOutline,
    camera: CameraModel,
    hidden_mask_u8: NDArray[np.uint8] | None = None,
) -> PoseFit | None:
    """Fit the pose of the drawing in the camera frame by Gauss-Newton steps from `start`, so that
    the projected edges of `outline` match the edges in the distorted image (h, w). Edge points with
    a profile over pixels at which `hidden_mask_u8` (h, w) is not zero are not used. Both poses have
    their translation in half sides of the large marker.

    Returns None if fewer than 24 edge points (`_MIN_EDGE_POINTS_TO_FIT`) are in view or found, if
    the robust fit rejects too many of them, or if it does not converge. A result that is not None
    may still be unreliable: check it with `_is_pose_fit_reliable`.
    """
    pose, pose_and_edge_shift_change_from_start, fit_step, moved_px = (
        start,
        np.zeros(7),
        None,
        math.inf,
    )
    for max_profile_half_length_px in _PROFILE_HALF_LENGTH_PER_ITERATION_PX:
        edge_points = _project_edge_points_in_view(
            pose, outline, max_profile_half_length_px, image.shape, camera, hidden_mask_u8
        )
        if len(edge_points.outline_point_index) < _MIN_EDGE_POINTS_TO_FIT:
            return None
        reach_cells_px = (
            _MAX_PROFILE_HALF_LENGTH_CELLS
            * outline.adjacent_cell_width_half_sides[edge_points.outline_point_index]
            * edge_points.px_per_half_side
        )
        profile_half_lengths_px = np.minimum(max_profile_half_length_px, reach_cells_px)
        edge_offset_to_white_px, is_edge_found = _measure_edge_offsets(
            image, edge_points, profile_half_lengths_px
        )
        if np.count_nonzero(is_edge_found) < _MIN_EDGE_POINTS_TO_FIT:
            return None
        fit_step = _solve_gauss_newton_step(
            edge_points,
            edge_offset_to_white_px,
            is_edge_found,
            pose_and_edge_shift_change_from_start,
        )
        if fit_step is None:
            return None
        step = fit_step.pose_and_edge_shift_change[:6]
        turn = np.asarray(cv2.Rodrigues(step[:3])[0], dtype=np.float64)
        pose = RigidPose(turn @ pose.R_cam_drawing, pose.t_cam_drawing_half_sides + step[3:])
        pose_and_edge_shift_change_from_start[:6] += step
        moved_px = float(
            np.abs(edge_points.normal_motion_jacobian_wrt_pose_and_shift[:, :6] @ step).max()
        )
        if moved_px < _MAX_TRUNCATED_FIT_STEP_TO_COUNT_AS_CONVERGED_PX:
            break
    if fit_step is None or not (
        moved_px <= _MAX_FINAL_STEP_TO_ACCEPT_FIT_PX and pose.t_cam_drawing_half_sides[2] > 0.0
    ):  # also for NaN
        return None
    return _make_pose_fit(pose, fit_step, edge_points, outline)


def predict_fit_accuracy(
    pose: RigidPose, outline: TargetOutline, camera: CameraModel
) -> PoseFit | None:
    """Return the fit that an ideal image of the drawing at `pose` in the camera frame would yield,
    in which each visible edge point has its edge exactly where it is expected. No image is needed.
    Return None if fewer than 24 edge points (`_MIN_EDGE_POINTS_TO_FIT`) are in view.

    In the result, only the covariance and the point counts are meaningful. The covariance is
    optimistic because an RMS residual of only 0.03 px is assumed.
    """
    edge_points = _project_edge_points_in_view(
        pose, outline, _PROFILE_HALF_LENGTH_PER_ITERATION_PX[0], camera.size_px[::-1], camera, None
    )
    n = len(edge_points.outline_point_index)
    if n < _MIN_EDGE_POINTS_TO_FIT:
        return None
    fit_step = _solve_gauss_newton_step(
        edge_points, np.zeros(n), np.ones(n, dtype=np.bool_), np.zeros(7)
    )
    return None if fit_step is None else _make_pose_fit(pose, fit_step, edge_points, outline)


def _project_edge_points_in_view(
    pose: RigidPose,
    outline: TargetOutline,
    max_profile_half_length_px: float,
    image_shape: tuple[int, ...],
    camera: CameraModel,
    hidden_mask_u8: NDArray[np.uint8] | None,
) -> _ProjectedEdgePoints:
    h, w = image_shape[:2]
    X = (
        np.column_stack([outline.points_half_sides, np.zeros(len(outline.points_half_sides))])
        @ pose.R_cam_drawing.T
        + pose.t_cam_drawing_half_sides
    )
    ahead = X[:, 2] > 0.05
    x = X[:, :2] / np.where(ahead, X[:, 2], 1.0)[:, None]
    near = np.flatnonzero(
        ahead & (np.hypot(*x.T) < make_coarse_lattice(camera).valid_lens_radius_normalised)
    )
    at = distort_to_px(x[near], camera)
    room = max_profile_half_length_px + 1.0
    inside = ((at >= room) & (at <= np.array([w - 1.0, h - 1.0]) - room)).all(axis=1)
    near, at = near[inside], at[inside]
    X, x = X[near], x[near]
    # Derivative of the lens model, (n, 2, 2), by finite differences.
    small = 1e-4
    D = np.stack(
        [
            (distort_to_px(x + step, camera) - at) / small
            for step in (np.array([small, 0.0]), np.array([0.0, small]))
        ],
        axis=2,
    )
    # Derivative dx/dX (n, 2, 3) of a projected point x with respect to its position X in the camera
    # frame. Rotations are about the drawing's centre.
    P = np.zeros((len(x), 2, 3))
    P[:, 0, 0] = P[:, 1, 1] = 1.0 / X[:, 2]
    P[:, :, 2] = -x / X[:, 2:]
    A = D @ P
    across = outline.edge_normal_to_white_in_drawing[near]
    along = np.stack([-across[:, 1], across[:, 0]], axis=1)
    tangent = np.einsum("nij,nj->ni", A, along @ pose.R_cam_drawing[:, :2].T)
    towards = np.einsum("nij,nj->ni", A, across @ pose.R_cam_drawing[:, :2].T)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    normal /= np.maximum(np.hypot(*normal.T), 1e-12)[:, None]
    px = (normal * towards).sum(axis=1)
    normal *= np.sign(px)[:, None]
    move = np.einsum("ni,nij->nj", normal, A)
    turn = np.cross(X - pose.t_cam_drawing_half_sides, move)  # since (w x r)' m = w' (r x m)
    free = np.ones(len(near), dtype=np.bool_)
    if hidden_mask_u8 is not None:
        for fraction in (-1.0, -0.5, 0.0, 0.5, 1.0):
            x_px, y_px = (
                np.rint(at + fraction * max_profile_half_length_px * normal).astype(np.intp).T
            )
            free &= hidden_mask_u8[y_px, x_px] == 0
    J = np.concatenate([turn, move, -np.ones((len(near), 1))], axis=1)
    return _ProjectedEdgePoints(at[free], normal[free], J[free], np.abs(px)[free], near[free])


def _measure_edge_offsets(
    image: NDArray[np.uint8], edge_points: _ProjectedEdgePoints, profile_half_lengths_px: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return two values for each edge point: the distance (n,), px, of the edge in the image from
    its expected position along the point's normal, positive towards white; and whether an edge was
    found (n,). If it was not, the distance is meaningless.

    An edge is the windowed centroid of the grey gradient on a profile that extends
    `profile_half_lengths_px` (n,), but at least 3 px, to both sides of the expected position. It
    counts as found if its contrast is high enough. Distances are limited to the half length.
    """
    profile_half_lengths_px = np.maximum(profile_half_lengths_px, _MIN_PROFILE_HALF_LENGTH_PX)
    grey = sample_profiles(
        image,
        edge_points.points_px[:, None],
        edge_points.edge_normal_to_white_in_image[:, None],
        profile_half_lengths_px,
    )[:, 0]
    gradient = np.diff(grey, axis=1).astype(np.float64)
    u = profile_half_lengths_px[:, None] * GRADIENT_POSITIONS_ALONG_PROFILE_HALF_LENGTHS.astype(
        np.float64
    )
    mass = gradient * np.exp(-0.5 * (u / (0.5 * profile_half_lengths_px[:, None])) ** 2)
    total = mass.sum(axis=1)
    contrast = grey[:, -1].astype(np.float64) - grey[:, 0]
    least = max(
        _MIN_CONTRAST_TO_COUNT_AS_EDGE_GREY,
        _MIN_EDGE_TO_MEDIAN_CONTRAST_RATIO * float(np.median(contrast)),
    )
    is_edge_found = (contrast > least) & (total > 0.25 * least)
    edge_offset_to_white_px = (mass * u).sum(axis=1) / np.where(is_edge_found, total, 1.0)
    return np.clip(
        edge_offset_to_white_px, -profile_half_lengths_px, profile_half_lengths_px
    ), is_edge_found


def _solve_gauss_newton_step(
    edge_points: _ProjectedEdgePoints,
    edge_offset_to_white_px: Array,
    is_edge_found: NDArray[np.bool_],
    pose_and_edge_shift_change_from_start: Array,
) -> _GaussNewtonStep | None:
    """Return one Gauss-Newton step, with robust (Tukey) weights, for the target's pose and the
    growth of white over black at all edges (the edge shift); None if the sum of the weights is
    below 12. `edge_offset_to_white_px` and `is_edge_found`, (n,), are the results of
    `_measure_edge_offsets`.

    `pose_and_edge_shift_change_from_start` (7,) is the sum of the previous steps: rotation (rad)
    and translation (half sides of the large marker). The prior pulls the sum of all steps towards
    zero. The last element is always 0 because every step estimates the whole edge shift (px) anew.
    """
    J, weight = (
        edge_points.normal_motion_jacobian_wrt_pose_and_shift,
        is_edge_found.astype(np.float64),
    )
    variance, step = 1.0, np.zeros(7)
    for _ in range(4):
        error = edge_offset_to_white_px - J @ step
        size = np.abs(error)
        scale = max(1.4826 * float(np.median(size[is_edge_found])), _MIN_TUKEY_SCALE_PX)
        weight = (
            np.maximum(1.0 - (size / (_TUKEY_CUTOFF_SIGMAS * scale)) ** 2, 0.0) ** 2 * is_edge_found
        )
        mass = float(weight.sum())
        if mass < 0.5 * _MIN_EDGE_POINTS_TO_FIT:
            return None
        variance = max(_TUKEY_VARIANCE_CORRECTION_FACTOR * float(weight @ error**2) / mass, 1e-3)
        N = (J * weight[:, None]).T @ J / variance + np.diag(_POSE_PRIOR_INFORMATION_DIAGONAL)
        inverse = np.asarray(np.linalg.inv(N), np.float64)
        step = inverse @ (
            J.T @ (weight * edge_offset_to_white_px) / variance
            - _POSE_PRIOR_INFORMATION_DIAGONAL * pose_and_edge_shift_change_from_start
        )
    return _GaussNewtonStep(step, inverse, weight, variance)


def _make_pose_fit(
    pose: RigidPose,
    fit_step: _GaussNewtonStep,
    edge_points: _ProjectedEdgePoints,
    outline: TargetOutline,
) -> PoseFit:
    J, (_, inverse, w, variance) = edge_points.normal_motion_jacobian_wrt_pose_and_shift, fit_step
    line = outline.printed_line_index_per_point[edge_points.outline_point_index]
    common_px = np.hypot(
        outline.printed_line_position_sigma_half_sides[edge_points.outline_point_index]
        * edge_points.px_per_half_side,
        _SYSTEMATIC_LINE_OFFSET_SIGMA_PX,
    )
    by_line = np.zeros((int(line.max()) + 1, J.shape[1]))
    np.add.at(by_line, line, J * (w * common_px)[:, None])
    middle = variance * (J * (w**2)[:, None]).T @ J + by_line.T @ by_line
    cov = inverse @ (middle / variance**2 + np.diag(_POSE_PRIOR_INFORMATION_DIAGONAL)) @ inverse
    shown = w > 0.0
    return PoseFit(
        pose=pose,
        rotation_translation_cov_rad_half_sides=cov[:6, :6],
        visible_edge_point_count=len(shown),
        found_edge_point_count=int(np.count_nonzero(shown)),
        found_small_marker_edge_point_count=int(
            np.count_nonzero(shown & outline.is_on_small_marker[edge_points.outline_point_index])
        ),
        rms_residual_px=math.sqrt(variance),
    )
