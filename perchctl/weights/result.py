"""The fit from data files: all that it found out, as one value, as a report for a terminal, as one
JSON record, and as the weights file that a profile names (`merge.weights_file`)."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from perchctl.files import write_files
from perchctl.geometry import Array
from perchctl.weights.data import AXES, UNITS, YAW, read_data, wrap
from perchctl.weights.fit import (
    FITTED,
    LABELS,
    PAPER_WEIGHTS,
    SINGLE,
    Errors,
    Evidence,
    Fitted,
    LmsOptions,
    LmsRun,
    biases,
    check_determined,
    errors_of,
    evidence,
    fit_all,
    odd_positions,
    position_means,
    sums_of,
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
    sums: Array
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
        """Whether the chosen weight beats the better single marker, by axis."""
        return [bool(p) for p in self.evidence.proven[self.chosen]]

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


def fit_weights(
    paths: Sequence[Path], lms: LmsOptions, chosen: str, test: Path | None = None
) -> Result:
    """Read all data and fit the weights to it by each method; `chosen` is the one that is
    offered, `test` other data to judge it by. Errors: NotFound, InvalidValue, UsageError."""
    data, tested = read_data(paths, test)
    errors = errors_of(data)
    sums = sums_of(errors)
    check_determined(errors, sums)
    fits, runs = fit_all(errors, sums, lms)
    other = None
    if tested is not None:
        judged = errors_of(tested)
        other = evidence(judged, sums_of(judged), {n: fit.weights for n, fit in fits.items()})
    return Result(
        errors=errors,
        sums=sums,
        fits=fits,
        runs=runs,
        evidence=evidence(errors, sums, {name: fit.folds for name, fit in fits.items()}),
        other=other,
        other_name="" if test is None else str(test),
        chosen=chosen,
        notes=(*data.notes, *_notes(errors, sums, fits)),
        sha256=data.sha256,
    )


def _notes(errors: Errors, sums: Array, fits: Mapping[str, Fitted]) -> list[str]:
    """Sentences on clipped weights, odd positions, and too few of them."""
    notes = []
    for name, found in fits.items():
        weights = zip(AXES, found.raw, strict=True)
        outside = [f"{axis} {w:.3f}" for axis, w in weights if not 0.0 <= w <= 1.0]
        if outside:
            notes.append(f"{name}: clipped to 0 .. 1: {', '.join(outside)}")
    for number, axis, off in odd_positions(errors, sums):
        size = f"{np.degrees(off):.1f} deg" if axis == "yaw" else f"{off * 1e3:.1f} mm"
        notes.append(
            f"position {number}: both markers are off by {size} in {axis} more than elsewhere; "
            f"was its actual pose taken down wrongly?"
        )
    count = len(errors.positions)
    if count < 5:
        notes.append(f"{count} positions are few: intervals are wide (10 are usual)")
    return notes


# --- The JSON record and the weights file ------------------------------------------------------


def _by_axis(values: Array) -> dict[str, float | None]:
    return {
        axis: float(value) if math.isfinite(value) else None
        for axis, value in zip(AXES, values, strict=True)
    }


def weights_record(result: Result) -> dict[str, Any]:
    """The one object of `--json`. Lengths in m, angles in rad."""
    bias = biases(result.sums)
    lms = result.runs["lms"]
    record: dict[str, Any] = {name: _by_axis(result.fits[name].weights) for name in FITTED}
    record |= {
        "paper": dict(zip(AXES, PAPER_WEIGHTS, strict=True)),
        "method": result.chosen,
        "recommended": _by_axis(result.recommended) if any(result.proven) else None,
        "proven": dict(zip(AXES, result.proven, strict=True)),
        "better_single": dict(zip(AXES, result.better, strict=True)),
        "intervals": {
            name: {
                axis: list(pair)
                for axis, *pair in zip(
                    AXES, _by_axis(fit.low).values(), _by_axis(fit.high).values(), strict=True
                )
            }
            for name, fit in result.fits.items()
        },
        "errors": _errors_record(result.evidence),
    }
    if result.other is not None:
        record["test"] = {"file": result.other_name, "errors": _errors_record(result.other)}
    return record | {
        "bias": {name: _by_axis(mean) for name, (mean, _) in bias.items()},
        "bias_half_width": {name: _by_axis(half) for name, (_, half) in bias.items()},
        "outliers": dict(zip(AXES, result.errors.outliers.tolist(), strict=True)),
        "lms_run": {
            "passes": lms.passes,
            "rows": int(lms.rows[-1]),
            "moved_in_second_half": _by_axis(lms.moved),
        },
        "data": _data_record(result),
        "notes": list(result.notes),
    }


def _data_record(result: Result) -> dict[str, Any]:
    return {
        "file": result.errors.name,
        "sha256": result.sha256,
        "rows": len(result.errors),
        "positions": len(result.errors.positions),
    }


def _errors_record(evidence: Evidence) -> dict[str, Any]:
    """By method its RMS, (x, y, z, yaw), the interval, and the gain over the better
    single marker with its interval."""
    return {
        name: _by_axis(method.rms)
        | {
            key: _by_axis(getattr(method, key))
            for key in ("low", "high", "gain", "gain_low", "gain_high")
        }
        for name, method in evidence.methods.items()
    }


def write_weights(path: Path, result: Result, date: str, *, anyway: bool) -> None:
    """Write the weights file: those that are recommended, or, `anyway`, all that were fitted.
    Errors in it are in m and rad, on positions not fitted to. Errors: InvalidValue when it cannot
    be written; the old one then stays."""

    def rounded(weights: Array) -> dict[str, float]:
        return {axis: round(float(w), 6) for axis, w in zip(AXES, weights, strict=True)}

    fitted = rounded(result.fits[result.chosen].weights)
    merged = [anyway or proven for proven in result.proven]
    content = {
        "format": FORMAT,
        "date": date,
        "method": result.chosen,
        "weights": dict(fitted) if anyway else rounded(result.recommended),
        "axes": {
            axis: "merged" if m else f"{name} alone"
            for axis, m, name in zip(AXES, merged, result.better, strict=True)
        },
        "fitted": fitted,
        "data": _data_record(result),
        "errors": {
            name: {
                f"{axis}_{unit}": float(f"{value:.6g}")
                for axis, unit, value in zip(AXES, UNITS, method.rms, strict=True)
            }
            for name, method in result.evidence.methods.items()
        },
    }
    text = _HEAD + yaml.safe_dump(content, sort_keys=False)
    write_files({path: text.encode("utf-8")})


# --- The report, for a terminal of 80 columns: the verdict first, notes last -------------------
# Lengths are in micrometres and angles in thousandths of a degree, as that is the size of the
# errors of good corners.


WIDTH = 80
MOST_POSITIONS = 20
_SCALES = np.array([1e6, 1e6, 1e6, 180e3 / math.pi])
_HEADS = tuple(
    f"{axis} [{unit}]" for axis, unit in zip(AXES, ("um", "um", "um", "mdeg"), strict=True)
)


def report_text(result: Result) -> str:
    """Verdict, errors, gains, weights, offsets, positions, notes."""
    errors = result.errors
    data = f"{errors.name}: {len(errors)} rows of {len(errors.positions)} positions"
    if errors.single_rows:
        data += f" ({errors.single_rows} more rows without both markers do not count)"
    title = "RMS error on positions left out of the fit, 95 % interval"
    parts = [_wrapped(data), _verdict(result)]
    parts += _evidence_text(result.evidence, result.chosen, title, "")
    if result.other is not None:
        where = f" on {result.other_name}"
        parts += _evidence_text(result.other, result.chosen, f"RMS error{where}", where)
    parts += [_weights_text(result), _bias_text(result), _positions_text(result)]
    if result.notes:
        parts.append("\n".join(_wrapped(f"note: {note}") for note in result.notes))
    return "\n\n".join(parts)


def _verdict(result: Result) -> str:
    """What to fly with, and why, in a line for each axis."""
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


def _evidence_text(found: Evidence, chosen: str, title: str, where: str) -> list[str]:
    """Each method's error, and by how much the chosen weights' error is below that of others."""
    errors = [_wrapped(title), _line("", _HEADS)]
    for name, method in found.methods.items():
        errors.append(_line(LABELS[name], _scaled(method.rms, method.high - method.rms)))
    gains = [
        _wrapped(f"gain of {LABELS[chosen]} in RMS error{where} over (* beyond its interval)"),
        _line("", _HEADS),
    ]
    for other in ("large", "small", "paper", "joint"):
        if other in found.methods:
            m = found.methods[chosen].against(found.methods[other])
            beyond = (m.gain_low > 0.0) | (m.gain_high < 0.0)
            cells = _scaled(m.gain, m.gain_high - m.gain, "+")
            marked = [c + ("*" if b else " ") for c, b in zip(cells, beyond, strict=True)]
            gains.append(_line(LABELS[other], marked).rstrip())
    return ["\n".join(errors), "\n".join(gains)]


def _weights_text(result: Result) -> str:
    """The large marker's, by all methods, and how LMS got there."""
    lines = [_line("fitted weights", AXES)]
    for name, fit in result.fits.items():
        halves = (fit.high - fit.low) / 2.0
        cells = [f"{w:.3f} +-{half:.3f}" for w, half in zip(fit.weights, halves, strict=True)]
        lines.append(_line(LABELS[name], cells))
    lines.append(_line(LABELS["paper"], [f"{w:.3f}{'':8}" for w in PAPER_WEIGHTS]).rstrip())
    run = result.runs["lms"]
    away = np.abs(run.weights - result.fits["closed_form"].raw).max()
    lines.append(
        _wrapped(
            f"LMS took {run.passes} passes ({int(run.rows[-1])} rows); in their second half its "
            f"weights moved by at most {run.moved.max():.4f}, and it ends {away:.4f} from the "
            f"closed form"
        )
    )
    return "\n".join(lines)


