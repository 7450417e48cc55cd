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
from perchctl.log.fields import FIELDS, Kind, field_kind
from perchctl.log.read import FlightLog
from perchctl.profile import key_unit

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
        cells = ([_cell(value) for value in column.values] for column in self.columns)
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
        arrays = [
            pa.array(column.values, type=field.type)
            for column, field in zip(self.columns, fields, strict=True)
        ]
        table = pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=about))
        content = BytesIO()
        pq.write_table(table, content, compression="zstd")
        return content.getvalue()


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    return int(value) if isinstance(value, bool) else value


def log_table(log: FlightLog) -> LogTable:
    """`t_s` first, from 0; then the log's fields in their order, with lists flattened, what
    happened in words, and how long the parts of the turn took.

    Errors: InvalidValue for a log without ticks, and for a value that is none of its field's.
    """
    if not log.records:
        raise InvalidValue(f"{log.path}: the log holds no ticks, there is nothing to export")
    found: list[Column] = []
    for key in dict.fromkeys((*FIELDS, *(key for record in log.records for key in record))):
        found += _of_field(log, key)
    return LogTable(log, [*found, _events(log), *_timings(log)])


def _of_field(log: FlightLog, key: str) -> Iterator[Column]:
    values = [record.get(key) for record in log.records]
    meaning = FIELDS.get(key) or str(_header_fields(log).get(key, ""))
    if key in _TIMES:
        meaning = meaning.replace("on the loop's clock", "since the flight's first turn")
        values = [None if v is None else _since(log, key, v) for v in values]
    if key in FIELDS and field_kind(key) == "corners":
        yield from _corners(log, key, meaning, values)
        return
    kind = _kind(key, values)
    yield Column(key, kind, meaning, [_checked(log, key, kind, value) for value in values])


def _corners(log: FlightLog, key: str, meaning: str, values: list[Any]) -> Iterator[Column]:
    for value in values:
        if value is not None and not (isinstance(value, list) and len(value) == len(_CORNERS)):
            raise _wrong(log, key, value, f"{len(_CORNERS)} numbers")
    marker = key.removesuffix("_px")
    for i, corner in enumerate(_CORNERS):
        name = f"{marker}_{corner}_px"
        one = [None if v is None else _checked(log, key, "number", v[i]) for v in values]
        yield Column(name, "number", f"{meaning}: {corner.replace('_', ' ')}", one)


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
        values = [_checked(log, key, "number", timing.get(key)) for timing in timings]
        yield Column(key, "number", meaning, values)


def _kind(key: str, values: list[Any]) -> Kind:
    if key in FIELDS:
        return field_kind(key)
    known = [value for value in values if value is not None]
    numbers = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in known)
    return "number" if numbers else "text"


def _checked(log: FlightLog, key: str, kind: Kind, value: Any) -> Any:
    """The value as its kind has it."""
    if value is None:
        return None
    match kind:
        case "text":
            return value if isinstance(value, str) else json.dumps(value)
        case "flag":
            if not isinstance(value, bool):
                raise _wrong(log, key, value, "true or false")
            return value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _wrong(log, key, value, "a number")
    if kind == "integer":
        if value != int(value):
            raise _wrong(log, key, value, "a whole number")
        return int(value)
    return float(value)


def _since(log: FlightLog, key: str, value: Any) -> float:
    number: float = _checked(log, key, "number", value)
    return round(log.since(number), _DECIMALS) + 0.0


def _header_fields(log: FlightLog) -> dict[str, Any]:
    fields = log.header.get("fields")
    return fields if isinstance(fields, dict) else {}


def _wrong(log: FlightLog, key: str, value: Any, allowed: str) -> InvalidValue:
    found = json.dumps(value)
    shown = found if len(found) <= 40 else f"{found[:37]}..."
    return InvalidValue(
        f"{log.path}: {key} must be {allowed}, found {shown}: the file is damaged, take the "
        f"original"
    )
