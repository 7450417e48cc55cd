"""A proposed target beside the one that there is: by how much, and in what, it is better."""

from __future__ import annotations

import math

import numpy as np

from perchctl.target.design import ErrorCurve, TargetDesign, cm_text, error_curve
from perchctl.target.lengths import mm_text

_RANGES_M = (1.0, 0.5, 0.2, 0.1)
"""At which the errors are compared."""


def compare_designs(proposed: TargetDesign, present: TargetDesign, name: str) -> list[str]:
    """A table of sizes, ranges and errors; `name` is the present target's."""
    rows: list[tuple[str, ...]] = [("", "proposed", name)]
    pair = (proposed, present)
    rows.append(("large marker, mm", *(mm_text(d.target.large.side_m) for d in pair)))
    rows.append(("small marker, mm", *(mm_text(d.target.small.side_m) for d in pair)))
    for key, what in (
        ("z1_m", "large one read up to, cm"),
        ("z2_m", "small one read up to, cm"),
        ("z3_m", "large one whole down to, cm"),
        ("z4_m", "small one whole down to, cm"),
    ):
        rows.append((what, *(_cm(getattr(d.ranges, key)) for d in pair)))
    curves = [error_curve(d) for d in pair]
    for z_m in _RANGES_M:
        words = (_height_error(curve, z_m) for curve in curves)
        rows.append((f"least error in z at {100 * z_m:.0f} cm, mm", *words))
    wide = [max(len(row[i]) for row in rows) for i in range(3)]
    return [f"   {what:<{wide[0]}}  {new:>{wide[1]}}  {old:>{wide[2]}}" for what, new, old in rows]


def _height_error(curve: ErrorCurve, z_m: float) -> str:
    """By the best that is seen at the range nearest to it, in mm."""
    if not curve.z_m[0] <= z_m <= curve.z_m[-1]:
        return "-"
    i = int(np.abs(curve.z_m - z_m).argmin())
    found = [curve.bounds[name][i][1] for name in ("both", "large", "small")]
    best = next((error_m for error_m in found if math.isfinite(error_m)), None)
    return "-" if best is None else f"{1e3 * best:.3f}"


def _cm(length_m: float | None) -> str:
    return "never" if length_m is None else cm_text(length_m)
