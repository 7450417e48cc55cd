"""Widrow and Hoff's LMS, and its normalised form, for one weight an axis.

``w <- w + mu e d`` with d = large - small and e = actual - merged is, in the errors a and
b of `perchctl.weights.fit`, ``w <- (1 - mu d^2) w - mu b d``: affine in w. Steps compose,
so a long run is cut into equal pieces that are composed side by side and then applied one
after another: exact, and a million rows take a fraction of a second.

The step is given in units of 1 / mean(d^2): below 2 LMS converges in the mean. Without a
step of its own it begins at `START_STEP` and falls as 1 / rows, which ends at the
least-squares weight instead of wandering about it; a step that is given stays constant,
and the answer is the mean over the last pass. The normalised form divides each row's step
by ``d^2 + mean(d^2)``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.weights.fit import Errors
from perchctl.weights.types import AXES

Order = Literal["shuffled", "recorded"]
START_STEP = 0.02
LEAST_ROWS = 40_000
"""Rows to run through, in as many passes as that takes, so that few rows suffice."""
LEAST_PASSES = 3
BLOCK_ROWS = 1 << 17
FOLD_ROWS, MOST_FOLDS = 20_000, 20
ESCAPED = 1e3
"""No weight that is on its way to [0, 1] gets here."""
_STREAM = 601


@dataclass(frozen=True)
class LmsOptions:
    """`step` None falls; `passes` None is as many as needed; `start` is the weight that
    the run begins with."""

    step: float | None = None
    passes: int | None = None
    order: Order = "shuffled"
    start: float = 0.5
    normalised: bool = False
    seed: int = 0


@dataclass(frozen=True, eq=False)
class LmsRun:
    """Attributes:
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


def lms(errors: Errors, options: LmsOptions, tick: Callable[[], None] = lambda: None) -> LmsRun:
    """Run LMS over the rows, the mean errors taken off. Errors: InvalidValue when it
    diverges or an option is out of its range."""
    _check(options)
    power, pull, scale = _inputs(errors, options.normalised)
    return run(power, pull, options, scale, tick)


def _check(options: LmsOptions) -> None:
    if options.step is not None and not (math.isfinite(options.step) and options.step > 0.0):
        raise InvalidValue(f"--step {options.step:g} must be a positive number, such as 0.02")
    if options.passes is not None and options.passes < 1:
        raise InvalidValue(f"--passes {options.passes} must be at least 1")
    if not math.isfinite(options.start):
        raise InvalidValue(f"--start {options.start} must be a number, such as 0.5")


def _inputs(errors: Errors, normalised: bool) -> tuple[Array, Array, Array]:
    """p and q of ``w <- w - s (p w + q)``, each (n, 4), p of mean 1; and what a step is
    multiplied by to become s, (4,). An outlier's row is zero and moves nothing."""
    use = errors.use
    n = np.maximum(use.sum(axis=0), 1)
    a = np.where(use, errors.large, 0.0)
    a -= np.where(use, a.sum(axis=0) / n, 0.0)
    b = np.where(use, errors.small, 0.0)
    b -= np.where(use, b.sum(axis=0) / n, 0.0)
    a -= b  # d
    b *= a
    a *= a
    mean = a.sum(axis=0) / n
    scale = np.ones(4)
    if normalised:
        b /= a + mean
        a /= a + mean
        scale = a.sum(axis=0) / n
        mean = scale
    a /= mean
    b /= mean
    return a, b, scale


def run(
    power: Array,
    pull: Array,
    options: LmsOptions,
    scale: Array | None = None,
    tick: Callable[[], None] = lambda: None,
) -> LmsRun:
    """The recursion ``w <- w - s (p w + q)`` over p = `power` and q = `pull`, (n, 4)."""
    n = len(power)
    passes = options.passes or max(LEAST_PASSES, math.ceil(LEAST_ROWS / n))
    scale = np.ones(power.shape[1]) if scale is None else scale
    falling = options.step is None
    largest = np.maximum(power.max(axis=0), 1.0)
    step = np.minimum(START_STEP, 1.0 / largest) if falling else float(options.step or 0) * scale
    w = np.full(power.shape[1], options.start)
    rows, curve = [0.0], [w]
    done = 0
    for block in _blocks(n, passes, options):
        if not isinstance(block, slice) and not len(block):
            continue
        p, q = (power, pull) if isinstance(block, slice) else (power[block], pull[block])
        if falling:
            m = (done + np.arange(len(p), dtype=np.float64))[:, None]
            s = step / (1.0 + 0.5 * step * m)
        else:
            s = np.broadcast_to(step, p.shape)
        trace = _composed(w, s * p, s * q)
        w = trace[-1]
        ends = done + np.linspace(0, len(p), len(trace) + 1)[1:]
        done += len(p)
        rows += ends.tolist()
        curve += list(trace)
        if not np.isfinite(w).all() or (np.abs(trace) > ESCAPED).any():
            _explain(np.asarray(curve), power, options, int(rows[-1]))
        tick()
    trajectory, at = np.asarray(curve), np.asarray(rows)
    tail = trajectory[at > done - n] if not falling else trajectory[-1:]
    half = trajectory[at >= done / 2.0]
    return LmsRun(tail.mean(axis=0), at, trajectory, passes, np.ptp(half, axis=0))


