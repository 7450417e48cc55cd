"""A flight log as CSV, for PlotJuggler and spreadsheets."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any, TextIO

from perchctl.errors import InvalidValue
from perchctl.record.fields import FIELDS
from perchctl.record.log_file import FlightLog

CORNER_FIELDS = ("large_px", "small_px")
CORNER_COLUMNS = 8


def to_csv(log: FlightLog, path: Path | TextIO) -> None:
    """Write the ticks, one a row, `t_s` first; a missing value is an empty cell.

    Corner lists become eight columns (``large_px_0`` ... ``large_px_7``), true and
    false 1 and 0. Raises InvalidValue when the file cannot be written.
    """
    if not isinstance(path, Path):
        _write(log, path)
        return
    try:
        with path.open("w", newline="", encoding="utf-8") as stream:
            _write(log, stream)
    except OSError as error:
        raise InvalidValue(f"{path}: cannot be written: {error.strerror}") from None


def columns() -> list[str]:
    """The columns of `to_csv`, in order."""
    names: list[str] = []
    for key in FIELDS:
        names += [f"{key}_{i}" for i in range(CORNER_COLUMNS)] if key in CORNER_FIELDS else [key]
    return names


def _write(log: FlightLog, stream: TextIO) -> None:
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns())
    for record in log.records:
        writer.writerow(_row(record))


def _row(record: dict[str, Any]) -> list[Any]:
    row: list[Any] = []
    for key in FIELDS:
        value = record.get(key)
        if key in CORNER_FIELDS:
            row += value or [None] * CORNER_COLUMNS
        else:
            row.append(int(value) if isinstance(value, bool) else value)
    return row
