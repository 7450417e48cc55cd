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
import math
import operator
import os
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound, UsageError
from perchctl.geometry import Array

AXES = ("x", "y", "z", "yaw")
YAW = 3
UNITS = ("m", "m", "m", "rad")
SOURCES = ("large", "small", "actual")

LEAST_M = 0.005
"""Coordinates below this are too small to compare scales by."""
FARTHEST_M = 5.0
"""No pair of markers is seen from farther away than this."""
_SLIPS = {100.0: ("centimetres", 50.0, 300.0), 1000.0: ("millimetres", 300.0, 3000.0)}
"""A slip of units by its factor: its name, and the ratios that show it."""
_MOST_POSITIONS = 1000  # whose units are looked at


def pose_columns(source: str) -> tuple[str, ...]:
    """Names of the four columns of a pose."""
    return tuple(f"{source}_{axis}_{unit}" for axis, unit in zip(AXES, UNITS, strict=True))


NEEDED = ("position", "t_s", *(column for source in SOURCES for column in pose_columns(source)))
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
        line: the row's line in its file, (n,).
        notes: sentences about the data that are no faults.
    """

    name: str
    sha256: str
    position: NDArray[np.int64]
    t_s: Array
    large: Array
    small: Array
    actual: Array
    joint: Array
    line: NDArray[np.int64]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.position)

    @property
    def both(self) -> NDArray[np.bool_]:
        """True for rows in which both markers were seen, (n,)."""
        return ~(np.isnan(self.large[:, 0]) | np.isnan(self.small[:, 0]))


def wrap(angle_rad: Any) -> Any:
    """The same angles in (-pi, pi], any shape."""
    return -((-angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


def row_text(position: int, t_s: float, poses: Sequence[Array | None]) -> str:
    """One line of the CSV for large, small, actual and joint, each (4,) or None."""
    cells = [str(position), f"{t_s:.6f}"]
    for pose in poses:
        cells += [""] * 4 if pose is None else [f"{float(value):.8f}" for value in pose]
    return ",".join(cells) + "\n"


def read_data(paths: Sequence[Path], test: Path | None = None) -> tuple[Measurements, Any]:
    """All files as one, and the data of `test` (None without it), all of them checked.

    Positions of different files stay different. Errors: NotFound, UsageError; InvalidValue for a
    file that cannot be fitted, and for a row that is there twice: it would narrow the intervals
    and is no more evidence."""
    if not paths:
        raise UsageError("no data: name a CSV file; perchctl fit-weights collect makes one")
    parts = [read_csv(path) for path in paths]
    tested = None if test is None else read_csv(test)
    for part in (*parts, *([tested] if tested is not None else [])):
        check(part)
    refuse_repeated(parts, tested)
    return _joined(parts), tested


def _joined(parts: list[Measurements]) -> Measurements:
    if len(parts) == 1:
        return parts[0]
    offset, positions = 0, []
    for part in parts:
        positions.append(part.position - int(part.position.min()) + offset)
        offset = int(positions[-1].max()) + 1
    arrays: dict[str, Any] = {
        key: np.concatenate([getattr(part, key) for part in parts])
        for key in ("t_s", "large", "small", "actual", "joint", "line")
    }
    return Measurements(
        name=", ".join(part.name for part in parts),
        sha256=",".join(part.sha256 for part in parts),
        position=np.concatenate(positions),
        notes=tuple(note for part in parts for note in part.notes),
        **arrays,
    )


def refuse_repeated(parts: Sequence[Measurements], test: Measurements | None = None) -> None:
    """Raises InvalidValue where a row is there twice; `test` judges the fit, and must hold none
    of the others' rows.

    Without times, rows of one position may well be equal: rounded, of a camera at rest.
    """
    files = [*parts, *([] if test is None else [test])]
    first: dict[bytes, tuple[Measurements, int]] = {}
    for part in files:
        timeless = float(np.ptp(part.t_s)) == 0.0
        poses = [np.nan_to_num(getattr(part, source)) for source in SOURCES]
        values = np.column_stack([part.t_s, *poses]) + 0.0  # no zero with a minus
        content, size = values.tobytes(), values.itemsize * values.shape[1]
        for row in range(len(part)):
            key = content[row * size : (row + 1) * size]
            if key not in first:
                first[key] = (part, row)
                continue
            before, old_row = first[key]
            if before is part and timeless and part.position[row] == part.position[old_row]:
                continue
            why = (
                "--test judges by other data than was fitted to"
                if part is test and before is not test
                else "the same rows twice are no more evidence; take out what is there twice"
            )
            raise InvalidValue(
                f"{part.name}: line {int(part.line[row])}: this row stands in line "
                f"{int(before.line[old_row])} of {before.name} too: {why}"
            )


# --- Reading the CSV ---------------------------------------------------------------------------


def read_csv(path: Path) -> Measurements:
    """Reads a file. Errors: NotFound; InvalidValue, which names file and line."""
    try:
        with path.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            stream.seek(-min(1, stream.tell()), os.SEEK_END)
            ended = stream.read() == b"\n"
        with path.open(encoding="utf-8-sig", newline="") as text:
            return _parsed(path, sha256, csv.reader(text, skipinitialspace=True), ended)
    except FileNotFoundError:
        raise NotFound(f"data file {path} does not exist") from None
    except IsADirectoryError:
        raise NotFound(f"data file {path} is a folder; name a .csv file") from None
    except OSError as error:
        raise NotFound(f"data file {path} cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error):
        raise InvalidValue(f"{path}: line 1: not a text file in UTF-8; a CSV is needed") from None


def _parsed(path: Path, sha256: str, reader: Any, ended: bool) -> Measurements:
    """`ended`: whether the last line has an end."""

    def fault(line: int, text: str) -> InvalidValue:
        return InvalidValue(f"{path}: line {line}: {text}")

    columns = [name.strip() for name in next(reader, [])]
    _check_header(columns, fault)
    names = [name for name in (*NEEDED, *JOINT) if name in columns]
    if not all(name in columns for name in JOINT):
        names = list(NEEDED)
    wanted = [columns.index(name) for name in names]
    pick = operator.itemgetter(*wanted)
    numbers, lines = array("d"), array("q")
    for cells in reader:
        if len(cells) < 2 and not "".join(cells).strip():
            continue
        line = reader.line_num
        if len(cells) != len(columns):
            if not ended and len(cells) < len(columns) and next(reader, None) is None:
                raise fault(
                    line,
                    f"the file is cut in the middle of this line ({len(cells)} of {len(columns)} "
                    f"cells): remove the line, or take the original file",
                )
            raise fault(line, f"{len(cells)} cells where the header has {len(columns)} columns")
        try:
            row = list(map(float, pick(cells)))
            plain = math.isfinite(sum(row))
        except ValueError:
            plain = False
        if not plain:  # a marker that was not seen, or a fault
            row = [
                _number(cells[k], name, line, fault) for k, name in zip(wanted, names, strict=True)
            ]
        numbers.extend(row)
        lines.append(line)
    if not lines:
        raise fault(2, "there is no row of data after the header")
    table = np.array(numbers).reshape(len(lines), len(names))
    at = np.array(lines, dtype=np.int64)
    _check_cells(table, names, at, fault)

    def pose(source: str) -> Array:
        first = names.index(pose_columns(source)[0])
        return np.ascontiguousarray(table[:, first : first + 4])

    note = (
        f"{path}: line {int(at[-1])}: the last line has no end; if the file was cut, its last "
        f"value may be short"
    )
    return Measurements(
        name=str(path),
        sha256=sha256,
        position=table[:, 0].astype(np.int64),
        t_s=table[:, 1].copy(),
        large=pose("large"),
        small=pose("small"),
        actual=pose("actual"),
        joint=pose("joint") if JOINT[0] in names else np.full((len(at), 4), np.nan),
        line=at,
        notes=() if ended else (note,),
    )


def _check_header(columns: list[str], fault: Any) -> None:
    if not any(columns):
        raise fault(1, f"the file is empty; its first line must be {','.join(NEEDED)}")
    missing = [name for name in NEEDED if name not in columns]
    if missing:
        more = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
        text = columns[0]
        hint = " (cells must be separated by commas)" if ";" in text or "\t" in text else ""
        raise fault(
            1, f"column {missing[0]} is missing{more}{hint}; needed are {', '.join(NEEDED)}"
        )
    twice = [name for name in NEEDED if columns.count(name) > 1]
    if twice:
        raise fault(1, f"column {twice[0]} is there twice")


def _number(cell: str, column: str, line: int, fault: Any) -> float:
    text = cell.strip()
    try:
        value = float(text or "nan")
    except ValueError:
        raise fault(line, f"{column}: {text!r} is not a number") from None
    if text and not math.isfinite(value):
        raise fault(
            line,
            f"{column}: {text} is not a measurement; leave the cell empty where a marker was "
            f"not seen",
        )
    return value


def _check_cells(table: Array, names: list[str], lines: NDArray[np.int64], fault: Any) -> None:
    """Empty cells where there must be a value, half poses, positions that are no number."""

    def refuse(bad: NDArray[np.bool_], columns: Sequence[str], text: str) -> None:
        if bad.any():
            row = int(np.argmax(bad.any(axis=1)))
            column = columns[int(np.argmax(bad[row]))]
            raise fault(int(lines[row]), f"{column}: {text}")

    empty = np.isnan(table)
    must = ("position", "t_s", *pose_columns("actual"))
    text = "the cell is empty; only cells of a marker that was not seen may be"
    refuse(empty[:, [names.index(name) for name in must]], must, text)
    place = table[:, :1]
    refuse((place != np.floor(place)) | (np.abs(place) > 2**52), names, "must be a whole number")
    for source in ("large", "small", "joint"):
        if pose_columns(source)[0] not in names:
            continue
        first = names.index(pose_columns(source)[0])
        part = empty[:, first : first + 4]
        refuse(
            part & ~part.all(axis=1, keepdims=True), pose_columns(source),
            f"the cell is empty, but others of the {source} pose are not; leave all four empty "
            f"where it was not seen",
        )  # fmt: skip


# --- Data that would fit to nonsense: unit slips, markers never seen, values that stand still --


def check(data: Measurements) -> None:
    """Raises InvalidValue, with file and line, for data that cannot be fitted."""
    _check_seen(data)
    _check_units(data)
    _check_variation(data)


def _check_seen(data: Measurements) -> None:
    seen = {name: ~np.isnan(getattr(data, name)[:, 0]) for name in ("large", "small")}
    unseen = [f"the {name} marker is never seen" for name, rows in seen.items() if not rows.any()]
    if not data.both.any():
        what = unseen[0] if unseen else "no row holds both markers"
        raise InvalidValue(
            f"{data.name}: lines {int(data.line[0])} to {int(data.line[-1])}: {what}, so there is "
            f"nothing to merge; take positions from which both markers are whole in the picture"
        )
    places = np.unique(data.position[data.both])
    if len(places) < 2:
        raise InvalidValue(
            f"{data.name}: line {int(data.line[data.both][0])}: all rows with both markers are of "
            f"position {int(places[0])}; frames of one position are not independent, so at "
            f"least 2 positions are needed (10 are usual)"
        )


def _check_variation(data: Measurements) -> None:
    large, small = data.large[data.both], data.small[data.both]
    where = f"{data.name}: line {int(data.line[data.both][0])}"
    for source, values in (("large", large), ("small", small)):
        still = np.ptp(values, axis=0) == 0.0
        # A plain truth may stand still on one axis; a measurement of it cannot.
        if len(values) > 2 and still.any():
            axis = int(np.argmax(still))
            raise InvalidValue(
                f"{where}: {pose_columns(source)[axis]} is {values[0, axis]:g} in every row with "
                f"both markers: constant data are no measurement"
            )
    same = np.abs(large - small).max(axis=0) < 1e-12
    if same.any():
        raise InvalidValue(
            f"{where}: both markers give the same {AXES[int(np.argmax(same))]} in every row, so "
            f"every weight fits alike; was one marker's column copied?"
        )


def _check_units(data: Measurements) -> None:
    medians, lines = _medians(data)
    _check_radians(data, medians, lines)

    def slipped(place: int, source: int, axis: int, times: float, whole: bool) -> InvalidValue:
        column = pose_columns(SOURCES[source])[axis]
        subject = "all positions look" if whole else f"{column} looks"
        return InvalidValue(
            f"{data.name}: line {int(lines[place])}: {subject} like {_SLIPS[times][0]} where "
            f"metres are needed ({column} is {medians[place, source, axis]:g}): divide by {times:g}"
        )

    for place, poses in enumerate(np.abs(medians)):
        for axis in range(YAW):
            slip = _odd_one_out(poses[:, axis])
            if slip is not None:
                raise slipped(place, slip[0], axis, slip[1], whole=False)
    # All three alike, but farther away than anything can be.
    typical = float(np.median(np.linalg.norm(medians[:, SOURCES.index("actual"), :YAW], axis=1)))
    if typical > FARTHEST_M:
        raise slipped(0, 0, 2, 1000.0 if typical > 60.0 else 100.0, whole=True)


def _medians(data: Measurements) -> tuple[Array, NDArray[np.int64]]:
    """Of each position the medians, (positions, source, axis), and its first line."""
    order = np.argsort(data.position, kind="stable")
    places = np.split(order, np.flatnonzero(np.diff(data.position[order])) + 1)
    places = places[:: max(1, len(places) // _MOST_POSITIONS)]
    medians = np.full((len(places), len(SOURCES), 4), np.nan)
    for row, rows in enumerate(places):
        for column, source in enumerate(SOURCES):
            values = getattr(data, source)[rows]
            seen = values[~np.isnan(values[:, 0])]
            if len(seen):
                medians[row, column] = np.median(seen, axis=0)
    return medians, np.array([data.line[rows[0]] for rows in places])


def _odd_one_out(size: Array) -> tuple[int, float] | None:
    """Which of large, small and actual is 100 or 1000 times the others, and how many times."""
    for source in range(len(size)):
        others = [s for s in range(len(size)) if s != source and not np.isnan(size[s])]
        if np.isnan(size[source]) or not others:
            continue
        if size[others].max() > 3.0 * size[others].min():
            continue  # the others do not agree either
        rest = float(size[others].mean())
        wrong = source if size[source] > rest else others[0]  # a slip makes numbers larger
        low, high = sorted((float(size[source]), rest))
        for times, (_, least, most) in _SLIPS.items():
            if low >= LEAST_M and least <= high / low < most:
                return wrong, times
    return None


def _check_radians(data: Measurements, medians: Array, lines: NDArray[np.int64]) -> None:
    advice = "looks like degrees where radians are needed: multiply by pi / 180"
    for source in SOURCES:
        values = getattr(data, source)[:, YAW]
        far = np.abs(values) > 2.0 * math.pi + 1e-6
        if far.any():
            row = int(np.argmax(far))
            raise InvalidValue(
                f"{data.name}: line {int(data.line[row])}: {pose_columns(source)[YAW]} is "
                f"{values[row]:g}, which {advice}"
            )
    # Small angles in degrees stay below a turn: their ratio gives them away.
    yaw = np.abs(medians[:, :, YAW])
    for column, source in enumerate(SOURCES):
        others = np.delete(yaw, column, axis=1).mean(axis=1)
        clear = ~np.isnan(yaw).any(axis=1) & (others > math.radians(0.5))
        if clear.sum() >= 2 and 45.0 < float(np.median(yaw[clear, column] / others[clear])) < 70.0:
            raise InvalidValue(
                f"{data.name}: line {int(lines[clear][0])}: {pose_columns(source)[YAW]} {advice}"
            )
