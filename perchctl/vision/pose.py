"""Compute the target's pose relative to the gear from the corners of its markers.

For a planar marker, two tilts produce nearly identical images. Since the target is horizontal, the
vehicle's roll and pitch decide between the two. If they are unknown, the tilt in the previous frame
decides. The position is also rotated to the level frame with the vehicle's roll and pitch, never
with the marker's own axes: at 1.15 m, the error is 0.5 mm instead of 40 mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np

from perchctl.geometry import R_MARKER_TARGET, Array, is_finite, yaw_of
from perchctl.profile import PoseConfig, TargetConfig
from perchctl.values import cached_property, replace
from perchctl.vision.lens import undistort_px
from perchctl.vision.types import CameraModel, Detection, MarkerPose, VehicleState

# Combined error of the mounting, the attitude estimate and the ceiling.
_TILT_PRIOR_SIGMA_FROM_ATTITUDE_RAD = math.radians(6.0)
# Change of the tilt between two frames.
_TILT_PRIOR_SIGMA_FROM_PREVIOUS_POSE_RAD = math.radians(10.0)
# If the corners of both markers on a flat sheet have a larger chi-squared per degree of freedom,
# the sheet may be curled.
_MIN_CHI2_PER_DOF_TO_TRY_SHEET_CURL = 3.0
# If curl is the cause, at most this fraction of chi-squared remains after allowing for it.
_MAX_CURLED_TO_FLAT_CHI2_RATIO_TO_ACCEPT_CURL = 0.5
_PoseSource = Literal["large", "small", "joint"]


@dataclass(frozen=True, eq=False)
class PoseSetup:
    """Parameters of pose estimation. `T_body_cam` (4, 4) is the camera mounting, the pose of the
    camera in body axes, `gear_body_m` (3,) the position of the gear's tip in body axes, and
    `rolling_shutter_readout_s` the rolling-shutter readout time from the first to the last image
    row (None if unknown)."""

    config: PoseConfig
    target: TargetConfig
    T_body_cam: Array
    gear_body_m: Array
    camera: CameraModel
    rolling_shutter_readout_s: float | None = 0.0

    @cached_property
    def marker_corners_m(self) -> dict[_PoseSource, Array]:
        """Corners (4, 3) of each marker, m, in its own axes: x right and y up on the paper, z out
        of it. The order is top left, top right, bottom right, bottom left. ``joint`` (8, 3)
        contains the corners of the large marker, then those of the small one."""
        large, small = (square_corners(m.side_m) for m in (self.target.large, self.target.small))
        return {"large": large, "small": small, "joint": np.concatenate([large, small])}

    @cached_property
    def corner_lift_per_sheet_curl_sigma_m(self) -> dict[_PoseSource, Array]:
        """Height of each corner above the flat sheet, m, for one standard deviation of the sheet's
        curl: (8, 2), or (16, 2) for ``joint``. The columns are the two modes of
        `corner_lift_by_sheet_curl`. Each corner has two equal rows, one for its x and one for its y
        in the image."""
        curl = self.target.curl_per_m
        return {
            source: corner_lift_by_sheet_curl(corners, curl)
            for source, corners in self.marker_corners_m.items()
        }


def square_corners(side_m: float) -> Array:
    """Return the corners, (4, 3) m, of a marker with the side `side_m` in its own axes (x right and
    y up on the paper, z = 0), in the order top left, top right, bottom right, bottom left."""
    h = side_m / 2.0
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def R_level_body_of(attitude: VehicleState | None) -> Array:
    """Return the rotation (3, 3) from body to level axes for an attitude, given by its roll and
    pitch. If the attitude is None, the vehicle is assumed to be level."""
    return np.eye(3) if attitude is None else attitude.R_level_body


def estimate_pose(
    detections: Sequence[Detection],
    t_s: float,
    attitude: VehicleState | None,
    setup: PoseSetup,
    previous_target_normal_cam: Array | None = None,
    start: PoseCandidate | None = None,
) -> MarkerPose | None:
    """Estimate the target's pose from the corners of one marker, or of both markers jointly.

    A planar marker allows two tilts (pose ambiguity). If a `start` pose in the camera frame is
    given, it is only refined and keeps its tilt, unless the refinement fails or contradicts the
    expected tilt. Otherwise the vehicle's roll and pitch resolve the ambiguity, because the target
    is horizontal. Without an attitude, the tilt with the normal closer to
    `previous_target_normal_cam` (3,), the target's last unit normal (out of the paper) in camera
    axes, is chosen. Returns None if the corners yield no pose, because there is no finite solution
    in front of the camera, or because the reprojection error (RMS over the corners) is above
    `pose.max_reprojection_px`.

    If the corners of both markers do not fit a flat sheet, and the pose of a curled sheet reduces
    chi-squared to less than half, the pose of the curled sheet is returned, with the larger
    chi-squared of the flat one.
    """
    source: _PoseSource = "joint" if len(detections) > 1 else detections[0].marker
    image_points_px = undistort_px(np.concatenate([d.corners_px for d in detections]), setup.camera)
    if not is_finite(image_points_px):
        return None  # the lens model has no solution for these corners
    K, lift = setup.camera.K, setup.corner_lift_per_sheet_curl_sigma_m[source]
    points = compute_corner_weights(
        detections, setup.marker_corners_m[source], image_points_px, K, lift
    )
    R_level_body = R_level_body_of(attitude)
    if attitude is not None:
        R_level_cam = R_level_body.dot(setup.T_body_cam[:3, :3])
        prior = TiltPrior(-R_level_cam[2], _TILT_PRIOR_SIGMA_FROM_ATTITUDE_RAD)
    else:
        prior = TiltPrior(previous_target_normal_cam, _TILT_PRIOR_SIGMA_FROM_PREVIOUS_POSE_RAD)
    max_rms_reprojection_px = setup.config.max_reprojection_px
    solution = _refine_from_start(points, start, prior, max_rms_reprojection_px) or solve_pose(
        points, prior
    )
    if solution is None or not solution.rms_reprojection_px <= max_rms_reprojection_px:
        return None
    pose = _make_marker_pose(source, t_s, solution, points, R_level_body, setup)
    if (
        source != "joint"
        or pose.chi2_per_dof < _MIN_CHI2_PER_DOF_TO_TRY_SHEET_CURL
        or setup.target.curl_per_m == 0.0
    ):
        return pose
    if any(d.horizontal_side_deinterlacing_sigma_px > 0.0 for d in detections):
        return pose  # Interpolated rows make the sides look curled.
    # No flat sheet explains the positions of both markers. Either the sheet is curled, or the
    # corners are wrong.
    points = replace(points, allows_for_sheet_curl=True)
    settled = _refine_from_start(points, solution, prior, max_rms_reprojection_px)
    if settled is None:
        return pose
    bent = _make_marker_pose(source, t_s, settled, points, R_level_body, setup)
    return (
        replace(bent, chi2_per_dof=pose.chi2_per_dof)
        if bent.chi2_per_dof < _MAX_CURLED_TO_FLAT_CHI2_RATIO_TO_ACCEPT_CURL * pose.chi2_per_dof
        else pose
    )


def _refine_from_start(
    points: WeightedCorners,
    start: PoseCandidate | None,
    prior: TiltPrior,
    max_rms_reprojection_px: float,
) -> ScoredPose | None:
    """Refine the pose `start` to match the corners `points` (`refine_pose`). Returns None if there
    is no start, if the refinement fails, if the RMS reprojection error exceeds
    `max_rms_reprojection_px`, or if the tilt contradicts `prior`."""
    solution = None if start is None else refine_pose(points, start)
    if (
        solution is None
        or not solution.rms_reprojection_px <= max_rms_reprojection_px
        or prior.contradicts(solution)
    ):
        return None
    return solution


def _make_marker_pose(
    source: _PoseSource,
    t_s: float,
    solution: ScoredPose,
    points: WeightedCorners,
    R_level_body: Array,
    setup: PoseSetup,
) -> MarkerPose:
    R_body_cam, t_body_cam_m = setup.T_body_cam[:3, :3], setup.T_body_cam[:3, 3]
    R_level_cam = R_level_body.dot(R_body_cam)
    R, dR_drvec = (np.asarray(m, dtype=np.float64) for m in cv2.Rodrigues(solution.rvec_rad))
    cov, chi2, curl = pose_covariance(points, solution)
    e_m = R_level_body.dot(R_body_cam.dot(solution.tvec_m) + t_body_cam_m - setup.gear_body_m)
    R_level_target = R_level_cam.dot(R).dot(R_MARKER_TARGET)
    G = np.zeros((4, 6))  # derivative of (e, e_yaw) with respect to (rvec, tvec)
    G[:3, 3:] = R_level_cam
    G[3, :3] = _yaw_gradient_wrt_rvec(R_level_cam, R_level_target, dR_drvec)
    cov_e = G.dot(cov).dot(G.T)
    # If the print is larger by some percentage, the target is actually further away by the same
    # percentage.
    print_cam = np.array([setup.target.size_sigma * solution.tvec_m, curl[3:]])
    print_shift_m = R_level_cam.dot(print_cam.T)
    cov_e[:3, :3] += print_shift_m.dot(print_shift_m.T)
    sigma = np.sqrt(np.maximum(cov_e.diagonal(), 0.0))
    return MarkerPose(
        source=source,
        t_s=t_s,
        rvec_rad=solution.rvec_rad,
        tvec_m=solution.tvec_m,
        e_m=e_m,
        e_yaw_rad=yaw_of(R_level_target),
        sigma_m=sigma[:3],
        sigma_yaw_rad=float(sigma[3]),
        rms_reprojection_px=solution.rms_reprojection_px,
        chi2_per_dof=chi2,
        level_frame_xyz_yaw_cov=cov_e,
        position_shift_per_print_error_sigma_m=print_shift_m,
        rvec_tvec_cov=cov,
    )


def target_rotation_translation_cov_cam(pose: MarkerPose) -> Array:
    """Return the covariance (6, 6) of the target's pose in the camera frame, for small rotations
    (rad) about, and translations (m) along, the camera's x, y and z axes. Print errors are not
    included."""
    assert pose.rvec_tvec_cov is not None
    R, dR_drvec = (np.asarray(m, dtype=np.float64) for m in cv2.Rodrigues(pose.rvec_rad))
    # one skew-symmetric matrix for each component of the rotation vector
    turns = dR_drvec.reshape(3, 3, 3) @ R.T
    J = np.eye(6)
    J[:3, :3] = turns[:, (2, 0, 1), (1, 2, 0)].T
    return np.asarray(J @ pose.rvec_tvec_cov @ J.T)


def rotation_matrix(rvec: Array) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector (3,), rad."""
    return np.asarray(cv2.Rodrigues(rvec)[0], dtype=np.float64)


