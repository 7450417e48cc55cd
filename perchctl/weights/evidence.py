"""Do the weights help? Leave-one-position-out cross-validation with intervals.

Frames of one position share its errors, so whole positions are held out: the weights are
fitted to the others and tested on the one that was left out, bias included, as it acts in
a flight. Intervals are Student's t over positions (for a root mean square by the
delta method), 95 %.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.weights.fit import (
    Errors,
    Sums,
    clipped,
    closed_form,
    inverse_variance,
    sums_of,
    t_quantile,
)
from perchctl.weights.lms import LmsOptions, LmsRun, lms, lms_folds, thinned
from perchctl.weights.types import PAPER_WEIGHTS

FITTED = ("lms", "nlms", "closed_form", "inverse_variance")
SINGLE = ("large", "small")
LABELS = {
    "large": "large marker alone",
    "small": "small marker alone",
    "paper": "the paper's weights",
    "lms": "LMS",
    "nlms": "normalised LMS",
    "closed_form": "closed form",
    "inverse_variance": "inverse variance",
    "joint": "joint solve",
}


@dataclass(frozen=True, eq=False)
class MethodErrors:
    """Root mean square errors of one method, per axis, on positions it was not fitted to.

    Attributes:
        rms: over all positions, (4,), m and rad; low, high: its 95 % interval.
        by_position: (g, 4).
        gain, gain_low, gain_high: by how much it is below the better single marker, and
            the interval of that difference, (4,).
    """

    rms: Array
    low: Array
    high: Array
    by_position: Array
    gain: Array
    gain_low: Array
    gain_high: Array


@dataclass(frozen=True, eq=False)
class Fitted:
    """One method's weights: as fitted, clipped to [0, 1], and their 95 % interval over
    positions (jackknife), (4,); `folds` without each position in turn, (g, 4)."""

    raw: Array
    weights: Array
    low: Array
    high: Array
    folds: Array


@dataclass(frozen=True, eq=False)
class Evidence:
    """Attributes:
    better: of the single markers, by axis: index into `SINGLE`, (4,).
    proven: by fitted method, where its gain is above zero with its whole interval, (4,).
    """

    methods: dict[str, MethodErrors]
    better: NDArray[np.int64]
    proven: dict[str, NDArray[np.bool_]]


def fit_all(
    errors: Errors,
    sums: Sums,
    options: LmsOptions,
    tick: Callable[[], None] = lambda: None,
) -> tuple[dict[str, Fitted], dict[str, LmsRun]]:
    """The weights of all methods, and the runs of LMS and its normalised form."""
    left = sums.without()
    fits = {
        "closed_form": _fitted(closed_form(sums.total()), closed_form(left)),
        "inverse_variance": _fitted(inverse_variance(sums.total()), inverse_variance(left)),
    }
    runs: dict[str, LmsRun] = {}
    for name, normalised in (("lms", False), ("nlms", True)):
        # A step of the user's is LMS's; the normalised form is stable with any below 2.
        step = options.step if not normalised or (options.step or 0.0) < 2.0 else None
        chosen = replace(options, normalised=normalised, step=step)
        runs[name] = lms(errors, chosen, tick)
        folds = lms_folds(errors, chosen, tick)
        fit = _fitted(runs[name].weights, folds)
        if thinned(errors):  # what LMS approaches has the same spread over positions
            half = fits["closed_form"].high - fits["closed_form"].raw
            fit = replace(fit, low=fit.raw - half, high=fit.raw + half)
        fits[name] = fit
    return {name: fits[name] for name in FITTED}, runs


def _fitted(raw: Array, folds: Array) -> Fitted:
    g = len(folds)
    folds = np.where(np.isfinite(folds), folds, raw)
    spread = np.sqrt((g - 1) / g * ((folds - folds.mean(axis=0)) ** 2).sum(axis=0))
    half = t_quantile(g - 1) * spread
    return Fitted(raw, clipped(raw), raw - half, raw + half, clipped(folds))


def evidence(errors: Errors, sums: Sums, fits: dict[str, Fitted]) -> Evidence:
    """Errors of every method on held-out positions."""
    return _evidence(errors, sums, {name: fit.folds for name, fit in fits.items()})


def on_other_data(errors: Errors, fits: dict[str, Fitted]) -> Evidence:
    """Errors of the weights as they are, on data that they were not fitted to."""
    return _evidence(errors, sums_of(errors), {name: fit.weights for name, fit in fits.items()})


def _evidence(errors: Errors, sums: Sums, fitted: dict[str, Array]) -> Evidence:
    shape = sums.n.shape
    squares = {
        "large": sums.mean_square(np.ones(shape)),
        "small": sums.mean_square(np.zeros(shape)),
        "paper": sums.mean_square(np.broadcast_to(np.array(PAPER_WEIGHTS), shape)),
    }
    squares |= {name: sums.mean_square(np.broadcast_to(w, shape)) for name, w in fitted.items()}
    joint = _joint_squares(errors)
    if joint is not None:
        squares["joint"] = joint
    single = np.stack([_mean(squares[name]) for name in SINGLE])
    better = np.argmin(single, axis=0)
    reference = np.where(better == 0, squares["large"], squares["small"])
    methods = {name: _method(square, reference) for name, square in squares.items()}
    proven = {name: methods[name].gain_low > 0.0 for name in fitted}
    return Evidence(methods, better, proven)


def gain_over(found: Evidence, name: str, other: str) -> tuple[Array, Array, Array]:
    """By how much `name`'s error is below `other`'s, and the 95 % interval, (4,) each."""
    mine = _method(found.methods[name].by_position ** 2, found.methods[other].by_position ** 2)
    return mine.gain, mine.gain_low, mine.gain_high


def _mean(squares: Array) -> Array:
    known = np.isfinite(squares)
    return np.asarray(np.where(known, squares, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1))


def _joint_squares(errors: Errors) -> Array | None:
    """(g, 4), NaN where a position has no joint pose; None without any."""
    if errors.joint is None:
        return None
    there = errors.use & ~np.isnan(errors.joint)
    if not there.any():
        return None
    squares = np.where(there, errors.joint, 0.0) ** 2
    n = np.add.reduceat(there.astype(np.float64), errors.starts, axis=0)
    total = np.add.reduceat(squares, errors.starts, axis=0)
    return np.where(n > 0, total / np.maximum(n, 1.0), np.nan)


def _method(square: Array, reference: Array) -> MethodErrors:
    both = np.isfinite(square) & np.isfinite(reference)
    g = both.sum(axis=0)
    square, reference = np.where(both, square, np.nan), np.where(both, reference, np.nan)
    rms, influence = _root(square)
    other, other_influence = _root(reference)
    t = np.array([t_quantile(int(count) - 1) for count in g])
    half = _half(influence, g, t)
    gain = other - rms
    gain_half = _half(other_influence - influence, g, t)
    return MethodErrors(
        rms,
        np.maximum(rms - half, 0.0),
        rms + half,
        np.sqrt(square),
        gain,
        gain - gain_half,
        gain + gain_half,
    )


def _root(square: Array) -> tuple[Array, Array]:
    """The root of the mean over positions, and each position's influence on it."""
    mean = _mean(square)
    rms = np.sqrt(mean)
    return rms, (square - mean) / (2.0 * np.maximum(rms, 1e-300))


def _half(influence: Array, g: Array, t: Array) -> Array:
    total = np.nansum(influence**2, axis=0)
    out = np.full(len(g), math.inf)
    many = g > 1
    out[many] = t[many] * np.sqrt(total[many] / (g[many] - 1) / g[many])
    return out
