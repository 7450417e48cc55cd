"""Synthetic sessions whose best weights are known, and the command that fits them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from typer.testing import CliRunner, Result

from perchctl.commands import app
from perchctl.geometry import Array
from perchctl.weights.data import HEADER, Measurements, csv_row, wrap_angles

BEST = np.array([0.275, 0.306, 0.728, 0.469])
"""The weights that `known` data are made with."""


def places(rng: np.random.Generator, positions: int, per_position: int) -> tuple[Array, Array]:
    """Positions' numbers (n,) and the truth (n, 4)."""
    number = np.repeat(np.arange(1, positions + 1), per_position)
    low, high = np.array([-0.05, -0.05, 0.12, -3.1]), np.array([0.05, 0.05, 0.25, 3.1])
    return number, rng.uniform(low, high, (positions, 4))[number - 1]


def known(
    seed: int = 0, best: Array = BEST, turn_rad: float = 0.0, positions: int = 10, per: int = 100
) -> Measurements:
    """The truth is the merge by `best` of two noisy markers, but for a tenth of a hair."""
    rng = np.random.default_rng(seed)
    number, actual = places(rng, positions, per)
    apart = rng.normal(0.0, [2e-3, 2e-3, 3e-3, 0.05], actual.shape)
    rest = rng.normal(0.0, [1e-5, 1e-5, 1e-5, 2e-4], actual.shape)
    return measured(number, actual, (1.0 - best) * apart + rest, -best * apart + rest, turn_rad)


def independent(
    seed: int = 0,
    large: tuple[float, ...] = (1e-3, 1e-3, 2e-3, 0.02),
    small: tuple[float, ...] = (2e-3, 1e-3, 1e-3, 0.01),
    positions: int = 10,
    per: int = 100,
) -> Measurements:
    """Two markers with independent normal errors of these standard deviations."""
    rng = np.random.default_rng(seed)
    number, actual = places(rng, positions, per)
    return measured(
        number, actual, rng.normal(0.0, large, actual.shape), rng.normal(0.0, small, actual.shape)
    )


def measured(
    number: Array, actual: Array, a: Array, b: Array, turn_rad: float = 0.0
) -> Measurements:
    """Errors a and b on the truth, all of it turned."""

    def turned(pose: Array) -> Array:
        out = pose.copy()
        out[:, 3] = wrap_angles(out[:, 3] + turn_rad)
        return out

    return Measurements(
        name="synthetic.csv",
        position=number.astype(np.int64),
        large=turned(actual + a),
        small=turned(actual + b),
        actual=turned(actual),
    )


def write(data: Measurements, path: Path) -> Path:
    """As the documented CSV."""
    rows = zip(data.position, data.large, data.small, data.actual, strict=True)
    lines = [csv_row(int(p), k / 30.0, poses) for k, (p, *poses) in enumerate(rows)]
    path.write_text("".join([f"{HEADER}\n", *lines]), encoding="utf-8")
    return path


def run(*words: object, stdin: str | None = None) -> Result:
    result = CliRunner().invoke(app, ["fit-weights", *map(str, words)], input=stdin)
    assert "Traceback" not in result.output
    return result
