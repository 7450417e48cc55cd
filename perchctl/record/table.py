"""A flight log as one table: a row each turn of the loop, a column each number or word.

The columns are the same for every log: a field without a value anywhere is an empty column.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from io import StringIO
from itertools import chain
from typing import Any, NamedTuple

from perchctl.errors import InvalidValue
from perchctl.record.fields import FIELDS, field_kind
from perchctl.record.read import FlightLog, log_values

_CORNERS = tuple(f"{corner}_{axis}" for corner in ("tl", "tr", "br", "bl") for axis in "xy")
_TIMES = ("t_s", "frame_t_s")
"""On the loop's clock in the log, from the flight's first turn in the table."""
_TIMINGS = ("pipeline_s", "planner_s", "send_s", "turn_s")
_DECIMALS = 6
_Column = tuple[str, list[Any]]


class LogTable(NamedTuple):
    """A flight as a table: the names of its columns, and its rows; None is a missing value."""

    columns: list[str]
    rows: list[tuple[Any, ...]]

    def csv(self) -> str:
        """Return a line of names, then a line each row; a missing value is empty, a flag 0 or 1."""
        text = StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        for row in self.rows:
            writer.writerow([int(cell) if isinstance(cell, bool) else cell for cell in row])
        return text.getvalue()


def log_table(log: FlightLog) -> LogTable:
    """Make the table of a log: `t_s` first, from 0; then the log's fields in their order, with the
    markers' corners as columns of their own, what happened in words, and how long the parts of the
    turn took.

    Errors: InvalidValue for a log without ticks, and for a value that no flight writes.
    """
    if not log.records:
        raise InvalidValue(f"{log.path}: the log holds no ticks, there is nothing to export")
    with log_values(log.path):
        columns = list(chain(_fields(log), _events(log), _timings(log)))
    names, values = zip(*columns, strict=True)
    return LogTable(list(names), list(zip(*values, strict=True)))


def _fields(log: FlightLog) -> Iterator[_Column]:
    for key in FIELDS:
        values = [record.get(key) for record in log.records]
        if key in _TIMES:
            values = [None if v is None else round(log.since(v), _DECIMALS) + 0.0 for v in values]
        if field_kind(key) == "number":
            log.column(key)  # raises for what is none
        if field_kind(key) != "corners":
            yield key, values
            continue
        if not all(value is None or len(value) == len(_CORNERS) for value in values):
            raise ValueError(f"{key} needs {len(_CORNERS)} numbers")
        for at, corner in enumerate(_CORNERS):
            name = f"{key.removesuffix('_px')}_{corner}_px"
            yield name, [None if value is None else value[at] for value in values]


def _events(log: FlightLog) -> Iterator[_Column]:
    """Yield what happened, in the first row at or behind it."""
    times = [float(record["t_s"]) for record in log.records]
    told: list[list[str]] = [[] for _ in times]
    row = 0
    for event in log.events:
        while row < len(times) - 1 and times[row] < float(event["t_s"]):
            row += 1
        kind, reason = event.get("event"), str(event.get("reason") or "")
        name = str(event.get("phase")) if kind == "phase" else str(kind)
        told[row].append(f"{name}: {reason}".rstrip(": "))
    yield "event", [" | ".join(words) or None for words in told]


def _timings(log: FlightLog) -> Iterator[_Column]:
    """Yield what the parts of the turns took, s; a flight in lockstep has none of it."""
    of_turn = {
        round(float(record["t_s"]), _DECIMALS): record["timing"]
        for record in log.turn_records
        if isinstance(record.get("timing"), dict)
    }
    timings = [of_turn.get(float(record["t_s"]), {}) for record in log.records]
    for key in _TIMINGS:
        yield key, [timing.get(key) for timing in timings]
