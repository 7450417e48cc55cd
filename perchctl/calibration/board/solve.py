"""From views of a board to a camera, and whether they are enough; if not, what to add."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.board.adjust import (
    MODEL_NAMES,
    Fit,
    NoSolution,
    Robust,
    lens_covariance,
    pixel_grid,
    reject_outliers,
    weighted_fit,
)
from perchctl.calibration.board.capture import MIN_VIEWS
from perchctl.calibration.board.detect import BoardView, Rejection
from perchctl.calibration.board.predict import coverage, predict_errors
from perchctl.calibration.board.result import Calibration, Lack
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.vision import project, undistort

FOLDS_BACK = "folds back inside of the picture"
_EASIER = 0.95  # a richer model must leave at most this part of the simpler one's spread


def calibrate_camera(
    views: Sequence[BoardView],
    board: str,
    model: str = "auto",
    missing: Sequence[Rejection] = (),
) -> Calibration:
    """Solve for the camera, leave outliers out, and predict the error at the target.

    Args:
        model: ``plumb_bob``, ``rational_polynomial`` or ``fisheye``; ``auto`` for the simplest one
            that follows the lens.
        missing: pictures in which no board was found, for the report.

    Raises:
        InvalidValue: too few views, all frontal, most of the image empty, focal length
        not fixed, or too many views that fit no camera.
    """
    pictures = len(views) + len(missing)
    _check_count(views, pictures)
    robust, tried = _robust_fit(views, MODEL_NAMES if model == "auto" else (model,))
    _check_count(robust.views, pictures)
    # Tilt and coverage first: their messages name best what to add.
    covered, fit = coverage(robust.views), robust.fit
    _check_variety(robust, covered)
    covariance = lens_covariance(fit)
    _check_focal(fit.parameters, np.sqrt(np.diag(covariance)))
    return Calibration(
        board=board,
        fit=fit,
        covariance=covariance,
        views=robust.views,
        rejections=robust.rejections,
        missing=tuple(missing),
        tried=tried,
        errors=predict_errors(fit.camera, covariance, covered=covered),
        covered=covered,
        lacks=tuple(_lacks(fit, len(robust.views), covered)),
    )


def _robust_fit(
    views: Sequence[BoardView], models: Sequence[str]
) -> tuple[Robust, dict[str, float]]:
    """Return the views without outliers and their fit, by the simplest of `models` that follows the
    lens (one that cannot would call the views at the picture's rim outliers); and the spread of
    the residuals that each model leaves, in px.

    Raises InvalidValue: the views fit no camera.
    """
    fits: dict[str, tuple[Fit, float]] = {}
    for name in models:
        try:
            fits[name] = weighted_fit(views, name)
        except NoSolution as error:
            if name == models[0]:
                hint = "is --board the true layout of the board?"
                raise InvalidValue(f"{error}: {hint}") from None
    best, best_spread = fits[models[0]]
    for fit, spread in fits.values():
        if spread < _EASIER * best_spread and _is_usable(fit):
            best, best_spread = fit, spread
    return reject_outliers(views, best), {name: spread for name, (_, spread) in fits.items()}


def _is_usable(fit: Fit) -> bool:
    """Return true if the lens is one-to-one over the image and its centre lies inside."""
    camera = fit.camera
    w, h = camera.size_px
    grid = pixel_grid(camera.size_px)
    rays = undistort(grid, camera)
    if not (0 < camera.K[0, 2] < w and 0 < camera.K[1, 2] < h and np.isfinite(rays).all()):
        return False
    ahead = np.column_stack([rays, np.ones(len(rays))])
    again = project(ahead, np.zeros(3), np.zeros(3), camera)
    return bool(np.abs(again - grid).max() < 0.05)


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
    """Return what keeps it from being a good calibration, whatever its error, and goes with more
    pictures."""
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
    """Return how far each board (poses (v, 6)) is turned out of the image plane, (v,) deg."""
    normals = np.array([cv2.Rodrigues(pose[:3])[0][2, 2] for pose in poses])
    return np.asarray(np.degrees(np.arccos(np.minimum(np.abs(normals), 1.0))), dtype=np.float64)


def _uncovered_text(covered: NDArray[np.bool_]) -> str:
    """Return the emptier ninths of the picture, the emptiest first: 'at the top left and right'."""
    thirds = [
        (float(cell.mean()), name)
        for row, names in zip(np.array_split(covered, 3), _NAMES, strict=True)
        for cell, name in zip(np.array_split(row, 3, axis=1), names, strict=True)
    ]
    empty = [name for share, name in sorted(thirds) if share < 0.6][:4]
    if not empty:
        return "at the rims"
    return "at the " + (", ".join(empty[:-1]) + " and " + empty[-1] if empty[1:] else empty[0])
