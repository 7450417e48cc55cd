"""The weights from the data: closed-form least squares and inverse variance, per axis.

With a = large - actual and b = small - actual the merged error of equation 8 is
``w a + (1 - w) b``. What is constant in a and b is the markers' bias: no weight can mend
it, so it is estimated and reported apart, and the weights are fitted to the rest. All
differences of yaw are wrapped about the errors' own mean direction, so that neither the
seam at +-180 deg nor a constant turn of the data changes a weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.weights.types import AXES, YAW, Measurements, wrap

OUTLIER_SIGMAS = 6.0
"""A row does not count on an axis where a marker's error is farther from the median of
its position than this many robust standard deviations (1.4826 times the median absolute
deviation): of a million normal errors not one."""
ODD_POSITION_SIGMAS = 8.0
"""A position is named when both markers' errors there are this far from the others'."""
LEAST_ROWS = 8
"""Rows a position, on average, below which nothing is called an outlier."""
_MAD_TO_SIGMA = 1.4826


def t_quantile(freedom: int) -> float:
    """The two-sided 95 % quantile of Student's t; inf without a degree of freedom."""
    return float(stdtrit(freedom, 0.975)) if freedom >= 1 else math.inf


def _half_width(values: Array) -> Array:
    """Of the 95 % interval of the mean of `values` (g, ...), over the first axis."""
    g = len(values)
    if g < 2:
        return np.full(values.shape[1:], np.inf)
    return np.asarray(t_quantile(g - 1) * values.std(axis=0, ddof=1) / math.sqrt(g))


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of the rows with both markers, sorted by position: n rows, g positions.

    Attributes:
        positions: the positions' numbers, (g,); starts: the first row of each, (g,).
        large, small: a and b, (n, 4). joint: (n, 4) with NaN, or None.
        use: False where the row is an outlier on the axis, (n, 4).
        actual: the truth at each position's first row, (g, 4).
        single_rows: rows left out because only one marker, or none, was seen.
        name, line: the file and its first line with both markers, for messages.
    """

    name: str
    line: int
    positions: NDArray[np.int64]
    starts: NDArray[np.int64]
    large: Array
    small: Array
    joint: Array | None
    use: NDArray[np.bool_]
    actual: Array
    single_rows: int

    def __len__(self) -> int:
        return len(self.large)

    @property
    def outliers(self) -> NDArray[np.int64]:
        """Rows left out on each axis, (4,)."""
        return np.asarray((~self.use).sum(axis=0))


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over rows, (..., 4): any number of them add up."""

    n: Array
    a: Array
    b: Array
    aa: Array
    bb: Array
    ab: Array

    def total(self) -> Sums:
        return Sums(*(np.asarray(v.sum(axis=0)) for v in self.parts()))

    def without(self) -> Sums:
        """The total less each one: what is left when a position is held out."""
        return Sums(*(v.sum(axis=0) - v for v in self.parts()))

    def parts(self) -> tuple[Array, ...]:
        return self.n, self.a, self.b, self.aa, self.bb, self.ab

    def mean_square(self, w: Array) -> Array:
        """Of the merged error, bias included; `w` (4,) or of the sums' shape."""
        v = 1.0 - w
        return np.asarray(
            (w * w * self.aa + 2.0 * w * v * self.ab + v * v * self.bb) / np.maximum(self.n, 1.0)
        )

    def covariances(self) -> tuple[Array, Array, Array]:
        """Var a, var b and their covariance, about the means."""
        n = np.maximum(self.n, 1.0)
        a, b = self.a / n, self.b / n
        return self.aa / n - a * a, self.bb / n - b * b, self.ab / n - a * b


def errors_of(data: Measurements) -> Errors:
    """Rows with both markers, as errors. Errors: InvalidValue where none varies."""
    both = ~(np.isnan(data.large[:, 0]) | np.isnan(data.small[:, 0]))
    rows = np.flatnonzero(both)
    place = data.position[rows]
    if (np.diff(place) < 0).any():
        order = np.argsort(place, kind="stable")
        rows, place = rows[order], place[order]
    positions, starts = np.unique(place, return_index=True)
    actual = data.actual[rows]
    large, small = data.large[rows] - actual, data.small[rows] - actual
    reference = _direction(np.concatenate([large[:, YAW], small[:, YAW]]))
    joint = None if data.joint is None else data.joint[rows] - actual
    for each in (large, small, joint):
        if each is not None:
            each[:, YAW] = reference + wrap(each[:, YAW] - reference)
    use = inliers(large, starts) & inliers(small, starts)
    truth = actual[starts]
    return Errors(
        name=data.name,
        line=int(data.line[rows[0]]) if len(rows) else 1,
        positions=positions,
        starts=starts,
        large=large,
        small=small,
        joint=joint,
        use=use,
        actual=truth,
        single_rows=len(data) - len(rows),
    )


