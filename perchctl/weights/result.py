"""The fit from data files: all that it found out, as one value, one JSON record, and the weights
file that a profile names (`merge.weights_file`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from perchctl.files import write_files
from perchctl.geometry import Array
from perchctl.weights.check import check
from perchctl.weights.evidence import (
    FITTED,
    SINGLE,
    Evidence,
    Fitted,
    evidence,
    fit_all,
    on_other_data,
)
from perchctl.weights.fit import (
    Bias,
    Errors,
    Sums,
    biases,
    check_determined,
    errors_of,
    odd_positions,
    sums_of,
)
from perchctl.weights.flight_logs import read_flight_log
from perchctl.weights.lms import LmsOptions, LmsRun
from perchctl.weights.repeated import refuse_repeated
from perchctl.weights.table import chunks_of, read_csv
from perchctl.weights.types import AXES, PAPER_WEIGHTS, UNITS, Measurements, joined

FORMAT = "perchctl-merge-weights"
_HEAD = """\
# Merge weights of the large marker (the small one's are 1 - w), fitted by perchctl
# fit-weights. Named by a profile: merge: {method: weights, weights_file: THIS_FILE}
"""
Bar = Callable[[str, int | None], AbstractContextManager[Callable[[], None]]]


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


def fit_weights(
    paths: Sequence[Path], lms: LmsOptions, chosen: str, test: Path | None, bar: Bar
) -> Result:
    """Read all data and fit the weights to it by each method; `chosen` is the one that is
    offered, `test` other data to judge it by. `bar` shows progress. Errors: NotFound,
    InvalidValue."""
    with bar("reading [MB]", sum(chunks_of(path) for path in paths)) as advance:
        parts = [_read(path, advance) for path in paths]
    tested = None if test is None else _read(test, lambda: None)
    data = joined(parts)
    refuse_repeated(parts, tested)
    errors = errors_of(data)
    sums = sums_of(errors)
    check_determined(errors, sums)
    with bar("fitting", None) as advance:
        fits, runs = fit_all(errors, sums, lms, advance)
    proof = evidence(errors, sums, fits)
    other = None if tested is None else on_other_data(errors_of(tested), fits)
    return Result(
        errors=errors,
        sums=sums,
        bias=biases(sums),
        fits=fits,
        runs=runs,
        evidence=proof,
        other=other,
        other_name=str(test) if test is not None else "",
        chosen=chosen,
        notes=(*data.notes, *_notes(errors, sums, fits)),
        sha256=data.sha256,
    )


def _notes(errors: Errors, sums: Sums, fits: Mapping[str, Fitted]) -> list[str]:
    """Sentences on clipped weights, odd positions, and too few of them."""
    notes = []
    for name, found in fits.items():
        outside = [
            f"{axis} {w:.3f}"
            for axis, w in zip(AXES, found.raw, strict=True)
            if not 0.0 <= w <= 1.0
        ]
        if outside:
            notes.append(f"{name}: clipped to 0 .. 1: {', '.join(outside)}")
    for number, axis, off in odd_positions(errors, sums):
        size = f"{np.degrees(off):.1f} deg" if axis == "yaw" else f"{off * 1e3:.1f} mm"
        notes.append(
            f"position {number}: both markers are off by {size} in {axis} more than elsewhere; "
            f"was its actual pose taken down wrongly?"
        )
    if len(errors.positions) < 5:
        notes.append(
            f"{len(errors.positions)} positions are few: intervals are wide (10 are usual)"
        )
    return notes


def _read(path: Path, advance: Callable[[], None]) -> Measurements:
    logged = path.suffix.lower() == ".jsonl"
    data = read_flight_log(path) if logged else read_csv(path, advance)
    check(data)
    return data


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


def write_weights(path: Path, result: Result, date: str, *, anyway: bool) -> None:
    """Write the weights file: those that are recommended, or, `anyway`, all that were fitted.
    Errors: InvalidValue when it cannot be written; the old one then stays."""
    content = _file_content(result, date)
    if anyway:
        content["weights"] = dict(content["fitted"])
        content["axes"] = dict.fromkeys(AXES, "merged")
    text = _HEAD + yaml.safe_dump({"format": FORMAT, **content}, sort_keys=False)
    write_files({path: text.encode("utf-8")})


def _file_content(result: Result, date: str) -> dict[str, Any]:
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
