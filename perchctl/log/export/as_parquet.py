"""A flight as an Apache Parquet file. Needs the extra ``parquet``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from io import BytesIO

from perchctl.errors import no_parquet
from perchctl.log.export.table import Column, Kind
from perchctl.log.read import FlightLog


def check_parquet() -> None:
    """Before any long work. Errors: UsageError where the library is not installed."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise no_parquet() from None


def parquet_bytes(log: FlightLog, columns: Sequence[Column]) -> bytes:
    """The table, each column's unit and meaning, and the log's header and summary as JSON under
    ``perchctl.header`` and ``perchctl.summary``. Errors: UsageError without the library."""
    check_parquet()
    import pyarrow as pa
    import pyarrow.parquet as pq

    types: dict[Kind, pa.DataType] = {
        "number": pa.float64(),
        "integer": pa.int64(),
        "flag": pa.bool_(),
        "text": pa.string(),
    }
    fields = [
        pa.field(c.name, types[c.kind], metadata={"unit": c.unit, "meaning": c.meaning})
        for c in columns
    ]
    about = {
        "perchctl.header": json.dumps(log.header),
        "perchctl.summary": json.dumps(log.summary),
    }
    arrays = [
        pa.array(column.values, type=field.type)
        for column, field in zip(columns, fields, strict=True)
    ]
    table = pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=about))
    content = BytesIO()
    pq.write_table(table, content, compression="zstd")
    return content.getvalue()
