"""Which lens model: the one that best predicts views it was not fitted to.

The views are split into at most ten groups. Each group in turn is left out, the camera
is solved from the others, and the group's corners are compared with that camera (only
the boards' poses are fitted to them). A richer model is recommended only when its
held-out error is smaller by 2 % and by two standard errors of the views' differences;
otherwise the simpler one, which extrapolates better, stays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from perchctl.calibration.bundle import Fit, NoSolution, poses_only, refit
from perchctl.calibration.lens import MODEL_NAMES
from perchctl.calibration.types import BoardView, ModelScore

FOLDS = 10
MIN_GAIN = 0.02
MIN_SIGMAS = 2.0


def score(views: Sequence[BoardView], fit: Fit) -> ModelScore:
    """Cross-validation of one model; `fit` is its solution of all these views."""
    held_out = np.full(len(views), np.nan)
    folds = min(FOLDS, len(views))
    groups = np.arange(len(views)) % folds
    for k in range(folds):
        rest = [v for v, g in zip(views, groups, strict=True) if g != k]
        group = [v for v, g in zip(views, groups, strict=True) if g == k]
        near = Fit(fit.model, fit.size_px, fit.parameters, fit.poses[groups != k], (), (), ())
        try:
            camera = refit(rest, near).camera
        except NoSolution:
            return ModelScore(fit.model, fit.rms_px, None, note="unsteady without some views")
        judged = poses_only(group, camera)
        if judged is None:
            return ModelScore(fit.model, fit.rms_px, None, note="unsteady without some views")
        held_out[groups == k] = [np.sqrt((r**2).sum(axis=1).mean()) for r in judged.residuals]
    counts = np.array([len(v) for v in views])
    total = float(np.sqrt((counts * held_out**2).sum() / counts.sum()))
    return ModelScore(fit.model, fit.rms_px, total, tuple(float(x) for x in held_out))


def recommend(scores: Sequence[ModelScore]) -> str:
    """The simplest model that none of the others beats clearly."""
    judged = [s for s in scores if s.held_out_px is not None]
    by_name = {s.model: s for s in judged if not s.note} or {s.model: s for s in judged}
    best: ModelScore | None = None
    for name in MODEL_NAMES:
        candidate = by_name.get(name)
        if candidate is not None and (best is None or _beats(candidate, best)):
            best = candidate
    return best.model if best is not None else MODEL_NAMES[0]


def _beats(challenger: ModelScore, holder: ModelScore) -> bool:
    gain = np.array(holder.per_view_px) - np.array(challenger.per_view_px)
    error = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 1 else np.inf
    relative = gain.mean() / max(float(np.mean(holder.per_view_px)), 1e-9)
    return bool(relative > MIN_GAIN and gain.mean() > MIN_SIGMAS * error)