def rotation_vector(R: Array) -> Array:
    """Return the rotation vector (3,), rad, of a rotation matrix (3, 3)."""
    return np.asarray(cv2.Rodrigues(R)[0], dtype=np.float64).ravel()


def target_normal_cam(pose: MarkerPose) -> Array:
    """Return the target's unit normal (3,) in camera axes. It is the marker's z axis, which points
    out of the paper."""
    return np.asarray(cv2.Rodrigues(pose.rvec_rad)[0][:, 2])


def _yaw_gradient_wrt_rvec(R_level_cam: Array, R_level_target: Array, dR_drvec: Array) -> Array:
    """Return the gradient (3,) of the target's yaw in the level frame with respect to the rotation
    vector. The yaw is atan2(R[1, 0], R[0, 0]) with R = `R_level_target` (3, 3). `R_level_cam` (3,
    3) rotates from camera to level axes. `dR_drvec` (3, 9) is the derivative of the rotation matrix
    from marker to camera axes, row by row, with respect to the rotation vector, rad."""
    # derivative of the target's x axis: rows for the components of rvec, columns for the level axes
    dx = dR_drvec.reshape(3, 3, 3)[:, :, 0].dot(R_level_cam.T)
    hx, hy = float(R_level_target[0, 0]), float(R_level_target[1, 0])
    return np.asarray((hx * dx[:, 1] - hy * dx[:, 0]) / max(hx * hx + hy * hy, 1e-12))


