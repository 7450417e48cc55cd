"""The weights from the data, per axis: LMS, closed-form least squares, inverse variance; and
whether they help.

With a = large - actual and b = small - actual the merged error of equation 8 is
``w a + (1 - w) b``. What is constant in a and b is the markers' bias: no weight can mend
it, so it is estimated and reported apart, and the weights are fitted to the rest. All
differences of yaw are wrapped about the errors' own mean direction, so that neither the
seam at +-180 deg nor a constant turn of the data changes a weight.

Frames of one position share its errors, so whole positions are held out: the weights are
fitted to the others and tested on the one that was left out, bias included, as it acts in
a flight. Intervals are Student's t over positions (for a root mean square by the delta
method), 95 %.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.weights.data import AXES, YAW, Measurements, wrap

OUTLIER_SIGMAS = 6.0
"""A row does not count on an axis where a marker's error is farther from the median of
its position than this many robust standard deviations (1.4826 times the median absolute
deviation): of a million normal errors not one."""
ODD_POSITION_SIGMAS = 8.0
"""A position is named when both markers' errors there are this far from the others'."""
LEAST_ROWS = 8
"""Rows a position, on average, below which nothing is called an outlier."""
_MAD_TO_SIGMA = 1.4826

PAPER_WEIGHTS = (0.275, 0.306, 0.728, 0.469)
"""w_x, w_y, w_z, w_psi of the paper, section III-B."""
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
class Errors:
    """Errors of the rows with both markers, sorted by position: n rows, g positions.

    Attributes:
        positions: the positions' numbers, (g,); starts: the first row of each, (g,).
        large, small: a and b, (n, 4). joint: (n, 4) with NaN.
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
    joint: Array
    use: NDArray[np.bool_]
    actual: Array
    single_rows: int

    def __len__(self) -> int:
        return len(self.large)

    @property
    def outliers(self) -> NDArray[np.int64]:
        """Rows left out on each axis, (4,)."""
        return np.asarray((~self.use).sum(axis=0))


def errors_of(data: Measurements) -> Errors:
    """The errors of the rows with both markers."""
    rows = np.flatnonzero(data.both)
    rows = rows[np.argsort(data.position[rows], kind="stable")]
    positions, starts = np.unique(data.position[rows], return_index=True)
    actual = data.actual[rows]
    large, small = data.large[rows] - actual, data.small[rows] - actual
    yaw = np.concatenate([large[:, YAW], small[:, YAW]])
    reference = float(np.arctan2(np.sin(yaw).sum(), np.cos(yaw).sum()))
    joint = data.joint[rows] - actual
    for each in (large, small, joint):
        each[:, YAW] = reference + wrap(each[:, YAW] - reference)
    return Errors(
        name=data.name,
        line=int(data.line[rows[0]]),
        positions=positions,
        starts=starts,
        large=large,
        small=small,
        joint=joint,
        use=_inliers(large, starts) & _inliers(small, starts),
        actual=actual[starts],
        single_rows=len(data) - len(rows),
    )


