"""Solve for the camera from the views of a board, judge the result, and say what to add if the
views are not enough."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.board.adjust import (
    MODEL_NAMES,
    PARAMETERS,
    CameraFit,
    NoSolution,
    fit_camera,
    lens_covariance,
    reject_outliers,
)
from perchctl.calibration.board.detect import BoardView, FoundViews, FrameCounts, Rejection
from perchctl.calibration.board.predict import (
    ErrorAtRange,
    allowed_error_mm,
    covered_cells,
    predict_errors,
)
from perchctl.calibration.files import calibration_text
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.vision import CameraModel, project, undistort_to_normalised

Level = Literal["fly", "care", "stop"]
TITLES: dict[Level, str] = {
    "fly": "GOOD TO FLY",
    "care": "FLY WITH CARE",
    "stop": "DO NOT FLY WITH THIS",
}
CARE_FACTOR = 3.0
ASIDE_FACTOR = 2.0
_EASIER = 0.95  # a richer model is used only if it reduces the spread to this share or less


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of a calibration.

    Attributes:
        fit: the camera, and the poses and residuals of the `views`.
        covariance: covariance (p, p) of the p lens parameters.
        views: the views used, without rejected corners.
        without_board: images without a board, and why.
        errors: predicted position error of the target at each distance.
        covered_cells: mask (rows, columns) of the image's grid cells that boards covered.
        defects: sentences about shortcomings of the views, with remedies; any of them rules out the
            best verdict.
        frames: the counts of frames from a video or camera; None for image files.
    """

    board: str
    fit: CameraFit
    covariance: Array
    views: tuple[BoardView, ...]
    rejections: tuple[Rejection, ...]
    without_board: tuple[Rejection, ...]
    errors: tuple[ErrorAtRange, ...]
    covered_cells: NDArray[np.bool_]
    defects: tuple[str, ...]
    frames: FrameCounts | None = None

    @property
    def camera(self) -> CameraModel:
        """The camera model."""
        return self.fit.camera

    @property
    def parameter_std(self) -> Array:
        """Standard deviation of each lens parameter, (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def verdict(self) -> Level:
        """The verdict, based on the defects and on the predicted error straight ahead, where the
        target is during a perch. Off the axis, twice the limit is accepted."""
        ahead = max(e.axis_mm95 / allowed_error_mm(e.z_m) for e in self.errors)
        aside = max(e.mm95 / allowed_error_mm(e.z_m) for e in self.errors)
        if ahead <= 1.0 and aside <= ASIDE_FACTOR and not self.defects:
            return "fly"
        return "care" if ahead <= CARE_FACTOR else "stop"

    @property
    def verdict_text(self) -> str:
        """The verdict in words, with the predicted errors at 10 cm and 1 m."""
        return f"{TITLES[self.verdict]}: {self.errors_text}"

    @property
    def errors_text(self) -> str:
        """The predicted errors at 10 cm and 1 m in words."""
        near, far = (e for e in self.errors if e.z_m in (0.1, 1.0))
        text = (
            f"the target's centre is accurate to {near.axis_mm95:.2g} mm at 10 cm and "
            f"{far.axis_mm95:.2g} mm at 1 m (95 %)"
        )
        aside = max(self.errors, key=lambda e: e.mm95 / allowed_error_mm(e.z_m))
        if aside.mm95 > ASIDE_FACTOR * allowed_error_mm(aside.z_m):
            text += (
                f", but away from the optical axis only to {aside.mm95:.2g} mm at "
                f"{aside.z_m * 100:.0f} cm"
            )
        return text

    def lines(self) -> list[str]:
        """Return the lines of text about rejections, lens parameters, shortcomings and the
        verdict."""
        lines = [f"left out {r.view}: {r.reason}" for r in self.without_board]
        for r in self.rejections:
            what = (
                f"corners {', '.join(map(str, r.corner_ids))} of {r.view}"
                if r.corner_ids
                else r.view
            )
            lines.append(f"rejected {what}: {r.reason}")
        values = zip(
            ("fx", "fy", "cx", "cy"), self.fit.parameters, self.parameter_std, strict=False
        )
        lens = ", ".join(f"{name} {value:.2f} +- {std:.2f}" for name, value, std in values)
        lines.append(
            f"{len(self.views)} views, RMS {self.fit.rms_px:.3f} px, {self.camera.model}, {lens} px"
        )
        return [*lines, *self.defects, self.verdict_text]

    def record(self) -> dict[str, Any]:
        """The JSON object that `calibrate` prints."""
        names = PARAMETERS[self.camera.model]
        values = self.fit.parameters.tolist()
        return {
            **dict(zip(names[:4], values[:4], strict=True)),
            "distortion": self.camera.dist.tolist(),
            "model": self.camera.model,
            "size_px": list(self.camera.size_px),
            "board": self.board,
            "rms_px": self.fit.rms_px,
            "views_used": len(self.views),
            "views_rejected": rejected_view_records(self.rejections),
            "pictures_without_board": rejected_view_records(self.without_board),
            "std": dict(zip(names, self.parameter_std.tolist(), strict=True)),
            "error_mm": [vars(e) | {"limit_mm": allowed_error_mm(e.z_m)} for e in self.errors],
            "coverage": float(self.covered_cells.mean()),
            "warnings": list(self.defects),
            "verdict": self.verdict,
        }

    def file_text(self, name: str, date: str) -> str:
        """The calibration file's text, with quality and covariance; `name` is the camera's."""
        return calibration_text(
            self.camera,
            name,
            {
                "date": date,
                "board": self.board,
                "rms_px": self.fit.rms_px,
                "views_used": len(self.views),
                "views_rejected": len(rejected_view_records(self.rejections)),
                "picture_hashes": " ".join(v.picture_hash for v in self.views if v.picture_hash),
                "parameters": " ".join(PARAMETERS[self.camera.model]),
                "parameter_std": self.parameter_std[None],
                "parameter_covariance": self.covariance,
            },
        )


def rejected_view_records(rejections: Iterable[Rejection]) -> list[dict[str, str]]:
    """Return name and reason of each wholly rejected view, for JSON."""
    return [{"name": r.view, "reason": r.reason} for r in rejections if not r.corner_ids]


def calibrate_camera(found: FoundViews, board: str, model: str = "auto") -> Calibration:
    """Fit the camera without outliers, and predict the position error at the target.

    Args:
        board: notation of the board, to be written to the file.
        model: ``plumb_bob`` or ``fisheye``; ``auto`` for the simplest one that describes the lens.

    Raises:
        InvalidValue: there are too few views, all views are frontal, most of the image is empty,
            the views do not determine the focal length, or too many views do not fit a common
            camera model.
    """
    _check_count(found.views, found)
    models = MODEL_NAMES if model == "auto" else (model,)
    fit, kept, rejections = robust_fit(found.views, models)
    _check_count(kept, found)
    # Tilt and coverage are checked first, because their messages give the best advice.
    covered = covered_cells(kept)
    _check_variety(fit, covered)
    covariance = lens_covariance(kept, fit)
    _check_focal(fit.parameters, np.sqrt(np.diag(covariance)))
    return Calibration(
        board=board,
        fit=fit,
        covariance=covariance,
        views=tuple(kept),
        rejections=tuple(rejections),
        without_board=found.without_board,
        errors=predict_errors(fit.camera, covariance, covered),
        covered_cells=covered,
        defects=tuple(_lacks(fit, len(kept), covered)),
        frames=found.frames,
    )


def robust_fit(
    views: Sequence[BoardView], models: Sequence[str] = MODEL_NAMES
) -> tuple[CameraFit, list[BoardView], list[Rejection]]:
    """Fit the views without outliers, with the simplest of the `models` that describes the lens. (A
    model that does not fit would reject views at the edge of the image.) Return the fit, the
    views used, and the rejected views and corners.

    Raises InvalidValue if no camera model fits the views.
    """
    best: CameraFit | None = None
    for model in models:
        try:
            fit = fit_camera(views, model)
        except NoSolution:
            continue
        follows = best is not None and fit.robust_std_px < _EASIER * best.robust_std_px
        if best is None or (follows and _is_usable(fit.camera)):
            best = fit
    try:
        if best is not None:
            return reject_outliers(views, best)
    except NoSolution:
        pass
    raise InvalidValue("no camera model fits these images: check that --board matches the board")


def _is_usable(camera: CameraModel) -> bool:
    w, h = camera.size_px
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 17), np.linspace(0, h - 1, 13)), axis=-1)
    pixels = grid.reshape(-1, 2)
    rays = undistort_to_normalised(pixels, camera)
    if not (0 < camera.K[0, 2] < w and 0 < camera.K[1, 2] < h and np.isfinite(rays).all()):
        return False
    ahead = np.column_stack([rays, np.ones(len(rays))])
    again = project(ahead, np.zeros(3), np.zeros(3), camera)
    return bool(np.abs(again - pixels).max() < 0.05)


# --- Check that the views are enough for a calibration and, if not, say what to add ---


MIN_VIEWS, GOOD_VIEWS = 5, 10
MIN_TILT_DEG = 12.0
MIN_TILTED = 3
MIN_COVERED, GOOD_COVERED = 0.3, 0.7
MAX_FOCAL_ERROR = 0.01
_NAMES = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)


def _check_count(views: Sequence[BoardView], found: FoundViews) -> None:
    """Raise InvalidValue if there are too few usable `views`."""
    if len(views) >= MIN_VIEWS:
        return
    missing = MIN_VIEWS - len(views)
    variety = (
        "with the board tilted by 20 to 45 deg in all directions, near and far, and in every "
        "corner of the image"
    )
    if found.frames is not None:
        advice = found.frames.advice or f"show the board {variety.removeprefix('with the board ')}"
        raise InvalidValue(
            f"only {len(views)} usable views, but at least {MIN_VIEWS} are needed "
            f"({found.frames.text}): {advice}"
        )
    pictures = len(found.views) + len(found.without_board)
    of = f"of {pictures} images" if pictures > len(views) else "images"
    raise InvalidValue(
        f"only {len(views)} {of} show the board, but at least {MIN_VIEWS} are needed: "
        f"add {missing} or more (15 to 25 are good) {variety}"
    )


def _check_variety(fit: CameraFit, covered: NDArray[np.bool_]) -> None:
    """Raise InvalidValue if all views are frontal or most of the image is empty."""
    tilts = tilts_deg(fit.poses)
    tilted = int((tilts >= MIN_TILT_DEG).sum())
    if tilted < MIN_TILTED:
        raise InvalidValue(
            f"{tilted} of {len(tilts)} views are tilted by more than {MIN_TILT_DEG:g} deg (the "
            f"largest tilt is {tilts.max():.0f} deg), so focal length and distance cannot be "
            f"separated: add {MIN_TILTED - tilted} or more with the board tilted by 20 to 45 deg, "
            "about both axes"
        )
    if covered.mean() < MIN_COVERED:
        raise InvalidValue(
            f"the boards cover {100 * covered.mean():.0f} % of the image, but at least "
            f"{100 * MIN_COVERED:.0f} % are needed: add views with the board "
            f"{_uncovered_text(covered)} of the image, or closer"
        )


def _check_focal(parameters: Array, std: Array) -> None:
    share = float((std[:2] / parameters[:2]).max())
    if not share <= MAX_FOCAL_ERROR:
        raise InvalidValue(
            f"the views determine the focal length only to +-{100 * share:.1f} % (at most "
            f"{100 * MAX_FOCAL_ERROR:g} % is accepted): add sharp views with the board "
            "tilted by 20 to 45 deg about both axes and filling half of the image"
        )


def _lacks(fit: CameraFit, views: int, covered: NDArray[np.bool_]) -> list[str]:
    lacks = []
    if not _is_usable(fit.camera):
        lacks.append("the lens model folds back inside the image: add views at the image's edges")
    if views < GOOD_VIEWS:
        lacks.append(f"only {views} views: add {GOOD_VIEWS - views} or more")
    if covered.mean() < GOOD_COVERED:
        lacks.append(
            f"{100 * (1 - covered.mean()):.0f} % of the image is uncovered: add views with the "
            f"board {_uncovered_text(covered)}"
        )
    return lacks


def tilts_deg(poses: Array) -> Array:
    """The angles (v,) between the boards and the image plane, from the boards' poses (v, 6)."""
    normals = np.array([cv2.Rodrigues(pose[:3])[0][2, 2] for pose in poses])
    return np.asarray(np.degrees(np.arccos(np.minimum(np.abs(normals), 1.0))), dtype=np.float64)


def _uncovered_text(covered: NDArray[np.bool_]) -> str:
    thirds = [
        (float(cell.mean()), name)
        for row, names in zip(np.array_split(covered, 3), _NAMES, strict=True)
        for cell, name in zip(np.array_split(row, 3, axis=1), names, strict=True)
    ]
    empty = [name for share, name in sorted(thirds) if share < 0.6][:4]
    *others, last = empty or ["edges"]
    return f"at the {', '.join(others)} and {last}" if others else f"at the {last}"
