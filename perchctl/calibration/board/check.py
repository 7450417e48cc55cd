"""Check an existing calibration against new images.

For the camera in the file, only the board poses are fitted to the new views. This camera is
compared with one whose parameters are fitted to the new views as well. The reprojection error of
the camera in the file reveals wrong lens parameters. The poses can absorb a wrong focal length,
however, so the target positions that follow from the two cameras are compared as well. The check
fails

- if the RMS error of the camera in the file is more than twice that of the fitted camera and above
  0.3 px, or
- if the target positions straight ahead differ by more than half of the limit (1 mm, or 1 % of the
  distance) and by more than the 95 % uncertainty of the fitted camera.

If the calibration would pass but the 95 % uncertainty of the fitted camera is above twice the
limit, the new images are not accurate enough, and perchctl reports an error instead of a verdict.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from perchctl.calibration.board.adjust import CameraFit, fit_poses, lens_covariance
from perchctl.calibration.board.detect import FoundViews, Rejection
from perchctl.calibration.board.predict import allowed_error_mm, position_errors_mm, predict_errors
from perchctl.calibration.board.solve import rejected_view_records, robust_fit, tilts_deg
from perchctl.errors import InvalidValue
from perchctl.vision import CameraModel

MIN_CHECK_VIEWS = 3
RMS_FACTOR = 2.0
RMS_FLOOR_PX = 0.3
UNSURE_FACTOR = 2.0


@dataclass(frozen=True)
class Deviation:
    """`mm`: shift of the target's position, straight ahead at distance `z_m`, between the checked
    and the refitted camera; `mm95`: 95 % uncertainty of the refit."""

    z_m: float
    mm: float
    mm95: float

    @property
    def allowed_error_share(self) -> float:
        """`mm` relative to the error that perching allows; 0 if `mm` is within `mm95`."""
        return self.mm / allowed_error_mm(self.z_m) if self.mm > self.mm95 else 0.0


@dataclass(frozen=True)
class CheckResult:
    """Verdict on a calibration, based on new images, and the `reason` for it.

    rms_px: reprojection error of the checked camera (infinite if boards are out of its view);
    best_rms_px: error of the camera refitted to the images; rejections: outliers left out.
    """

    passed: bool
    reason: str
    rms_px: float
    best_rms_px: float
    deviations: tuple[Deviation, ...]
    rejections: tuple[Rejection, ...]

    def record(self, file: Path) -> dict[str, Any]:
        """The JSON object that `calibrate check` prints; `file` is the checked calibration."""
        return {
            "pass": self.passed,
            "reason": self.reason,
            "file": str(file),
            "rms_px": self.rms_px if np.isfinite(self.rms_px) else None,
            "best_rms_px": self.best_rms_px,
            "views_rejected": rejected_view_records(self.rejections),
            "error_mm": [vars(d) for d in self.deviations if np.isfinite(d.mm)],
        }


def check_calibration(
    camera: CameraModel, found: FoundViews, own_hashes: Collection[str] = ()
) -> CheckResult:
    """Check a calibration against new views of a board.

    Args:
        own_hashes: `BoardView.picture_hash` of the images that the calibration was made from. These
            images are left out: a calibration always fits its own images, even if it is wrong.

    Raises InvalidValue for too few views, or views that cannot reveal a wrong focal length.
    """
    own = [view for view in found.views if view.picture_hash in own_hashes]
    found = replace(found, views=tuple(view for view in found.views if view not in own))
    if own and len(found.views) < MIN_CHECK_VIEWS:
        raise InvalidValue(
            f"{len(own)} of {len(own) + len(found.views)} views are from images that the "
            "calibration was made from, so they cannot test it: take new images"
        )
    if len(found.views) < MIN_CHECK_VIEWS:
        advice = "add images with the board tilted by 20 to 45 deg and near the image's edges"
        seen = f"{len(found.views)} images show the board"
        if found.frames is not None:
            seen = f"{len(found.views)} usable views ({found.frames.text})"
            advice = found.frames.advice or advice
        raise InvalidValue(f"{seen}, but a check needs at least {MIN_CHECK_VIEWS}: {advice}")
    free, kept, outliers = robust_fit(found.views)
    reason = "the calibration was made from this image"
    rejections = [*(Rejection(view.name, reason) for view in own), *outliers]
    fixed = fit_poses(kept, camera)
    if fixed is None:
        reason = (
            "no pose of the board fits the images with this calibration, which may belong to "
            "another camera"
        )
        return CheckResult(False, reason, np.inf, free.rms_px, (), tuple(rejections))
    deviations = tuple(
        Deviation(e.z_m, float(position_errors_mm(camera, free.camera, e.z_m)[0]), e.axis_mm95)
        for e in predict_errors(free.camera, lens_covariance(kept, free))
    )
    passed, reason = _verdict(fixed, free, deviations)
    if passed:
        _check_evidence(free, deviations)
    return CheckResult(passed, reason, fixed.rms_px, free.rms_px, deviations, tuple(rejections))


def _verdict(
    fixed: CameraFit, free: CameraFit, deviations: Sequence[Deviation]
) -> tuple[bool, str]:
    if fixed.rms_px > max(RMS_FACTOR * free.rms_px, RMS_FLOOR_PX):
        return False, (
            f"reprojection RMS {fixed.rms_px:.2f} px, but {free.rms_px:.2f} px is possible "
            "with these images"
        )
    worst = max(deviations, key=lambda d: d.allowed_error_share, default=None)
    if worst is not None and worst.allowed_error_share > 0.5:
        return False, (
            f"at {worst.z_m * 100:.0f} cm the target would be {worst.mm:.1f} mm from where "
            f"these images place it (+-{worst.mm95:.1f} mm), but only "
            f"{0.5 * allowed_error_mm(worst.z_m):.1f} mm is allowed"
        )
    return True, f"reprojection RMS {fixed.rms_px:.2f} px ({free.rms_px:.2f} px at best)"


def _check_evidence(free: CameraFit, deviations: Sequence[Deviation]) -> None:
    """Raise InvalidValue if these images could not reveal a wrong focal length."""
    if deviations and all(d.mm95 <= UNSURE_FACTOR * allowed_error_mm(d.z_m) for d in deviations):
        return
    raise InvalidValue(
        f"{len(free.poses)} images (board tilted by at most "
        f"{tilts_deg(free.poses).max():.0f} deg) are not enough to judge the focal "
        "length: add images with the board tilted by 20 to 45 deg and filling the image"
    )
