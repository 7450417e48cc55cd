"""Does an existing calibration fit new pictures?

The new views give two solutions: the file's camera with only the boards' poses fitted,
and a camera of the same model fitted to these views alone. The first's reprojection
error shows a wrong lens; but poses take up a wrong focal length, so the two cameras
are compared at the target as well, in mm. The check fails

- when the file's RMS is more than twice that of the free camera and above 0.3 px, or
- when the two put the target further apart, straight ahead, than half of the limit
  (1 mm, or 1 % of the distance) and than the 95 % line of the new pictures themselves.

Pictures whose own 95 % line is above twice the limit cannot judge, and the check is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from perchctl.calibration.bundle import Fit, NoSolution, fit_from, poses_only
from perchctl.calibration.enough import tilts_deg
from perchctl.calibration.predict import RANGES_M, position_errors_mm, predict_errors
from perchctl.calibration.robust import reject, weighted_fit
from perchctl.calibration.solve import lens_covariance
from perchctl.calibration.types import BoardView, Calibration, Rejection
from perchctl.errors import InvalidValue
from perchctl.vision import CameraModel

MIN_CHECK_VIEWS = 3
RMS_FACTOR = 2.0
RMS_FLOOR_PX = 0.3
UNSURE_FACTOR = 2.0


@dataclass(frozen=True)
class Deviation:
    """mm: between the target's places by the two cameras, straight ahead; mm95: how well
    the new pictures fix it."""

    z_m: float
    mm: float
    mm95: float


@dataclass(frozen=True)
class CheckResult:
    passed: bool
    reason: str
    rms_px: float
    free_rms_px: float
    views: tuple[tuple[str, float], ...]  # name and RMS with the file's camera
    rejections: tuple[Rejection, ...]
    deviations: tuple[Deviation, ...]


def check_calibration(camera: CameraModel, views: Sequence[BoardView]) -> CheckResult:
    """Judge a calibration by new views of a board.

    Raises InvalidValue for too few views, or views that do not fix it.
    """
    if len(views) < MIN_CHECK_VIEWS:
        raise InvalidValue(
            f"{len(views)} pictures show the board, a check needs at least {MIN_CHECK_VIEWS}: add "
            f"some with the board tilted by 20 to 45 deg and near the picture's rims"
        )
    try:
        robust = reject(views, weighted_fit(views, camera.model)[0])
    except NoSolution:
        raise InvalidValue(
            "no camera fits these pictures: is --board the true layout of the board?"
        ) from None
    free = _nearer(robust.views, robust.fit, camera)
    fixed = poses_only(robust.views, camera)
    if fixed is None:
        return CheckResult(
            False,
            "the calibration cannot see the boards where they are: it is another camera's",
            float("inf"),
            free.rms_px,
            (),
            robust.rejections,
            (),
        )
    covariance = lens_covariance(free)
    own = predict_errors(free.camera, covariance) if np.isfinite(covariance).all() else ()
    deviations = tuple(
        Deviation(e.z_m, float(position_errors_mm(camera, free.camera, e.z_m)[0]), e.axis_mm95)
        for e in own
    )
    passed, reason = _judged(fixed, free, deviations)
    if passed:
        _check_evidence(robust.views, free, deviations)
    rms = [float(np.sqrt((r**2).sum(axis=1).mean())) for r in fixed.residuals]
    names = [v.name for v in robust.views]
    return CheckResult(
        passed,
        reason,
        fixed.rms_px,
        free.rms_px,
        tuple(zip(names, rms, strict=True)),
        robust.rejections,
        deviations,
    )


def _nearer(views: Sequence[BoardView], fit: Fit, camera: CameraModel) -> Fit:
    """The better of the free solutions from nothing and from the file's camera."""
    try:
        other = fit_from(views, camera)
    except NoSolution:
        return fit
    return other if other.cost < fit.cost else fit


