"""Data that would fit to nonsense: unit slips, markers never seen, values that stand still."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.weights.table import pose_columns
from perchctl.weights.types import AXES, SOURCES, YAW, Measurements

LEAST_M = 0.01
"""Coordinates below this are too small to compare scales by."""
FARTHEST_M = 5.0
"""No pair of markers is seen from farther away than this."""
_USUAL_M = 0.2
_SLIPS = ((100.0, "centimetres"), (1000.0, "millimetres"))
_RATIOS = ((100.0, 50.0, 300.0), (1000.0, 300.0, 3000.0))
_SLACK = 2.0


def check(data: Measurements) -> None:
    """Raises InvalidValue, with file and line, for data that cannot be fitted."""
    _check_seen(data)
    _check_units(data)
    _check_positions(data)
    _check_variation(data)


def _check_seen(data: Measurements) -> None:
    seen = {name: ~np.isnan(getattr(data, name)[:, 0]) for name in ("large", "small")}
    where = f"{data.name}: lines {int(data.line[0])} to {int(data.line[-1])}"
    for name, mask in seen.items():
        if not mask.any():
            raise InvalidValue(
                f"{where}: the {name} marker is never seen, so there is nothing to merge; take "
                f"positions from which both markers are whole in the picture"
            )
    if not (seen["large"] & seen["small"]).any():
        raise InvalidValue(
            f"{where}: no row holds both markers, so there is nothing to merge; take positions "
            f"from which both markers are whole in the picture"
        )


def _check_positions(data: Measurements) -> None:
    both = ~(np.isnan(data.large[:, 0]) | np.isnan(data.small[:, 0]))
    places = np.unique(data.position[both])
    if len(places) < 2:
        raise InvalidValue(
            f"{data.name}: line {int(data.line[both][0])}: all rows with both markers are of "
            f"position {int(places[0])}; frames of one position are not independent, so at "
            f"least 2 positions are needed (10 are usual)"
        )


def _check_variation(data: Measurements) -> None:
    both = ~(np.isnan(data.large[:, 0]) | np.isnan(data.small[:, 0]))
    line = int(data.line[both][0])
    for source in ("large", "small"):
        values = getattr(data, source)[both]
        for k, name in enumerate(pose_columns(source)):
            # A plain truth may stand still on one axis; a measurement of it cannot.
            if len(values) > 2 and float(np.ptp(values[:, k])) == 0.0:
                raise InvalidValue(
                    f"{data.name}: line {line}: {name} is {values[0, k]:g} in every row with both "
                    f"markers: constant data are no measurement"
                )
    same = np.abs(data.large[both] - data.small[both]).max(axis=0) < 1e-12
    if same.any():
        axis = AXES[int(np.argmax(same))]
        raise InvalidValue(
            f"{data.name}: line {line}: both markers give the same {axis} in every row, so every "
            f"weight fits alike; was one marker's column copied?"
        )


def _check_units(data: Measurements) -> None:
    medians, lines = _medians(data)
    _check_radians(data, medians, lines)
    for place, line in zip(medians, lines, strict=True):
        for axis in range(YAW):
            slip = _odd_one_out(place[:, axis])
            if slip is not None:
                source, times = slip
                raise _slipped(data, line, source, axis, float(place[source, axis]), times)
    # All three alike, but farther away than anything can be.
    typical = float(np.median(np.linalg.norm(medians[:, SOURCES.index("actual"), :YAW], axis=1)))
    if typical > FARTHEST_M:
        times = min((t for t, _ in _SLIPS), key=lambda t: abs(math.log(typical / t / _USUAL_M)))
        raise _slipped(data, lines[0], 0, 2, float(medians[0, 0, 2]), times, everything=True)


def _medians(data: Measurements) -> tuple[Array, NDArray[np.int64]]:
    """Of each position the medians, (positions, source, axis), and its first line.

    At most a hundred rows of a position and a thousand positions are looked at: a slip of
    units is in all of a position's rows.
    """
    places, first, counts = np.unique(data.position, return_index=True, return_counts=True)
    order = np.argsort(data.position, kind="stable")
    starts = np.cumsum(counts) - counts
    keep = np.unique(np.linspace(0, len(places) - 1, min(len(places), 1000)).astype(int))
    medians = np.full((len(keep), len(SOURCES), 4), np.nan)
    for row, place in enumerate(keep):
        step = max(1, int(counts[place]) // 100)
        rows = order[starts[place] : starts[place] + counts[place] : step]
        for column, source in enumerate(SOURCES):
            values = getattr(data, source)[rows]
            values = values[~np.isnan(values[:, 0])]
            if len(values):
                medians[row, column] = np.median(values, axis=0)
    return medians, data.line[first[keep]]


def _odd_one_out(values: Array) -> tuple[int, float] | None:
    """Which of large, small and actual is 100 or 1000 times the others, and how many times."""
    size = np.abs(values)
    for source in range(len(size)):
        others = [s for s in range(len(size)) if s != source and not np.isnan(size[s])]
        if np.isnan(size[source]) or not others:
            continue
        rest = float(np.median(size[others]))
        if len(others) == 2 and not rest / _SLACK <= size[others[0]] <= rest * _SLACK:
            continue  # the others do not agree either
        wrong = source if size[source] > rest else others[0]  # a slip makes numbers larger
        small, large = sorted((float(size[source]), rest))
        if small < LEAST_M / 2:
            continue
        for times, low, high in _RATIOS:
            if low <= large / small < high:
                return wrong, times
    return None


def _slipped(
    data: Measurements,
    line: int,
    source: int,
    axis: int,
    value: float,
    times: float,
    everything: bool = False,
) -> InvalidValue:
    unit = dict(_SLIPS)[times]
    column = pose_columns(SOURCES[source])[axis]
    subject = "all positions look" if everything else f"{column} looks"
    return InvalidValue(
        f"{data.name}: line {int(line)}: {subject} like {unit} where metres are needed "
        f"({column} is {value:g}): divide by {times:g}"
    )


def _check_radians(data: Measurements, medians: Array, lines: NDArray[np.int64]) -> None:
    for source in SOURCES:
        values = getattr(data, source)[:, YAW]
        far = np.abs(values) > 2.0 * math.pi + 1e-6
        if far.any():
            row = int(np.argmax(far))
            name = pose_columns(source)[YAW]
            raise InvalidValue(
                f"{data.name}: line {int(data.line[row])}: {name} is {values[row]:g}, which looks "
                f"like degrees where radians are needed: multiply by pi / 180"
            )
    # Small angles in degrees stay below a turn: their ratio gives them away.
    yaw = np.abs(medians[:, :, YAW])
    for column, source in enumerate(SOURCES):
        rest = [c for c in range(len(SOURCES)) if c != column]
        known = ~np.isnan(yaw).any(axis=1)
        others = yaw[:, rest].mean(axis=1)
        clear = known & (others > math.radians(0.5))
        if clear.sum() >= 2 and 45.0 < float(np.median(yaw[clear, column] / others[clear])) < 70.0:
            raise InvalidValue(
                f"{data.name}: line {int(lines[clear][0])}: {pose_columns(source)[YAW]} looks like "
                f"degrees where radians are needed: multiply by pi / 180"
            )
