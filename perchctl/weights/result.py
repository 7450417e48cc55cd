"""All that a fit found out, as one value, as one JSON record, and as a weights file's content."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.weights.evidence import FITTED, SINGLE, Evidence, Fitted
from perchctl.weights.fit import Bias, Errors, Sums
from perchctl.weights.lms import LmsRun
from perchctl.weights.types import AXES, PAPER_WEIGHTS, UNITS


@dataclass(frozen=True, eq=False)
class Result:
    """All that a fit found out. `chosen` names the method whose weights are offered."""

    errors: Errors
    sums: Sums
    bias: dict[str, Bias]
    fits: dict[str, Fitted]
    runs: dict[str, LmsRun]
    evidence: Evidence
    other: Evidence | None
    other_name: str
    chosen: str
    notes: tuple[str, ...]
    sha256: str

    @property
    def proven(self) -> list[bool]:
        return [bool(p) for p in self.evidence.proven[self.chosen]]

    @property
    def recommended(self) -> Array:
        """The weights to fly with: the fitted ones where they are proven to beat the
        better single marker, elsewhere that marker alone, (4,)."""
        alone = np.where(self.evidence.better == 0, 1.0, 0.0)
        return np.where(self.proven, self.fits[self.chosen].weights, alone)


def by_axis(values: Array) -> dict[str, float | None]:
    return {
        axis: float(value) if math.isfinite(value) else None
        for axis, value in zip(AXES, values, strict=True)
    }


def weights_record(result: Result) -> dict[str, Any]:
    """The one object of `--json`. Lengths in m, angles in rad."""
    found: dict[str, Any] = {name: by_axis(result.fits[name].weights) for name in FITTED}
    found["paper"] = dict(zip(AXES, PAPER_WEIGHTS, strict=True))
    found["method"] = result.chosen
    found["recommended"] = by_axis(result.recommended) if any(result.proven) else None
    found["proven"] = dict(zip(AXES, result.proven, strict=True))
    found["better_single"] = {
        axis: SINGLE[int(i)] for axis, i in zip(AXES, result.evidence.better, strict=True)
    }
    found["intervals"] = {
        name: {axis: [lo, hi] for (axis, lo), hi in zip(
            by_axis(result.fits[name].low).items(), by_axis(result.fits[name].high).values(),
            strict=True,
        )}
        for name in FITTED
    }  # fmt: skip
    found["errors"] = _errors_record(result.evidence)
    if result.other is not None:
        found["test"] = {"file": result.other_name, "errors": _errors_record(result.other)}
    found["bias"] = {name: by_axis(bias.mean) for name, bias in result.bias.items()}
    found["bias_half_width"] = {
        name: by_axis(bias.half_width) for name, bias in result.bias.items()
    }
    found["outliers"] = {axis: int(k) for axis, k in zip(AXES, result.errors.outliers, strict=True)}
    found["lms_run"] = {
        "passes": result.runs["lms"].passes,
        "rows": int(result.runs["lms"].rows[-1]),
        "moved_in_second_half": by_axis(result.runs["lms"].moved),
    }
    found["data"] = {
        "file": result.errors.name,
        "sha256": result.sha256,
        "rows": len(result.errors),
        "positions": len(result.errors.positions),
    }
    found["notes"] = list(result.notes)
    return found


def _errors_record(evidence: Evidence) -> dict[str, Any]:
    """By method its RMS, (x, y, z, yaw), the interval, and the gain over the better
    single marker with its interval."""
    return {
        name: {
            **by_axis(method.rms),
            "low": by_axis(method.low),
            "high": by_axis(method.high),
            "gain": by_axis(method.gain),
            "gain_low": by_axis(method.gain_low),
            "gain_high": by_axis(method.gain_high),
        }
        for name, method in evidence.methods.items()
    }


def file_content(result: Result, date: str) -> dict[str, Any]:
    """What a weights file holds. Errors in m and rad, on positions not fitted to."""
    rounded = {axis: round(float(w), 6) for axis, w in by_axis(result.recommended).items() if w
               is not None}  # fmt: skip
    fitted = result.fits[result.chosen]
    return {
        "date": date,
        "method": result.chosen,
        "weights": rounded,
        "axes": {
            axis: "merged" if proven else f"{SINGLE[int(better)]} alone"
            for axis, proven, better in zip(
                AXES, result.proven, result.evidence.better, strict=True
            )
        },
        "fitted": {axis: round(float(w), 6) for axis, w in zip(AXES, fitted.weights, strict=True)},
        "data": {
            "file": result.errors.name,
            "sha256": result.sha256,
            "rows": len(result.errors),
            "positions": len(result.errors.positions),
        },
        "errors": {
            name: {
                f"{axis}_{unit}": float(f"{value:.6g}")
                for axis, unit, value in zip(AXES, UNITS, method.rms, strict=True)
            }
            for name, method in result.evidence.methods.items()
        },
    }