# --- Rotation and translation from corners: a closed form, then weighted least squares ---


_MIN_ANGLE_TO_COUNT_AS_DISTINCT_POSES_RAD = math.radians(
    2.0
)  # Two solutions that are closer together count as one.
_MIN_CORNER_SIGMA_IN_POSE_COST_PX = 0.05  # Lens and print errors make smaller values meaningless.
_MAX_GAUSS_NEWTON_STEPS = 8
# Weight of the standard deviation in the detections relative to the residuals, in degrees of
# freedom.
_CORNER_SIGMA_PRIOR_DOF = 8.0

# A step is small enough for the errors to be linear if it reduces the cost by less than the first
# value and changes each element of the pose, in rad or m, by less than the second one.
_MAX_COST_REDUCTION_OF_LINEAR_STEP, _MAX_POSE_CHANGE_OF_LINEAR_STEP_RAD_OR_M = 1.0, 0.005
# A larger reduction is also allowed if no corner moves further than this. The nonlinearity is about
# the squared motion divided by the distance between corners, which is 20 px or more.
_MAX_CORNER_MOTION_OF_LINEAR_STEP_PX = 0.3


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """A possible pose of the marker in the camera frame: rotation vector `rvec_rad` (3,) and
    translation `tvec_m` (3,)."""

    rvec_rad: Array
    tvec_m: Array


