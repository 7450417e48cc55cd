"""The report on a calibration: what the views cover, how well the camera model fits them, and what
to add.

A residual is the detected corner position minus the one that the camera model predicts. Residuals
in random directions come from image noise. If neighbouring residuals point in the same direction in
many views, the model does not describe the lens, or the board is not flat.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from perchctl.calibration.board.capture import (
    axis_advice,
    coverage_bars,
    covered_shares,
    view_signature,
)
from perchctl.calibration.board.detect import BoardView, Rejection
from perchctl.calibration.board.predict import CELLS, ErrorAtRange, allowed_error_mm
from perchctl.calibration.board.solve import ASIDE_FACTOR, TITLES, Calibration, tilts_deg
from perchctl.calibration.live import GuidanceBar
from perchctl.geometry import Array
from perchctl.report_page import render_template
from perchctl.target import Board

_VERDICT_GRADES = {"fly": "good", "care": "warn", "stop": "bad"}
_LONG_SHARE = 0.04
"""Length at which a long residual is drawn, in image widths. Larger: neighbours cross. Smaller: the
directions of the residuals cannot be seen."""
_LONG_PERCENTILE = 95.0
"""Percentile of the residuals' lengths that is used as the length of a long residual. Larger: a few
outliers shrink the others. Smaller: the longest arrows extend beyond the image."""
_LEAST_RESIDUAL_PX = 1e-3
"""Smallest length that counts as a long residual, px: with exact corners, all residuals are 0."""
_LEAST_STEPS = 2
"""Minimum number of steps on the distance axis; there may be up to 2.5 times as many. Larger:
labels overlap."""
_STEPS = (1.0, 2.0, 5.0)
"""Leading digits to which the enlargement, the length of the scale arrow and the steps of an axis
are rounded."""


@dataclass(frozen=True, eq=False)
class ReportedView:
    """One view used to compute the camera model.

    Attributes:
        outline_px: the convex hull of its corners, (n, 2).
        predicted_px, residuals_px: its corners according to the camera model, and the detected
            corners minus those.
        distance_m: distance of the board's centre from the camera.
        tilt_deg: angle between the board and the image plane.
        facing: unit vector (2,) in the image (right, down) towards the side that the board faces.
        rejected_corners: number of corners that were rejected as outliers.
    """

    name: str
    outline_px: Array
    predicted_px: Array
    residuals_px: Array
    distance_m: float
    tilt_deg: float
    facing: Array
    rejected_corners: int

    @property
    def rms_px(self) -> float:
        """RMS residual, defined as in OpenCV."""
        return float(np.sqrt((self.residuals_px**2).sum(axis=1).mean()))


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """The content of a calibration's report page.

    Attributes:
        name: name of the calibration file.
        date: date and time in ISO 8601, UTC.
    """

    result: Calibration
    name: str
    date: str

    @property
    def date_text(self) -> str:
        """The date to the minute."""
        return datetime.datetime.fromisoformat(self.date).strftime("%Y-%m-%d %H:%M UTC")

    @property
    def title(self) -> str:
        """The verdict."""
        return TITLES[self.result.verdict]

    @property
    def grade(self) -> str:
        """Grade of the verdict: good, warn or bad."""
        return _VERDICT_GRADES[self.result.verdict]

    @cached_property
    def views(self) -> tuple[ReportedView, ...]:
        """The views used, the largest residuals first."""
        result = self.result
        rejected = {r.view: len(r.corner_ids) for r in result.rejections}
        tilts = tilts_deg(result.fit.poses).tolist()
        parts = zip(result.views, result.fit.poses, result.fit.residuals, tilts, strict=True)
        views = [
            _reported_view(view, pose, residuals, tilt, rejected.get(view.name, 0))
            for view, pose, residuals, tilt in parts
        ]
        return tuple(sorted(views, key=lambda view: -view.rms_px))

    @property
    def rejections(self) -> list[Rejection]:
        """The views and images that were not used, with the reasons. Single corners are not
        included."""
        whole = [r for r in self.result.rejections if not r.corner_ids]
        return [*whole, *self.result.without_board]

    @cached_property
    def _signatures(self) -> list[Array]:
        board = Board.parse(self.result.board)
        return [view_signature(view, board) for view in self.result.views]

    @property
    def bars(self) -> dict[str, tuple[GuidanceBar, float]]:
        """The coverage bars, as during the capture, each with its share of the goal."""
        shares = covered_shares(self._signatures)
        return {axis: (bar, shares[axis]) for axis, bar in coverage_bars(self._signatures).items()}

    @property
    def advice(self) -> list[str]:
        """Suggestions for improvement, one sentence each; empty if there are none."""
        advice = [f"{defect}." for defect in self.result.defects]
        for axis, share in covered_shares(self._signatures).items():
            if share < 1.0:
                advice.append(
                    f"the views reach {100 * share:.0f} % of the goal for {axis}: "
                    f"{axis_advice(self._signatures, axis)}."
                )
        if any(self.is_too_large(error) for error in self.result.errors):
            advice.append(
                "the expected error exceeds its limit at some distances: add sharp views, near "
                "and far, with the board tilted by 20 to 45 deg about both axes."
            )
        if any(not r.corner_ids for r in self.result.rejections):
            advice.append(
                "some views do not fit the others: take them again with the board flat and still, "
                "and leave zoom and focus unchanged."
            )
        return [sentence[:1].upper() + sentence[1:] for sentence in advice]

    def is_too_large(self, error: ErrorAtRange) -> bool:
        """True if an expected error rules out the best verdict."""
        return self.is_ahead_too_large(error) or self.is_aside_too_large(error)

    def is_ahead_too_large(self, error: ErrorAtRange) -> bool:
        """True if the error straight ahead exceeds its limit."""
        return error.axis_mm95 > allowed_error_mm(error.z_m)

    def is_aside_too_large(self, error: ErrorAtRange) -> bool:
        """True if the error off the axis exceeds its limit."""
        return error.mm95 > ASIDE_FACTOR * allowed_error_mm(error.z_m)

    @cached_property
    def enlargement(self) -> float:
        """Factor by which residuals are enlarged in the drawing."""
        lengths_px = np.linalg.norm(np.concatenate(self.result.fit.residuals), axis=1)
        long_px = max(float(np.percentile(lengths_px, _LONG_PERCENTILE)), _LEAST_RESIDUAL_PX)
        return round_down(_LONG_SHARE * self.result.camera.size_px[0] / long_px)

    @property
    def key_px(self) -> float:
        """Length of the scale arrow in the drawing: a round number of px, close to the longest
        residuals."""
        return round_down(_LONG_SHARE * self.result.camera.size_px[0] / self.enlargement)

    @property
    def largest_px(self) -> float:
        """Length of the longest residual."""
        return float(np.linalg.norm(np.concatenate(self.result.fit.residuals), axis=1).max())

    @property
    def uncovered_boxes_px(self) -> list[tuple[float, float, float, float]]:
        """Left, top, width and height of each part of the image that no board covered. Adjacent
        empty cells in a row of the grid are combined."""
        w, h = self.result.camera.size_px
        rows, columns = CELLS
        boxes = []
        for row, covered in enumerate(self.result.covered_cells):
            edges = np.flatnonzero(np.diff(np.concatenate([[1], covered, [1]]).astype(int)))
            for start, end in edges.reshape(-1, 2).tolist():
                left, width = w * start / columns, w * (end - start) / columns
                boxes.append((left, h * row / rows, width, h / rows))
        return boxes

    @property
    def distance_ticks_m(self) -> list[float]:
        """Axis ticks at round distances, from 0 to beyond the farthest view."""
        farthest_m = max(view.distance_m for view in self.views)
        step_m = round_down(farthest_m / _LEAST_STEPS)
        return [step_m * k for k in range(int(np.ceil(farthest_m / step_m)) + 1)]

    @property
    def parameters(self) -> list[tuple[str, float, float]]:
        """Name, value and standard deviation of each focal length and centre coordinate, px."""
        names, result = ("fx", "fy", "cx", "cy"), self.result
        values, std = result.fit.parameters.tolist(), result.parameter_std.tolist()
        return list(zip(names, values[:4], std[:4], strict=True))


def calibration_report(result: Calibration, name: str, date: str) -> str:
    """The report on a calibration as a self-contained HTML page. `name` is the name of the
    calibration file; `date` is in ISO 8601."""
    return render_template(
        "perchctl.calibration",
        "calibration.html",
        report=CalibrationReport(result, name, date),
        result=result,
        allowed_error_mm=allowed_error_mm,
        aside_factor=ASIDE_FACTOR,
    )


def round_down(value: float) -> float:
    """The largest number of the form 1, 2 or 5 times a power of ten that is not above `value`,
    which must be positive."""
    power = 10.0 ** np.floor(np.log10(value))
    digit = max(step for step in _STEPS if step * power <= value * (1.0 + 1e-9))
    return float(f"{digit * power:.6g}")


def _reported_view(
    view: BoardView, pose: Array, residuals_px: Array, tilt_deg: float, rejected_corners: int
) -> ReportedView:
    R = np.asarray(cv2.Rodrigues(pose[:3])[0], dtype=np.float64)
    middle_m = R @ view.corners_m.mean(axis=0) + pose[3:]
    normal = -R[:, 2] if R[2, 2] > 0 else R[:, 2]  # points towards the camera
    hull = cv2.convexHull(view.corners_px.astype(np.float32))
    sideways = float(np.linalg.norm(normal[:2]))
    return ReportedView(
        name=view.name,
        outline_px=np.asarray(hull.reshape(-1, 2), dtype=np.float64),
        predicted_px=view.corners_px - residuals_px,
        residuals_px=residuals_px,
        distance_m=float(np.linalg.norm(middle_m)),
        tilt_deg=tilt_deg,
        facing=normal[:2] / max(sideways, 1e-9),
        rejected_corners=rejected_corners,
    )
