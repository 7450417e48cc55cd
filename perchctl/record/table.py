"""A flight log as one table: a row each turn of the loop, a column each number or word.

The columns are the same for every log: a field without a value anywhere is an empty column.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO, StringIO
from typing import Any

from perchctl.errors import InvalidValue, no_parquet
from perchctl.profile import key_unit
from perchctl.record.fields import FIELDS, Kind, field_kind
from perchctl.record.read import FlightLog, log_values

_CORNERS = tuple(f"{corner}_{axis}" for corner in ("tl", "tr", "br", "bl") for axis in "xy")
_TIMES = ("t_s", "frame_t_s")
"""On the loop's clock in the log, from the flight's first turn in the table."""
_TIMINGS = {
    "pipeline_s": "taking in and looking took so long",
    "planner_s": "deciding took so long",
    "send_s": "sending took so long",
    "turn_s": "the whole turn took so long",
}
_DECIMALS = 6


@dataclass(frozen=True)
class Column:
    """One column; `values` has None where a row has none."""

    name: str
    kind: Kind
    meaning: str
    values: list[Any]

    @property
    def unit(self) -> str:
        """``m/s``; empty for a plain number or a word."""
        return key_unit(self.name)


@dataclass(frozen=True)
class LogTable:
    """A flight as a table; all columns are of one length."""

    log: FlightLog
    columns: list[Column]

    @property
    def rows(self) -> int:
        """How many turns it has."""
        return len(self.columns[0].values)

    def csv(self) -> str:
        """A line of names, then a line each row; a missing value is empty, a flag 0 or 1."""
        text = StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([column.name for column in self.columns])
        cells = (
            [int(value) if isinstance(value, bool) else value for value in column.values]
            for column in self.columns
        )
        writer.writerows(zip(*cells, strict=True))
        return text.getvalue()

    def parquet(self) -> bytes:
        """An Apache Parquet file: the table, each column's unit and meaning, and the log's header
        and summary as JSON under ``perchctl.header`` and ``perchctl.summary``.

        Errors: UsageError without the library, which comes with the extra ``parquet``.
        """
        try:
            import pyarrow as pa
            import pyarrow.parquet as pq
        except ImportError:
            raise no_parquet() from None
        types: dict[Kind, pa.DataType] = {
            "number": pa.float64(),
            "integer": pa.int64(),
            "flag": pa.bool_(),
            "text": pa.string(),
        }
        fields = [
            pa.field(c.name, types[c.kind], metadata={"unit": c.unit, "meaning": c.meaning})
            for c in self.columns
        ]
        about = {
            "perchctl.header": json.dumps(self.log.header),
            "perchctl.summary": json.dumps(self.log.summary),
        }
        values = {column.name: column.values for column in self.columns}
        table = pa.table(values, schema=pa.schema(fields, metadata=about))
        content = BytesIO()
        pq.write_table(table, content, compression="zstd")
        return content.getvalue()


def log_table(log: FlightLog) -> LogTable:
    """`t_s` first, from 0; then the log's fields in their order, with the markers' corners as
    columns of their own, what happened in words, and how long the parts of the turn took.

    Errors: InvalidValue for a log without ticks, and for a value that is none of its field's.
    """
    if not log.records:
        raise InvalidValue(f"{log.path}: the log holds no ticks, there is nothing to export")
    with log_values(log.path):
        columns = [column for key in FIELDS for column in _of_field(log, key)]
        return LogTable(log, [*columns, _events(log), *_timings(log)])


def _of_field(log: FlightLog, key: str) -> Iterator[Column]:
    values, meaning, kind = [r.get(key) for r in log.records], FIELDS[key], field_kind(key)
    if key in _TIMES:
        meaning = meaning.replace("on the loop's clock", "since the flight's first turn")
        values = [None if v is None else round(log.since(v), _DECIMALS) + 0.0 for v in values]
    if kind != "corners":
        yield Column(key, kind, meaning, [_as_kind(key, kind, value) for value in values])
        return
    for corner, of_corner in zip(_CORNERS, zip(*map(_corners, values), strict=True), strict=True):
        name = f"{key.removesuffix('_px')}_{corner}_px"
        one = [_as_kind(name, "number", value) for value in of_corner]
        yield Column(name, "number", f"{meaning}: {corner.replace('_', ' ')}", one)


def _corners(value: Any) -> list[Any]:
    corners = [None] * len(_CORNERS) if value is None else list(value)
    if len(corners) != len(_CORNERS):
        raise ValueError(f"corners must be {len(_CORNERS)} numbers, found {value!r:.40}")
    return corners


def _events(log: FlightLog) -> Column:
    """What happened, in the first row at or behind it."""
    times = [float(record["t_s"]) for record in log.records]
    told: list[list[str]] = [[] for _ in times]
    row = 0
    for event in log.events:
        while row < len(times) - 1 and times[row] < float(event["t_s"]):
            row += 1
        kind, reason = event.get("event"), str(event.get("reason") or "")
        name = str(event.get("phase")) if kind == "phase" else str(kind)
        told[row].append(f"{name}: {reason}".rstrip(": "))
    texts = [" | ".join(words) or None for words in told]
    return Column("event", "text", "phases entered, holds and notes", texts)


def _timings(log: FlightLog) -> Iterator[Column]:
    """Of the turns that are in the log; in lockstep they have none."""
    of_turn = {
        round(float(record["t_s"]), _DECIMALS): record["timing"]
        for record in log.turn_records
        if isinstance(record.get("timing"), dict)
    }
    timings = [of_turn.get(float(record["t_s"]), {}) for record in log.records]
    for key, meaning in _TIMINGS.items():
        values = [_as_kind(key, "number", timing.get(key)) for timing in timings]
        yield Column(key, "number", meaning, values)


def _as_kind(key: str, kind: Kind, value: Any) -> Any:
    """The value as its kind has it. Raises ValueError for one of another kind."""
    if value is None:
        return None
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    match kind:
        case "text" if isinstance(value, str):
            return value
        case "flag" if isinstance(value, bool):
            return value
        case "number" if is_number:
            return float(value)
        case "integer" if is_number and value == int(value):
            return int(value)
    raise ValueError(f"{key}: a {kind} is needed, found {value!r:.40}")
