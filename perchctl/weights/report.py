"""The report of a fit: weights, errors, verdict, and tables in the paper's form."""

from __future__ import annotations

import math

import numpy as np

from perchctl.geometry import Array
from perchctl.weights.evidence import LABELS, SINGLE, Evidence, gain_over
from perchctl.weights.result import Result
from perchctl.weights.types import AXES, PAPER_WEIGHTS, YAW, wrap

COLUMNS = 5
"""Positions side by side in a table, as in the paper's Table I."""
_SCALES = np.array([1e3, 1e3, 1e3, 180.0 / math.pi])
_UNITS = ("mm", "mm", "mm", "deg")


def report_text(result: Result) -> str:
    """Weights, errors, verdict, bias, outliers, tables, notes."""
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
