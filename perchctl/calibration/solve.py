"""From views of a board to a camera and the error of its calibration."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.bundle import (
    Fit,
    NoSolution,
    as_solution,
    poses_only,
    reduced_blocks,
    refit,
    start_fit,
)
from perchctl.calibration.enough import (
    GOOD_COVERED,
    GOOD_VIEWS,
    check_focal,
    check_variety,
    check_views,
    coverage,
    uncovered_text,
)
from perchctl.calibration.lens import MODEL_NAMES, pixel_grid
from perchctl.calibration.predict import predict_errors, ray_errors_px
from perchctl.calibration.robust import Robust, keep_all, reject, weighted_fit
from perchctl.calibration.types import BoardView, Calibration, Lack, ModelScore, Rejection
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.vision import distort, undistort

AUTO_MODEL = "auto"
FOLDS_BACK = "folds back inside of the picture"
_EASIER = 0.95  # a richer model must leave at most this part of the simpler one's spread


def calibrate_camera(
    views: Sequence[BoardView],
    board: str,
    model: str = AUTO_MODEL,
    rejecting: bool = True,
    missing: Sequence[Rejection] = (),
) -> Calibration:
    """Solve, reject, compare, predict.

    Args:
        model: a name of `MODEL_NAMES`, or ``auto`` for the recommended one.
        rejecting: leave out outliers (`perchctl.calibration.robust`).
        missing: pictures in which no board was found, for the report.

    Raises:
        InvalidValue: too few views, all frontal, most of the image empty, focal length
        not fixed, or too many views that fit no camera.
    """
    pictures = len(views) + len(missing)
    check_views(views, pictures)
    robust = robust_fit(views, rejecting)
    check_views(robust.views, pictures)
    # Tilt and coverage first: their messages name best what to add.
    check_variety(robust.views, robust.fit.poses)
    fits, scores = _fit_models(robust)
    recommended = recommend(scores)
    fit = _chosen(fits, scores, recommended if model == AUTO_MODEL else model)
    covariance = lens_covariance(fit)
    solution = as_solution(fit, covariance)
    check_focal(solution.std, solution.parameters)
    rms95, max95, _ = ray_errors_px(solution.camera, covariance)
    covered = coverage(robust.views)
    return Calibration(
        board=board,
        solution=solution,
        views=robust.views,
        seen=tuple(views),
        rejections=robust.rejections,
        missing=tuple(missing),
        scores=tuple(scores),
        recommended=recommended,
        errors=predict_errors(solution.camera, covariance, covered=covered),
        ray_rms_px95=rms95,
        ray_max_px95=max95,
        covered=covered,
        lacks=tuple(_lacks(fit, len(robust.views), covered)),
    )


def _fit_models(robust: Robust) -> tuple[dict[str, Fit], list[ModelScore]]:
    """Every lens model that can be fitted to the views, and how each predicts."""
    fits: dict[str, Fit] = {}
    scores: list[ModelScore] = []
    for name in MODEL_NAMES:
        try:
            fit = robust.fit if robust.fit.model == name else start_fit(robust.views, name)
        except NoSolution as error:
            scores.append(ModelScore(name, None, None, note=str(error)))
            continue
        fits[name] = fit
        scored = score(robust.views, fit)
        if not usable(fit):
            scored = dataclasses.replace(scored, note=FOLDS_BACK)
        scores.append(scored)
    return fits, scores


def _chosen(fits: Mapping[str, Fit], scores: Sequence[ModelScore], model: str) -> Fit:
    if model not in fits:
        notes = {s.model: s.note for s in scores}
        raise InvalidValue(f"the lens model {model} cannot be fitted: {notes[model]}")
    return fits[model]


def _lacks(fit: Fit, views: int, covered: NDArray[np.bool_]) -> list[Lack]:
    """What keeps it from being a good calibration, whatever its error, and goes
    with more pictures."""
    lacks = []
    if not usable(fit):
        lacks.append(
            Lack(
                f"the lens model {FOLDS_BACK}", "no corners were seen there, add views at its rims"
            )
        )
    if views < GOOD_VIEWS:
        lacks.append(Lack(f"only {views} views", f"add {GOOD_VIEWS - views} or more"))
    if covered.mean() < GOOD_COVERED:
        lacks.append(
            Lack(
                f"{100 * (1 - covered.mean()):.0f} % of the picture is uncovered",
                f"add views with the board {uncovered_text(covered)}",
            )
        )
    return lacks


def robust_fit(views: Sequence[BoardView], rejecting: bool = True) -> Robust:
    """The views without outliers, and the camera that they were judged by: the simplest model
    that follows the lens. One that cannot would call the views at the picture's rim outliers.

    Raises InvalidValue: the views fit no camera.
    """
    try:
        if not rejecting:
            return keep_all(views, MODEL_NAMES[0])
        best, best_spread = weighted_fit(views, MODEL_NAMES[0])
    except NoSolution as error:
        raise InvalidValue(f"{error}: is --board the true layout of the board?") from None
    for name in MODEL_NAMES[1:]:
        try:
            fit, spread = weighted_fit(views, name)
        except NoSolution:
            continue
        if spread < _EASIER * best_spread and usable(fit):
            best, best_spread = fit, spread
    return reject(views, best)


def usable(fit: Fit) -> bool:
    """Whether the lens is one-to-one over the image and its centre lies inside."""
    camera = fit.camera
    w, h = camera.size_px
    if not (0 < camera.K[0, 2] < w and 0 < camera.K[1, 2] < h):
        return False
    grid = pixel_grid(camera.size_px)
    rays = undistort(grid, camera)
    if not np.isfinite(rays).all():
        return False
    return bool(np.abs(distort(rays, camera) - grid).max() < 0.05)


# --- Which lens model: the one that best predicts views it was not fitted to -------------------
# The views are split into at most ten groups. Each group in turn is left out, the camera
# is solved from the others, and the group's corners are compared with that camera (only
# the boards' poses are fitted to them). A richer model is recommended only when its
# held-out error is smaller by 2 % and by two standard errors of the views' differences;
# otherwise the simpler one, which extrapolates better, stays.


FOLDS = 10
MIN_GAIN = 0.02
MIN_SIGMAS = 2.0


def score(views: Sequence[BoardView], fit: Fit) -> ModelScore:
    """Cross-validation of one model; `fit` is its solution of all these views."""
    held_out = np.full(len(views), np.nan)
    folds = min(FOLDS, len(views))
    groups = np.arange(len(views)) % folds
    for k in range(folds):
        rest = [v for v, g in zip(views, groups, strict=True) if g != k]
        group = [v for v, g in zip(views, groups, strict=True) if g == k]
        near = Fit(fit.model, fit.size_px, fit.parameters, fit.poses[groups != k], (), (), ())
        try:
            camera = refit(rest, near).camera
        except NoSolution:
            return ModelScore(fit.model, fit.rms_px, None, note="unsteady without some views")
        judged = poses_only(group, camera)
        if judged is None:
            return ModelScore(fit.model, fit.rms_px, None, note="unsteady without some views")
        held_out[groups == k] = [np.sqrt((r**2).sum(axis=1).mean()) for r in judged.residuals]
    counts = np.array([len(v) for v in views])
    total = float(np.sqrt((counts * held_out**2).sum() / counts.sum()))
    return ModelScore(fit.model, fit.rms_px, total, tuple(float(x) for x in held_out))


def recommend(scores: Sequence[ModelScore]) -> str:
    """The simplest model that none of the others beats clearly."""
    judged = [s for s in scores if s.held_out_px is not None]
    by_name = {s.model: s for s in judged if not s.note} or {s.model: s for s in judged}
    best: ModelScore | None = None
    for name in MODEL_NAMES:
        candidate = by_name.get(name)
        if candidate is not None and (best is None or _beats(candidate, best)):
            best = candidate
    return best.model if best is not None else MODEL_NAMES[0]


def _beats(challenger: ModelScore, holder: ModelScore) -> bool:
    gain = np.array(holder.per_view_px) - np.array(challenger.per_view_px)
    error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else np.inf
    relative = gain.mean() / max(float(np.mean(holder.per_view_px)), 1e-9)
    return bool(relative > MIN_GAIN and gain.mean() > MIN_SIGMAS * error)


# --- How far the lens parameters may be off ----------------------------------------------------
# Two estimates are made. The first takes the corners' errors as independent: the residuals'
# variance times the inverse of the normal equations. The second uses the views: errors
# within a view go together (blur, a bent board, a moving camera), so each view is left out
# once, in the linear approximation, and the spread of those solutions is the covariance
# (the jackknife over clusters). In every direction of parameter space the larger of the
# two counts.


def lens_covariance(fit: Fit) -> Array:
    """Covariance of the lens parameters (p, p); infinite where the views leave one free."""
    blocks = reduced_blocks(fit)
    p = len(fit.parameters)
    information = np.sum([A.T @ A for A, _ in blocks], axis=0) + np.diag(fit.prior)
    d = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    scaled = information * d[:, None] * d[None]
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < 1e-13:
        return np.diag(np.full(p, np.inf))
    inverse = (vectors / values) @ vectors.T
    rows = sum(len(r) for _, r in blocks)
    free = max(rows - p - 6 * len(blocks), 1)
    noise2 = sum(float(r @ r) for _, r in blocks) / free
    independent = noise2 * inverse
    return _larger(independent, _jackknife(blocks, scaled, d)) * d[:, None] * d[None]


def _jackknife(blocks: list[tuple[Array, Array]], scaled: Array, d: Array) -> Array:
    """Spread of the solutions without one view each, in scaled parameters, (p, p)."""
    p, v = len(d), len(blocks)
    moves = []
    for A, r in blocks:
        As = A * d[None]
        rest = scaled - As.T @ As
        # A view that alone fixes a direction would be infinite: the floor keeps it finite.
        values, vectors = np.linalg.eigh(rest)
        values = np.maximum(values, 1e-3 * np.linalg.eigvalsh(scaled)[0])
        moves.append((vectors / values) @ (vectors.T @ (As.T @ r)))
    spread = np.array(moves)
    spread -= spread.mean(axis=0)
    return np.asarray((v - 1) / v * spread.T @ spread) if v > 1 else np.zeros((p, p))


def _larger(a: Array, b: Array) -> Array:
    """The smallest covariance that is nowhere below a, and as large as b along each axis
    in which b exceeds a (axes of b in units of a)."""
    root = np.linalg.cholesky(a + 1e-15 * np.trace(a) * np.eye(len(a)))
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    lifted = root @ vectors
    return np.asarray((lifted * np.maximum(values, 1.0)) @ lifted.T)
