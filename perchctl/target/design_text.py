"""The designer's findings in words."""

from __future__ import annotations

import math

import numpy as np

from perchctl.target.blind import blind_lines, blind_record
from perchctl.target.design import (
    PAPER_CM,
    PAPER_FOCAL_PX,
    PAPER_SIZE_PX,
    ErrorCurve,
    TargetDesign,
    cm_text,
)
from perchctl.target.lengths import mm_text

_NEVER = "never"
_TABLE_CM = (3, 5, 7, 10, 15, 20, 25, 30, 50, 75, 100, 150, 200, 300, 500)


def describe_design(design: TargetDesign, curve: ErrorCurve, camera_name: str) -> str:
    """Ranges, overlap, error over the range, warnings; several lines."""
    r, optics, target = design.ranges, design.optics, design.target
    width, height = design.camera.size_px
    lines = [
        f"camera    {camera_name}, {width}x{height}, f {r.focal_px:.0f} px",
        f"optics    blur sigma {optics.blur_px:g} px, noise sigma {optics.noise:g}",
        f"target    {mm_text(target.large.side_m)} mm {target.large.dictionary}/"
        f"{target.large.id} around {mm_text(target.small.side_m)} mm "
        f"{target.small.dictionary}/{target.small.id}",
        f"z1        {_cm(r.z1_m):<9} large marker from here on inwards (side {_px(r.large_px)})",
        f"z2        {_cm(r.z2_m):<9} small marker from here on inwards (side {_px(r.small_px)})",
        f"z3        {_cm(r.z3_m):<9} whole large marker down to here at any turn; "
        f"{_cm(r.z3_upright_m)} where it is upright",
        f"z4        {_cm(r.z4_m):<9} whole small marker down to here at any turn",
        "overlap   " + _overlap(design),
        f"at gear   whole large marker down to {_cm(design.gear.large_nearest_m)}, small down to "
        f"{_cm(design.gear.small_nearest_m)} between gear and target, the gear under its centre",
    ]
    blind, *advice = blind_lines(design.mount)
    lines += [f"mounting  {blind}", *(f"advice    {text}" for text in advice)]
    if design.search_range_m is not None:
        where = f"at the highest search position ({design.search_height_m:g} m)"
        if design.search_height_m == 0.0:
            where = "on the ground, from where it has to be seen"
        lines.append(f"search    target {_cm(design.search_range_m)} away {where}")
    lines += ["", *_table(curve), ""]
    lines += [f"warning: {text}" for text in design.warnings] or ["no gap from search to stand-off"]
    lines += _against_paper(design)
    return "\n".join(lines)


def design_record(design: TargetDesign) -> dict[str, object]:
    """The same for machines; metres."""
    r = design.ranges
    return {
        "z1_m": r.z1_m,
        "z2_m": r.z2_m,
        "z3_m": r.z3_m,
        "z3_upright_m": r.z3_upright_m,
        "z4_m": r.z4_m,
        "large_px": r.large_px,
        "small_px": r.small_px,
        "gear_large_nearest_m": design.gear.large_nearest_m,
        "gear_small_nearest_m": design.gear.small_nearest_m,
        "blind": blind_record(design.mount),
        "search_range_m": design.search_range_m,
        "warnings": list(design.warnings),
    }


def _overlap(design: TargetDesign) -> str:
    r = design.ranges
    if r.z2_m is None or r.z3_m is None or r.z2_m <= r.z3_m:
        return "none: the two markers are never seen together at every turn"
    return f"{_cm(r.z3_m)} to {_cm(r.z2_m)}, both markers at any turn"


def _table(curve: ErrorCurve) -> list[str]:
    """Least possible errors at a few ranges, by the best that is seen there."""
    lines = ["least error that the corners allow (sigma 0.2 px):"]
    lines.append("   range cm   x, y mm     z mm   turn deg   seen")
    rows = [z for z in _TABLE_CM if curve.z_m[0] <= z / 100.0 <= curve.z_m[-1]]
    for i in (int(np.abs(curve.z_m - z / 100.0).argmin()) for z in rows):
        for name in ("both", "large", "small"):
            x, z, yaw = curve.bounds[name][i]
            if math.isfinite(x):
                lines.append(
                    f"   {100 * curve.z_m[i]:8.1f}  {1e3 * x:8.3f}  {1e3 * z:7.3f}  "
                    f"{math.degrees(yaw):9.3f}   {name}"
                )
                break
        else:
            lines.append(f"   {100 * curve.z_m[i]:8.1f}   nothing whole and readable")
    return lines


def _against_paper(design: TargetDesign) -> list[str]:
    """Where the paper's own camera and target differ from what it reports."""
    r, target = design.ranges, design.target
    same = (
        design.camera.size_px == PAPER_SIZE_PX
        and abs(r.focal_px / PAPER_FOCAL_PX - 1.0) < 0.02
        and math.isclose(target.large.side_m, 0.150)
        and math.isclose(target.small.side_m, 0.025)
    )
    if not same or r.z1_m is None or r.z2_m is None or r.z3_m is None or r.z3_upright_m is None:
        return []
    lines = ["", "the paper reports 115, 25 and 12 cm for this camera and target:"]
    for name, here, note in (
        ("z1", r.z1_m, _needed_blur(design, r.z1_m, "z1")),
        ("z2", r.z2_m, _needed_blur(design, r.z2_m, "z2")),
        ("z3", r.z3_upright_m, f"upright; at any turn it is {_cm(r.z3_m)}"),
    ):
        there = PAPER_CM[name]
        off = 100.0 * (100.0 * here / there - 1.0)
        lines.append(f"  {name} {there:3.0f} cm, here {_cm(here)} ({off:+.0f} %); {note}")
    return lines


def _needed_blur(design: TargetDesign, here_m: float, name: str) -> str:
    """In strong blur the readable side grows in proportion to it."""
    blur = design.optics.blur_px
    if blur < 1.5:
        return "the paper's video is more blurred: try --blur 2.5"
    return f"the paper's is what a blur of {blur * 100.0 * here_m / PAPER_CM[name]:.1f} px gives"


def _cm(length_m: float | None) -> str:
    return _NEVER if length_m is None else f"{cm_text(length_m)} cm"


def _px(side_px: float | None) -> str:
    return _NEVER if side_px is None else f"{side_px:.0f} px"
