"""The result of a fit: for people (with tables in the paper's form) and as one object."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.weights.evidence import FITTED, LABELS, SINGLE, Evidence, Fitted, gain_over
from perchctl.weights.fit import Bias, Errors, Sums
from perchctl.weights.lms import LmsRun
from perchctl.weights.types import AXES, PAPER_WEIGHTS, UNITS, YAW, wrap

COLUMNS = 5
"""Positions side by side in a table, as in the paper's Table I."""
_SCALES = np.array([1e3, 1e3, 1e3, 180.0 / math.pi])
_UNITS = ("mm", "mm", "mm", "deg")


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


def as_object(result: Result) -> dict[str, Any]:
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
    found["errors"] = _errors_object(result.evidence)
    if result.other is not None:
        found["test"] = {"file": result.other_name, "errors": _errors_object(result.other)}
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


def _errors_object(evidence: Evidence) -> dict[str, Any]:
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


# -- for people -------------------------------------------------------------


def text(result: Result) -> str:
    """The report: weights, errors, verdict, bias, outliers, tables."""
    errors, evidence = result.errors, result.evidence
    data = f"{errors.name}: {len(errors)} rows of {len(errors.positions)} positions"
    if errors.single_rows:
        data += f" ({errors.single_rows} more rows without both markers do not count)"
    parts = [
        data,
        _weights_text(result),
        _lms_text(result),
        _errors_text("RMS error on positions left out of the fit, and its 95 % interval", evidence),
    ]
    if result.other is not None:
        parts.append(_errors_text(f"RMS error on {result.other_name}", result.other))
    parts += [verdict(result), _bias_text(result), table_one(result), table_two(result)]
    parts += [f"note: {note}" for note in result.notes]
    return "\n\n".join(parts)


def _weights_text(result: Result) -> str:
    lines = [_line("weights of the large marker", [f"{axis:<22}" for axis in AXES])]
    for name, fit in result.fits.items():
        cells = [
            f"{w:.3f} [{low:+.3f}, {high:+.3f}]"
            for w, low, high in zip(fit.weights, fit.low, fit.high, strict=True)
        ]
        lines.append(_line(LABELS[name], cells))
    lines.append(_line(LABELS["paper"], [f"{w:.3f}{'':17}" for w in PAPER_WEIGHTS]))
    return "\n".join(line.rstrip() for line in lines)


def _lms_text(result: Result) -> str:
    run = result.runs["lms"]
    away = np.abs(run.weights - result.fits["closed_form"].raw).max()
    return (
        f"LMS took {run.passes} passes ({int(run.rows[-1])} rows); in their second half its "
        f"weights moved by at most {run.moved.max():.4f}, and it ends {away:.4f} from the closed "
        f"form"
    )


def _errors_text(title: str, evidence: Evidence) -> str:
    lines = [title, _head()]
    for name, method in evidence.methods.items():
        cells = [
            f"{v * k:.3g} [{low * k:.3g}, {high * k:.3g}]"
            for v, low, high, k in zip(method.rms, method.low, method.high, _SCALES, strict=True)
        ]
        lines.append(_line(LABELS[name], cells))
    return "\n".join(lines)


def verdict(result: Result) -> str:
    """Against what the weights win, and which are recommended."""
    lines = [
        f"gain of {LABELS[result.chosen]} in RMS error, with its 95 % interval (* beyond it)",
        _head(),
        *_gains(result.evidence, result.chosen),
    ]
    if result.other is not None:
        lines += [f"on {result.other_name}", *_gains(result.other, result.chosen)]
    for k, axis in enumerate(AXES):
        better = SINGLE[int(result.evidence.better[k])]
        lines.append(
            f"{axis}: recommended is {result.recommended[k]:.3f}, which beats the {better} marker"
            if result.proven[k]
            else f"{axis}: no weight is proven to beat the {better} marker alone"
        )
    if not any(result.proven):
        lines.append(
            "these weights are not recommended: on no axis do they beat the better single marker "
            "beyond the interval"
        )
    return "\n".join(lines)


