"""A camera's calibration: its verdict, as lines for people, a record for programs, and a file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.board.adjust import PARAMETERS, Fit
from perchctl.calibration.board.detect import BoardView, Rejection
from perchctl.calibration.board.predict import RangeError, limit_mm
from perchctl.calibration.files import calibration_text, camera_record
from perchctl.geometry import Array
from perchctl.vision import CameraModel

Level = Literal["fly", "care", "stop"]
CARE_FACTOR = 3.0
ASIDE_FACTOR = 2.0
TITLES: dict[Level, str] = {
    "fly": "GOOD TO FLY",
    "care": "FLY WITH CARE",
    "stop": "DO NOT FLY WITH THIS",
}
_MOST_MISSING = 8
"""Pictures without a board that are named one by one."""


@dataclass(frozen=True)
class Lack:
    """What a calibration lacks, and what would mend it."""

    what: str
    advice: str

    def __str__(self) -> str:
        return f"{self.what}: {self.advice}"


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of a calibration.

    Attributes:
        fit: the adjustment's minimum; covariance (p, p) of its lens parameters.
        views: those used, without rejected corners; `fit` belongs to them.
        missing: pictures without a board, and why.
        tried: the spread of the residuals that each lens model leaves, in px.
        errors: what it means at the target, by distance.
        covered: the picture's cells (rows, columns) that boards were seen in.
        lacks: what keeps it from being a good one, whatever its error.
    """

    board: str
    fit: Fit
    covariance: Array
    views: tuple[BoardView, ...]
    rejections: tuple[Rejection, ...]
    missing: tuple[Rejection, ...]
    tried: dict[str, float]
    errors: tuple[RangeError, ...]
    covered: NDArray[np.bool_]
    lacks: tuple[Lack, ...] = ()

    @property
    def camera(self) -> CameraModel:
        """The camera model."""
        return self.fit.camera

    @property
    def std(self) -> Array:
        """Standard deviation of each lens parameter, (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def level(self) -> Level:
        """Verdict by the predicted error straight ahead of the camera, where perching happens;
        aside, where the search may see the target first, twice the limit will do. Of what the
        boards did not cover nothing is known: a calibration that lacks coverage is no good one."""
        ahead = max(e.axis_mm95 / limit_mm(e.z_m) for e in self.errors)
        aside = max(e.mm95 / limit_mm(e.z_m) for e in self.errors)
        if ahead <= 1.0 and aside <= ASIDE_FACTOR and not self.lacks:
            return "fly"
        return "care" if ahead <= CARE_FACTOR else "stop"

    @property
    def sentence(self) -> str:
        """The verdict in words, with the two distances that matter."""
        near = min(self.errors, key=lambda e: abs(e.z_m - 0.1))
        far = min(self.errors, key=lambda e: abs(e.z_m - 1.0))
        text = (
            f"{TITLES[self.level]}: the target's centre is within {near.axis_mm95:.2g} mm at "
            f"{near.z_m * 100:.0f} cm and {far.axis_mm95:.2g} mm at {far.z_m * 100:.0f} cm (95 %)"
        )
        aside = max(self.errors, key=lambda e: e.mm95 / limit_mm(e.z_m))
        if aside.mm95 > ASIDE_FACTOR * limit_mm(aside.z_m):
            text += f", aside {aside.mm95:.2g} mm at {aside.z_m * 100:.0f} cm"
        if self.lacks:
            text += ", but " + " and ".join(lack.what for lack in self.lacks)
        return text

    def lines(self) -> list[str]:
        """Return what was left out, lens, models, what it lacks, and the verdict at the end."""
        lines = [f"left out {r.view}: {r.reason}" for r in self.missing[:_MOST_MISSING]]
        if len(self.missing) > _MOST_MISSING:
            left = len(self.missing) - _MOST_MISSING
            lines.append(f"left out {left} more pictures without a board")
        for r in self.rejections:
            what = f"corners {', '.join(map(str, r.corners))} of {r.view}" if r.corners else r.view
            lines.append(f"rejected {what}: {r.reason}")
        lens = [
            f"{name} {value:.2f} +- {std:.2f}"
            for name, value, std in zip(
                ("fx", "fy", "cx", "cy"), self.fit.parameters, self.std, strict=False
            )
        ]
        lines.append(f"{len(self.views)} views, RMS {self.fit.rms_px:.3f} px, {', '.join(lens)} px")
        tried = ", ".join(f"{name} {spread:.3f} px" for name, spread in self.tried.items())
        lines.append(f"lens model {self.fit.model}; spread of the residuals: {tried}")
        return [*lines, *map(str, self.lacks), self.sentence]

    def record(self, file: Path, report: Path | None) -> dict[str, Any]:
        """Return the object of `calibrate --json`, with the places of the file and its picture."""
        names = PARAMETERS[self.fit.model]
        return camera_record(self.camera) | {
            "board": self.board,
            "rms_px": self.fit.rms_px,
            "views_used": len(self.views),
            "views": [
                {"name": v.name, "rms_px": float(rms), "corners": len(v)}
                for v, rms in zip(self.views, self.fit.view_rms_px(), strict=True)
            ],
            "views_rejected": rejected_views(self.rejections),
            "corners_rejected": [
                {"name": r.view, "reason": r.reason, "corners": list(r.corners)}
                for r in self.rejections
                if r.corners
            ],
            "pictures_without_board": rejected_views(self.missing),
            "std": dict(zip(names, self.std.tolist(), strict=True)),
            "error_mm": [vars(e) | {"limit_mm": limit_mm(e.z_m)} for e in self.errors],
            "models": self.tried,
            "coverage": float(self.covered.mean()),
            "warnings": [str(lack) for lack in self.lacks],
            "verdict": self.level,
            "file": str(file),
            "report": None if report is None else str(report),
        }

    def text(self, name: str, date: str) -> str:
        """Return the calibration file, with its quality and the parameters' covariance."""
        return calibration_text(
            self.camera,
            name,
            {
                "date": date,
                "board": self.board,
                "rms_px": self.fit.rms_px,
                "views_used": len(self.views),
                "views_rejected": len(rejected_views(self.rejections)),
                "parameters": " ".join(PARAMETERS[self.fit.model]),
                "parameter_std": self.std[None],
                "parameter_covariance": self.covariance,
                "target_error_columns": "distance in m; 95 % lines in mm wherever boards were "
                "seen, and straight ahead",
                "target_error": np.array([[e.z_m, e.mm95, e.axis_mm95] for e in self.errors]),
            },
        )


def rejected_views(rejections: Iterable[Rejection]) -> list[dict[str, str]]:
    """Return the whole views that were left out, as a record has them."""
    return [{"name": r.view, "reason": r.reason} for r in rejections if not r.corners]
