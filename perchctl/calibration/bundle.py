"""The camera and all board poses together: Levenberg-Marquardt on the corners' distances.

The minimum is that of `cv2.calibrateCamera`; corners may weigh differently, a fisheye is
solved by the same code, and the derivatives stay for the covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from perchctl.calibration.lens import (
    COEFFICIENTS,
    make_camera,
    parameters_of,
    project_with_derivatives,
)
from perchctl.calibration.types import BoardView, Solution
from perchctl.geometry import Array
from perchctl.vision import CameraModel, undistort

MAX_ITERATIONS = 60
_FOCAL_GUESSES = (0.35, 0.55, 0.85, 1.3, 2.2)  # of the longer side of the picture
_STOP = 1e-9
_PRIOR_PX = 0.05
_PRIOR_SPREAD = 5.0
"""k1, k2, k3 and k4, k5, k6 of the rational model nearly cancel; left alone they run off
together, to poles beside the picture. They are held at 0 +- 5 as if by one corner."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Where the adjustment ended: lens parameters (p,), poses (v, 6), and the normal
    equations there: lens block (p, p), and for each view the coupling (p, 6) and the
    pose block (6, 6)."""

    model: str
    size_px: tuple[int, int]
    parameters: Array
    poses: Array
    residuals: tuple[Array, ...]  # found minus modelled, (n, 2) each
    jacobians: tuple[tuple[Array, Array], ...]  # lens (2n, p) and pose (2n, 6)
    weights: tuple[Array, ...]

    @property
    def camera(self) -> CameraModel:
        return make_camera(self.model, self.size_px, self.parameters)

    @property
    def prior(self) -> Array:
        """What pulls each lens parameter to zero, (p,): information in px^-2 of cost."""
        return prior_of(self.model)

    @property
    def cost(self) -> float:
        return float(
            (self.prior * self.parameters**2).sum()
            + sum(
                (w[:, None] * r**2).sum() for w, r in zip(self.weights, self.residuals, strict=True)
            )
        )

    @property
    def corners(self) -> int:
        return sum(len(r) for r in self.residuals)

    @property
    def rms_px(self) -> float:
        total = sum(float((r**2).sum()) for r in self.residuals)
        return float(np.sqrt(total / max(self.corners, 1)))


def prior_of(model: str) -> Array:
    prior = np.zeros(4 + COEFFICIENTS[model])
    if model == "rational_polynomial":
        prior[[4, 5, 8, 9, 10, 11]] = (_PRIOR_PX / _PRIOR_SPREAD) ** 2
    return prior


class NoSolution(ArithmeticError):
    """No start led to a camera."""


def pose_of(view: BoardView, camera: CameraModel) -> Array | None:
    """The board's rvec and tvec (6,) seen by a known camera, or None."""
    normalised = undistort(view.corners_px, camera)
    good = np.isfinite(normalised).all(axis=1) & (np.abs(normalised) < 50.0).all(axis=1)
    if good.sum() < 4:
        return None
    try:
        found, rvec, tvec = cv2.solvePnP(
            view.object_m[good], normalised[good], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return None
    pose = np.concatenate([rvec.ravel(), tvec.ravel()]) if found else np.full(6, np.nan)
    if not np.isfinite(pose).all() or pose[5] <= 0:
        # IPPE fails on exactly frontal boards.
        found, rvec, tvec = cv2.solvePnP(
            view.object_m[good], normalised[good], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
        pose = np.concatenate([rvec.ravel(), tvec.ravel()]) if found else np.full(6, np.nan)
    return pose if np.isfinite(pose).all() and pose[5] > 0 else None


def start_fit(views: Sequence[BoardView], model: str) -> Fit:
    """Solve from nothing: several focal lengths are tried, the best end wins.

    Raises NoSolution.
    """
    w, h = views[0].size_px
    best: Fit | None = None
    for share in _FOCAL_GUESSES:
        f = share * max(w, h)
        start = np.array([f, f, (w - 1) / 2, (h - 1) / 2] + [0.0] * COEFFICIENTS[model])
        fit = _from(views, model, start, iterations=25)
        if fit is not None and (best is None or fit.cost < best.cost):
            best = fit
    if best is None:
        raise NoSolution(f"no {model} camera fits the corners")
    return refit(views, best)


def fit_from(views: Sequence[BoardView], camera: CameraModel) -> Fit:
    """Solve all parameters from a camera that is nearly right. Raises NoSolution."""
    fit = _from(views, camera.model, parameters_of(camera), MAX_ITERATIONS)
    if fit is None:
        raise NoSolution("the camera given cannot see the boards where they are")
    return fit


def refit(views: Sequence[BoardView], near: Fit, weights: Sequence[Array] | None = None) -> Fit:
    """Solve again from a fit of the same views, with other corners' weights."""
    fit = _solve(views, near.model, near.parameters, near.poses, weights, MAX_ITERATIONS)
    if fit is None:
        raise NoSolution("the adjustment diverged")
    return fit


def poses_only(views: Sequence[BoardView], camera: CameraModel) -> Fit | None:
    """Best poses for a camera held fixed; None where a view does not fit it at all."""
    poses = _poses(views, camera)
    if poses is None:
        return None
    return _solve(
        views, camera.model, parameters_of(camera), poses, None, MAX_ITERATIONS, fixed=True
    )


def as_solution(fit: Fit, covariance: Array) -> Solution:
    return Solution(fit.camera, fit.poses, fit.residuals, fit.rms_px, covariance)


def _poses(views: Sequence[BoardView], camera: CameraModel) -> Array | None:
    poses = [pose_of(view, camera) for view in views]
    return None if any(p is None for p in poses) else np.array(poses)


def _from(views: Sequence[BoardView], model: str, start: Array, iterations: int) -> Fit | None:
    poses = _poses(views, make_camera(model, views[0].size_px, start))
    return None if poses is None else _solve(views, model, start, poses, None, iterations)


def _solve(
    views: Sequence[BoardView],
    model: str,
    parameters: Array,
    poses: Array,
    weights: Sequence[Array] | None,
    iterations: int,
    fixed: bool = False,
) -> Fit | None:
    weights = tuple(np.ones(len(v)) for v in views) if weights is None else tuple(weights)
    size_px = views[0].size_px

    def at(parameters: Array, poses: Array) -> Fit | None:
        try:
            seen = project_with_derivatives(model, parameters, poses, [v.object_m for v in views])
        except cv2.error:
            return None
        residuals = tuple(v.corners_px - px for v, (px, _, _) in zip(views, seen, strict=True))
        if not all(np.isfinite(r).all() for r in residuals):
            return None
        jacobians = tuple((a.reshape(-1, a.shape[2]), b.reshape(-1, 6)) for _, a, b in seen)
        return Fit(model, size_px, parameters, poses, residuals, jacobians, weights)

    fit = at(parameters, poses)
    if fit is None:
        return None
    damping = 1e-3
    for _ in range(iterations):
        step = _step(fit, damping, fixed)
        trial = None
        if step is not None:
            trial = at(fit.parameters + step[0], fit.poses + step[1])
        if trial is not None and not (
            trial.parameters[0] > 0 and trial.parameters[1] > 0 and (trial.poses[:, 5] > 0).all()
        ):
            trial = None
        if trial is None or trial.cost > fit.cost:
            damping *= 8.0
            if damping > 1e9:
                break
            continue
        gained = fit.cost - trial.cost
        fit = trial
        damping = max(damping / 8.0, 1e-12)
        if gained <= _STOP * fit.cost:
            break
    return fit


def _step(fit: Fit, damping: float, fixed: bool) -> tuple[Array, Array] | None:
    """Lens step (p,) and pose steps (v, 6), the poses eliminated first (Schur)."""
    p = len(fit.parameters)
    S, g = np.diag(fit.prior), -fit.prior * fit.parameters
    parts = []
    try:
        for r, (A, B), w in zip(fit.residuals, fit.jacobians, fit.weights, strict=True):
            w2 = np.repeat(w, 2)
            Bw = B * w2[:, None]
            V = B.T @ Bw
            V[range(6), range(6)] += damping * np.diag(V) + 1e-12
            gb = Bw.T @ r.ravel()
            if fixed:
                parts.append((np.zeros((p, 6)), np.linalg.inv(V), gb))
                continue
            Aw = A * w2[:, None]
            W = Aw.T @ B
            Vi = np.linalg.inv(V)
            U = A.T @ Aw
            U[range(p), range(p)] += damping * np.diag(U)
            S += U - W @ Vi @ W.T
            g += Aw.T @ r.ravel() - W @ Vi @ gb
            parts.append((W, Vi, gb))
        lens = np.zeros(p) if fixed else _scaled_solve(S, g)
    except np.linalg.LinAlgError:
        return None
    poses = np.array([Vi @ (gb - W.T @ lens) for W, Vi, gb in parts])
    if not (np.isfinite(lens).all() and np.isfinite(poses).all()):
        return None
    return lens, poses


def _scaled_solve(S: Array, g: Array) -> Array:
    """S x = g with unlike units (px and coefficients) brought to one scale."""
    d = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-30))
    return np.asarray(d * np.linalg.solve(S * d[:, None] * d[None], g * d))


def reduced_blocks(fit: Fit) -> list[tuple[Array, Array]]:
    """What each view contributes to the lens once its pose is free: A (2n, p) with the
    pose's part projected out, and the weighted residuals (2n,)."""
    blocks = []
    for r, (A, B), w in zip(fit.residuals, fit.jacobians, fit.weights, strict=True):
        root = np.sqrt(np.repeat(w, 2))
        Q, _ = np.linalg.qr(B * root[:, None])
        Aw = A * root[:, None]
        blocks.append((Aw - Q @ (Q.T @ Aw), root * r.ravel()))
    return blocks
