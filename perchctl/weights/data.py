"""The data for a fit: read and check a CSV file with one row per frame. Error messages name the
line.

The columns are ``position`` (a whole number: the place where the row was taken), ``t_s``, then x,
y, z in metres and yaw in radians with each of the prefixes ``large_``, ``small_`` and ``actual_``.
perchctl writes them in this order, and reads them by name. Cells of a marker that was not seen are
empty. Other columns are ignored. All three poses must be in the same frame; perchctl writes the
target relative to the gear's tip in the level frame.
"""

from __future__ import annotations

import csv
import operator
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound
from perchctl.files import kind_note
from perchctl.geometry import Array

AXES = ("x", "y", "z", "yaw")
YAW_COLUMN = 3
SOURCES = ("large", "small", "actual")
NEEDED = (
    "position",
    "t_s",
    *(f"{source}_{axis}" for source in SOURCES for axis in ("x_m", "y_m", "z_m", "yaw_rad")),
)
HEADER = ",".join(NEEDED)

MOST_APART = np.array([0.3, 0.3, 0.3, np.radians(30.0)])
"""Difference from the ground truth in x, y, z (m) and yaw (rad) above which a marker's pose is
probably in different units."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """Poses of the target (x, y, z in m, yaw in rad), n rows, one per frame.

    Attributes:
        name: name of the data file, for messages.
        position: number of the place where the row was taken, (n,).
        large, small: pose measured from each marker, (n, 4); NaN where the marker was not seen.
        actual: true pose, (n, 4).
    """

    name: str
    position: NDArray[np.int64]
    large: Array
    small: Array
    actual: Array

    def __len__(self) -> int:
        return len(self.position)

    @property
    def has_both_markers(self) -> NDArray[np.bool_]:
        """True for rows in which both markers were seen, (n,)."""
        return ~(np.isnan(self.large[:, 0]) | np.isnan(self.small[:, 0]))


def wrap_angles(angle_rad: Any) -> Any:
    """The angles (an array of any shape), wrapped to (-pi, pi]."""
    return -((-angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


def csv_row(position: int, t_s: float, poses: Sequence[Array | None]) -> str:
    """The CSV line for a frame at `position`. `poses`: large, small, actual, each (4,) or None."""
    cells = [str(position), f"{t_s:.6f}"]
    for pose in poses:
        cells += [""] * 4 if pose is None else [f"{float(value):.8f}" for value in pose]
    return ",".join(cells) + "\n"


def read_data(path: Path) -> Measurements:
    """Read a CSV file for the fit. Raises NotFound, and InvalidValue with the line or the
    position."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as text:
            lines, table = _read_table(path, csv.reader(text, skipinitialspace=True))
    except OSError as error:
        raise NotFound(f"data file {path} cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error):
        raise InvalidValue(f"{path}: line 1: not a text file in UTF-8; a CSV is needed") from None
    large, small, actual = np.split(table[:, 2:], 3, axis=1)
    _check_cells(path, lines, table[:, :2], dict(zip(SOURCES, (large, small, actual), strict=True)))
    data = Measurements(str(path), table[:, 0].astype(np.int64), large, small, actual)
    _check_positions(data)
    return data


def _read_table(path: Path, reader: Any) -> tuple[NDArray[np.int64], Array]:
    """Return the line numbers of the rows (n,) and the required columns (n, 14), NaN where a cell
    is empty."""
    header = [name.strip() for name in next(reader, [])]
    missing = [name for name in NEEDED if header.count(name) != 1]
    if missing:
        raise InvalidValue(
            f"{path}: line 1: column {missing[0]} is missing, or appears twice"
            f"{kind_note(path)}; the columns "
            f"{HEADER} are needed, separated by commas"
        )
    pick = operator.itemgetter(*(header.index(name) for name in NEEDED))
    numbers, lines = array("d"), array("q")
    for cells in reader:
        if not any(cells):
            continue
        lines.append(reader.line_num)
        try:
            if len(cells) != len(header):
                raise ValueError(f"{len(cells)} cells, but the header has {len(header)} columns")
            numbers.extend([float(cell or "nan") for cell in pick(cells)])
        except ValueError as error:
            raise InvalidValue(f"{path}: line {reader.line_num}: {error}") from None
    if not lines:
        raise InvalidValue(f"{path}: line 2: no data after the header")
    return np.array(lines), np.array(numbers).reshape(len(lines), len(NEEDED))


def _check_cells(
    path: Path, lines: NDArray[np.int64], heads: Array, poses: dict[str, Array]
) -> None:
    """Raise InvalidValue for infinite numbers, missing cells, and incomplete poses."""

    def refuse(bad: Any, text: str) -> None:
        if bad.any():
            raise InvalidValue(f"{path}: line {int(lines[np.argmax(bad)])}: {text}")

    refuse(
        ~np.isfinite(heads).all(axis=1) | (heads[:, 0] != np.floor(heads[:, 0])),
        "position must be a whole number, and t_s must be finite",
    )
    for source, pose in poses.items():
        refuse(np.isinf(pose).any(axis=1), f"the {source} pose contains an infinite number")
        refuse(
            np.abs(pose[:, YAW_COLUMN]) > 2.0 * np.pi + 1e-6,
            f"{source}_yaw_rad looks like degrees: radians are needed",
        )
        empty = np.isnan(pose)
        refuse(
            empty.any(axis=1) & ~empty.all(axis=1),
            f"only some cells of the {source} pose are empty; leave all four empty if the "
            "marker was not seen",
        )
    refuse(np.isnan(poses["actual"][:, 0]), "the actual pose is empty")


def _check_positions(data: Measurements) -> None:
    for source in ("large", "small"):
        if np.isnan(getattr(data, source)).all():
            raise InvalidValue(f"{data.name}: the {source} marker was never seen")
    places = np.unique(data.position[data.has_both_markers])
    if len(places) < 2:
        raise InvalidValue(
            f"{data.name}: {len(places)} positions show both markers; frames from one "
            "position are not independent, so at least 2 positions are needed (10 are typical)"
        )
    for place in places:
        rows = data.has_both_markers & (data.position == place)
        for source in ("large", "small"):
            apart = getattr(data, source)[rows] - data.actual[rows]
            apart[:, YAW_COLUMN] = wrap_angles(apart[:, YAW_COLUMN])
            far = np.abs(np.median(apart, axis=0)) > MOST_APART
            if far.any():
                raise InvalidValue(
                    f"{data.name}: position {place}: {source} and actual pose disagree in "
                    f"{AXES[int(np.argmax(far))]}: all poses must be in metres and radians, and in "
                    "the same frame"
                )