@dataclass(frozen=True, eq=False)
class ScoredPose(PoseCandidate):
    """A pose candidate with its reprojection errors (n, 2), px in the image of a pinhole camera,
    projected minus measured, and their Jacobian (2n, 6) with respect to rvec and tvec."""

    reprojection_error_px: Array
    reprojection_jacobian: Array

    @property
    def rms_reprojection_px(self) -> float:
        """RMS distance between projected and measured corners, px."""
        flat = self.reprojection_error_px.ravel()
        return math.sqrt(float(flat.dot(flat)) / len(self.reprojection_error_px))


@dataclass(frozen=True, eq=False)
class TiltPrior:
    """Expected direction of the target's unit normal (out of the paper) in camera axes, (3,), None
    if unknown, and the standard deviation `sigma_rad` of the angle between the actual and the
    expected normal."""

    target_normal_cam: Array | None
    sigma_rad: float

    def contradicts(self, candidate: PoseCandidate) -> bool:
        """True if the candidate's normal differs from a known `target_normal_cam` by more than
        `sigma_rad`."""
        return (
            self.target_normal_cam is not None
            and angle_to_expected_normal_rad(candidate.rvec_rad, self.target_normal_cam)
            > self.sigma_rad
        )


def solve_pose(points: WeightedCorners, prior: TiltPrior) -> ScoredPose | None:
    """Return the more likely of the two possible poses of a planar marker; None if neither pose is
    finite and in front of the camera.

    The poses come from a closed form (SQPNP) and, if the expected normal in `prior` is unknown or
    contradicts them, from mirroring the tilt about the line of sight. The pose with the smallest
    sum of squared errors is chosen: reprojection errors and the deviation from the expected normal,
    each divided by its standard deviation. It is then refined by weighted least squares
    (`refine_pose`).
    """
    candidates = [_refine_unweighted(points, c) for c in _solve_closed_form(points)]
    scored = [_score_candidate(c, points) for c in candidates if _is_valid_candidate(c)]
    if not scored:
        return None
    best = _choose_most_likely_pose(scored, points, prior)
    if prior.target_normal_cam is None or prior.contradicts(best):
        best = _choose_most_likely_pose(
            [best, *_find_flipped_candidates(best, points)], points, prior
        )
    # The unweighted optimum is close enough to the weighted one for the errors to be linear.
    return refine_pose(points, best) or best


def refine_pose(points: WeightedCorners, start: PoseCandidate) -> ScoredPose | None:
    """Refine the pose `start`, which must be close to the solution, by Gauss-Newton steps. They
    minimise the sum of the squared reprojection errors after `points.whitening_matrix` has made
    these independent with unit variance; if `points.allows_for_sheet_curl` is True, errors that
    curl would cause have less weight. Returns None if the steps do not converge, if the corners do
    not determine the pose, or if a step moves the marker behind the camera."""
    candidate: PoseCandidate = start
    before = math.inf
    W = points.whitening_matrix
    for _ in range(_MAX_GAUSS_NEWTON_STEPS):
        scored = _score_candidate(candidate, points)
        A, error = W.dot(scored.reprojection_jacobian), W.dot(scored.reprojection_error_px.ravel())
        B, weighed = A, error
        if points.allows_for_sheet_curl:
            weight = sheet_curl_weight_matrix(_whitened_shift_per_sheet_curl_sigma(points, scored))
            B, weighed = weight @ A, weight @ error
        cost = float(error.dot(weighed))
        if cost > before * (1.0 + 1e-6) + 1e-9 or not math.isfinite(cost):
            return None
        g = B.T.dot(error)
        # OpenCV's solver is three times as fast as numpy's for matrices of this size.
        regular, solved = cv2.solve(B.T.dot(A), g[:, None], flags=cv2.DECOMP_CHOLESKY)
        if not regular:
            return None
        step = solved[:, 0]
        # Reduction of the cost by this step, in squared standard deviations.
        gain = float(step.dot(g))
        moved_px = scored.reprojection_jacobian.dot(step).reshape(-1, 2)
        small = (
            gain < _MAX_COST_REDUCTION_OF_LINEAR_STEP
            or float(np.abs(moved_px).max()) < _MAX_CORNER_MOTION_OF_LINEAR_STEP_PX
        )
        if small and max(map(abs, step.tolist())) < _MAX_POSE_CHANGE_OF_LINEAR_STEP_RAD_OR_M:
            # The errors are linear for a step of this size.
            reprojection_error_px = scored.reprojection_error_px - moved_px
            rvec, tvec = scored.rvec_rad - step[:3], scored.tvec_m - step[3:]
            return ScoredPose(rvec, tvec, reprojection_error_px, scored.reprojection_jacobian)
        if gain < 1e-4 + 1e-6 * cost:
            return scored
        candidate, before = (
            PoseCandidate(candidate.rvec_rad - step[:3], candidate.tvec_m - step[3:]),
            cost,
        )
        if not _is_valid_candidate(candidate):
            return None
    return None


