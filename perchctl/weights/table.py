"""The CSV of the experiment: one row a frame, read fast and with its faults named by line.

Columns, in this order where perchctl writes them, by name where it reads them:
``position`` (a whole number: the place where the row was taken), ``t_s``, then x, y, z
in metres and yaw in radians of ``large_``, ``small_`` and ``actual_``. Cells of a marker
that was not seen are empty. ``joint_`` columns (both markers solved together) may follow;
other columns are ignored. What matters is that the three poses are in one frame:
perchctl's own are the target relative to the gear's tip in the level frame.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound
from perchctl.geometry import Array
from perchctl.weights.types import AXES, UNITS, Measurements

CHUNK_BYTES = 1 << 20
_PLAIN = b"0123456789+-.eE,\n"

Progress = Callable[[], None]


def pose_columns(source: str) -> tuple[str, ...]:
    return tuple(f"{source}_{axis}_{unit}" for axis, unit in zip(AXES, UNITS, strict=True))


NEEDED = (
    "position",
    "t_s",
    *pose_columns("large"),
    *pose_columns("small"),
    *pose_columns("actual"),
)
JOINT = pose_columns("joint")
HEADER = ",".join((*NEEDED, *JOINT))


def row_text(position: int, t_s: float, poses: list[Array | None]) -> str:
    """One line for large, small, actual and joint, each (4,) or None."""
    cells = [str(position), f"{t_s:.6f}"]
    for pose in poses:
        cells += [""] * 4 if pose is None else [f"{float(value):.8f}" for value in pose]
    return ",".join(cells) + "\n"


def chunks_of(path: Path) -> int:
    """How often `read_csv` will call its progress."""
    try:
        return path.stat().st_size // CHUNK_BYTES + 1
    except OSError:
        return 1


def read_csv(path: Path, progress: Progress = lambda: None) -> Measurements:
    """Read and check a file. Errors: NotFound; InvalidValue, with file and line."""
    try:
        with path.open("rb") as stream:
            return _Reader(path, progress).read(stream)
    except FileNotFoundError:
        raise NotFound(f"data file {path} does not exist") from None
    except IsADirectoryError:
        raise NotFound(f"data file {path} is a folder; name a .csv file") from None
    except OSError as error:
        raise NotFound(f"data file {path} cannot be read: {error.strerror}") from None


class _Reader:
    def __init__(self, path: Path, progress: Progress) -> None:
        self._path, self._progress = path, progress
        self._columns: list[str] = []
        self._index: dict[str, int] = {}
        self._line = 1
        self._blocks: list[Array] = []
        self._lines: list[NDArray[np.int64]] = []
        self._notes: tuple[str, ...] = ()

    def read(self, stream: IO[bytes]) -> Measurements:
        sha = hashlib.sha256()
        rest = b""
        while chunk := stream.read(CHUNK_BYTES):
            sha.update(chunk)
            whole, newline, rest = (rest + chunk).rpartition(b"\n")
            self._take(whole + newline)
            self._progress()
        if rest.strip():
            self._last(rest)
        if not self._columns:
            raise self._fault(1, f"the file is empty; its first line must be {','.join(NEEDED)}")
        if not self._blocks:
            raise self._fault(2, "there is no row of data after the header")
        table = np.concatenate(self._blocks)
        self._blocks = []
        return self._measurements(table, sha.hexdigest())

    def _take(self, text: bytes) -> None:
        if text and not self._columns:
            first, _, text = text.partition(b"\n")
            self._header(first)
        if text:
            self._rows(text.replace(b"\r\n", b"\n"))

    def _last(self, text: bytes) -> None:
        """A last line without an end: whole, or where the file was cut."""
        if not self._columns:
            self._take(text + b"\n")
            return
        cells = text.count(b",") + 1
        if cells < len(self._columns):
            raise self._fault(
                self._line + 1,
                f"the file is cut in the middle of this line ({cells} of {len(self._columns)} "
                f"cells): remove the line, or take the original file",
            )
        self._take(text + b"\n")
        self._notes += (
            f"{self._path}: line {self._line}: the last line has no end; if the file was cut, "
            f"its last value may be short",
        )

    def _header(self, line: bytes) -> None:
        try:
            text = line.decode("utf-8-sig").strip()
        except UnicodeDecodeError:
            raise self._fault(1, "not a text file in UTF-8; a CSV is needed") from None
        columns = [name.strip().strip('"') for name in text.split(",")]
        missing = [name for name in NEEDED if name not in columns]
        if missing:
            hint = ""
            if len(columns) == 1 and (";" in text or "\t" in text):
                hint = " (cells must be separated by commas)"
            raise self._fault(
                1, f"column {missing[0]} is missing{_more(missing)}{hint}; needed are "
                f"{', '.join(NEEDED)}"
            )  # fmt: skip
        twice = [name for name in NEEDED if columns.count(name) > 1]
        if twice:
            raise self._fault(1, f"column {twice[0]} is there twice")
        self._columns = columns
        self._index = {name: columns.index(name) for name in (*NEEDED, *JOINT) if name in columns}

    def _rows(self, text: bytes) -> None:
        values = self._quick(text)
        if values is None:
            values, lines = self._slow(text)
        else:
            lines = np.arange(self._line + 1, self._line + 1 + len(values), dtype=np.int64)
        self._line += text.count(b"\n")
        if len(values):
            self._check(values, lines)
            self._blocks.append(values)
            self._lines.append(lines)

    def _wanted(self) -> list[int]:
        return list(self._index.values())

    def _quick(self, text: bytes) -> Array | None:
        """All rows at once; None where a line is not plain numbers in all columns."""
        if text.translate(None, _PLAIN):
            return None
        raw = np.frombuffer(text, np.uint8)
        ends = np.flatnonzero(raw == 10)
        commas = np.searchsorted(np.flatnonzero(raw == 44), ends)
        if (np.diff(commas, prepend=0) != len(self._columns) - 1).any():
            return None
        if b",," in text:
            text = text.replace(b",,", b",nan,").replace(b",,", b",nan,")
        text = text.replace(b",\n", b",nan\n").replace(b"\n,", b"\nnan,")
        if text.startswith(b","):
            text = b"nan" + text
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                values = np.fromstring(text.replace(b"\n", b","), sep=",")
        except (ValueError, DeprecationWarning):
            return None
        if values.size != len(ends) * len(self._columns):
            return None
        return np.ascontiguousarray(values.reshape(len(ends), -1)[:, self._wanted()])

    def _slow(self, text: bytes) -> tuple[Array, NDArray[np.int64]]:
        """Line by line: blanks, spaces, quotes, columns of text; or the fault."""
        names = list(self._index)
        wanted = self._wanted()
        rows, lines = [], []
        for number, raw in enumerate(text.split(b"\n")[:-1], start=self._line + 1):
            if not raw.strip():
                continue
            cells = raw.decode("utf-8", "replace").split(",")
            if len(cells) != len(self._columns):
                raise self._fault(
                    number,
                    f"{len(cells)} cells where the header has {len(self._columns)} columns",
                )
            rows.append([self._number(cells[i], names[k], number) for k, i in enumerate(wanted)])
            lines.append(number)
        values = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
        return values, np.array(lines, dtype=np.int64)

    def _number(self, cell: str, column: str, line: int) -> float:
        text = cell.strip().strip('"')
        if not text:
            return float("nan")
        try:
            value = float(text)
        except ValueError:
            raise self._fault(line, f"{column}: {text!r} is not a number") from None
        if not np.isfinite(value):
            raise self._fault(
                line,
                f"{column}: {text} is not a measurement; leave the cell empty where a marker was "
                f"not seen",
            )
        return value

    def _check(self, values: Array, lines: NDArray[np.int64]) -> None:
        names = list(self._index)
        must = [k for k, name in enumerate(names) if name in ("position", "t_s", *_ACTUAL)]
        self._refuse_first(
            np.isnan(values[:, must]), lines, [names[k] for k in must], "the cell is empty; only "
            "cells of a marker that was not seen may be",
        )  # fmt: skip
        infinite = np.isinf(values)
        self._refuse_first(infinite, lines, names, "the number is beyond all bounds")
        place = values[:, names.index("position")]
        odd = (place != np.floor(place)) | (np.abs(place) > 2**52)
        self._refuse_first(odd[:, None], lines, ["position"], "must be a whole number")
        for source in ("large", "small", "joint"):
            columns = [names.index(name) for name in pose_columns(source) if name in names]
            if len(columns) < 4:
                continue
            empty = np.isnan(values[:, columns])
            half = empty & ~empty.all(axis=1, keepdims=True)
            self._refuse_first(
                half, lines, list(pose_columns(source)),
                f"the cell is empty, but others of the {source} pose are not; leave all four "
                f"empty where it was not seen",
            )  # fmt: skip

    def _refuse_first(
        self, bad: NDArray[np.bool_], lines: NDArray[np.int64], names: list[str], text: str
    ) -> None:
        if bad.any():
            row = int(np.argmax(bad.any(axis=1)))
            raise self._fault(int(lines[row]), f"{names[int(np.argmax(bad[row]))]}: {text}")

    def _measurements(self, table: Array, sha256: str) -> Measurements:
        names = list(self._index)

        def pose(source: str) -> Array:
            columns = [names.index(name) for name in pose_columns(source)]
            return np.ascontiguousarray(table[:, columns])

        return Measurements(
            name=str(self._path),
            sha256=sha256,
            position=table[:, names.index("position")].astype(np.int64),
            t_s=np.ascontiguousarray(table[:, names.index("t_s")]),
            large=pose("large"),
            small=pose("small"),
            actual=pose("actual"),
            joint=pose("joint") if all(name in names for name in JOINT) else None,
            line=np.concatenate(self._lines),
            notes=self._notes,
        )

    def _fault(self, line: int, text: str) -> InvalidValue:
        return InvalidValue(f"{self._path}: line {line}: {text}")


_ACTUAL = pose_columns("actual")


def _more(names: list[str]) -> str:
    return f" (and {len(names) - 1} more)" if len(names) > 1 else ""