def _judged(fixed: Fit, free: Fit, deviations: Sequence[Deviation]) -> tuple[bool, str]:
    if fixed.rms_px > max(RMS_FACTOR * free.rms_px, RMS_FLOOR_PX):
        return False, (
            f"reprojection RMS {fixed.rms_px:.2f} px, where these pictures allow "
            f"{free.rms_px:.2f} px"
        )
    worst = max(deviations, key=lambda d: _share(d), default=None)
    if worst is not None and _share(worst) > 0.5:
        return False, (
            f"at {worst.z_m * 100:.0f} cm the target would be {worst.mm:.1f} mm from where "
            f"these pictures put it (+-{worst.mm95:.1f} mm), and "
            f"{0.5 * limit_mm(worst.z_m):.1f} mm is allowed"
        )
    return True, f"reprojection RMS {fixed.rms_px:.2f} px ({free.rms_px:.2f} px at best)"


def _share(deviation: Deviation) -> float:
    """Of the limit; zero where the pictures themselves do not fix it so well."""
    if deviation.mm <= deviation.mm95:
        return 0.0
    return deviation.mm / limit_mm(deviation.z_m)


def _check_evidence(views: Sequence[BoardView], free: Fit, deviations: Sequence[Deviation]) -> None:
    """Raises InvalidValue where the pictures could not show a wrong focal length."""
    unsure = not deviations or any(
        d.mm95 > UNSURE_FACTOR * limit_mm(d.z_m) for d in deviations if d.z_m in RANGES_M
    )
    if unsure:
        tilt = float(tilts_deg(free.poses).max())
        raise InvalidValue(
            f"{len(views)} pictures (board tilted by at most {tilt:.0f} deg) are too little to "
            f"judge a focal length: add some with the board tilted by 20 to 45 deg, filling "
            f"the picture"
        )


# --- What a calibration is good for: its predicted error against what perching needs -----------


Level = Literal["fly", "care", "stop"]
LIMIT_SHARE = 0.01
LIMIT_FLOOR_MM = 1.0
CARE_FACTOR = 3.0
ASIDE_FACTOR = 2.0
TITLES: dict[Level, str] = {
    "fly": "GOOD TO FLY",
    "care": "FLY WITH CARE",
    "stop": "DO NOT FLY WITH THIS",
}


def limit_mm(z_m: float) -> float:
    """1 mm, or 1 % of the distance where that is more: the gear settles within 4 mm a hand's
    breadth under the target, and an approach from 1.5 m tolerates centimetres."""
    return max(LIMIT_FLOOR_MM, 1e3 * LIMIT_SHARE * z_m)


def level(calibration: Calibration) -> Level:
    """By the predicted error straight ahead of the camera, where perching happens; aside,
    where the search may see the target first, twice the limit will do. Of what the boards did
    not cover nothing is known, so that a calibration that lacks coverage is no good one."""
    ahead = max(e.axis_mm95 / limit_mm(e.z_m) for e in calibration.errors)
    aside = max(e.mm95 / limit_mm(e.z_m) for e in calibration.errors)
    if ahead <= 1.0 and aside <= ASIDE_FACTOR and not calibration.lacks:
        return "fly"
    return "care" if ahead <= CARE_FACTOR else "stop"


def sentence(calibration: Calibration) -> str:
    """The verdict in words, with the two distances that matter."""
    near = min(calibration.errors, key=lambda e: abs(e.z_m - 0.1))
    far = min(calibration.errors, key=lambda e: abs(e.z_m - 1.0))
    text = (
        f"{TITLES[level(calibration)]}: the target's centre is within {near.axis_mm95:.2g} mm at "
        f"{near.z_m * 100:.0f} cm and {far.axis_mm95:.2g} mm at {far.z_m * 100:.0f} cm (95 %)"
    )
    aside = max(calibration.errors, key=lambda e: e.mm95 / limit_mm(e.z_m))
    if aside.mm95 > ASIDE_FACTOR * limit_mm(aside.z_m):
        text += f", aside {aside.mm95:.2g} mm at {aside.z_m * 100:.0f} cm"
    if calibration.lacks:
        text += ", but " + " and ".join(lack.what for lack in calibration.lacks)
    return text