class PoseCovariance(NamedTuple):
    """Covariance (6, 6) of (rvec, tvec), chi-squared of the corners per degree of freedom, and the
    shift (6,) of (rvec, tvec), rad and m, that one standard deviation of a bowl-shaped curl of the
    sheet causes."""

    rvec_tvec_cov: Array
    chi2_per_dof: float
    rvec_tvec_shift_per_sheet_curl_sigma: Array


def pose_covariance(points: WeightedCorners, scored: ScoredPose) -> PoseCovariance:
    """Return the covariance of a pose, the chi-squared of its corners, and the effect of the
    sheet's curl, from the weighted least-squares problem linearised at the pose.

    The covariance includes corner noise, scaled by how well the residuals agree with it, and shifts
    common to several corners. If `points.allows_for_sheet_curl` is True, it also includes the
    saddle-shaped curl of the sheet. The bowl-shaped curl is never included, but returned
    separately. Covariance and chi-squared are infinite if the corners do not determine the pose.
    """
    W = points.whitening_matrix
    A, error = W.dot(scored.reprojection_jacobian), W.dot(scored.reprojection_error_px.ravel())
    freedom = len(error) - 6
    curl = _whitened_shift_per_sheet_curl_sigma(points, scored)
    weight = sheet_curl_weight_matrix(curl) if points.allows_for_sheet_curl else None
    B, weighed = (A, error) if weight is None else (weight @ A, weight @ error)
    regular, inverse = cv2.invert(B.T.dot(A), flags=cv2.DECOMP_CHOLESKY)
    if not regular:
        return PoseCovariance(np.full((6, 6), np.inf), math.inf, np.zeros(6))
    gain = inverse.dot(B.T)
    chi2 = float(error.dot(weighed))
    growth = max((_CORNER_SIGMA_PRIOR_DOF + chi2) / (_CORNER_SIGMA_PRIOR_DOF + freedom), 0.7)
    common = gain.dot(points.whitened_corner_shift_per_common_error_sigma)
    noise = inverse if weight is None else gain @ gain.T
    cov = noise * growth + common.dot(common.T)
    curled, twisted = gain.dot(curl).T
    if weight is not None:
        cov += np.multiply.outer(twisted, twisted)
    return PoseCovariance(cov, chi2 / freedom, curled)


def _whitened_shift_per_sheet_curl_sigma(points: WeightedCorners, scored: ScoredPose) -> Array:
    """Return the shift (2n, 2) of the whitened reprojection errors of `points` at the pose `scored`
    for one standard deviation of each mode of the sheet's curl (`corner_lift_by_sheet_curl`). If
    curl lifts a corner off the sheet's plane, its image moves as if the whole target moved along
    its normal."""
    target_normal_cam = rotation_matrix(scored.rvec_rad)[:, 2]
    moved = (
        scored.reprojection_jacobian[:, 3:].dot(target_normal_cam)[:, None]
        * points.corner_lift_per_sheet_curl_sigma_m
    )
    return np.asarray(points.whitening_matrix.dot(moved))


def angle_to_expected_normal_rad(rvec: Array, expected_normal_cam: Array) -> float:
    """Return the angle, rad, between the unit vector `expected_normal_cam` (3,) and the normal (out
    of the paper), both in camera axes, of a marker with the rotation vector `rvec` (3,), rad."""
    normal = rotation_matrix(rvec)[:, 2]
    return math.acos(max(-1.0, min(1.0, float(normal @ expected_normal_cam))))


def _solve_closed_form(points: WeightedCorners) -> list[PoseCandidate]:
    """Return the poses from OpenCV's SQPNP solver that are finite and in front of the camera. The
    list is empty if there are none or if the solver fails, for example for collinear corners."""
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
            points.object_points_m, points.image_points_px, points.K, None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return []
    solutions = zip(rvecs, tvecs, strict=True)
    candidates = [PoseCandidate(np.ravel(r), np.ravel(t)) for r, t in solutions]
    return [candidate for candidate in candidates if _is_valid_candidate(candidate)]


def _is_valid_candidate(candidate: PoseCandidate) -> bool:
    rvec, tvec = candidate.rvec_rad, candidate.tvec_m
    return bool(is_finite(rvec) and is_finite(tvec) and tvec[2] > 0.0)