def _gains(evidence: Evidence, chosen: str) -> list[str]:
    lines = []
    for other in ("large", "small", "paper", "joint"):
        if other not in evidence.methods:
            continue
        gain, low, high = gain_over(evidence, chosen, other)
        cells = [
            f"{g * k:+.3g} [{lo * k:+.3g}, {hi * k:+.3g}]" + ("*" if lo > 0.0 or hi < 0.0 else " ")
            for g, lo, hi, k in zip(gain, low, high, _SCALES, strict=True)
        ]
        lines.append(_line(f"over {LABELS[other]}", cells))
    return lines


def _head() -> str:
    return _line("", [f"{axis} [{unit}]" for axis, unit in zip(AXES, _UNITS, strict=True)])


def _line(label: str, cells: list[str]) -> str:
    return f"{label:<26}" + "".join(f"{cell:>28}" for cell in cells)


def _bias_text(result: Result) -> str:
    lines = ["constant offsets (no weight can mend them: calibration, mounting or print can)"]
    for name, bias in result.bias.items():
        cells = [
            f"{axis} {mean * k:+.3f} +- {half * k:.3f} {unit}"
            for axis, mean, half, k, unit in zip(
                AXES, bias.mean, bias.half_width, _SCALES, _UNITS, strict=True
            )
        ]
        lines.append(f"  {name}: " + ", ".join(cells))
    outliers = ", ".join(
        f"{axis} {k}" for axis, k in zip(AXES, result.errors.outliers, strict=True)
    )
    lines.append(f"outliers left out: {outliers}")
    return "\n".join(lines)


def estimated(result: Result) -> Array:
    """Mean merged pose of each position, by weights fitted without it, (g, 4)."""
    folds = result.fits[result.chosen].folds
    n = np.maximum(result.sums.n, 1.0)
    error = folds * result.sums.a / n + (1.0 - folds) * result.sums.b / n
    return result.errors.actual + error


def table_one(result: Result) -> str:
    """The paper's Table I: relative positions in centimetres."""
    actual = result.errors.actual[:, :3] * 100.0
    found = estimated(result)[:, :3] * 100.0

    def triple(v: Array, digits: int) -> str:
        return "(" + ", ".join(_plain(float(c), digits) for c in v) + ")"

    rows = (
        ("Actual Position", [triple(v, 2) for v in actual]),
        ("Estimated Position", [triple(v, 3) for v in found]),
        ("Est. Position Error", [triple(v, 4) for v in found - actual]),
    )
    return _table("TABLE I  Relative position in centimetres", rows)


def table_two(result: Result) -> str:
    """The paper's Table II: relative heading in degrees."""
    actual = np.degrees(wrap(result.errors.actual[:, YAW]))
    found = np.degrees(wrap(estimated(result)[:, YAW]))
    error = np.degrees(wrap(np.radians(found - actual)))
    rows = (
        ("Actual Heading Angle", [_plain(float(v), 1) for v in actual]),
        ("Estimated Heading Angle", [_plain(float(v), 3) for v in found]),
        ("Est. Heading Angle Error", [_plain(float(v), 4) for v in error]),
    )
    return _table("TABLE II  Relative heading angle in degrees", rows)


def _plain(value: float, digits: int) -> str:
    """Without the sign of a zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _table(title: str, rows: tuple[tuple[str, list[str]], ...], most: int = 20) -> str:
    count = len(rows[0][1])
    lines = [title + (f" (the first {most} of {count} positions)" if count > most else "")]
    for start in range(0, min(count, most), COLUMNS):
        blocks = [cells[start : min(start + COLUMNS, most)] for _, cells in rows]
        widths = [max(len(block[i]) for block in blocks) for i in range(len(blocks[0]))]
        for (label, _), block in zip(rows, blocks, strict=True):
            cells = (f"{cell:>{width}}" for cell, width in zip(block, widths, strict=True))
            lines.append(f"| {label:<24} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
