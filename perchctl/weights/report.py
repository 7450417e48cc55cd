"""The report of a fit, for a terminal of 80 columns: the verdict first, notes last.

Lengths are in micrometres and angles in thousandths of a degree, as that is what good corners
come to.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np

from perchctl.geometry import Array
from perchctl.weights.evidence import LABELS, SINGLE, Evidence, gain_over
from perchctl.weights.result import Result
from perchctl.weights.types import AXES, PAPER_WEIGHTS, YAW, wrap

WIDTH = 80
MOST_POSITIONS = 20
_LABEL = 20
_CELL = 15
_SCALES = np.array([1e6, 1e6, 1e6, 180e3 / math.pi])
_UNITS = ("um", "um", "um", "mdeg")


def report_text(result: Result) -> str:
    """Verdict, errors, gains, weights, offsets, positions, notes."""
    parts = [
        _data_text(result),
        verdict(result),
        _errors_text("RMS error on positions left out of the fit, 95 % interval", result.evidence),
        _gains_text(result, result.evidence, ""),
    ]
    if result.other is not None:
        parts.append(_errors_text(f"RMS error on {result.other_name}", result.other))
        parts.append(_gains_text(result, result.other, f" on {result.other_name}"))
    parts += [_weights_text(result), _bias_text(result), positions_text(result)]
    if result.notes:
        parts.append("\n".join(_wrapped(f"note: {note}") for note in result.notes))
    return "\n\n".join(parts)


def _data_text(result: Result) -> str:
    errors = result.errors
    text = f"{errors.name}: {len(errors)} rows of {len(errors.positions)} positions"
    if errors.single_rows:
        text += f" ({errors.single_rows} more rows without both markers do not count)"
    return _wrapped(text)


def verdict(result: Result) -> str:
    """What to fly with, and why, in a line for each axis."""
    better = [SINGLE[int(k)] for k in result.evidence.better]
    if not any(result.proven):
        return _wrapped(
            "not recommended: on no axis do these weights beat the better single marker beyond "
            "the 95 % interval; take more positions, or fly merge.method: joint"
        )
    lines = [f"recommended weights of the large marker ({LABELS[result.chosen]})"]
    for axis, name, proven, weight in zip(
        AXES, better, result.proven, result.recommended, strict=True
    ):
        why = (
            f"beats the {name} marker alone beyond the 95 % interval"
            if proven
            else f"the {name} marker alone: no weight is proven to beat it"
        )
        lines.append(f"  {axis:<4} {weight:.3f}  {why}")
    return "\n".join(lines)


def _errors_text(title: str, evidence: Evidence) -> str:
    lines = [_wrapped(title), _head()]
    for name, method in evidence.methods.items():
        halves = method.high - method.rms
        lines.append(_line(LABELS[name], _scaled(method.rms, halves)))
    return "\n".join(lines)


def _gains_text(result: Result, evidence: Evidence, where: str) -> str:
    """By how much the chosen weights' error is below that of other ways."""
    lines = [
        _wrapped(
            f"gain of {LABELS[result.chosen]} in RMS error{where} over (* beyond its interval)"
        ),
        _head(),
    ]
    for other in ("large", "small", "paper", "joint"):
        if other not in evidence.methods:
            continue
        gain, low, high = gain_over(evidence, result.chosen, other)
        cells = [
            cell + ("*" if lo > 0.0 or hi < 0.0 else " ")
            for cell, lo, hi in zip(_scaled(gain, high - gain, sign="+"), low, high, strict=True)
        ]
        lines.append(_line(LABELS[other], cells).rstrip())
    return "\n".join(lines)


def _weights_text(result: Result) -> str:
    """The large marker's, by all methods, and how LMS got there."""
    lines = [_line("fitted weights", list(AXES))]
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
        _head(),
    ]
    for name, bias in result.bias.items():
        lines.append(_line(f"{name} marker", _scaled(bias.mean, bias.half_width, sign="+")))
    cells = [f"{int(count)}{'':6}" for count in result.errors.outliers]
    lines.append(_line("outliers left out", cells).rstrip())
    return "\n".join(lines)


def estimated(result: Result) -> Array:
    """Mean merged pose of each position, by weights fitted without it, (g, 4)."""
    folds = result.fits[result.chosen].folds
    n = np.maximum(result.sums.n, 1.0)
    error = folds * result.sums.a / n + (1.0 - folds) * result.sums.b / n
    return result.errors.actual + error


def positions_text(result: Result) -> str:
    """The paper's tables I and II in one: a line for each position."""
    actual = result.errors.actual
    error = estimated(result) - actual
    error[:, YAW] = wrap(error[:, YAW])
    shown = np.column_stack([actual[:, :3] * 100.0, np.degrees(wrap(actual[:, YAW]))])
    count = len(actual)
    more = f" (the first {MOST_POSITIONS} of {count})" if count > MOST_POSITIONS else ""
    columns = ("x [cm]", "y [cm]", "z [cm]", "yaw [deg]")
    heads = (*columns, *(f"{axis} [{unit}]" for axis, unit in zip(AXES, _UNITS, strict=True)))
    lines = [
        f"positions{more}: as they are, and the merged pose's error there (weights fitted",
        "to the others; Tables I and II of the paper)",
        _place_line("", heads),
    ]
    numbers = result.errors.positions
    for number, place, off in list(zip(numbers, shown, error * _SCALES, strict=True))[
        :MOST_POSITIONS
    ]:
        cells = [*(f"{v:.2f}" for v in place[:3]), f"{place[3]:.1f}", *(figure(v) for v in off)]
        lines.append(_place_line(str(int(number)), cells))
    return "\n".join(lines)


_WIDTHS = (8, 8, 8, 11, 9, 8, 8, 12)


def _place_line(name: str, cells: Sequence[str]) -> str:
    return f"{name:<8}" + "".join(f"{c:>{width}}" for c, width in zip(cells, _WIDTHS, strict=True))


def figure(value: float, sign: str = "", spread: float = 0.0) -> str:
    """To three digits of the larger one, but no finer than hundredths; beyond 100 000 in
    thousands (k). No exponent, and no zero with a minus."""
    size = max(abs(value), abs(spread))
    if size >= 99_950:
        return f"{value / 1e3:{sign}.0f}k"
    digits = 2 if size < 9.995 else 1 if size < 99.95 else 0
    return f"{round(value, digits) + 0.0:{sign}.{digits}f}"


def _scaled(values: Array, halves: Array, sign: str = "") -> list[str]:
    cells = []
    for value, half in zip(values * _SCALES, halves * _SCALES, strict=True):
        v, h = float(value), float(half)
        cells.append(f"{figure(v, sign, h)} +-{figure(h, '', v)}")
    return cells


def _head() -> str:
    cells = [f"{axis} [{unit}]" for axis, unit in zip(AXES, _UNITS, strict=True)]
    return _line("", cells)


def _line(label: str, cells: list[str]) -> str:
    room = _CELL - 1
    return f"{label:<{_LABEL}}" + "".join(f" {cell:>{room}}" for cell in cells)


def _wrapped(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)