def _refine_unweighted(points: WeightedCorners, start: PoseCandidate) -> PoseCandidate:
    first = start.rvec_rad.reshape(3, 1).copy(), start.tvec_m.reshape(3, 1).copy()
    try:
        rvec, tvec = cv2.solvePnPRefineLM(
            points.object_points_m, points.image_points_px, points.K, None, *first
        )
    except cv2.error:
        return start
    return PoseCandidate(np.ravel(rvec), np.ravel(tvec))


def _score_candidate(candidate: PoseCandidate, points: WeightedCorners) -> ScoredPose:
    rvec, tvec = candidate.rvec_rad, candidate.tvec_m
    projected, reprojection_jacobian = cv2.projectPoints(
        points.object_points_m, rvec, tvec, points.K, None
    )
    error: Array = projected.reshape(-1, 2) - points.image_points_px
    return ScoredPose(rvec, tvec, error, np.asarray(reprojection_jacobian[:, :6], dtype=np.float64))


def _find_flipped_candidates(scored: ScoredPose, points: WeightedCorners) -> list[ScoredPose]:
    """Return the second solution of a planar marker, refined from a candidate whose normal is
    mirrored about the line of sight. The list has at most one pose. It is empty if both normals are
    nearly the same or if the second solution is not finite and in front of the camera."""
    R = rotation_matrix(scored.rvec_rad)
    normal, sight = R[:, 2], scored.tvec_m / np.linalg.norm(scored.tvec_m)
    other = 2.0 * float(normal @ sight) * sight - normal
    axis = np.cross(normal, other)
    sine, cosine = float(np.linalg.norm(axis)), float(normal @ other)
    angle = math.atan2(sine, cosine)
    if angle < _MIN_ANGLE_TO_COUNT_AS_DISTINCT_POSES_RAD or sine < 1e-9:
        return []
    rvec = rotation_vector(rotation_matrix(axis / sine * angle) @ R)
    turned = _refine_unweighted(points, PoseCandidate(rvec, scored.tvec_m))
    return [_score_candidate(turned, points)] if _is_valid_candidate(turned) else []


def _choose_most_likely_pose(
    scored: list[ScoredPose], points: WeightedCorners, prior: TiltPrior
) -> ScoredPose:
    if len(scored) == 1:
        return scored[0]
    sigma = np.maximum(points.sigma_px, _MIN_CORNER_SIGMA_IN_POSE_COST_PX)[:, None]

    def cost(s: ScoredPose) -> float:
        total = float(((s.reprojection_error_px / sigma) ** 2).sum())
        if prior.target_normal_cam is not None:
            total += (
                angle_to_expected_normal_rad(s.rvec_rad, prior.target_normal_cam) / prior.sigma_rad
            ) ** 2
        return total

    return min(scored, key=cost)


# --- A sheet that is not flat: effect of its curl on corners, and their weights ---


def corner_lift_by_sheet_curl(object_points_m: Array, sheet_curl_sigma_per_m: float) -> Array:
    """Return how far, m, one standard deviation of the sheet's curl lifts the corners out of the
    flat sheet, along its normal. The result has the shape (2n, 2). Its columns are two modes of
    curl: a bowl, which lifts all corners to the same side, and a saddle, which lifts neighbouring
    corners to opposite sides. Each corner has two equal rows, one for x and one for y in the image.

    `object_points_m` (n, 3) are the corners in the marker's axes. `sheet_curl_sigma_per_m` is the
    standard deviation of the lift divided by the squared distance from the sheet's centre, 1/m.
    """
    x, y = object_points_m[:, 0], object_points_m[:, 1]
    lift: Array = sheet_curl_sigma_per_m * np.stack([x * x + y * y, math.sqrt(2.0) * x * y], axis=1)
    return lift.repeat(2, axis=0)


def sheet_curl_weight_matrix(whitened_shift_per_sheet_curl_sigma: Array) -> Array:
    """Return the weight matrix ``(I + C C^T)^-1`` (2n, 2n) of the whitened reprojection errors of n
    corners on a curled sheet. C is `whitened_shift_per_sheet_curl_sigma` (2n, k): each column is
    the shift of these errors for one standard deviation of one mode of curl. The matrix is the
    inverse of the errors' covariance: unit noise plus the shifts due to curl."""
    inner = np.linalg.inv(
        np.eye(whitened_shift_per_sheet_curl_sigma.shape[1])
        + whitened_shift_per_sheet_curl_sigma.T @ whitened_shift_per_sheet_curl_sigma
    )
    weight: Array = (
        np.eye(len(whitened_shift_per_sheet_curl_sigma))
        - whitened_shift_per_sheet_curl_sigma @ inner @ whitened_shift_per_sheet_curl_sigma.T
    )
    return weight


