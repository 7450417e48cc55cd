"""Convert values to JSON and back bit for bit, as a replay requires.

A float is written as the shortest text that reads back as the same float; infinities and NaN are
written as ``"inf"``, ``"-inf"``, ``"nan"``. A one-dimensional float64 array becomes a list, and any
other array is written with its type and shape. An enum is written as its value. If a field can
contain one of several dataclasses, such as a command, the class name comes first. None is left out
if it is the field's default.
"""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from collections.abc import Mapping
from enum import Enum
from functools import cache
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np

from perchctl.record.keys import log_names

T = TypeVar("T")
_GONE = {"timing"}  # removed fields, written by version 0.2.0 for flights in real time
_NOT_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
_AS_IT_IS = (bool, int, str)  # types that JSON has as well


def to_exact_json(value: Any) -> Any:
    """Convert a value to JSON types, from which `from_exact_json` restores it exactly.

    Raises TypeError for a value that has no exact form.
    """
    kind = type(value)
    if kind is float:  # first, because nearly all values in a record are floats
        return value if math.isfinite(value) else repr(value)
    if value is None or kind in _AS_IT_IS:
        return value
    if isinstance(value, float):  # includes numpy's float64
        return to_exact_json(float(value))
    if isinstance(value, (list, tuple)):
        return [to_exact_json(v) for v in value]
    if hasattr(kind, "__dataclass_fields__"):
        return _exact_fields(value)
    if isinstance(value, Enum):
        return to_exact_json(value.value)
    if isinstance(value, dict):
        if all(type(key) is str for key in value):
            return {key: to_exact_json(v) for key, v in value.items()}
        return [[to_exact_json(key), to_exact_json(v)] for key, v in value.items()]
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "fiub":
        flat = [to_exact_json(v) for v in value.ravel().tolist()]
        if value.dtype == np.float64 and value.ndim == 1:
            return flat
        return {"dtype": value.dtype.str, "shape": list(value.shape), "data": flat}
    raise TypeError(f"{type(value).__name__} cannot be stored exactly in a flight log")


def _exact_fields(value: Any) -> dict[str, Any]:
    kind: Any = type(value)
    found: dict[str, Any] = {}
    for name, key, default, members in _fields_of(kind):
        part = getattr(value, name)
        if part is None:
            if default is not None:
                found[key] = None
        elif len(members) > 1:
            found[key] = [type(part).__name__, to_exact_json(part)]
        else:
            found[key] = to_exact_json(part)
    return found


@cache
def _fields_of(kind: type) -> list[tuple[str, str, Any, tuple[Any, ...]]]:
    hints, keys = typing.get_type_hints(kind), log_names(kind).keys
    return [
        (f.name, keys[f.name], f.default, _members(hints[f.name])) for f in dataclasses.fields(kind)
    ]


@cache
def _names_by_key(kind: type) -> dict[str, str]:
    return {key: name for name, key, _, _ in _fields_of(kind)}


