"""Which corners and views to leave out, by one rule that the report repeats.

1. The camera is solved with weights 1 / (1 + (r / 3s)^2)^2, r a corner's distance from the
   model and s the median spread, repeated, so that outliers do not bend the solution
   that judges them.
2. A corner is rejected when r > 5 times the spread of its view (at least that of all
   views), and r > 0.3 px.
3. A view is rejected when the RMS of its remaining corners is above 2.5 times the median
   view's and above 0.1 px, when more than a quarter of its corners were rejected, or
   when fewer than 6 remain.
4. What remains is solved with equal weights, and 2 to 3 are repeated until nothing changes.

When more than a third of the views would go, nothing is rejected and calibration is
refused: then not the views are wrong, but the board, its size or the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.bundle import Fit, refit, start_fit
from perchctl.calibration.detect import MIN_CORNERS
from perchctl.calibration.types import BoardView, Rejection
from perchctl.errors import InvalidValue
from perchctl.geometry import Array

CORNER_FACTOR = 5.0
CORNER_FLOOR_PX = 0.3
VIEW_FACTOR = 2.5
VIEW_FLOOR_PX = 0.1
MAX_CORNERS_OUT = 0.25
MAX_VIEWS_OUT = 1.0 / 3.0
_MEDIAN_OF_RAYLEIGH = 1.1774  # median distance of a round Gaussian with spread 1
_MIN_SPREAD_PX = 0.01
_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Robust:
    """fit: of `views`, which are those kept, without their rejected corners."""

    fit: Fit
    views: tuple[BoardView, ...]
    rejections: tuple[Rejection, ...]


def weighted_fit(views: Sequence[BoardView], model: str) -> tuple[Fit, float]:
    """Step 1: the solution that outliers do not bend, and its median spread s in px."""
    fit = start_fit(views, model)
    spread = spread_px(fit.residuals)
    for _ in range(12):
        weights = [
            (1.0 + (np.linalg.norm(r, axis=1) / (3.0 * spread)) ** 2) ** -2 for r in fit.residuals
        ]
        fit = refit(views, fit, weights)
        before, spread = spread, spread_px(fit.residuals)
        if abs(spread - before) < 0.01 * before:
            break
    return fit, spread


def reject(views: Sequence[BoardView], start: Fit) -> Robust:
    """Steps 2 to 4 from the weighted solution of all views; InvalidValue when too many go."""
    kept, fit = list(views), start
    out_corners: dict[str, set[int]] = {v.name: set() for v in views}
    out_views: dict[str, str] = {}
    for _ in range(_ROUNDS):
        masks, reasons = _judge(kept, fit, {v.name: len(v) for v in views})
        changed = False
        remaining = []
        for view, mask in zip(kept, masks, strict=True):
            out_corners[view.name] |= {int(i) for i in view.ids[~mask]}
            if view.name in reasons:
                out_views[view.name] = reasons[view.name]
                changed = True
                continue
            changed |= not bool(mask.all())
            remaining.append(view.keep(mask) if not mask.all() else view)
        if len(views) - len(remaining) > MAX_VIEWS_OUT * len(views):
            raise InvalidValue(
                f"{len(views) - len(remaining)} of {len(views)} views do not fit one camera "
                f"({_named(out_views)}): is the board flat and --board its true layout, and were "
                f"zoom and focus left alone between the pictures?"
            )
        if not changed and fit is not start:
            break
        poses = fit.poses[[v.name not in reasons for v in kept]]
        kept = remaining
        fit = refit(kept, Fit(fit.model, fit.size_px, fit.parameters, poses, (), (), ()))
    rejections = [Rejection(name, reason) for name, reason in out_views.items()]
    rejections += [
        Rejection(
            view.name,
            f"{len(out_corners[view.name])} corners are off by more than "
            f"{CORNER_FACTOR:g} times the view's spread",
            tuple(sorted(out_corners[view.name])),
        )
        for view in kept
        if out_corners[view.name]
    ]
    return Robust(fit, tuple(kept), tuple(rejections))


def keep_all(views: Sequence[BoardView], model: str) -> Robust:
    """No rejection at all: the plain least squares of every corner."""
    return Robust(start_fit(views, model), tuple(views), ())


def spread_px(residuals: Sequence[Array]) -> float:
    """Spread of one coordinate, from the median distance."""
    distances = np.concatenate([np.linalg.norm(r, axis=1) for r in residuals])
    return max(float(np.median(distances)) / _MEDIAN_OF_RAYLEIGH, _MIN_SPREAD_PX)


def _judge(
    views: Sequence[BoardView], fit: Fit, counts: dict[str, int]
) -> tuple[list[NDArray[np.bool_]], dict[str, str]]:
    """Corners to keep in each view, and views to leave out with the reason."""
    overall = spread_px(fit.residuals)
    masks, rms = [], []
    for r in fit.residuals:
        distance = np.linalg.norm(r, axis=1)
        limit = max(CORNER_FACTOR * max(overall, spread_px([r])), CORNER_FLOOR_PX)
        mask = distance <= limit
        masks.append(mask)
        rms.append(float(np.sqrt((distance[mask] ** 2).mean())) if mask.any() else np.inf)
    median = float(np.median(rms))
    limit = max(VIEW_FACTOR * median, VIEW_FLOOR_PX)
    reasons = {}
    for view, mask, view_rms in zip(views, masks, rms, strict=True):
        left, had = int(mask.sum()), counts[view.name]
        if view_rms > limit:
            reasons[view.name] = f"RMS {view_rms:.2f} px, the median view has {median:.2f}"
        elif had - left > MAX_CORNERS_OUT * had:
            reasons[view.name] = f"{had - left} of its {had} corners are outliers"
        elif left < MIN_CORNERS:
            reasons[view.name] = f"only {left} good corners remain"
    return masks, reasons


def _named(names: dict[str, str]) -> str:
    shown = list(names)[:4]
    return ", ".join(shown) + (", ..." if len(names) > len(shown) else "")