# --- Weights of the corners in the pose solution ---
# A fitted line has errors of offset and tilt, and moves the corners at both of its ends. The errors
# of these two corners across the line have the variance s^2 and a correlation of -1/2. Half their
# sum (the line's offset) therefore has the standard deviation s/2, and half their difference (its
# tilt) has s sqrt(3)/2: `whitening_matrix` transforms the corner errors to these independent ones.
# A shift of all edges (clipped white, ink) is only part of the covariance: if it were part of the
# fit, the errors of small markers would corrupt the result.


_IDENTITY_8 = np.eye(8)
_LINE_TILT_TO_OFFSET_WHITENING_RATIO = np.array(1.0 / math.sqrt(3.0))
_PREVIOUS_CORNER_INDICES = np.array([3, 0, 1, 2])
# Side k runs from corner k to corner k + 1.
_SIDE_START_CORNER_INDICES = np.arange(4)
_SIDE_END_CORNER_INDICES = np.array([1, 2, 3, 0])
_SIDE_WHITENING_MATRIX_ROW_INDICES = np.concatenate(
    [2 * np.tile(_SIDE_START_CORNER_INDICES, 4), 2 * np.tile(_SIDE_START_CORNER_INDICES, 4) + 1]
)
_SIDE_WHITENING_MATRIX_COLUMN_INDICES = np.concatenate(
    [
        2 * _SIDE_START_CORNER_INDICES,
        2 * _SIDE_START_CORNER_INDICES + 1,
        2 * _SIDE_END_CORNER_INDICES,
        2 * _SIDE_END_CORNER_INDICES + 1,
    ]
    * 2
)
# Indices into a flattened (8, 8) matrix.
_SIDE_WHITENING_FLAT_INDICES = (
    8 * _SIDE_WHITENING_MATRIX_ROW_INDICES + _SIDE_WHITENING_MATRIX_COLUMN_INDICES
)


@dataclass(frozen=True, eq=False)
class WeightedCorners:
    """Corners with the weights of their reprojection errors.

    Attributes:
        object_points_m, image_points_px: corners (n, 3) in the marker's axes, and (n, 2) in the
            image of a pinhole camera `K` (3, 3).
        sigma_px: standard deviations (n,) of the corners.
        whitening_matrix: matrix (2n, 2n) that transforms the errors of the corners to independent
            errors with unit variance.
        whitened_corner_shift_per_common_error_sigma: whitened shift of the corners for one standard
            deviation of each error that is common to several corners, one column per error (2n, k).
            These errors are the remaining shift of all black-white edges (blooming, gamma), the
            error of the rolling-shutter readout time (`corner_shift_per_readout_time_sigma_px` of
            the detections), and the horizontal jitter of image rows in each detection, which has
            two columns.
        corner_lift_per_sheet_curl_sigma_m: result (2n, 2) of `corner_lift_by_sheet_curl`.
        allows_for_sheet_curl: True if the sheet may be curled, which reduces the weight of corners
            that curl would move; False if the sheet is assumed to be flat.
    """

    object_points_m: Array
    image_points_px: Array
    sigma_px: Array
    whitening_matrix: Array
    whitened_corner_shift_per_common_error_sigma: Array
    K: Array
    corner_lift_per_sheet_curl_sigma_m: Array
    allows_for_sheet_curl: bool = False