@cache
def _members(hint: Any) -> tuple[Any, ...]:
    """The members of a union except None; for any other type, the type itself."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return tuple(part for part in typing.get_args(hint) if part is not types.NoneType)
    return (hint,)


@dataclasses.dataclass(frozen=True)
class ExactField:
    """A field of a dataclass at any depth within a type, for example ``observation.imu.t_s``.

    All names are those used in the log (`perchctl.record.keys`).

    Attributes:
        path: the dotted names that lead to the field.
        owner: name of the dataclass to which the field belongs.
        is_always_written: False if `to_exact_json` leaves the field out while it is None.
    """

    path: str
    owner: str
    name: str
    is_always_written: bool


def exact_fields(hint: Any, path: str = "") -> list[ExactField]:
    """Return the fields of all dataclasses that a value of type `hint` can contain, at every depth.

    `path` is the prefix of the dotted names.
    """
    found: list[ExactField] = []
    for kind in _members(hint):
        if not dataclasses.is_dataclass(kind):
            for part in typing.get_args(kind):
                found += exact_fields(part, path)
            continue
        assert isinstance(kind, type)
        for name, key, default, _ in _fields_of(kind):
            within = f"{path}.{key}" if path else key
            found.append(ExactField(within, log_names(kind).owner, key, default is not None))
            found += exact_fields(_hints(kind)[name], within)
    return found


def collect_written_names(hint: Any, data: Any, names: dict[str, set[str]]) -> None:
    """Add the fields that `data` contains to `names`, keyed by dataclass. `data` is JSON from which
    `from_exact_json` makes a value of type `hint`."""
    members = _members(hint)
    if data is None:
        return
    if len(members) > 1:
        class_name, data = data
        members = tuple(kind for kind in members if kind.__name__ == class_name)
    (kind,) = members
    args = typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        assert isinstance(kind, type)
        names.setdefault(log_names(kind).owner, set()).update(data)
        for key, name in _names_by_key(kind).items():
            if key in data:
                collect_written_names(_hints(kind)[name], data[key], names)
    elif typing.get_origin(kind) is tuple:
        kinds = [args[0]] * len(data) if args[-1] is Ellipsis else args
        for each, part in zip(kinds, data, strict=True):
            collect_written_names(each, part, names)
    elif typing.get_origin(kind) is dict:
        for part in data.values() if isinstance(data, dict) else (value for _, value in data):
            collect_written_names(args[1], part, names)


def from_exact_json(kind: type[T], data: Any) -> T:
    """Restore a value of type `kind` written by `to_exact_json`. A missing field gets its default.

    Raises ValueError, naming the field, for data in any other form.
    """
    try:
        return typing.cast(T, _from_exact(kind, data))
    except (TypeError, LookupError, AttributeError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None


def _from_exact(hint: Any, data: Any) -> Any:
    members = _members(hint)
    if members != (hint,) and data is None:
        return None
    if len(members) > 1:
        name, part = data
        return _from_exact({member.__name__: member for member in members}[name], part)
    (kind,) = members
    if kind is Any:
        return data
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is np.ndarray:
        return _array_from(data)
    if origin is typing.Literal:
        return args[args.index(data)]
    if origin is tuple:
        kinds = [args[0]] * len(data) if args[-1] is Ellipsis else args
        return tuple(_from_exact(each, part) for each, part in zip(kinds, data, strict=True))
    if origin is dict:
        pairs = data.items() if isinstance(data, dict) else data
        return {_from_exact(args[0], key): _from_exact(args[1], v) for key, v in pairs}
    if dataclasses.is_dataclass(kind):
        return _dataclass_from(kind, data)
    if issubclass(kind, Enum):
        return kind(data)
    return Path(_plain_from(data, str)) if kind is Path else _plain_from(data, kind)


def _dataclass_from(kind: Any, data: Any) -> Any:
    hints, values, names = _hints(kind), {}, _names_by_key(kind)
    for key, part in data.items():
        if key in _GONE:
            continue
        try:
            values[names[key]] = _from_exact(hints[names[key]], part)
        except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
            raise ValueError(f"{key}: {error}") from None
    return kind(**values)


_hints = cache(typing.get_type_hints)


def _plain_from(data: Any, kind: type) -> Any:
    if isinstance(data, dict):  # a number of a numpy type
        return _array_from(data)[()]
    if kind is float and isinstance(data, str):
        return _NOT_FINITE[data]
    kinds = (float, int) if kind is float else (kind,)
    if type(data) not in kinds:
        raise ValueError(f"{kind.__name__} is needed, found {data!r:.60}")
    return data


def _array_from(data: Any) -> Any:
    if isinstance(data, list):
        return np.array([_plain_from(v, float) for v in data], dtype=np.float64)
    flat = [_NOT_FINITE.get(v, v) if isinstance(v, str) else v for v in data["data"]]
    return np.array(flat, dtype=np.dtype(data["dtype"])).reshape(data["shape"])


# --- Convert to rounded JSON, and encode as lines ---

DECIMALS = 6


def to_rounded_json(value: Any) -> Any:
    """Convert a value to JSON types, with numbers rounded to `DECIMALS`, and NaN and infinities as
    None.

    Raises TypeError for a value that cannot be written to a log.
    """
    if value is None or type(value) is str:
        return value
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):  # first, because nearly all values in a record are floats
        return round(value, DECIMALS) + 0.0 if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): to_rounded_json(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_rounded_json(v) for v in value]
    return to_exact_json(value)


def encode_line(record: Mapping[str, Any]) -> bytes:
    """Encode the record as one JSON line with a newline; numbers are rounded, and keys keep their
    order.

    Top-level keys whose value is None are left out.
    """
    return json_line({k: v for k, v in to_rounded_json(record).items() if v is not None})


_ENCODER = json.JSONEncoder(
    ensure_ascii=False,
    allow_nan=False,
    check_circular=False,  # cycles already fail in the conversion to JSON types
    separators=(",", ":"),
)
"""The encoder of all lines; `json.dumps` would create a new one for each line."""


def json_line(values: Mapping[str, Any]) -> bytes:
    """Encode values of JSON types as one UTF-8 line with a newline, without rounding."""
    return _ENCODER.encode(values).encode("utf-8", errors="backslashreplace") + b"\n"


def decode_line(line: bytes) -> dict[str, Any]:
    """Decode one line of a log to its record. Raises ValueError for anything other than a single
    JSON object."""
    try:
        record = json.loads(line.decode("utf-8"))
    except RecursionError:
        raise ValueError("nested too deep") from None
    if not isinstance(record, dict):
        raise ValueError("not a JSON object")
    return record
