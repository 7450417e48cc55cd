"""One record, one line: compact JSON that is the same bytes for the same values."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from enum import Enum
from pathlib import PurePath
from typing import Any

import numpy as np

DECIMALS = 6


def to_plain(value: Any) -> Any:
    """JSON's own types: numbers rounded to `DECIMALS`, NaN and infinities as None.

    Raises TypeError for a value that has no place in a log.
    """
    if type(value) is float:  # nearly all of a record, and a match is slow
        return round(value, DECIMALS) + 0.0 if math.isfinite(value) else None
    match value:
        case None | bool() | str():
            return value
        case Enum():
            return to_plain(value.value)
        case float() | np.floating():
            number = float(value)
            return round(number, DECIMALS) + 0.0 if math.isfinite(number) else None
        case np.bool_():
            return bool(value)
        case int() | np.integer():
            return int(value)
        case np.ndarray():
            return to_plain(value.tolist())
        case Mapping():
            return {str(k): to_plain(v) for k, v in value.items()}
        case list() | tuple():
            return [to_plain(v) for v in value]
        case PurePath():
            return str(value)
    raise TypeError(f"{type(value).__name__} cannot be written into a flight log")


def encode(record: Mapping[str, Any]) -> bytes:
    """The record as one line, keys in the record's own order, ended by a newline.

    Top-level keys whose value is None are left out.
    """
    return json_line({k: v for k, v in to_plain(record).items() if v is not None})


def json_line(plain: Mapping[str, Any]) -> bytes:
    """JSON's own types as one line; no number is rounded."""
    text = json.dumps(plain, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.encode("utf-8", errors="backslashreplace") + b"\n"


def decode_line(line: bytes) -> dict[str, Any]:
    """Inverse of `encode`; ValueError for anything that is not one JSON object."""
    try:
        record = json.loads(line.decode("utf-8"), parse_constant=_refuse_constant)
    except RecursionError:
        raise ValueError("nested too deep") from None
    if not isinstance(record, dict):
        raise ValueError("not a JSON object")
    return record


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")