def _inliers(error: Array, starts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """The robust rule of `OUTLIER_SIGMAS`, for errors (n, 4) of positions at `starts`."""
    use = np.ones(error.shape, dtype=bool)
    if len(starts) * LEAST_ROWS > len(error):
        return use  # too few rows a position to estimate what is usual
    for start, end in itertools.pairwise([*starts, len(error)]):
        part = error[start:end]
        away = np.abs(part - np.median(part, axis=0))
        spread = _MAD_TO_SIGMA * np.median(away, axis=0)
        # Where most values are alike (a coarse scale), the mean deviation is still of use.
        spread = np.where(spread > 0.0, spread, away.mean(axis=0))
        use[start:end] = away <= OUTLIER_SIGMAS * spread + 1e-12
    return use


# --- Least squares in closed form, from sums over rows -----------------------------------------


def sums_of(errors: Errors) -> Array:
    """Of each position the sums of 1, a, b, a^2, b^2 and a b over its rows, (6, g, 4)."""
    use = errors.use.astype(np.float64)
    a, b = errors.large * use, errors.small * use
    parts = np.stack([use, a, b, a * a, b * b, a * b])
    return np.asarray(np.add.reduceat(parts, errors.starts, axis=1))


def held_out(sums: Array) -> Array:
    """The sums over all positions but each one, (6, g, 4)."""
    return np.asarray(sums.sum(axis=1, keepdims=True) - sums)


def closed_form(sums: Array) -> Array:
    """The weight of least squared merged error about its mean; NaN where any fits. `sums` is
    (6, ..., 4)."""
    var_a, var_b, cov = _covariances(sums)
    return _ratio(var_b - cov, var_a + var_b - 2.0 * cov, var_a + var_b)


def inverse_variance(sums: Array) -> Array:
    """The least-squares weight if the two markers' errors were independent."""
    var_a, var_b, _ = _covariances(sums)
    return _ratio(var_b, var_a + var_b, var_a + var_b)


def _covariances(sums: Array) -> tuple[Array, Array, Array]:
    """Var a, var b and their covariance, about the means."""
    a, b, aa, bb, ab = sums[1:] / np.maximum(sums[0], 1.0)
    return aa - a * a, bb - b * b, ab - a * b


def _ratio(above: Array, below: Array, scale: Array) -> Array:
    fits = below > 1e-12 * scale + 1e-24
    return np.where(fits, above / np.where(fits, below, 1.0), np.nan)


def _mean_square(sums: Array, w: Array) -> Array:
    """Of the merged error, bias included, (g, 4)."""
    v = 1.0 - w
    return np.asarray(
        (w * w * sums[3] + 2.0 * w * v * sums[5] + v * v * sums[4]) / np.maximum(sums[0], 1.0)
    )


def check_determined(errors: Errors, sums: Array) -> None:
    """Raises InvalidValue for an axis on which every weight fits alike."""
    free = np.isnan(closed_form(sums.sum(axis=1)))
    if free.any():
        raise InvalidValue(
            f"{errors.name}: line {errors.line}: from here on the two markers differ by nothing or "
            f"by a constant in {AXES[int(np.argmax(free))]}, so every weight fits alike; were "
            f"frames repeated, or a column copied?"
        )


def position_means(sums: Array) -> Array:
    """Mean errors a and b of each position, (2, g, 4)."""
    return np.asarray(sums[1:3] / np.maximum(sums[0], 1.0))


def biases(sums: Array) -> dict[str, tuple[Array, Array]]:
    """Each marker's constant offset from the truth, (4,), and the half width of its 95 %
    interval over positions."""
    found = {}
    for name, means in zip(SINGLE, position_means(sums), strict=True):
        mean, g = means.mean(axis=0), len(means)
        half = t_quantile(g - 1) * means.std(axis=0, ddof=1) / math.sqrt(g)
        mean[YAW] = wrap(mean[YAW])
        found[name] = (mean, half)
    return found


def odd_positions(errors: Errors, sums: Array) -> list[tuple[int, str, float]]:
    """Positions whose truth seems wrong: number, axis, and how far both markers are off."""
    if len(errors.positions) < 5:
        return []
    offsets = position_means(sums)
    away = offsets - np.median(offsets, axis=1, keepdims=True)
    spread = _MAD_TO_SIGMA * np.median(np.abs(away), axis=1, keepdims=True)
    floor = np.array([0.002, 0.002, 0.002, np.radians(1.0)])
    far = np.abs(away) > np.maximum(ODD_POSITION_SIGMAS * spread, floor)
    odd = far.all(axis=0) & (np.sign(away[0]) == np.sign(away[1]))
    return [
        (int(errors.positions[g]), AXES[axis], float(away[:, g, axis].mean()))
        for g, axis in zip(*np.nonzero(odd), strict=True)
    ]


def t_quantile(freedom: int) -> float:
    """The two-sided 95 % quantile of Student's t; inf without a degree of freedom."""
    return float(stdtrit(freedom, 0.975)) if freedom >= 1 else math.inf


# --- Widrow and Hoff's LMS, and its normalised form --------------------------------------------
# ``w <- w + mu e d`` with d = large - small and e = actual - merged is, in the errors a and b,
# ``w <- (1 - mu d^2) w - mu b d``: affine in w. Steps compose, so a long run is cut into equal
# pieces that are composed side by side and then applied one after another: exact, and a million
# rows take a fraction of a second.
#
# The step is given in units of 1 / mean(d^2): below 2 LMS converges in the mean. Without a step
# of its own it begins at `START_STEP` and falls as 1 / rows, which ends at the least-squares
# weight instead of wandering about it; a step that is given stays constant, and the answer is
# the mean over the last pass. The normalised form divides each row's step by d^2 + mean(d^2).


START_STEP = 0.02
LEAST_RUN_ROWS, LEAST_PASSES = 40_000, 3
"""Rows to run through, in as many passes as that takes, so that few rows suffice."""
BLOCK_ROWS = 1 << 17
FOLD_ROWS, MOST_FOLDS = 20_000, 20
ESCAPED = 1e3
"""No weight that is on its way to [0, 1] gets here."""
_STREAM = (0, 601)


@dataclass(frozen=True)
class LmsOptions:
    """`step` None falls; `passes` None is as many as needed; `start` is the weight that the run
    begins with; `shuffled` is the order of the rows, else as recorded."""

    step: float | None = None
    passes: int | None = None
    shuffled: bool = True
    start: float = 0.5
    normalised: bool = False


@dataclass(frozen=True, eq=False)
class LmsRun:
    """One run of LMS.

    Attributes:
        weights: (4,), unclipped.
        rows: number of rows after which `curve` was taken, (k,); curve: weights, (k, 4).
        passes: through the data.
        moved: how far the weights still moved in the second half of the run, (4,).
    """

    weights: Array
    rows: Array
    curve: Array
    passes: int
    moved: Array


def lms(errors: Errors, options: LmsOptions) -> LmsRun:
    """Run LMS over the rows, the mean errors taken off. Errors: InvalidValue when it
    diverges or an option is out of its range."""
    if options.step is not None and not (math.isfinite(options.step) and options.step > 0.0):
        raise InvalidValue(f"--step {options.step:g} must be a positive number, such as 0.02")
    if options.passes is not None and options.passes < 1:
        raise InvalidValue(f"--passes {options.passes} must be at least 1")
    if not math.isfinite(options.start):
        raise InvalidValue(f"--start {options.start} must be a number, such as 0.5")
    return _run(*_recursion(errors, options.normalised), options)


def _recursion(errors: Errors, normalised: bool) -> tuple[Array, Array, Array]:
    """p and q of ``w <- w - s (p w + q)``, each (n, 4), p of mean 1; and what a step is
    multiplied by to become s, (4,). An outlier's row is zero and moves nothing."""
    use = errors.use
    n = np.maximum(use.sum(axis=0), 1)
    a, b = np.where(use, errors.large, 0.0), np.where(use, errors.small, 0.0)
    a -= np.where(use, a.sum(axis=0) / n, 0.0)
    b -= np.where(use, b.sum(axis=0) / n, 0.0)
    d = a - b
    power, pull = d * d, b * d
    mean = power.sum(axis=0) / n
    scale = np.ones(4)
    if normalised:
        pull /= power + mean
        power /= power + mean
        mean = scale = power.sum(axis=0) / n
    return power / mean, pull / mean, scale


def _run(power: Array, pull: Array, scale: Array, options: LmsOptions) -> LmsRun:
    """The recursion ``w <- w - s (p w + q)`` over p = `power` and q = `pull`, (n, 4)."""
    n = len(power)
    passes = options.passes or max(LEAST_PASSES, math.ceil(LEAST_RUN_ROWS / n))
    falling = options.step is None
    largest = np.maximum(power.max(axis=0), 1.0)
    step = np.minimum(START_STEP, 1.0 / largest) if falling else float(options.step or 0) * scale
    w = np.full(power.shape[1], options.start)
    rows, curve = [0.0], [w]
    done = 0
    for block in _blocks(n, passes, options.shuffled):
        p, q = power[block], pull[block]
        s = np.broadcast_to(step, p.shape)
        if falling:
            s = step / (1.0 + 0.5 * step * (done + np.arange(len(p), dtype=np.float64))[:, None])
        trace = _composed(w, s * p, s * q)
        w = trace[-1]
        rows += (done + np.linspace(0, len(p), len(trace) + 1)[1:]).tolist()
        curve += list(trace)
        done += len(p)
        if not np.isfinite(w).all() or (np.abs(trace) > ESCAPED).any():
            raise _diverged(np.asarray(curve), power, options, done)
    trajectory, at = np.asarray(curve), np.asarray(rows)
    tail = trajectory[-1:] if falling else trajectory[at > done - n]
    half = trajectory[at >= done / 2.0]
    return LmsRun(tail.mean(axis=0), at, trajectory, passes, np.ptp(half, axis=0))


def _blocks(n: int, passes: int, shuffled: bool) -> Iterator[NDArray[np.int64]]:
    """Which rows come next; several passes in one block where they are short."""
    rng = np.random.default_rng(_STREAM)
    many = max(1, BLOCK_ROWS // n)
    for first in range(0, passes, many):
        count = min(many, passes - first)
        order = np.concatenate(
            [rng.permutation(n) if shuffled else np.arange(n) for _ in range(count)]
        )
        # Short blocks at first, where the curve moves.
        cuts = [64, 1024] if first == 0 else [0, 0]
        head, more, rest = np.split(order, cuts)
        blocks = (head, more, *np.array_split(rest, max(1, math.ceil(len(rest) / BLOCK_ROWS))))
        yield from (block for block in blocks if len(block))


def _composed(w: Array, p: Array, q: Array) -> Array:
    """Weights after each piece of the rows, (pieces, 4), beginning at `w`."""
    pieces = max(1, math.isqrt(len(p)))
    length = math.ceil(len(p) / pieces)
    room = ((0, pieces * length - len(p)), (0, 0))
    # Row k of every piece side by side; rows of zeros at the end change nothing.
    factor = 1.0 - np.pad(p, room).reshape(pieces, length, -1)
    shift = np.pad(q, room).reshape(pieces, length, -1)
    trace = np.empty((pieces, p.shape[1]))
    with np.errstate(over="ignore", invalid="ignore"):
        A, B = factor[:, 0].copy(), -shift[:, 0]
        for k in range(1, length):
            A *= factor[:, k]
            B = B * factor[:, k] - shift[:, k]
        for piece in range(pieces):
            w = A[piece] * w + B[piece]
            trace[piece] = w
    return trace


def _diverged(curve: Array, power: Array, options: LmsOptions, rows: int) -> InvalidValue:
    axis = int(np.argmax(np.nan_to_num(np.abs(curve), nan=np.inf).max(axis=0)))
    # Mean-square stability of one weight: |1 - s p| below 1 in the mean square.
    bound = 2.0 / float((power[:, axis] ** 2).mean())
    return InvalidValue(
        f"LMS diverges in {AXES[axis]} within {rows} rows: --step {options.step:g} is too large "
        f"for this data's spread (the weight stays bounded below about {bound:.2g}); leave --step "
        f"out, or take {min(START_STEP, bound / 10):.2g}"
    )


def _lms_folds(errors: Errors, options: LmsOptions) -> Array:
    """The weights without each position in turn, (g, 4).

    Of large data (`_is_thinned`) an even share of `FOLD_ROWS` rows is used, and of many positions
    a `MOST_FOLDS`th is held out at a time: one position then moves the weights by far less
    than their spread.
    """
    g = len(errors.starts)
    group = np.arange(g) * min(g, MOST_FOLDS) // g
    of_row = np.repeat(group, np.diff(errors.starts, append=len(errors)))
    chosen = slice(None, None, max(1, len(errors) // FOLD_ROWS))
    power, pull, scale = _recursion(errors, options.normalised)
    power, pull, of_row = power[chosen], pull[chosen], of_row[chosen]
    folds = []
    for fold in range(int(group[-1]) + 1):
        keep = of_row != fold
        mean = power[keep].mean(axis=0)
        # The held-out rows' part of the mean errors is a matter of the second order.
        folds.append(_run(power[keep] / mean, pull[keep] / mean, scale, options).weights)
    return np.array(folds)[group]


def _is_thinned(errors: Errors) -> bool:
    return len(errors) >= 2 * FOLD_ROWS or len(errors.starts) > MOST_FOLDS


# --- All methods, and their errors on positions that they were not fitted to --------------------


@dataclass(frozen=True, eq=False)
class Fitted:
    """One method's weights: as fitted, clipped to [0, 1], and their 95 % interval over
    positions (jackknife), (4,); `folds` without each position in turn, (g, 4)."""

    raw: Array
    weights: Array
    low: Array
    high: Array
    folds: Array


def fit_all(
    errors: Errors, sums: Array, options: LmsOptions
) -> tuple[dict[str, Fitted], dict[str, LmsRun]]:
    """The weights of all methods, and the runs of LMS and its normalised form."""
    total, left = sums.sum(axis=1), held_out(sums)
    closed = _fitted(closed_form(total), closed_form(left))
    fits, runs = {}, {}
    for name, normalised in (("lms", False), ("nlms", True)):
        # A step of the user's is LMS's; the normalised form is stable with any below 2.
        step = options.step if not normalised or (options.step or 0.0) < 2.0 else None
        chosen = replace(options, normalised=normalised, step=step)
        runs[name] = lms(errors, chosen)
        fit = _fitted(runs[name].weights, _lms_folds(errors, chosen))
        if _is_thinned(errors):  # what LMS approaches has the same spread over positions
            half = closed.high - closed.raw
            fit = replace(fit, low=fit.raw - half, high=fit.raw + half)
        fits[name] = fit
    fits["closed_form"] = closed
    fits["inverse_variance"] = _fitted(inverse_variance(total), inverse_variance(left))
    return fits, runs


def _fitted(raw: Array, folds: Array) -> Fitted:
    g = len(folds)
    folds = np.where(np.isfinite(folds), folds, raw)
    spread = np.sqrt((g - 1) / g * ((folds - folds.mean(axis=0)) ** 2).sum(axis=0))
    half = t_quantile(g - 1) * spread
    return Fitted(raw, np.clip(raw, 0.0, 1.0), raw - half, raw + half, np.clip(folds, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class MethodErrors:
    """Root mean square errors of one method, per axis, on positions it was not fitted to.

    Attributes:
        rms: over all positions, (4,), m and rad; low, high: its 95 % interval.
        by_position: (g, 4).
        gain, gain_low, gain_high: by how much it is below that of another way, by default the
            better single marker, and the interval of that difference, (4,).
    """

    rms: Array
    low: Array
    high: Array
    by_position: Array
    gain: Array
    gain_low: Array
    gain_high: Array

    def against(self, other: MethodErrors) -> MethodErrors:
        """The same with the gain over `other`."""
        return _method(self.by_position**2, other.by_position**2)


@dataclass(frozen=True, eq=False)
class Evidence:
    """How well each method does, by its name.

    Attributes:
        better: of the single markers, by axis: index into `SINGLE`, (4,).
        proven: by fitted method, where its gain is above zero with its whole interval, (4,).
    """

    methods: dict[str, MethodErrors]
    better: NDArray[np.int64]
    proven: dict[str, NDArray[np.bool_]]


def evidence(errors: Errors, sums: Array, weights: Mapping[str, Array]) -> Evidence:
    """Errors of every method. `weights` by the fitted methods' names: (4,), or with another row
    for each position, (g, 4)."""
    known = {"large": np.ones(4), "small": np.zeros(4), "paper": np.array(PAPER_WEIGHTS)}
    squares = {name: _mean_square(sums, w) for name, w in (known | dict(weights)).items()}
    joint = _joint_squares(errors)
    if joint is not None:
        squares["joint"] = joint
    better = np.argmin([squares[name].mean(axis=0) for name in SINGLE], axis=0)
    reference = np.where(better == 0, squares["large"], squares["small"])
    methods = {name: _method(square, reference) for name, square in squares.items()}
    return Evidence(methods, better, {name: methods[name].gain_low > 0.0 for name in weights})


def _joint_squares(errors: Errors) -> Array | None:
    """(g, 4), NaN where a position has no joint pose; None without any."""
    there = errors.use & ~np.isnan(errors.joint)
    if not there.any():
        return None
    squares = np.where(there, errors.joint, 0.0) ** 2
    n = np.add.reduceat(there.astype(np.float64), errors.starts, axis=0)
    total = np.add.reduceat(squares, errors.starts, axis=0)
    return np.where(n > 0, total / np.maximum(n, 1.0), np.nan)


def _method(square: Array, reference: Array) -> MethodErrors:
    """`square`: mean square errors of each position, (g, 4); `reference`: of what it is compared
    with."""
    both = np.isfinite(square) & np.isfinite(reference)
    square, reference = np.where(both, square, np.nan), np.where(both, reference, np.nan)
    g = both.sum(axis=0)
    t = np.array([t_quantile(int(count) - 1) for count in g])

    def root(values: Array) -> tuple[Array, Array]:
        """The root of the mean over positions, and each position's influence on it."""
        mean = np.nansum(values, axis=0) / np.maximum(g, 1)
        rms = np.sqrt(mean)
        return rms, (values - mean) / (2.0 * np.maximum(rms, 1e-300))

    def half(influence: Array) -> Array:
        spread = np.sqrt(np.nansum(influence**2, axis=0) / np.maximum(g - 1, 1) / np.maximum(g, 1))
        return np.where(g > 1, np.where(g > 1, t, 0.0) * spread, np.inf)

    (rms, influence), (other, other_influence) = root(square), root(reference)
    gain = other - rms
    gain_half = half(other_influence - influence)
    return MethodErrors(
        rms,
        np.maximum(rms - half(influence), 0.0),
        rms + half(influence),
        np.sqrt(square),
        gain,
        gain - gain_half,
        gain + gain_half,
    )
