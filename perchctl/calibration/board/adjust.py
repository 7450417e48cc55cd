"""Fit the camera and all board poses by OpenCV's bundle adjustment, reject outliers, and estimate
the uncertainty of the lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from perchctl.calibration.board.detect import MIN_CORNERS, BoardView, Rejection
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.vision import CameraModel, project, undistort_to_normalised

ModelName = Literal["plumb_bob", "fisheye"]
MODEL_NAMES: tuple[ModelName, ...] = get_args(ModelName)  # from the simplest to the most general
PARAMETERS: dict[str, tuple[str, ...]] = {
    "plumb_bob": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
_STILL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
_FISHEYE = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW


class NoSolution(ArithmeticError):
    """No camera model fits the detected board corners."""


@dataclass(frozen=True, eq=False)
class CameraFit:
    """Least-squares solution for a camera and the board's pose in each view.

    Attributes:
        poses: rvec and tvec of each view's board in the camera frame, (v, 6).
        residuals: detected minus modelled corner positions of each view, (n, 2) px each.
    """

    camera: CameraModel
    poses: Array
    residuals: tuple[Array, ...]

    @property
    def parameters(self) -> Array:
        """The lens parameters, (p,), in the order of `PARAMETERS`."""
        return lens_parameters(self.camera)

    @property
    def rms_px(self) -> float:
        """RMS reprojection error over all corners, defined as in OpenCV."""
        return float(np.sqrt((np.concatenate(self.residuals) ** 2).sum(axis=1).mean()))

    @property
    def robust_std_px(self) -> float:
        """Robust standard deviation of a residual's x or y, px, from the median residual."""
        return _spread_px(np.concatenate(self.residuals))


def lens_parameters(camera: CameraModel) -> Array:
    """Return fx, fy, cx, cy and the distortion of a camera, (p,); k3 = 0 is added to a plumb_bob
    model with four coefficients."""
    K, dist = camera.K, camera.dist
    if camera.model == "plumb_bob" and dist.size == 4:
        dist = np.append(dist, 0.0)
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], dist])


def fit_camera(views: Sequence[BoardView], model: str) -> CameraFit:
    """Fit the camera with the lens `model` (one of `MODEL_NAMES`) and the board poses by least
    squares.

    Raises NoSolution.
    """
    size_px = views[0].size_px
    objects = [view.corners_m.astype(np.float32)[None] for view in views]
    corners = [view.corners_px.astype(np.float32)[None] for view in views]
    solve = cv2.calibrateCamera if model == "plumb_bob" else cv2.fisheye.calibrate
    flags = 0 if model == "plumb_bob" else _FISHEYE
    try:
        _, K, dist, rvecs, tvecs = solve(
            objects, corners, size_px, np.eye(3), np.zeros(0), flags=flags, criteria=_STILL
        )
    except cv2.error:
        raise NoSolution(f"no {model} camera model fits the corners") from None
    poses = np.concatenate([np.reshape(rvecs, (-1, 3)), np.reshape(tvecs, (-1, 3))], axis=1)
    if not (np.isfinite(K).all() and np.isfinite(dist).all() and np.isfinite(poses).all()):
        raise NoSolution(f"no {model} camera model fits the corners")
    return _fit_of(views, CameraModel(size_px, np.array(K, float), np.ravel(dist), model), poses)


