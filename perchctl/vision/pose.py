"""From corners to the target's pose relative to the gear.

All solving is done in pixels of a pinhole with the camera's `K`, from corners that
were undistorted. A planar marker has two tilts with nearly the same picture; which
one is true is decided by the vehicle's roll and pitch (the target lies level) or by
the tilt of the frame before. The position comes from the camera-frame translation,
turned level by the vehicle's roll and pitch, never from the marker's own axes: at
1.15 m that is 0.5 mm against 40 mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from perchctl.geometry import R_MARKER_TARGET, Array, rotation_from_rpy, yaw_of
from perchctl.profile import PoseConfig, TargetConfig
from perchctl.vision.camera_model import undistort_px
from perchctl.vision.types import Attitude, CameraModel, Detection, MarkerName, MarkerPose

_FLAGS = {
    "sqpnp": cv2.SOLVEPNP_SQPNP,
    "iterative": cv2.SOLVEPNP_ITERATIVE,
    "epnp": cv2.SOLVEPNP_EPNP,
    "ippe": cv2.SOLVEPNP_IPPE,
    "ippe_square": cv2.SOLVEPNP_IPPE_SQUARE,
}
_ATTITUDE_TILT_RAD = math.radians(6.0)  # mounting, estimate and ceiling together
_PREVIOUS_TILT_RAD = math.radians(10.0)  # between two frames
_MIN_FLIP_RAD = math.radians(2.0)  # closer solutions are one
_MIN_SCORE_SIGMA_PX = 0.05  # lens and print set a floor to what residuals can tell


@dataclass(frozen=True, eq=False)
class PoseSetup:
    """`object_points` (4, 3) m in marker axes, in the order of the corners."""

    config: PoseConfig
    object_points: dict[MarkerName, Array]
    T_body_cam: Array
    gear_body_m: Array
    camera: CameraModel


def make_pose_setup(
    config: PoseConfig,
    target: TargetConfig,
    T_body_cam: Array,
    gear_body_m: Sequence[float] | Array,
    camera: CameraModel,
) -> PoseSetup:
    return PoseSetup(
        config=config,
        object_points={
            "large": square(target.large.side_m),
            "small": square(target.small.side_m),
        },
        T_body_cam=np.asarray(T_body_cam, dtype=np.float64),
        gear_body_m=np.asarray(gear_body_m, dtype=np.float64),
        camera=camera,
    )


def square(side_m: float) -> Array:
    """Corners TL TR BR BL of a marker in its own axes, (4, 3)."""
    h = side_m / 2.0
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def level_rotation(attitude: Attitude | None) -> Array:
    """``R_level_body`` (3, 3); without an attitude the vehicle counts as level."""
    if attitude is None:
        return np.eye(3)
    return rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, 0.0)


def estimate_pose(
    detections: Sequence[Detection],
    t_s: float,
    attitude: Attitude | None,
    setup: PoseSetup,
    previous_normal_cam: Array | None = None,
    start: MarkerPose | None = None,
) -> MarkerPose | None:
    """The pose from one marker's corners, or from both markers' corners at once.

    `start` is a pose of the same frame whose tilt is already decided (the joint one):
    it is refined on these corners instead of solving anew.
    None where the corners give no pose: no finite solution in front of the camera, or
    a reprojection error (RMS over the corners) above `pose.max_reprojection_px`.
    """
    object_m = np.concatenate([setup.object_points[d.marker] for d in detections])
    raw_px = np.concatenate([d.corners_px for d in detections])
    sigma_px = np.repeat([d.sigma_px for d in detections], 4)
    image_px = undistort_px(raw_px, setup.camera)
    if not (np.isfinite(image_px).all() and np.isfinite(sigma_px).all()):
        return None
    R_level_cam = level_rotation(attitude) @ setup.T_body_cam[:3, :3]
    K = setup.camera.K
    if attitude is not None:
        expected_cam: Array | None = -R_level_cam[2]
        spread_rad = _ATTITUDE_TILT_RAD
    else:
        expected_cam, spread_rad = previous_normal_cam, _PREVIOUS_TILT_RAD
    config, points = setup.config, _Points(object_m, image_px, sigma_px, K)
    solution = None
    if start is not None and config.refine:
        near = _refined(points, (start.rvec_rad, start.tvec_m))
        solution = _scored(near, points) if _usable(near) else None
    if solution is None:
        solution = _solve(points, config.solver, config.refine, expected_cam, spread_rad)
    if not _fits(solution, config.max_reprojection_px) and config.solver != "sqpnp":
        # EPnP and IPPE fail on exactly frontal views, which is where hovering happens.
        solution = _solve(points, "sqpnp", config.refine, expected_cam, spread_rad)
    if solution is None or not _fits(solution, config.max_reprojection_px):
        return None
    rvec, tvec, error_px, J = solution
    rms_px = _rms(error_px)
    cov = _covariance(J, error_px, sigma_px)
    R, dR = (np.asarray(m, dtype=np.float64) for m in cv2.Rodrigues(rvec))
    e_m = level_rotation(attitude) @ (
        setup.T_body_cam[:3, :3] @ tvec + setup.T_body_cam[:3, 3] - setup.gear_body_m
    )
    heading = R_level_cam @ R @ R_MARKER_TARGET
    sigma_m = np.sqrt(np.maximum(np.diag(R_level_cam @ cov[3:, 3:] @ R_level_cam.T), 0.0))
    return MarkerPose(
        source="joint" if len(detections) > 1 else detections[0].marker,
        t_s=t_s,
        rvec_rad=rvec,
        tvec_m=tvec,
        e_m=e_m,
        e_yaw_rad=yaw_of(heading),
        sigma_m=sigma_m,
        sigma_yaw_rad=_sigma_yaw(R_level_cam, heading, dR, cov[:3, :3]),
        reprojection_px=rms_px,
    )


def normal_cam(pose: MarkerPose) -> Array:
    """The marker's z axis (out of the paper) in camera axes, (3,)."""
    return np.asarray(cv2.Rodrigues(pose.rvec_rad)[0][:, 2])


