"""The result of fitting weights to a data file: as a value, as a report for a terminal, as a JSON
record, and as the weights file that a profile names (`merge.weights_file`)."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from perchctl.errors import InvalidValue
from perchctl.files import same_file, write_files
from perchctl.geometry import Array
from perchctl.weights.data import AXES, read_data
from perchctl.weights.fit import (
    FITTED,
    LABELS,
    PAPER_WEIGHTS,
    SINGLE,
    Evidence,
    FittedWeights,
    MarkerErrors,
    evaluate_weights,
    fit_by_each_method,
    marker_errors,
)

FORMAT = "perchctl-merge-weights"
_HEAD = """\
# Merge weights of the large marker (the small one's are 1 - w), fitted by perchctl
# fit-weights. In a profile, write merge: {method: weights, weights_file: THIS_FILE}
"""


@dataclass(frozen=True, eq=False)
class FitResult:
    """Result of a fit. `method` is the one whose weights are recommended; `test_evidence` is the
    evidence on the test data `test_name`, or None."""

    errors: MarkerErrors
    fits: dict[str, FittedWeights]
    evidence: Evidence
    test_evidence: Evidence | None
    test_name: str
    method: str

    @property
    def is_proven_better(self) -> list[bool]:
        """True for each axis on which the merge weight fitted by `method` beats the better single
        marker."""
        return [bool(p) for p in self.evidence.is_proven_better(self.method)]

    @property
    def better_markers(self) -> list[str]:
        """The better single marker (large or small) on each axis."""
        return [SINGLE[int(k)] for k in self.evidence.better_marker]

    @property
    def recommended_weights(self) -> Array:
        """The fitted weights on axes where they are proven better; on the others 1 or 0, that is,
        the better single marker alone, (4,)."""
        alone = np.where(self.evidence.better_marker == 0, 1.0, 0.0)
        return np.where(self.is_proven_better, self.fits[self.method].weights, alone)


def fit_weights(path: Path, method: str, test: Path | None = None) -> FitResult:
    """Read the data file `path`, fit the weights by each method, and judge them on held-out
    positions.

    Args:
        method: the method to recommend, one of `FITTED`.
        test: another data file on which to judge the weights.

    Errors: NotFound, InvalidValue.
    """
    if test is not None and same_file(path, test):
        raise InvalidValue(f"the weights were fitted to {test}, so it cannot be used to test them")
    errors = marker_errors(read_data(path))
    fits = fit_by_each_method(errors)
    other = None
    if test is not None:
        weights = {name: fit.weights for name, fit in fits.items()}
        other = evaluate_weights(marker_errors(read_data(test)), weights)
    return FitResult(
        errors=errors,
        fits=fits,
        evidence=evaluate_weights(errors, {name: fit.fold_weights for name, fit in fits.items()}),
        test_evidence=other,
        test_name="" if test is None else str(test),
        method=method,
    )


# --- The JSON record and the weights file ---


def _by_axis(values: Iterable[float]) -> dict[str, float | None]:
    return {
        axis: float(f"{value:.6g}") if math.isfinite(value) else None
        for axis, value in zip(AXES, values, strict=True)
    }


def weights_record(result: FitResult) -> dict[str, Any]:
    """The result as the JSON object that `--json` prints. Lengths in m, angles in rad."""
    record: dict[str, Any] = {name: _by_axis(result.fits[name].weights) for name in FITTED}
    record |= {
        "paper": _by_axis(PAPER_WEIGHTS),
        "method": result.method,
        "recommended": _by_axis(result.recommended_weights)
        if any(result.is_proven_better)
        else None,
        "proven": dict(zip(AXES, result.is_proven_better, strict=True)),
        "better_single": dict(zip(AXES, result.better_markers, strict=True)),
        "half_width": {name: _by_axis(fit.half_width) for name, fit in result.fits.items()},
        "errors": _errors_record(result.evidence),
        "data": {
            "file": result.errors.name,
            "rows": len(result.errors),
            "positions": len(result.errors.positions),
        },
    }
    if result.test_evidence is not None:
        record["test"] = {"file": result.test_name, "errors": _errors_record(result.test_evidence)}
    return record


def _errors_record(found: Evidence) -> dict[str, Any]:
    record = {}
    for name in found.squares:
        rms, half = found.rms(name)
        record[name] = _by_axis(rms) | {"half_width": _by_axis(half)}
    return record


def write_weights(path: Path, result: FitResult, date: str, *, anyway: bool) -> None:
    """Write a file with the recommended weights (or, with `anyway`, the fitted ones) and the
    results of the fit.

    Errors: InvalidValue if the file cannot be written; an existing file is then left unchanged.
    """
    flown = result.fits[result.method].weights if anyway else result.recommended_weights
    content = {"format": FORMAT, "date": date, "weights": _by_axis(flown)} | weights_record(result)
    write_files({path: (_HEAD + yaml.safe_dump(content, sort_keys=False)).encode("utf-8")})


# --- The report for a terminal of 80 columns, with the verdict first ---
# Lengths are in micrometres and angles in thousandths of a degree.


WEIGHTS_COLUMNS = 80
_SCALES = np.array([1e6, 1e6, 1e6, 180e3 / math.pi])
_HEADS = ("x [um]", "y [um]", "z [um]", "yaw [mdeg]")


def report_text(result: FitResult) -> str:
    """The report: verdict, errors, gains and weights."""
    errors = result.errors
    left_out = int((~errors.is_inlier).any(axis=1).sum())
    data = (
        f"{errors.name}: {len(errors)} rows of {len(errors.positions)} positions show "
        f"both markers; {left_out} of the rows are outliers"
    )
    parts = [_wrapped(data), _verdict(result)]
    judged = [(result.evidence, "on positions left out of the fit")]
    if result.test_evidence is not None:
        judged.append((result.test_evidence, f"on {result.test_name}"))
    for found, where in judged:
        rms = {LABELS[name]: _scaled(*found.rms(name)) for name in found.squares}
        gains = {
            LABELS[name]: _scaled(*found.rms_gain(result.method, square), "+")
            for name, square in found.squares.items()
            if name not in FITTED
        }
        title = f"reduction in RMS error with {LABELS[result.method]} {where}, compared with"
        parts.append(_table(f"RMS error {where}, 95 % interval", _HEADS, rms))
        parts.append(_table(title, _HEADS, gains))
    weights = {
        LABELS[name]: [
            f"{w:.3f} +-{h:.3f}" for w, h in zip(fit.weights, fit.half_width, strict=True)
        ]
        for name, fit in result.fits.items()
    }
    weights[LABELS["paper"]] = [f"{w:.3f}{'':8}" for w in PAPER_WEIGHTS]
    parts.append(_table("fitted weights of the large marker, 95 % interval", AXES, weights))
    return "\n\n".join(parts)


def _verdict(result: FitResult) -> str:
    if not any(result.is_proven_better):
        return _wrapped(
            "not recommended: on no axis are these weights better than the better single "
            "marker by more than the 95 % interval; measure more positions, or fly with "
            "merge.method: joint"
        )
    lines = [f"recommended weights of the large marker ({LABELS[result.method]})"]
    for axis, name, proven, weight in zip(
        AXES,
        result.better_markers,
        result.is_proven_better,
        result.recommended_weights,
        strict=True,
    ):
        why = (
            f"better than the {name} marker alone by more than the 95 % interval"
            if proven
            else f"the {name} marker alone: merging both markers is not significantly better"
        )
        lines.append(f"  {axis:<4} {weight:.3f}  {why}")
    return "\n".join(lines)


def _table(title: str, heads: Sequence[str], rows: dict[str, list[str]]) -> str:
    lines = [_wrapped(title)]
    for label, cells in ({"": list(heads)} | rows).items():
        lines.append((f"{label:<20}" + "".join(f"{cell:>15}" for cell in cells)).rstrip())
    return "\n".join(lines)


def _scaled(values: Array, halves: Array, sign: str = "") -> list[str]:
    """Return cells as ``6.5 +-1.2``, in micrometres and thousandths of a degree."""
    cells = []
    for value, half in zip(values * _SCALES, halves * _SCALES, strict=True):
        digits = 1 if abs(value) < 1e3 else 0
        cells.append(f"{value:{sign}.{digits}f} +-{half:.{digits}f}")
    return cells


def _wrapped(text: str) -> str:
    return textwrap.fill(text, WEIGHTS_COLUMNS, break_long_words=False, break_on_hyphens=False)
