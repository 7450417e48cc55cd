"""From views of a board to a camera, and whether they are enough; if not, what to add."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.board.adjust import (
    MODEL_NAMES,
    Fit,
    NoSolution,
    Robust,
    fit_from,
    lens_covariance,
    pixel_grid,
    poses_only,
    refit,
    reject,
    weighted_fit,
)
from perchctl.calibration.board.capture import MIN_VIEWS
from perchctl.calibration.board.detect import BoardView, Rejection
from perchctl.calibration.board.predict import coverage, predict_errors, ray_errors_px
from perchctl.calibration.board.result import Calibration, Lack, ModelScore
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.vision import distort, undistort

FOLDS_BACK = "folds back inside of the picture"
_EASIER = 0.95  # a richer model must leave at most this part of the simpler one's spread


def calibrate_camera(
    views: Sequence[BoardView],
    board: str,
    model: str = "auto",
    rejecting: bool = True,
    missing: Sequence[Rejection] = (),
) -> Calibration:
    """Solve, reject, compare, predict.

    Args:
        model: ``plumb_bob``, ``rational_polynomial``, ``fisheye``, or ``auto`` for the recommended.
        rejecting: leave out outliers.
        missing: pictures in which no board was found, for the report.

    Raises:
        InvalidValue: too few views, all frontal, most of the image empty, focal length
        not fixed, or too many views that fit no camera.
    """
    pictures = len(views) + len(missing)
    _check_count(views, pictures)
    robust, starts = _robust_fit(views, rejecting)
    _check_count(robust.views, pictures)
    # Tilt and coverage first: their messages name best what to add.
    covered = coverage(robust.views)
    _check_variety(robust, covered)
    fits, scores = _fit_models(robust, starts)
    recommended = _recommend(scores)
    chosen = recommended if model == "auto" else model
    if chosen not in fits:
        [note] = [score.note for score in scores if score.model == chosen]
        raise InvalidValue(f"the lens model {chosen} cannot be fitted: {note}")
    fit = fits[chosen]
    covariance = lens_covariance(fit)
    _check_focal(fit.parameters, np.sqrt(np.diag(covariance)))
    rms95, max95, _ = ray_errors_px(fit.camera, covariance)
    return Calibration(
        board=board,
        fit=fit,
        covariance=covariance,
        views=robust.views,
        seen=tuple(views),
        rejections=robust.rejections,
        missing=tuple(missing),
        scores=tuple(scores),
        recommended=recommended,
        errors=predict_errors(fit.camera, covariance, covered=covered),
        ray_rms_px95=rms95,
        ray_max_px95=max95,
        covered=covered,
        lacks=tuple(_lacks(fit, len(robust.views), covered)),
    )


def _robust_fit(views: Sequence[BoardView], rejecting: bool) -> tuple[Robust, dict[str, Fit]]:
    """The views without outliers, and each model's fit that outliers do not bend. They are judged
    by the simplest model that follows the lens: one that cannot would call the views at the
    picture's rim outliers.

    Raises InvalidValue: the views fit no camera.
    """
    fits: dict[str, tuple[Fit, float]] = {}
    for name in MODEL_NAMES:
        try:
            fits[name] = weighted_fit(views, name)
        except NoSolution as error:
            if name == MODEL_NAMES[0]:
                hint = "is --board the true layout of the board?"
                raise InvalidValue(f"{error}: {hint}") from None
    starts = {name: fit for name, (fit, _) in fits.items()}
    best, best_spread = fits[MODEL_NAMES[0]]
    if not rejecting:
        return Robust(refit(views, best), tuple(views), ()), starts
    for fit, spread in fits.values():
        if spread < _EASIER * best_spread and _is_usable(fit):
            best, best_spread = fit, spread
    return reject(views, best), starts


def _is_usable(fit: Fit) -> bool:
    """True if the lens is one-to-one over the image and its centre lies inside."""
    camera = fit.camera
    w, h = camera.size_px
    grid = pixel_grid(camera.size_px)
    rays = undistort(grid, camera)
    if not (0 < camera.K[0, 2] < w and 0 < camera.K[1, 2] < h and np.isfinite(rays).all()):
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


def _fit_models(
    robust: Robust, starts: Mapping[str, Fit]
) -> tuple[dict[str, Fit], list[ModelScore]]:
    """Every lens model that can be fitted to the views, and how each predicts."""
    fits: dict[str, Fit] = {}
    scores: list[ModelScore] = []
    for name in MODEL_NAMES:
        try:
            if name == robust.fit.model:
                fit = robust.fit
            elif name in starts:
                fit = fit_from(robust.views, starts[name].camera)
            else:
                raise NoSolution(f"no {name} camera fits the corners")
        except NoSolution as error:
            scores.append(ModelScore(name, None, None, note=str(error)))
            continue
        fits[name] = fit
        score = _cross_validate(robust.views, fit)
        scores.append(score if _is_usable(fit) else replace(score, note=FOLDS_BACK))
    return fits, scores


def _cross_validate(views: Sequence[BoardView], fit: Fit) -> ModelScore:
    """How the model of `fit`, which is its solution of all views, predicts views left out."""
    held_out = np.full(len(views), np.nan)
    group = np.arange(len(views)) % min(FOLDS, len(views))
    for k in range(group.max() + 1):
        rest = [view for view, g in zip(views, group, strict=True) if g != k]
        left_out = [view for view, g in zip(views, group, strict=True) if g == k]
        try:
            judged = poses_only(left_out, refit(rest, fit, kept=group != k).camera)
        except NoSolution:
            judged = None
        if judged is None:
            return ModelScore(fit.model, fit.rms_px, None, note="unsteady without some views")
        held_out[group == k] = judged.view_rms_px()
    counts = np.array([len(v) for v in views])
    total = float(np.sqrt((counts * held_out**2).sum() / counts.sum()))
    return ModelScore(fit.model, fit.rms_px, total, tuple(held_out.tolist()))


def _recommend(scores: Sequence[ModelScore]) -> str:
    """The simplest model that none of the others beats clearly."""
    judged = [s for s in scores if s.held_out_px is not None]
    judged = [s for s in judged if not s.note] or judged
    if not judged:
        return MODEL_NAMES[0]
    best = judged[0]
    for score in judged[1:]:
        if _beats(score, best):
            best = score
    return best.model


def _beats(challenger: ModelScore, holder: ModelScore) -> bool:
    gain = np.array(holder.per_view_px) - np.array(challenger.per_view_px)
    error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else np.inf
    relative = gain.mean() / max(float(np.mean(holder.per_view_px)), 1e-9)
    return bool(relative > MIN_GAIN and gain.mean() > MIN_SIGMAS * error)


# --- Whether there is enough to calibrate from; if not, what to add ----------------------------


GOOD_VIEWS = 10
MIN_TILT_DEG = 12.0
MIN_TILTED = 3
MIN_COVERED = 0.3
GOOD_COVERED = 0.7
MAX_FOCAL_ERROR = 0.01
_NAMES = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)


def _check_count(views: Sequence[BoardView], pictures: int) -> None:
    """Raises InvalidValue when there are too few views to begin with."""
    if len(views) < MIN_VIEWS:
        of = f"of {pictures} pictures" if pictures > len(views) else "pictures"
        raise InvalidValue(
            f"only {len(views)} {of} show the board, at least {MIN_VIEWS} are needed: add "
            f"{MIN_VIEWS - len(views)} or more (15 to 25 are good) with the board tilted by 20 to "
            f"45 deg in all directions, near and far, and in every corner of the picture"
        )


def _check_variety(robust: Robust, covered: NDArray[np.bool_]) -> None:
    """Raises InvalidValue when views are all frontal or leave most of the image empty."""
    tilts = tilts_deg(robust.fit.poses)
    tilted = int((tilts >= MIN_TILT_DEG).sum())
    if tilted < MIN_TILTED:
        raise InvalidValue(
            f"{tilted} of {len(tilts)} views are tilted by more than {MIN_TILT_DEG:g} deg (the "
            f"most by {tilts.max():.0f}), so focal length and distance cannot be separated: add "
            f"{MIN_TILTED - tilted} or more with the board tilted by 20 to 45 deg, about both axes"
        )
    if covered.mean() < MIN_COVERED:
        raise InvalidValue(
            f"the boards cover {100 * covered.mean():.0f} % of the picture, at least "
            f"{100 * MIN_COVERED:.0f} % are needed: add views with the board "
            f"{_uncovered_text(covered)} of the picture, or nearer"
        )


def _check_focal(parameters: Array, std: Array) -> None:
    """Raises InvalidValue when the focal length remains unknown."""
    share = float((std[:2] / parameters[:2]).max())
    if not share <= MAX_FOCAL_ERROR:
        known = f"+-{100 * share:.1f} %" if np.isfinite(share) and share < 1 else "not at all"
        raise InvalidValue(
            f"the views fix the focal length only to {known} (at most "
            f"{100 * MAX_FOCAL_ERROR:g} % is accepted): add sharp views with the board tilted by "
            f"20 to 45 deg about both axes and filling half of the picture"
        )


def _lacks(fit: Fit, views: int, covered: NDArray[np.bool_]) -> list[Lack]:
    """What keeps it from being a good calibration, whatever its error, and goes
    with more pictures."""
    lacks = []
    if not _is_usable(fit):
        advice = "no corners were seen there, add views at its rims"
        lacks.append(Lack(f"the lens model {FOLDS_BACK}", advice))
    if views < GOOD_VIEWS:
        lacks.append(Lack(f"only {views} views", f"add {GOOD_VIEWS - views} or more"))
    if covered.mean() < GOOD_COVERED:
        what = f"{100 * (1 - covered.mean()):.0f} % of the picture is uncovered"
        lacks.append(Lack(what, f"add views with the board {_uncovered_text(covered)}"))
    return lacks


def tilts_deg(poses: Array) -> Array:
    """How far each board (its pose (6,)) is turned out of the image plane, (v,)."""
    normals = np.array([cv2.Rodrigues(pose[:3])[0][2, 2] for pose in poses])
    return np.asarray(np.degrees(np.arccos(np.minimum(np.abs(normals), 1.0))), dtype=np.float64)


def _uncovered_text(covered: NDArray[np.bool_]) -> str:
    """The emptier ninths of the picture, the emptiest first: 'at the top left and right'."""
    thirds = [
        (float(cell.mean()), name)
        for row, names in zip(np.array_split(covered, 3), _NAMES, strict=True)
        for cell, name in zip(np.array_split(row, 3, axis=1), names, strict=True)
    ]
    empty = [name for share, name in sorted(thirds) if share < 0.6][:4]
    if not empty:
        return "at the rims"
    return "at the " + (", ".join(empty[:-1]) + " and " + empty[-1] if empty[1:] else empty[0])