def _bias_text(result: Result) -> str:
    lines = [
        _wrapped("constant offsets (no weight can mend them: calibration, mounting or print can)"),
        _line("", _HEADS),
    ]
    for name, (mean, half) in biases(result.sums).items():
        lines.append(_line(f"{name} marker", _scaled(mean, half, "+")))
    cells = [f"{count}{'':6}" for count in result.errors.outliers]
    lines.append(_line("outliers left out", cells).rstrip())
    return "\n".join(lines)


def _positions_text(result: Result) -> str:
    """The paper's tables I and II in one: a line for each position, with the mean merged pose's
    error by weights fitted without it."""
    a, b = position_means(result.sums)
    folds = result.fits[result.chosen].folds
    error = folds * a + (1.0 - folds) * b
    error[:, YAW] = wrap(error[:, YAW])
    actual = result.errors.actual
    places = np.column_stack([actual[:, :3] * 100.0, np.degrees(wrap(actual[:, YAW]))])
    count = len(actual)
    more = f" (the first {MOST_POSITIONS} of {count})" if count > MOST_POSITIONS else ""

    def line(name: str, cells: Sequence[str]) -> str:
        widths = (8, 8, 8, 11, 9, 8, 8, 12)
        return f"{name:<8}" + "".join(f"{c:>{w}}" for c, w in zip(cells, widths, strict=True))

    lines = [
        f"positions{more}: as they are, and the merged pose's error there (weights fitted",
        "to the others; Tables I and II of the paper)",
        line("", ("x [cm]", "y [cm]", "z [cm]", "yaw [deg]", *_HEADS)),
    ]
    for k in range(min(count, MOST_POSITIONS)):
        *xyz, yaw = places[k]
        cells = [*(f"{v:.2f}" for v in xyz), f"{yaw:.1f}", *map(_figure, error[k] * _SCALES)]
        lines.append(line(str(int(result.errors.positions[k])), cells))
    return "\n".join(lines)


def _figure(value: float, sign: str = "", spread: float = 0.0) -> str:
    """To three digits of the larger one, but no finer than hundredths; beyond 100 000 in
    thousands (k). No exponent, and no zero with a minus."""
    size = max(abs(value), abs(spread))
    if size >= 99_950:
        return f"{value / 1e3:{sign}.0f}k"
    digits = 2 if size < 9.995 else 1 if size < 99.95 else 0
    return f"{round(value, digits) + 0.0:{sign}.{digits}f}"


def _scaled(values: Array, halves: Array, sign: str = "") -> list[str]:
    pairs = zip((values * _SCALES).tolist(), (halves * _SCALES).tolist(), strict=True)
    return [f"{_figure(v, sign, h)} +-{_figure(h, '', v)}" for v, h in pairs]


def _line(label: str, cells: Sequence[str]) -> str:
    return f"{label:<20}" + "".join(f" {cell:>14}" for cell in cells)


def _wrapped(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)
