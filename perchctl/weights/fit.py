"""Fit the merge weights to the data for each axis, by the paper's LMS (least mean squares) and by
the closed-form least squares to which it converges, and test whether they help.

With a = large - actual and b = small - actual, the merged error of equation 8 is ``w a + (1 - w)
b``. The constant part of a and b is the markers' bias. No merge weight can correct it, so it is
reported separately, and the weights are fitted to the rest. Differences of yaw are wrapped about
their mean direction.

Frames at one position have errors in common, so the weights are tested by cross-validation over
whole positions. The test errors include the bias, as in a flight. Intervals are 95 % intervals by
Student's t over positions (for a root mean square, by the delta method).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.weights.data import AXES, YAW_COLUMN, Measurements, wrap_angles

OUTLIER_SIGMAS = 6.0
"""A row is excluded on an axis if a marker's error there differs from the median at the same
position by more than this many robust standard deviations."""
LEAST_ROWS = 8
"""Average number of rows per position below which no row is treated as an outlier."""
_MAD_TO_SIGMA = 1.4826

PAPER_WEIGHTS = (0.275, 0.306, 0.728, 0.469)
"""w_x, w_y, w_z, w_psi of the paper, section III-B."""
FITTED = ("lms", "closed_form")
SINGLE = ("large", "small")
LABELS = {
    "large": "large marker alone",
    "small": "small marker alone",
    "paper": "the paper's weights",
    "lms": "LMS",
    "closed_form": "closed form",
}


@dataclass(frozen=True, eq=False)
class MarkerErrors:
    """Pose errors (measured minus actual) of the n rows with both markers, sorted by position.

    Attributes:
        name: the data file, for messages.
        positions: numbers of the g positions, (g,); starts: the first row of each position, (g,).
        large, small: each marker's errors in x, y, z (m) and yaw (rad), (n, 4).
        is_inlier: False where the row is an outlier on the axis, (n, 4).
    """

    name: str
    positions: NDArray[np.int64]
    starts: NDArray[np.int64]
    large: Array
    small: Array
    is_inlier: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.large)

    @cached_property
    def sums(self) -> Array:
        """Each position's sums of 1, a, b, a^2, b^2, a b, (6, g, 4); a is `large`, b `small`."""
        use = self.is_inlier.astype(np.float64)
        a, b = self.large * use, self.small * use
        parts = np.stack([use, a, b, a * a, b * b, a * b])
        return np.asarray(np.add.reduceat(parts, self.starts, axis=1))


def marker_errors(data: Measurements) -> MarkerErrors:
    """The pose errors in the rows that contain both markers."""
    rows = np.flatnonzero(data.has_both_markers)
    rows = rows[np.argsort(data.position[rows], kind="stable")]
    positions, starts = np.unique(data.position[rows], return_index=True)
    actual = data.actual[rows]
    large, small = data.large[rows] - actual, data.small[rows] - actual
    yaw = np.concatenate([large[:, YAW_COLUMN], small[:, YAW_COLUMN]])
    reference = float(np.arctan2(np.sin(yaw).sum(), np.cos(yaw).sum()))
    for each in (large, small):
        each[:, YAW_COLUMN] = reference + wrap_angles(each[:, YAW_COLUMN] - reference)
    return MarkerErrors(
        name=data.name,
        positions=positions,
        starts=starts,
        large=large,
        small=small,
        is_inlier=_inliers(large, starts) & _inliers(small, starts),
    )


