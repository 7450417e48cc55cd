"""The data of a fit: a CSV with one row a frame, read and checked, its faults named by line.

Columns, in this order where perchctl writes them, by name where it reads them: ``position`` (a
whole number: the place where the row was taken), ``t_s``, then x, y, z in metres and yaw in
radians of ``large_``, ``small_`` and ``actual_``. Cells of a marker that was not seen are empty.
``joint_`` columns (both markers solved together) may follow; other columns are ignored. What
matters is that the three poses are in one frame: perchctl's own are the target relative to the
gear's tip in the level frame.
"""

from __future__ import annotations

import csv
import hashlib
import operator
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound, UsageError
from perchctl.geometry import Array

AXES = ("x", "y", "z", "yaw")
YAW = 3
UNITS = ("m", "m", "m", "rad")
SOURCES = ("large", "small", "actual", "joint")

FARTHEST_M = 5.0
"""No pair of markers is seen from farther away than this."""
MOST_APART = np.array([0.3, 0.3, 0.3, np.radians(30.0)])
"""A marker that measures a position so far from the truth was written in other units."""


def pose_columns(source: str) -> tuple[str, ...]:
    """Return the names of the four columns of a pose."""
    return tuple(f"{source}_{axis}_{unit}" for axis, unit in zip(AXES, UNITS, strict=True))


NEEDED = ("position", "t_s", *(column for source in SOURCES[:3] for column in pose_columns(source)))
JOINT = pose_columns("joint")
HEADER = ",".join((*NEEDED, *JOINT))


@dataclass(frozen=True, eq=False)
class Measurements:
    """Poses of the target (x, y, z in m, yaw in rad), one row a frame, n rows.

    Attributes:
        name: the file (or files) they come from, for messages.
        sha256: of the file's bytes, hexadecimal.
        position: number of the place where the row was taken, (n,).
        t_s: (n,).
        large, small: (n, 4), NaN where the marker was not seen.
        actual: (n, 4), the truth.
        joint: (n, 4), both markers solved together; NaN where it is missing.
    """

    name: str
    sha256: str
    position: NDArray[np.int64]
    t_s: Array
    large: Array
    small: Array
    actual: Array
    joint: Array

    def __len__(self) -> int:
        return len(self.position)

    @property
    def both(self) -> NDArray[np.bool_]:
        """True for rows in which both markers were seen, (n,)."""
        return ~(np.isnan(self.large[:, 0]) | np.isnan(self.small[:, 0]))


def wrap(angle_rad: Any) -> Any:
    """Return the same angles in (-pi, pi], any shape."""
    return -((-angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


def row_text(position: int, t_s: float, poses: Sequence[Array | None]) -> str:
    """Return one line of the CSV for large, small, actual and joint, each (4,) or None."""
    cells = [str(position), f"{t_s:.6f}"]
    for pose in poses:
        cells += [""] * 4 if pose is None else [f"{float(value):.8f}" for value in pose]
    return ",".join(cells) + "\n"


def read_data(
    paths: Sequence[Path], test: Path | None = None
) -> tuple[Measurements, Measurements | None]:
    """Return all files as one, and the data of `test` (None without it), all of them checked.

    Positions of different files stay different. Raises NotFound, UsageError, and InvalidValue for
    a file that cannot be fitted or a row that is there twice."""
    if not paths:
        raise UsageError("no data: name a CSV file; perchctl fit-weights collect makes one")
    parts = [read_csv(path) for path in paths]
    tested = None if test is None else read_csv(test)
    whole = [*parts, *([] if tested is None else [tested])]
    for part in whole:
        _check_positions(part)
    _refuse_repeated(whole)
    return _joined(parts), tested


def _joined(parts: list[Measurements]) -> Measurements:
    """Return the parts as one, with positions of different parts numbered apart."""
    if len(parts) == 1:
        return parts[0]
    offset, positions = 0, []
    for part in parts:
        positions.append(part.position - int(part.position.min()) + offset)
        offset = int(positions[-1].max()) + 1
    arrays: dict[str, Any] = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Measurements)[2:]
    }
    return Measurements(
        ", ".join(part.name for part in parts),
        ",".join(part.sha256 for part in parts),
        **arrays | {"position": np.concatenate(positions)},
    )


# --- Reading the CSV --------------------------------------------------


