"""A flight as comma-separated values."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from io import StringIO
from typing import Any

from perchctl.log.export.table import Column


def csv_text(columns: Sequence[Column]) -> str:
    """A line of names, then a line each row; a missing value is empty, a flag 0 or 1."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in columns])
    writer.writerows(zip(*([_cell(v) for v in column.values] for column in columns), strict=True))
    return text.getvalue()


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    return int(value) if isinstance(value, bool) else value