def compute_corner_weights(
    detections: Sequence[Detection],
    object_points_m: Array,
    image_points_px: Array,
    K: Array,
    corner_lift_per_sheet_curl_sigma_m: Array,
) -> WeightedCorners:
    """Return the corners of the detections with their weights. The weights follow from how a
    marker's corners were measured: from their covariance `cov_px2` if there is one, from the errors
    of four fitted lines, or otherwise from independent errors with `sigma_px`.

    `object_points_m` (n, 3) are the corners in the marker's axes, `image_points_px` (n, 2) the
    corners in the image of a pinhole camera with the matrix `K`.
    `corner_lift_per_sheet_curl_sigma_m` is the result of `corner_lift_by_sheet_curl`.
    """
    n, m = len(image_points_px), len(detections)
    W, error_shifts = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 + 2 * m))
    corners_px = image_points_px.reshape(m, 4, 2)
    normals = _outward_side_normals(corners_px)
    # If all edges shift by one pixel, a corner moves by one pixel along the normals of both of its
    # sides.
    moved = (normals + normals.take(_PREVIOUS_CORNER_INDICES, axis=1)).reshape(m, 8)
    for i, d in enumerate(detections):
        rows, corners = slice(8 * i, 8 * i + 8), corners_px[i]
        error_shifts[rows, 0] = d.remaining_edge_shift_sigma_px * moved[i]
        if d.cov_px2 is not None:
            try:
                W[rows, rows] = np.linalg.inv(np.linalg.cholesky(d.cov_px2))
            except np.linalg.LinAlgError:
                # Distant corners of a truncated target cause rounding errors.
                W[rows, rows] = np.diag(np.maximum(np.diagonal(d.cov_px2), 1e-6) ** -0.5)
        elif d.are_corners_fitted:
            spread_px = (
                d.sigma_px
                if d.horizontal_side_deinterlacing_sigma_px == 0.0
                else _side_sigma_px(d, corners)
            )
            own = np.zeros(64)
            own[_SIDE_WHITENING_FLAT_INDICES] = _line_whitening_elements(normals[i], spread_px)
            W[rows, rows] = own.reshape(8, 8)
        else:
            W[rows, rows] = _IDENTITY_8 / d.sigma_px
        if d.corner_shift_per_readout_time_sigma_px is not None:
            error_shifts[rows, 1] = d.corner_shift_per_readout_time_sigma_px.ravel()
        if d.row_jitter_sigma_px > 0.0:
            # As with a fitted line, the errors are a common shift of the rows (half the standard
            # deviation) and a tilt. Together, the two reach the whole standard deviation in the
            # outermost rows.
            down = corners[:, 1] - corners[:, 1].mean()
            down /= max(float(np.abs(down).max()), 1e-9)
            along_x = slice(8 * i, 8 * i + 8, 2)
            error_shifts[along_x, 2 + 2 * i] = 0.5 * d.row_jitter_sigma_px
            error_shifts[along_x, 3 + 2 * i] = 0.5 * math.sqrt(3.0) * d.row_jitter_sigma_px * down
    sigma_px = np.array([d.sigma_px for d in detections]).repeat(4)
    return WeightedCorners(
        object_points_m,
        image_points_px,
        sigma_px,
        W,
        W.dot(error_shifts),
        K,
        corner_lift_per_sheet_curl_sigma_m,
    )


def _outward_side_normals(corners: Array) -> Array:
    """Return the outward unit normals (m, 4, 2) of the sides of m quadrilaterals with `corners` (m,
    4, 2), listed clockwise or counterclockwise. Side k runs from corner k to corner k + 1."""
    side = corners.take(_SIDE_END_CORNER_INDICES, axis=1) - corners
    x, y = side[..., 0], side[..., 1]
    length = np.maximum(np.hypot(x, y), 1e-9)
    length = np.copysign(length, (x[:, 0] * y[:, 1] - y[:, 0] * x[:, 1])[:, None])
    normals = np.empty_like(side)
    np.divide(y, length, out=normals[..., 0])
    np.divide(x, -length, out=normals[..., 1])
    return normals


def _side_sigma_px(detection: Detection, corners: Array) -> Array:
    """Return the standard deviation of each side's position perpendicular to it, (4,) px, for a
    detection with `corners` (4, 2) in pixels of a pinhole camera. In an image from a single field,
    it is larger for sides along the image rows because every second row is interpolated."""
    sides = corners.take(_SIDE_END_CORNER_INDICES, axis=0) - corners
    lying = np.abs(sides[:, 0]) / np.maximum(np.hypot(sides[:, 0], sides[:, 1]), 1e-9)
    rows = 0.5 * math.pi * np.abs(sides[:, 1])
    return np.asarray(
        np.hypot(
            detection.sigma_px,
            detection.horizontal_side_deinterlacing_sigma_px * lying / np.hypot(1.0, rows),
        )
    )


def _line_whitening_elements(normals: Array, sigma_px: float | Array) -> Array:
    """Return the nonzero elements (32,), 1/px, of the whitening matrix (8, 8) of a marker whose
    corners are intersections of four fitted lines. The matrix transforms the errors of the corners
    to the lines' errors of offset and tilt, which are independent and have unit variance.
    `_SIDE_WHITENING_FLAT_INDICES` are the elements' indices in the flattened matrix.

    `normals` (4, 2) are the lines' unit normals; `sigma_px` is the standard deviation of a line's
    position at its two corners, px, a scalar for all lines, or (4,).
    """
    across = (normals.T / sigma_px).ravel()
    tilt = across * _LINE_TILT_TO_OFFSET_WHITENING_RATIO
    return np.concatenate([across, across, -tilt, tilt])