def read_csv(path: Path) -> Measurements:
    """Return the rows of a file. Raises NotFound, and InvalidValue that names file and line."""
    try:
        with path.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
        with path.open(encoding="utf-8-sig", newline="") as text:
            columns, lines, table = _read_table(path, csv.reader(text, skipinitialspace=True))
    except OSError as error:
        raise NotFound(f"data file {path} cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error):
        raise InvalidValue(f"{path}: line 1: not a text file in UTF-8; a CSV is needed") from None
    values = dict(zip(columns, table.T, strict=True))
    poses = {
        source: np.column_stack([values.get(name, np.nan * table[:, 0]) for name in names])
        for source in SOURCES
        for names in [pose_columns(source)]
    }
    _check_cells(path, lines, table[:, :2], poses)
    return Measurements(
        str(path), sha256, table[:, 0].astype(np.int64), table[:, 1].copy(), **poses
    )


def _read_table(path: Path, reader: Any) -> tuple[tuple[str, ...], NDArray[np.int64], Array]:
    """Return the columns that count, each row's line (n,), and the numbers (n, columns), NaN where
    a cell is empty."""
    header = [name.strip() for name in next(reader, [])]
    missing = [name for name in NEEDED if header.count(name) != 1]
    if missing:
        raise InvalidValue(
            f"{path}: line 1: column {missing[0]} is missing, or there twice; needed are "
            f"{','.join(NEEDED)}, separated by commas"
        )
    columns = (*NEEDED, *(JOINT if set(JOINT) <= set(header) else ()))
    pick = operator.itemgetter(*(header.index(name) for name in columns))
    numbers, lines = array("d"), array("q")
    for cells in reader:
        if not any(cells):
            continue
        lines.append(reader.line_num)
        try:
            if len(cells) != len(header):
                raise ValueError(f"{len(cells)} cells where the header has {len(header)} columns")
            numbers.extend([float(cell or "nan") for cell in pick(cells)])
        except ValueError as error:
            raise InvalidValue(f"{path}: line {reader.line_num}: {error}") from None
    if not lines:
        raise InvalidValue(f"{path}: line 2: there is no row of data after the header")
    table = np.array(numbers).reshape(len(lines), len(columns))
    return columns, np.array(lines), table


def _check_cells(
    path: Path, lines: NDArray[np.int64], heads: Array, poses: dict[str, Array]
) -> None:
    """Raises InvalidValue for infinite numbers, missing cells, and poses of which a part is
    missing."""

    def refuse(bad: Any, text: str) -> None:
        if bad.any():
            raise InvalidValue(f"{path}: line {int(lines[np.argmax(bad)])}: {text}")

    refuse(
        ~np.isfinite(heads).all(axis=1) | (heads[:, 0] != np.floor(heads[:, 0])),
        "position must be a whole number, and t_s a number",
    )
    for source, pose in poses.items():
        refuse(np.isinf(pose).any(axis=1), f"the {source} pose holds an infinite number")
        refuse(
            np.abs(pose[:, YAW]) > 2.0 * np.pi + 1e-6,
            f"{source}_yaw_rad looks like degrees where radians are needed",
        )
        empty = np.isnan(pose)
        refuse(
            empty.any(axis=1) & ~empty.all(axis=1),
            f"a cell of the {source} pose is empty, but others are not; leave all four empty "
            f"where the marker was not seen",
        )
    refuse(np.isnan(poses["actual"][:, 0]), "the actual pose is empty")


# --- Data that would fit to nonsense ----------------------------------


def _check_positions(data: Measurements) -> None:
    """Raises InvalidValue for a marker that was never seen, a single position, or wrong units."""
    for source in ("large", "small"):
        if np.isnan(getattr(data, source)).all():
            raise InvalidValue(f"{data.name}: the {source} marker is never seen")
    places = np.unique(data.position[data.both])
    if len(places) < 2:
        raise InvalidValue(
            f"{data.name}: {len(places)} positions show both markers; frames of one position are "
            f"not independent, so at least 2 are needed (10 are usual)"
        )
    for place in places:
        rows = data.both & (data.position == place)
        actual = data.actual[rows]
        if np.linalg.norm(np.median(actual[:, :YAW], axis=0)) > FARTHEST_M:
            raise InvalidValue(
                f"{data.name}: position {place} is more than {FARTHEST_M:g} m away: metres and "
                f"radians are needed, not centimetres and degrees"
            )
        for source in ("large", "small"):
            apart = getattr(data, source)[rows] - actual
            apart[:, YAW] = wrap(apart[:, YAW])
            far = np.abs(np.median(apart, axis=0)) > MOST_APART
            if far.any():
                raise InvalidValue(
                    f"{data.name}: position {place}: {source} and actual do not agree in "
                    f"{AXES[int(np.argmax(far))]}: all poses must be in metres and radians, and "
                    f"in one frame"
                )


def _refuse_repeated(parts: Sequence[Measurements]) -> None:
    """Raises InvalidValue where a row is there twice: it would narrow the intervals and is no more
    evidence, and no test of weights that were fitted to it.

    Without times, rows of one position of one file may be equal: rounded, of a camera at rest.
    """
    seen: dict[bytes, tuple[int, int]] = {}  # the file's number and the position of a row
    for file, part in enumerate(parts):
        has_times = float(np.ptp(part.t_s)) > 0.0
        rows = np.column_stack([part.t_s, part.large, part.small, part.actual])
        for number, row in enumerate(np.nan_to_num(rows) + 0.0, start=1):  # no zero with a minus
            key, place = row.tobytes(), (file, int(part.position[number - 1]))
            if key in seen and (has_times or seen[key] != place):
                raise InvalidValue(
                    f"{part.name}: its row {number} is there twice, or was in the files before: "
                    f"the same rows are no more evidence, and no test of what was fitted to them"
                )
            seen[key] = place