def _direction(angles_rad: Array) -> float:
    return float(np.arctan2(np.sin(angles_rad).sum(), np.cos(angles_rad).sum()))


def inliers(error: Array, starts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """The robust rule of `OUTLIER_SIGMAS`, for errors (n, 4) of positions at `starts`."""
    use = np.ones(error.shape, dtype=bool)
    ends = np.append(starts[1:], len(error))
    if len(starts) * LEAST_ROWS > len(error):
        return use  # too few rows a position to estimate what is usual
    for start, end in zip(starts, ends, strict=True):
        part = error[start:end]
        away = np.abs(part - np.median(part, axis=0))
        spread = _MAD_TO_SIGMA * np.median(away, axis=0)
        # Where most values are alike (a coarse scale), the mean deviation is still of use.
        spread = np.where(spread > 0.0, spread, away.mean(axis=0))
        use[start:end] = away <= OUTLIER_SIGMAS * spread + 1e-12
    return use


def sums_of(errors: Errors) -> Sums:
    """One sum a position, (g, 4)."""
    use = errors.use.astype(np.float64)
    a, b = errors.large * use, errors.small * use

    def per_position(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, errors.starts, axis=0))

    return Sums(
        per_position(use),
        per_position(a),
        per_position(b),
        per_position(a * a),
        per_position(b * b),
        per_position(a * b),
    )


def closed_form(sums: Sums) -> Array:
    """The weight of least squared merged error about its mean; NaN where any fits."""
    var_a, var_b, cov = sums.covariances()
    return _ratio(var_b - cov, var_a + var_b - 2.0 * cov, var_a + var_b)


def inverse_variance(sums: Sums) -> Array:
    """The least-squares weight if the two markers' errors were independent."""
    var_a, var_b, _ = sums.covariances()
    return _ratio(var_b, var_a + var_b, var_a + var_b)


def _ratio(above: Array, below: Array, scale: Array) -> Array:
    fits = below > 1e-12 * scale + 1e-24
    return np.where(fits, above / np.where(fits, below, 1.0), np.nan)


def check_determined(errors: Errors, sums: Sums) -> None:
    """Raises InvalidValue for an axis on which every weight fits alike."""
    free = np.isnan(closed_form(sums.total()))
    if free.any():
        raise InvalidValue(
            f"{errors.name}: line {errors.line}: from here on the two markers differ by nothing or "
            f"by a constant in {AXES[int(np.argmax(free))]}, so every weight fits alike; were "
            f"frames repeated, or a column copied?"
        )


def clipped(weights: Array) -> Array:
    return np.clip(weights, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Bias:
    """A marker's constant offset from the truth, (4,), and the half width of its 95 %
    interval over positions."""

    mean: Array
    half_width: Array


def biases(sums: Sums) -> dict[str, Bias]:
    n = np.maximum(sums.n, 1.0)
    found = {}
    for name, total in (("large", sums.a), ("small", sums.b)):
        means = total / n
        mean = means.mean(axis=0)
        half = _half_width(means)
        mean[YAW] = wrap(mean[YAW])
        found[name] = Bias(mean, half)
    return found


def odd_positions(errors: Errors, sums: Sums) -> list[tuple[int, str, float]]:
    """Positions whose truth seems wrong: number, axis, and how far both markers are off."""
    if len(errors.positions) < 5:
        return []
    n = np.maximum(sums.n, 1.0)
    offsets = np.stack([sums.a / n, sums.b / n])  # (2, g, 4)
    away = offsets - np.median(offsets, axis=1, keepdims=True)
    spread = _MAD_TO_SIGMA * np.median(np.abs(away), axis=1, keepdims=True)
    floor = np.array([0.002, 0.002, 0.002, np.radians(1.0)])
    far = np.abs(away) > np.maximum(ODD_POSITION_SIGMAS * spread, floor)
    odd = far.all(axis=0) & (np.sign(away[0]) == np.sign(away[1]))
    found: list[tuple[int, str, float]] = []
    for g, axis in zip(*np.nonzero(odd), strict=True):
        found.append((int(errors.positions[g]), AXES[axis], float(away[:, g, axis].mean())))
    return found


def means_by_position(errors: Errors, sums: Sums) -> dict[str, Any]:
    """Mean errors of each position, (g, 4), by marker."""
    n = np.maximum(sums.n, 1.0)
    return {"large": sums.a / n, "small": sums.b / n}