def _blocks(n: int, passes: int, options: LmsOptions) -> Iterator[NDArray[np.int64] | slice]:
    """Which rows come next; several passes in one block where they are short."""
    rng = np.random.default_rng([options.seed, _STREAM])
    many = max(1, BLOCK_ROWS // n)
    for first in range(0, passes, many):
        some = min(many, passes - first)
        if n > BLOCK_ROWS and options.order == "recorded":
            yield slice(None)
            continue
        orders = [
            rng.permutation(n) if options.order == "shuffled" else np.arange(n) for _ in range(some)
        ]
        order = np.concatenate(orders)
        if first == 0:  # short pieces at first, where the curve moves
            yield from np.split(order[:1024], [64])
            order = order[1024:]
        if len(order):
            yield from np.array_split(order, math.ceil(len(order) / BLOCK_ROWS))


def _composed(w: Array, p: Array, q: Array) -> Array:
    """Weights after each piece of the rows, (pieces, 4), beginning at `w`."""
    n = len(p)
    pieces = max(1, math.isqrt(n))
    length = math.ceil(n / pieces)
    short = pieces * length - n
    if short:
        p = np.concatenate([p, np.zeros((short, p.shape[1]))])
        q = np.concatenate([q, np.zeros((short, q.shape[1]))])
    # Row k of every piece side by side.
    factor = 1.0 - p.reshape(pieces, length, -1)
    shift = q.reshape(pieces, length, -1)
    with np.errstate(over="ignore", invalid="ignore"):
        A, B = factor[:, 0].copy(), -shift[:, 0]
        for k in range(1, length):
            A *= factor[:, k]
            B *= factor[:, k]
            B -= shift[:, k]
        trace = np.empty((pieces, p.shape[1]))
        for piece in range(pieces):
            w = A[piece] * w + B[piece]
            trace[piece] = w
    return trace


def _explain(curve: Array, power: Array, options: LmsOptions, rows: int) -> None:
    wild = np.nan_to_num(np.abs(curve), nan=np.inf).max(axis=0)
    axis = int(np.argmax(wild))
    # Mean-square stability of one weight: |1 - s p| below 1 in the mean square.
    bound = 2.0 / float((power[:, axis] ** 2).mean())
    raise InvalidValue(
        f"LMS diverges in {AXES[axis]} within {rows} rows: --step {options.step:g} is too large "
        f"for this data's spread (the weight stays bounded below about {bound:.2g}); leave --step "
        f"out, or take {min(START_STEP, bound / 10):.2g}"
    )


def thinned(errors: Errors) -> bool:
    """Whether `lms_folds` takes a share only."""
    return len(errors) >= 2 * FOLD_ROWS or len(errors.starts) > MOST_FOLDS


def lms_folds(
    errors: Errors, options: LmsOptions, tick: Callable[[], None] = lambda: None
) -> Array:
    """The weights without each position in turn, (g, 4).

    Of large data (`thinned`) an even share of `FOLD_ROWS` rows is used, and of many positions
    a `MOST_FOLDS`th is held out at a time: one position then moves the weights by far less
    than their spread.
    """
    g = len(errors.starts)
    ends = np.append(errors.starts[1:], len(errors))
    group = np.arange(g) * min(g, MOST_FOLDS) // g
    of_row = np.repeat(group, ends - errors.starts)
    chosen = np.arange(0, len(errors), max(1, len(errors) // FOLD_ROWS))
    power, pull, scale = _inputs(errors, options.normalised)
    power, pull, of_row = power[chosen], pull[chosen], of_row[chosen]
    folds = np.empty((int(group[-1]) + 1, power.shape[1]))
    for fold in range(len(folds)):
        keep = of_row != fold
        mean = power[keep].mean(axis=0)
        # The held-out rows' part of the mean errors is a matter of the second order.
        folds[fold] = run(power[keep] / mean, pull[keep] / mean, options, scale).weights
        tick()
    return folds[group]