def fit_poses(views: Sequence[BoardView], camera: CameraModel) -> CameraFit | None:
    """Fit the board poses for a fixed camera; None if a board is outside its field of view."""
    poses = []
    for view in views:
        seen = undistort_to_normalised(view.corners_px, camera)
        if not np.isfinite(seen).all():
            return None
        _, rvec, tvec = cv2.solvePnP(
            view.corners_m, seen, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
        pose = cv2.solvePnPRefineLM(view.corners_m, seen, np.eye(3), None, rvec, tvec)
        poses.append(np.ravel(pose))
    return _fit_of(views, camera, np.array(poses))


def _fit_of(views: Sequence[BoardView], camera: CameraModel, poses: Array) -> CameraFit:
    residuals = tuple(
        view.corners_px - project(view.corners_m, pose[:3], pose[3:], camera)
        for view, pose in zip(views, poses, strict=True)
    )
    return CameraFit(camera, poses, residuals)


def projection_derivatives(
    camera: CameraModel, pose: Array, points_m: Array
) -> tuple[Array, Array]:
    """The Jacobians of the projections (px) of board points (n, 3), with respect to the lens
    parameters, (2 n, p), and to the board's pose, (2 n, 6). The pose (6,) consists of rvec and
    tvec."""
    rvec = pose[:3].copy()
    tvec = pose[3:].copy()
    p = len(lens_parameters(camera))
    if camera.model == "fisheye":
        points = points_m.reshape(-1, 1, 3)
        _, J = cv2.fisheye.projectPoints(points, rvec, tvec, camera.K, camera.dist)
        return np.asarray(J[:, :p], np.float64), np.asarray(J[:, p : p + 6], np.float64)
    _, J = cv2.projectPoints(points_m, rvec, tvec, camera.K, lens_parameters(camera)[4:])
    return np.asarray(J[:, 6 : 6 + p], np.float64), np.asarray(J[:, :6], np.float64)


def lens_covariance(views: Sequence[BoardView], fit: CameraFit) -> Array:
    """The covariance (p, p) of the lens parameters, marginalized over the board poses."""
    rows = []
    for view, pose, residual in zip(views, fit.poses, fit.residuals, strict=True):
        lens, outside = projection_derivatives(fit.camera, pose, view.corners_m)
        Q, _ = np.linalg.qr(outside)
        rows.append((lens - Q @ (Q.T @ lens), residual.ravel()))
    p = len(fit.parameters)
    free = sum(len(r) for _, r in rows) - p - 6 * len(rows)
    noise2 = sum(float(r @ r) for _, r in rows) / max(free, 1)
    blocks = [(J.T @ J / noise2, J.T @ r / noise2) for J, r in rows]
    return jackknife_covariance(blocks, np.zeros((p, p)))


# --- Outliers ---
# A corner is rejected if its residual exceeds 0.3 px and 5 times the spread of its view (or of all
# views, if that is larger). A view is rejected if the RMS of its remaining corners exceeds 0.1 px
# and 2.5 times the RMS of the median view, if more than a quarter of its corners were rejected, or
# if fewer than 6 remain. The worst views are rejected first, until nothing changes.


CORNER_FACTOR = 5.0
CORNER_FLOOR_PX = 0.3
VIEW_FACTOR = 2.5
VIEW_FLOOR_PX = 0.1
MAX_CORNERS_OUT = 0.25
MAX_VIEWS_OUT = 1.0 / 3.0
"""Largest fraction of views that may be rejected. If more are rejected, the fault lies not in the
views but in the board, its size or the lens."""
_MEDIAN_OF_RAYLEIGH = 1.1774  # median radius of a circular Gaussian with spread 1
_REJECTION_ROUNDS = 10


def reject_outliers(
    views: Sequence[BoardView], fit: CameraFit
) -> tuple[CameraFit, list[BoardView], list[Rejection]]:
    """Return the fit without outliers, the views used, and the rejected views and corners.

    Raises:
        InvalidValue: too many views do not fit a common camera model. NoSolution.
    """
    kept, rejections = list(views), []
    whole = {view.name: view for view in views}
    for _ in range(_REJECTION_ROUNDS):
        masks, reasons = _find_outliers(kept, fit, whole)
        if not reasons and all(mask.all() for mask in masks):
            break
        rejections += [Rejection(name, reason) for name, reason in reasons.items()]
        if len(rejections) > MAX_VIEWS_OUT * len(views):
            named = ", ".join(r.view for r in rejections[:4])
            raise InvalidValue(
                f"{len(rejections)} of {len(views)} views do not fit a single camera model "
                f"({named}): check that the board is flat, that --board matches it, and that zoom "
                "and focus were not changed between the images"
            )
        kept = [
            view.select(mask)
            for view, mask in zip(kept, masks, strict=True)
            if view.name not in reasons
        ]
        fit = fit_camera(kept, fit.camera.model)
    for view in kept:
        out = np.setdiff1d(whole[view.name].ids, view.ids)
        if len(out):
            reason = (
                f"off by more than {CORNER_FACTOR:g} times the spread of the errors in its view"
            )
            rejections.append(Rejection(view.name, reason, tuple(out.tolist())))
    return fit, kept, rejections


def _find_outliers(
    views: Sequence[BoardView], fit: CameraFit, whole: dict[str, BoardView]
) -> tuple[list[NDArray[np.bool_]], dict[str, str]]:
    masks, rms = [], []
    for residual in fit.residuals:
        distance = np.linalg.norm(residual, axis=1)
        spread = max(fit.robust_std_px, _spread_px(residual))
        mask = distance <= max(CORNER_FACTOR * spread, CORNER_FLOOR_PX)
        masks.append(mask)
        rms.append(float(np.sqrt((distance[mask] ** 2).mean())) if mask.any() else np.inf)
    median = float(np.median(rms))
    limit = max(VIEW_FACTOR * median, VIEW_FLOOR_PX, max(rms) / 2.0)
    reasons = {}
    for view, mask, view_rms in zip(views, masks, rms, strict=True):
        left = int(mask.sum())
        had = len(whole[view.name])
        if view_rms > limit:
            reasons[view.name] = f"RMS error {view_rms:.2f} px, but the median is {median:.2f} px"
        elif had - left > MAX_CORNERS_OUT * had or left < MIN_CORNERS:
            reasons[view.name] = f"{had - left} of its {had} corners are outliers"
    return masks, reasons


def _spread_px(residual: Array) -> float:
    return float(np.median(np.linalg.norm(residual, axis=1))) / _MEDIAN_OF_RAYLEIGH


# --- The covariance of a least-squares solution whose errors are correlated within a block of rows


SIGMAS_95 = 1.96
"""Half-width of a 95 % interval, in standard deviations."""
_LEAST_INFORMATION_SHARE = 1e-10
"""Each parameter's information is increased by this fraction, so that the variance of a parameter
that no image determines stays finite."""


def jackknife_covariance(
    blocks: Sequence[tuple[Array, Array]],
    prior: Array,
    curvature_factor: float = 1.0,
    information_factor: float = 1.0,
) -> Array:
    """Return the covariance (p, p) of a least-squares solution: the inverse of the information
    matrix, in which each variance is raised to its delete-one-block jackknife estimate if that is
    larger.

    Args:
        blocks: information J' J (p, p) and gradient J' r (p,) of each block of rows.
        prior: prior information (p, p), added to the information of the blocks.
        curvature_factor: ratio of the robust cost's true curvature to the blocks' information.
        information_factor: further factor on the blocks' information (sandwich covariance).
    """
    seen = np.sum([information for information, _ in blocks], axis=0)
    # Scale the parameters, which have different units, to comparable sizes.
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(prior + curvature_factor * seen), 1e-300))
    both = np.outer(scale, scale)
    known = prior + np.diag(_LEAST_INFORMATION_SHARE / scale**2)
    inverted = np.asarray(
        np.linalg.inv((known + curvature_factor * information_factor * seen) * both)
    )
    moves = np.array(
        [
            np.linalg.solve(
                (known + curvature_factor * (seen - information)) * both, scale * gradient
            )
            for information, gradient in blocks
        ]
    )
    count = len(blocks)
    spread = (count - 1) * moves.var(axis=0) * student_to_normal_ratio(count - 1) ** 2
    # Treat each parameter separately, because the blocks cannot determine all of them together.
    grown = np.sqrt(np.maximum(spread / np.diagonal(inverted), 1.0)) * scale
    return np.asarray(inverted * np.outer(grown, grown))


def student_to_normal_ratio(degrees_of_freedom: int) -> float:
    """Return the ratio of the 95 % half-width of Student's t distribution to that of the normal
    distribution; fewer than 3 degrees of freedom count as 3."""
    return float(stdtrit(max(degrees_of_freedom, 3), 0.975)) / SIGMAS_95