def flipped(rvec: Array, tvec: Array) -> Array | None:
    """The other tilt: the normal mirrored at the line of sight; None where both agree."""
    R = cv2.Rodrigues(rvec)[0]
    normal, sight = R[:, 2], tvec / np.linalg.norm(tvec)
    other = 2.0 * float(normal @ sight) * sight - normal
    axis = np.array(  # normal x other
        [
            normal[1] * other[2] - normal[2] * other[1],
            normal[2] * other[0] - normal[0] * other[2],
            normal[0] * other[1] - normal[1] * other[0],
        ]
    )
    sine, cosine = float(np.linalg.norm(axis)), float(normal @ other)
    angle = math.atan2(sine, cosine)
    if angle < _MIN_FLIP_RAD or sine < 1e-9:
        return None
    turn = cv2.Rodrigues(axis / sine * angle)[0]
    return _flat(cv2.Rodrigues(turn @ R)[0])


def _flat(values: Any) -> Array:
    return np.asarray(values, dtype=np.float64).ravel()


Solver = Literal["sqpnp", "iterative", "epnp", "ippe", "ippe_square"]
_Candidate = tuple[Array, Array]
_Scored = tuple[Array, Array, Array, Array]  # rvec, tvec, errors (n, 2), Jacobian (2n, 6)


@dataclass(frozen=True, eq=False)
class _Points:
    object_m: Array
    image_px: Array
    sigma_px: Array
    K: Array


def _rms(error_px: Array) -> float:
    return math.sqrt(float((error_px**2).sum()) / len(error_px))


def _fits(solution: _Scored | None, max_reprojection_px: float) -> bool:
    return solution is not None and _rms(solution[2]) <= max_reprojection_px


def _solve(
    points: _Points,
    solver: Solver,
    refine: bool,
    expected_cam: Array | None,
    spread_rad: float,
) -> _Scored | None:
    """The better of both tilts, None without a finite one in front of the camera."""
    candidates = _closed_form(points, solver)
    if refine:
        candidates = [_refined(points, c) for c in candidates]
    scored = [_scored(c, points) for c in candidates if _usable(c)]
    if not scored:
        return None

    def cost(s: _Scored) -> float:
        return _cost(s, points.sigma_px, expected_cam, spread_rad)

    best = min(scored, key=cost) if len(scored) > 1 else scored[0]
    if refine and (expected_cam is None or _tilt_rad(best[0], expected_cam) > spread_rad):
        other = flipped(best[0], best[1])
        turned = None if other is None else _refined(points, (other, best[1]))
        if turned is not None and _usable(turned):
            best = min(best, _scored(turned, points), key=cost)
    if refine and points.sigma_px.max() > 1.5 * points.sigma_px.min():
        best = _weighted_step(best, points)
    return best


