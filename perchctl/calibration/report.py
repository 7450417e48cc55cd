"""A calibration and a check as records for programs, and as lines for people."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from perchctl.calibration.check import CheckResult, level, limit_mm, sentence
from perchctl.calibration.lens import PARAMETERS
from perchctl.calibration.types import Calibration, Rejection
from perchctl.vision import CameraModel

_MOST_MISSING = 8
"""Pictures without a board that are named one by one."""


def calibration_record(result: Calibration, file: Path, picture: Path | None) -> dict[str, Any]:
    """The object of `calibrate --json`."""
    solution = result.solution
    names = PARAMETERS[result.camera.model]
    view_rms = solution.view_rms_px()
    return camera_record(result.camera) | {
        "board": result.board,
        "rms_px": solution.rms_px,
        "views_used": len(result.views),
        "views": [
            {"name": v.name, "rms_px": float(rms), "corners": len(v)}
            for v, rms in zip(result.views, view_rms, strict=True)
        ],
        "views_rejected": _whole_views(result.rejections),
        "corners_rejected": [
            {"name": r.view, "reason": r.reason, "corners": list(r.corners)}
            for r in result.rejections
            if r.corners
        ],
        "pictures_without_board": _whole_views(result.missing),
        "std": {n: float(s) for n, s in zip(names, solution.std, strict=True)},
        "error_mm": [
            {
                "z_m": e.z_m,
                "mm95": e.mm95,
                "axis_mm95": e.axis_mm95,
                "limit_mm": limit_mm(e.z_m),
            }
            for e in result.errors
        ],
        "ray_error_px": {"rms95": result.ray_rms_px95, "max95": result.ray_max_px95},
        "models": [
            {"model": s.model, "rms_px": s.rms_px, "held_out_px": s.held_out_px, "note": s.note}
            for s in result.scores
        ],
        "recommended": result.recommended,
        "coverage": float(result.covered.mean()),
        "warnings": [str(lack) for lack in result.lacks],
        "verdict": level(result),
        "file": str(file),
        "report": None if picture is None else str(picture),
    }


def camera_record(camera: CameraModel) -> dict[str, Any]:
    """The camera model as JSON's own types: lengths in pixels, distances in metres."""
    K = camera.K
    return {
        "fx": float(K[0, 0]),
        "fy": float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
        "distortion": [float(d) for d in camera.dist],
        "model": camera.model,
        "size_px": list(camera.size_px),
    }


def check_record(result: CheckResult, file: Path) -> dict[str, Any]:
    """The object of `calibrate --check --json`."""
    finite = np.isfinite(result.rms_px)
    return {
        "pass": result.passed,
        "reason": result.reason,
        "file": str(file),
        "rms_px": result.rms_px if finite else None,
        "best_rms_px": result.free_rms_px,
        "views": [{"name": name, "rms_px": rms} for name, rms in result.views],
        "views_rejected": _whole_views(result.rejections),
        "error_mm": [
            {"z_m": d.z_m, "mm": d.mm, "mm95": d.mm95}
            for d in result.deviations
            if np.isfinite(d.mm)
        ],
    }


def calibration_lines(result: Calibration) -> list[str]:
    """What was left out, the lens, the models, what it lacks, and the verdict at the end."""
    solution = result.solution
    lines = [f"left out {r.view}: {r.reason}" for r in result.missing[:_MOST_MISSING]]
    if len(result.missing) > _MOST_MISSING:
        left = len(result.missing) - _MOST_MISSING
        lines.append(f"left out {left} more pictures without a board")
    for r in result.rejections:
        what = f"corners {', '.join(map(str, r.corners))} of {r.view}" if r.corners else r.view
        lines.append(f"rejected {what}: {r.reason}")
    names = PARAMETERS[result.camera.model]
    lens = [
        f"{n} {value:.2f} +- {std:.2f}"
        for n, value, std in zip(names[:4], solution.parameters, solution.std, strict=False)
    ]
    lines.append(f"{len(result.views)} views, RMS {solution.rms_px:.3f} px, {', '.join(lens)} px")
    tried = [
        f"{s.model} {'-' if s.held_out_px is None else format(s.held_out_px, '.3f')} px"
        + (f" ({s.note})" if s.note else "")
        for s in result.scores
    ]
    lines.append(f"on views held out: {', '.join(tried)}; {result.recommended} is recommended")
    if result.camera.model != result.recommended:
        lines.append(f"--model {result.camera.model} was used as asked")
    return [*lines, *map(str, result.lacks), sentence(result)]


def _whole_views(rejections: Iterable[Rejection]) -> list[dict[str, str]]:
    return [{"name": r.view, "reason": r.reason} for r in rejections if not r.corners]
