"""The fit from data files: all that it found out, as one value, as a report for a terminal, as one
JSON record, and as the weights file that a profile names (`merge.weights_file`)."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from perchctl.files import write_files
from perchctl.geometry import Array
from perchctl.weights.data import AXES, read_data
from perchctl.weights.fit import (
    FITTED,
    LABELS,
    PAPER_WEIGHTS,
    SINGLE,
    Errors,
    Evidence,
    FittedWeights,
    errors_of,
    evidence,
    fit_all,
)

FORMAT = "perchctl-merge-weights"
_HEAD = """\
# Merge weights of the large marker (the small one's are 1 - w), fitted by perchctl
# fit-weights. Named by a profile: merge: {method: weights, weights_file: THIS_FILE}
"""


@dataclass(frozen=True, eq=False)
class Result:
    """All that a fit found out. `chosen` names the method whose weights are offered; `other` is
    the evidence from other data, named `other_name`."""

    errors: Errors
    fits: dict[str, FittedWeights]
    evidence: Evidence
    other: Evidence | None
    other_name: str
    chosen: str
    sha256: str

    @property
    def proven(self) -> list[bool]:
        """True where the chosen weight beats the better single marker, by axis."""
        return [bool(p) for p in self.evidence.proven(self.chosen)]

    @property
    def better(self) -> list[str]:
        """The better single marker, by axis."""
        return [SINGLE[int(k)] for k in self.evidence.better]

    @property
    def recommended(self) -> Array:
        """The weights to fly with: the fitted ones where they are proven to beat the
        better single marker, elsewhere that marker alone, (4,)."""
        alone = np.where(self.evidence.better == 0, 1.0, 0.0)
        return np.where(self.proven, self.fits[self.chosen].weights, alone)

    @property
    def notes(self) -> list[str]:
        """Sentences on clipped weights, and on too few positions."""
        notes = []
        for name, found in self.fits.items():
            outside = [
                f"{axis} {w:.3f}"
                for axis, w in zip(AXES, found.raw, strict=True)
                if not 0.0 <= w <= 1.0
            ]
            if outside:
                notes.append(f"{name}: clipped to 0 .. 1: {', '.join(outside)}")
        count = len(self.errors.positions)
        if count < 5:
            notes.append(f"{count} positions are few: intervals are wide (10 are usual)")
        return notes


def fit_weights(paths: Sequence[Path], chosen: str, test: Path | None = None) -> Result:
    """Read the data, fit the weights by each method, and judge them by held-out positions.

    Args:
        chosen: the method that is offered, one of `FITTED`.
        test: other data to judge the weights by.

    Errors: NotFound, InvalidValue, UsageError.
    """
    data, tested = read_data(paths, test)
    errors = errors_of(data)
    fits = fit_all(errors)
    other = None
    if tested is not None:
        other = evidence(errors_of(tested), {name: fit.weights for name, fit in fits.items()})
    return Result(
        errors=errors,
        fits=fits,
        evidence=evidence(errors, {name: fit.folds for name, fit in fits.items()}),
        other=other,
        other_name="" if test is None else str(test),
        chosen=chosen,
        sha256=data.sha256,
    )


# --- The JSON record and the weights file -----------------------------


def _by_axis(values: Iterable[float]) -> dict[str, float | None]:
    """Return the values by axis, to six figures, as a person may read them."""
    return {
        axis: float(f"{value:.6g}") if math.isfinite(value) else None
        for axis, value in zip(AXES, values, strict=True)
    }


def weights_record(result: Result) -> dict[str, Any]:
    """Return the one object of `--json`. Lengths in m, angles in rad."""
    record: dict[str, Any] = {name: _by_axis(result.fits[name].weights) for name in FITTED}
    record |= {
        "paper": _by_axis(PAPER_WEIGHTS),
        "method": result.chosen,
        "recommended": _by_axis(result.recommended) if any(result.proven) else None,
        "proven": dict(zip(AXES, result.proven, strict=True)),
        "better_single": dict(zip(AXES, result.better, strict=True)),
        "half_width": {name: _by_axis(fit.half) for name, fit in result.fits.items()},
        "errors": _errors_record(result.evidence),
        "bias": {name: _by_axis(mean) for name, (mean, _) in result.errors.biases.items()},
        "outliers": dict(zip(AXES, (~result.errors.use).sum(axis=0).tolist(), strict=True)),
        "data": {
            "file": result.errors.name,
            "sha256": result.sha256,
            "rows": len(result.errors),
            "positions": len(result.errors.positions),
        },
        "notes": result.notes,
    }
    if result.other is not None:
        record["test"] = {"file": result.other_name, "errors": _errors_record(result.other)}
    return record


def _errors_record(found: Evidence) -> dict[str, Any]:
    """Return the RMS error (x, y, z, yaw) of each set of weights with the half width of its
    interval, and the gain over the better single marker with its own."""
    record = {}
    for name in found.squares:
        (rms, half), (gain, gain_half) = found.rms(name), found.gain(name, found.better_squares)
        record[name] = _by_axis(rms) | {
            "half_width": _by_axis(half),
            "gain": _by_axis(gain),
            "gain_half_width": _by_axis(gain_half),
        }
    return record


def write_weights(path: Path, result: Result, date: str, *, anyway: bool) -> None:
    """Write the weights file: those that are recommended, or, `anyway`, all that were fitted; and
    the record of the fit behind them. Errors: InvalidValue when it cannot be written; the old one
    then stays."""
    flown = result.fits[result.chosen].weights if anyway else result.recommended
    content = {"format": FORMAT, "date": date, "weights": _by_axis(flown)} | weights_record(result)
    write_files({path: (_HEAD + yaml.safe_dump(content, sort_keys=False)).encode("utf-8")})


# --- The report, for a terminal of 80 columns: the verdict first, notes last ---
# Lengths are in micrometres and angles in thousandths of a degree, as that is the size of the
# errors of good corners.


WIDTH = 80
_SCALES = np.array([1e6, 1e6, 1e6, 180e3 / math.pi])
_HEADS = ("x [um]", "y [um]", "z [um]", "yaw [mdeg]")


def report_text(result: Result) -> str:
    """Return the report: verdict, errors, gains, weights, offsets, notes."""
    errors, label = result.errors, LABELS[result.chosen]
    data = (
        f"{errors.name}: {len(errors)} rows of {len(errors.positions)} positions show both markers"
    )
    parts = [_wrapped(data), _verdict(result)]
    judged = [(result.evidence, "on positions left out of the fit")]
    if result.other is not None:
        judged.append((result.other, f"on {result.other_name}"))
    for found, where in judged:
        rms = {LABELS[name]: _scaled(*found.rms(name)) for name in found.squares}
        gains = {
            LABELS[name]: _scaled(*found.gain(result.chosen, square), "+")
            for name, square in found.squares.items()
            if name not in FITTED
        }
        parts.append(_table(f"RMS error {where}, 95 % interval", _HEADS, rms))
        parts.append(_table(f"gain of {label} in RMS error {where} over", _HEADS, gains))
    weights = {
        LABELS[name]: [f"{w:.3f} +-{h:.3f}" for w, h in zip(fit.weights, fit.half, strict=True)]
        for name, fit in result.fits.items()
    }
    weights[LABELS["paper"]] = [f"{w:.3f}{'':8}" for w in PAPER_WEIGHTS]
    away = np.abs(result.fits["lms"].raw - result.fits["closed_form"].raw).max()
    title = f"fitted weights; LMS ends {away:.4f} from the closed form"
    parts.append(_table(title, AXES, weights))
    offsets = {f"{name} marker": _scaled(*found, "+") for name, found in errors.biases.items()}
    offsets["outliers left out"] = [f"{n}{'':6}" for n in (~errors.use).sum(axis=0)]
    mend = "constant offsets (no weight can mend them: calibration, mounting or print can)"
    parts.append(_table(mend, _HEADS, offsets))
    if result.notes:
        parts.append("\n".join(_wrapped(f"note: {note}") for note in result.notes))
    return "\n\n".join(parts)


def _verdict(result: Result) -> str:
    """Return the weights to fly with, and why, in a line for each axis."""
    if not any(result.proven):
        return _wrapped(
            "not recommended: on no axis do these weights beat the better single marker beyond "
            "the 95 % interval; take more positions, or fly merge.method: joint"
        )
    lines = [f"recommended weights of the large marker ({LABELS[result.chosen]})"]
    for axis, name, proven, weight in zip(
        AXES, result.better, result.proven, result.recommended, strict=True
    ):
        why = (
            f"beats the {name} marker alone beyond the 95 % interval"
            if proven
            else f"the {name} marker alone: no weight is proven to beat it"
        )
        lines.append(f"  {axis:<4} {weight:.3f}  {why}")
    return "\n".join(lines)


def _table(title: str, heads: Sequence[str], rows: dict[str, list[str]]) -> str:
    lines = [_wrapped(title)]
    for label, cells in ({"": list(heads)} | rows).items():
        lines.append((f"{label:<20}" + "".join(f"{cell:>15}" for cell in cells)).rstrip())
    return "\n".join(lines)


def _scaled(values: Array, halves: Array, sign: str = "") -> list[str]:
    """Return cells as ``6.5 +-1.2``, in micrometres and thousandths of a degree; large ones in
    thousands (k)."""
    cells = []
    for value, half in zip(values * _SCALES, halves * _SCALES, strict=True):
        size = max(abs(value), abs(half))
        unit, unit_text = (1e3, "k") if size >= 1e5 else (1.0, "")
        digits = 1 if size < 1e3 else 0
        shown = round(value / unit, digits) + 0.0
        cells.append(f"{shown:{sign}.{digits}f}{unit_text} +-{half / unit:.{digits}f}{unit_text}")
    return cells


def _wrapped(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)