def _closed_form(points: _Points, solver: Solver) -> list[_Candidate]:
    if solver == "ippe_square" and len(points.object_m) != 4:
        solver = "ippe"
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
            points.object_m, points.image_px, points.K, None, flags=_FLAGS[solver]
        )
    except cv2.error:
        return []  # degenerate corners: all on one line, or on one point
    pairs = [(_flat(r), _flat(t)) for r, t in zip(rvecs, tvecs, strict=True)]
    return [pair for pair in pairs if _usable(pair)]


def _usable(candidate: _Candidate) -> bool:
    rvec, tvec = candidate
    return bool(np.isfinite(rvec).all() and np.isfinite(tvec).all() and tvec[2] > 0.0)


def _refined(points: _Points, start: _Candidate) -> _Candidate:
    rvec, tvec = start[0].reshape(3, 1).copy(), start[1].reshape(3, 1).copy()
    try:
        moved = cv2.solvePnPRefineLM(points.object_m, points.image_px, points.K, None, rvec, tvec)
    except cv2.error:
        return start
    return _flat(moved[0]), _flat(moved[1])


def _scored(candidate: _Candidate, points: _Points) -> _Scored:
    rvec, tvec = candidate
    projected, jacobian = cv2.projectPoints(points.object_m, rvec, tvec, points.K, None)
    J = np.asarray(jacobian[:, :6], dtype=np.float64)
    return rvec, tvec, projected.reshape(-1, 2) - points.image_px, J


def _cost(scored: _Scored, sigma_px: Array, expected_cam: Array | None, spread_rad: float) -> float:
    rvec, _, error_px, _ = scored
    sigma = np.maximum(sigma_px, _MIN_SCORE_SIGMA_PX)[:, None]
    cost = float(((error_px / sigma) ** 2).sum())
    if expected_cam is not None:
        cost += (_tilt_rad(rvec, expected_cam) / spread_rad) ** 2
    return cost


def _tilt_rad(rvec: Array, expected_cam: Array) -> float:
    normal = cv2.Rodrigues(rvec)[0][:, 2]
    return math.acos(max(-1.0, min(1.0, float(normal @ expected_cam))))


def _weighted_step(best: _Scored, points: _Points) -> _Scored:
    """One Gauss-Newton step with each corner's own spread: `solvePnPRefineLM` has
    brought the pose to the unweighted optimum, where the errors are linear."""
    rvec, tvec, error_px, J = best
    w = np.repeat(1.0 / points.sigma_px**2, 2)
    try:
        step = -np.linalg.solve(J.T @ (J * w[:, None]), J.T @ (w * error_px.ravel()))
    except np.linalg.LinAlgError:
        return best
    moved = (rvec + step[:3], tvec + step[3:])
    if not _usable(moved):
        return best
    after = _scored(moved, points)
    before_cost = float((w * error_px.ravel() ** 2).sum())
    return after if float((w * after[2].ravel() ** 2).sum()) <= before_cost else best


def _covariance(J: Array, error_px: Array, sigma_px: Array) -> Array:
    """Of (rvec, tvec), (6, 6): inverse information, inflated where the residual says
    that the corners spread more than they claim."""
    w = np.repeat(1.0 / sigma_px**2, 2)
    chi2 = float((w * error_px.ravel() ** 2).sum())
    inflation = max(1.0, chi2 / (len(w) - 6))
    information = J.T @ (J * w[:, None])
    try:
        return np.asarray(np.linalg.inv(information) * inflation)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.inf)


def _sigma_yaw(R_level_cam: Array, heading: Array, dR: Array, cov_rvec: Array) -> float:
    """Spread of atan2(h[1, 0], h[0, 0]) through ``dR/drvec`` (3, 9); the target's x axis
    is the marker's."""
    dx = dR.reshape(3, 3, 3)[:, :, 0] @ R_level_cam.T  # (rvec component, level axis)
    hx, hy = float(heading[0, 0]), float(heading[1, 0])
    gradient = (hx * dx[:, 1] - hy * dx[:, 0]) / max(hx * hx + hy * hy, 1e-12)
    return math.sqrt(max(float(gradient @ cov_rvec @ gradient), 0.0))