def _inliers(error: Array, starts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return an array (n, 4) that is False at outliers according to `OUTLIER_SIGMAS`; positions
    begin at rows `starts`."""
    use = np.ones(error.shape, dtype=bool)
    if len(starts) * LEAST_ROWS > len(error):
        return use  # too few rows per position to recognise outliers
    for start, end in itertools.pairwise([*starts, len(error)]):
        part = error[start:end]
        away = np.abs(part - np.median(part, axis=0))
        spread = _MAD_TO_SIGMA * np.median(away, axis=0)
        # If most values are equal (coarse resolution), the mean deviation is still useful.
        spread = np.where(spread > 0.0, spread, away.mean(axis=0))
        use[start:end] = away <= OUTLIER_SIGMAS * spread + 1e-12
    return use


def t_quantile(freedom: int) -> float:
    """Return Student's two-sided 95 % quantile at `freedom` degrees of freedom; inf at 0."""
    return float(stdtrit(freedom, 0.975)) if freedom >= 1 else math.inf


def closed_form_weights(sums: Array) -> Array:
    """The weights (..., 4) that minimise the variance of the merged error; NaN where all weights
    fit equally well. `sums` is (6, ..., 4), as in `MarkerErrors.sums`."""
    a, b, aa, bb, ab = sums[1:] / np.maximum(sums[0], 1.0)
    var_a, var_b, cov = aa - a * a, bb - b * b, ab - a * b
    below = var_a + var_b - 2.0 * cov
    fits = below > 1e-12 * (var_a + var_b) + 1e-24
    return np.where(fits, (var_b - cov) / np.where(fits, below, 1.0), np.nan)


# --- Widrow and Hoff's LMS, as in the paper ---
# ``w <- w + mu e d`` with d = large - small and e = actual - merged is, in the errors a and b,
# ``w <- w - mu (d^2 w + b d)``. The step mu, in units of 1 / mean(d^2), begins at `START_STEP` and
# falls as 1 / rows, so that LMS ends at the least-squares weight instead of wandering about it.


START_STEP = 0.02
LEAST_RUN_ROWS, LEAST_PASSES = 40_000, 3
"""Smallest number of rows to process, in as many passes as necessary, and smallest number of
passes; a data file with few rows is therefore sufficient."""
MOST_ROWS = 100_000
"""Largest number of rows to process; if there are more, evenly spaced ones are processed."""
_LMS_STREAM = (0, 601)


def lms_weights(errors: MarkerErrors, start: float = 0.5) -> tuple[Array, Array]:
    """The final weights of LMS, (4,), not clipped, and the final weights with each position
    left out in turn, (g, 4).

    LMS begins at the weight `start` and processes the rows, minus the mean errors, in a shuffled
    order.
    """
    power, pull = _recursion(errors)
    g = len(errors.positions)
    place = np.repeat(np.arange(g), np.diff(errors.starts, append=len(errors)))
    share = slice(None, None, 1 + len(errors) // MOST_ROWS)
    power, pull, place = power[share], pull[share], place[share]
    n = len(power)
    rng = np.random.default_rng(_LMS_STREAM)
    passes = max(LEAST_PASSES, math.ceil(LEAST_RUN_ROWS / n))
    order = np.concatenate([rng.permutation(n) for _ in range(passes)])
    first = np.minimum(START_STEP, 0.5 / np.maximum(power.max(axis=0), 1.0))
    step = first / (1.0 + 0.5 * first * np.arange(len(order))[:, None])
    shrink, shift = 1.0 - step * power[order], -step * pull[order]
    held_out = [place[order] != position for position in range(g)]
    folds = np.array([_run(start, shrink[kept], shift[kept]) for kept in held_out])
    return _run(start, shrink, shift), folds


def _run(start: float, shrink: Array, shift: Array) -> Array:
    """The final w (4,) of the recursion ``w <- shrink[k] w + shift[k]`` that begins at `start`.

    `shrink`, `shift`: (n, 4). The recursion is linear, so it is computed as one sum.
    """
    product = np.cumprod(shrink[::-1], axis=0)  # product of the last 1, 2, ... n factors
    later = np.vstack([product[-2::-1], np.ones(4)])  # product of the factors after each row
    return np.asarray(product[-1] * start + (shift * later).sum(axis=0))


def _recursion(errors: MarkerErrors) -> tuple[Array, Array]:
    """Return p, scaled to a mean of 1, and q, (n, 4) each, for ``w <- w - mu (p w + q)``; the rows
    of outliers are zero."""
    use = errors.is_inlier
    n = np.maximum(use.sum(axis=0), 1)
    a, b = np.where(use, errors.large, 0.0), np.where(use, errors.small, 0.0)
    a -= np.where(use, a.sum(axis=0) / n, 0.0)
    b -= np.where(use, b.sum(axis=0) / n, 0.0)
    d = a - b
    mean = (d * d).sum(axis=0) / n
    return d * d / mean, b * d / mean


# --- Both methods, and their errors on held-out positions ---


@dataclass(frozen=True, eq=False)
class FittedWeights:
    """The large marker's weights for x, y, z and yaw, fitted by one method to g positions; arrays
    are (4,) unless stated.

    Attributes:
        raw_weights: weights as fitted.
        weights: `raw_weights`, clipped to [0, 1].
        half_width: half the width of the 95 % interval of `raw_weights` (jackknife over positions).
        fold_weights: clipped weights, each row fitted without one position, (g, 4).
    """

    raw_weights: Array
    weights: Array
    half_width: Array
    fold_weights: Array


def fit_by_each_method(errors: MarkerErrors) -> dict[str, FittedWeights]:
    """The weights fitted by each method in `FITTED`. Raises InvalidValue if on some axis all
    weights fit equally well."""
    total = errors.sums.sum(axis=1)
    closed = closed_form_weights(total)
    if np.isnan(closed).any():
        raise InvalidValue(
            f"{errors.name}: the two markers are equal or differ only by a constant in "
            f"{AXES[int(np.argmax(np.isnan(closed)))]}, so every weight fits equally well; "
            "check for repeated frames or a copied column"
        )
    held_out = closed_form_weights(total[:, None] - errors.sums)
    folds = np.where(np.isfinite(held_out), held_out, closed)
    g = len(folds)
    # LMS approximates the closed form, so its weights have the same spread over positions.
    spread = np.sqrt((g - 1) / g * ((folds - folds.mean(axis=0)) ** 2).sum(axis=0))
    half = t_quantile(g - 1) * spread
    return {
        name: FittedWeights(raw, np.clip(raw, 0.0, 1.0), half, np.clip(left, 0.0, 1.0))
        for name, (raw, left) in {
            "lms": lms_weights(errors),
            "closed_form": (closed, folds),
        }.items()
    }


@dataclass(frozen=True, eq=False)
class Evidence:
    """The errors of several sets of weights on held-out positions.

    `squares`: mean square errors (x, y, z, yaw) at g positions, (g, 4), keyed by the name of the
    set.
    """

    squares: dict[str, Array]

    @property
    def better_marker(self) -> NDArray[np.int64]:
        """The better single marker on each axis, as an index into `SINGLE`, (4,)."""
        means = [self.squares[name].mean(axis=0) for name in SINGLE]
        return np.asarray(np.argmin(means, axis=0))

    @property
    def better_marker_squares(self) -> Array:
        """The mean square errors of the better single marker, (g, 4)."""
        return np.where(self.better_marker == 0, self.squares["large"], self.squares["small"])

    def rms(self, name: str) -> tuple[Array, Array]:
        """The RMS error (m, rad) of the weights `name`, and half the width of its 95 % interval,
        (4,) each."""
        rms, influence = _root(self.squares[name])
        return rms, _half_width(influence)

    def rms_gain(self, name: str, other: Array) -> tuple[Array, Array]:
        """Return how much lower the RMS error of the weights `name` is than the RMS error from the
        mean squares `other` (g, 4), and half the width of its 95 % interval, (4,) each."""
        (rms, influence), (reference, of_reference) = _root(self.squares[name]), _root(other)
        return reference - rms, _half_width(of_reference - influence)

    def is_proven_better(self, name: str) -> NDArray[np.bool_]:
        """True where the whole interval of the gain of the weights `name` over the better single
        marker is above zero, (4,)."""
        gain, half = self.rms_gain(name, self.better_marker_squares)
        return np.asarray(gain - half > 0.0)


def evaluate_weights(errors: MarkerErrors, weights: Mapping[str, Array]) -> Evidence:
    """The errors of the fitted weights, of the paper's weights, and of each marker alone.
    `weights`, keyed by method: (4,), or one row per position, (g, 4)."""
    n, _, _, aa, bb, ab = errors.sums
    known = {"large": np.ones(4), "small": np.zeros(4), "paper": np.array(PAPER_WEIGHTS)}
    return Evidence(
        {
            name: (w * w * aa + 2.0 * w * (1.0 - w) * ab + (1.0 - w) ** 2 * bb) / np.maximum(n, 1.0)
            for name, w in (known | dict(weights)).items()
        }
    )


def _root(square: Array) -> tuple[Array, Array]:
    """The square root of the mean over positions (4,), and the influence of each position (g,
    4)."""
    mean = square.mean(axis=0)
    rms = np.sqrt(mean)
    return rms, (square - mean) / (2.0 * np.maximum(rms, 1e-300))


def _half_width(influence: Array) -> Array:
    g = len(influence)
    spread = np.sqrt((influence**2).sum(axis=0) / (g - 1) / g)
    return np.asarray(t_quantile(g - 1) * spread)
