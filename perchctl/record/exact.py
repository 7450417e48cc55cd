"""Values as JSON, and back to the same bits: what a replay rests on.

`to_exact` and `from_exact` follow the fields of the frozen dataclasses themselves; there is no
list of keys. A float is written by its shortest text that reads back to the same one, infinities
and NaN as ``"inf"``, ``"-inf"``, ``"nan"``; a row of float64 as a list, any other array with its
type and shape; an enum by its value; where a field takes one of several dataclasses, such as a
command, the class's name stands before it. None is left out where it is the field's default.
A field of type Any holds JSON's own types and comes back as them.

`to_plain` rounds, for people and plots; `encode` makes one line of a record, the same bytes for
the same values.
"""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from collections.abc import Callable, Mapping
from enum import Enum
from functools import cache
from pathlib import Path, PurePath
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")
_Plan = Callable[[Any], Any]
_NOT_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


def to_exact(value: Any) -> Any:
    """Return JSON's own types, from which `from_exact` makes the same value.

    Raises TypeError for what has no exact form.
    """
    write = _WRITERS.get(type(value))
    if write is None:
        write = _WRITERS[type(value)] = _writer_for(type(value))
    return write(value)


def from_exact(kind: type[T], data: Any) -> T:
    """Return the value of `kind` that `to_exact` wrote. A field that is missing has its default.

    Raises ValueError, with the way to it, for data that is none.
    """
    return typing.cast(T, _decoder(typing.cast(Any, kind))(data))


# --- out ----------------------------------------------------------------------------


def _as_it_is(value: Any) -> Any:
    return value


def _float_to(value: float) -> float | str:
    value = float(value)
    return value if math.isfinite(value) else repr(value)


def _list_to(value: Any) -> list[Any]:
    return [to_exact(v) for v in value]


def _dict_to(value: dict[Any, Any]) -> Any:
    if all(type(key) is str for key in value):
        return {key: to_exact(v) for key, v in value.items()}
    return [[to_exact(key), to_exact(v)] for key, v in value.items()]


def _array_to(array: Any) -> Any:
    array = np.asarray(array)
    flat = _list_to(array.ravel().tolist())
    if array.dtype == np.float64 and array.ndim == 1:
        return flat
    if array.dtype.kind not in "fiub":
        raise TypeError(f"an array of {array.dtype} has no exact form in a flight log")
    return {"dtype": array.dtype.str, "shape": list(array.shape), "data": flat}


def _fields_writer(kind: Any) -> _Plan:
    hints = typing.get_type_hints(kind)
    plan = [
        (field.name, field.default is None, len(_classes_in(hints[field.name])) > 1)
        for field in dataclasses.fields(kind)
    ]

    def write(value: Any) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, left_out, named in plan:
            part = getattr(value, name)
            if part is None:
                if not left_out:
                    found[name] = None
            else:
                exact = to_exact(part)
                found[name] = [type(part).__name__, exact] if named else exact
        return found

    return write


_WRITERS: dict[type, _Plan] = {
    type(None): _as_it_is,
    bool: _as_it_is,
    int: _as_it_is,
    str: _as_it_is,
    float: _float_to,
    np.float64: _float_to,
    np.ndarray: _array_to,
    list: _list_to,
    tuple: _list_to,
    dict: _dict_to,
}


def _writer_for(kind: Any) -> _Plan:
    if issubclass(kind, Enum):
        return lambda value: to_exact(value.value)
    if dataclasses.is_dataclass(kind):
        return _fields_writer(kind)
    if issubclass(kind, np.generic):
        return _array_to
    if issubclass(kind, PurePath):
        return str
    raise TypeError(f"{kind.__name__} has no exact form in a flight log")


def _classes_in(hint: Any) -> list[Any]:
    """Return the dataclasses that a field may hold."""
    return [part for part in _members(hint) if dataclasses.is_dataclass(part)]


def _members(hint: Any) -> tuple[Any, ...]:
    """Return the members of a union; of any other type itself."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return typing.get_args(hint)
    return (hint,)


# --- back ---------------------------------------------------------------------------


@cache
def _decoder(hint: Any) -> _Plan:
    members = [part for part in _members(hint) if part is not type(None)]
    if len(members) < len(_members(hint)):
        inner = _decoder_of(members)
        return lambda data: None if data is None else inner(data)
    return _decoder_of(members)


def _decoder_of(members: list[Any]) -> _Plan:
    if len(members) > 1:
        by_name = {part.__name__: _decoder(part) for part in members}
        return lambda data: _named_from(data, by_name)
    hint = members[0]
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is np.ndarray:
        return _array_from
    if origin is typing.Literal:
        return lambda data: _one_of(data, args)
    if origin is tuple:
        return _tuple_decoder(args)
    if origin is dict:
        return _dict_decoder(*args)
    if dataclasses.is_dataclass(hint):
        return _dataclass_decoder(typing.cast(type, hint))
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint
    if hint in (bool, int, float, str):
        return lambda data: _plain_from(data, hint)
    if hint is Path:
        return lambda data: Path(_plain_from(data, str))
    if hint is Any:
        return _as_it_is
    raise TypeError(f"{hint} has no exact form in a flight log")


def _named_from(data: Any, by_name: dict[str, _Plan]) -> Any:
    if not isinstance(data, list) or len(data) != 2 or data[0] not in by_name:
        raise ValueError(f"one of {', '.join(by_name)} is needed")
    return by_name[data[0]](data[1])


def _one_of(data: Any, allowed: tuple[Any, ...]) -> Any:
    if data not in allowed:
        raise ValueError(f"{data!r} is none of {', '.join(map(str, allowed))}")
    return data


def _plain_from(data: Any, kind: type) -> Any:
    if isinstance(data, dict) and kind is not str:  # a number of numpy's
        return _array_from(data)[()]
    if kind is float:
        if isinstance(data, str) and data in _NOT_FINITE:
            return _NOT_FINITE[data]
        kinds: tuple[type, ...] = (float, int)
    else:
        kinds = (kind,)
    if not isinstance(data, kinds) or (isinstance(data, bool) and kind is not bool):
        raise ValueError(f"{kind.__name__} is needed, found {data!r:.60}")
    return data


def _array_from(data: Any) -> Any:
    if isinstance(data, list):
        return np.array([_plain_from(v, float) for v in data], dtype=np.float64)
    if not isinstance(data, dict) or {*data} != {"dtype", "shape", "data"}:
        raise ValueError(f"an array is needed, found {data!r:.60}")
    try:
        dtype = np.dtype(data["dtype"])
        flat = [_NOT_FINITE.get(v, v) if isinstance(v, str) else v for v in data["data"]]
        return np.array(flat, dtype=dtype).reshape(data["shape"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"no array: {error}") from None


def _tuple_decoder(args: tuple[Any, ...]) -> _Plan:
    endless = len(args) == 2 and args[1] is Ellipsis
    plans = [_decoder(part) for part in (args[:1] if endless else args)]

    def decode(data: Any) -> tuple[Any, ...]:
        if not isinstance(data, list) or not (endless or len(data) == len(plans)):
            raise ValueError(f"a list is needed, found {data!r:.60}")
        if endless:
            return tuple(plans[0](v) for v in data)
        return tuple(plan(v) for plan, v in zip(plans, data, strict=True))

    return decode


def _dict_decoder(key_hint: Any, value_hint: Any) -> _Plan:
    key_of, value_of = _decoder(key_hint), _decoder(value_hint)

    def decode(data: Any) -> dict[Any, Any]:
        pairs = data.items() if isinstance(data, dict) else data
        if not isinstance(data, (dict, list)):
            raise ValueError(f"keys and values are needed, found {data!r:.60}")
        return {key_of(key): value_of(value) for key, value in pairs}

    return decode


def _dataclass_decoder(kind: type) -> _Plan:
    hints = typing.get_type_hints(kind)
    plans = {field.name: _decoder(hints[field.name]) for field in dataclasses.fields(kind)}

    def decode(data: Any) -> Any:
        if not isinstance(data, dict):
            raise ValueError(f"{kind.__name__} is needed, found {data!r:.60}")
        values = {}
        for name, part in data.items():
            if name not in plans:
                raise ValueError(f"{kind.__name__} has no field {name}")
            try:
                values[name] = plans[name](part)
            except (ValueError, TypeError) as error:
                raise ValueError(f"{name}: {error}") from None
        try:
            return kind(**values)
        except TypeError as error:
            raise ValueError(str(error)) from None

    return decode


# --- rounded, and as lines ------------------------------------------------------------

DECIMALS = 6


def to_plain(value: Any) -> Any:
    """Return JSON's own types: numbers rounded to `DECIMALS`, NaN and infinities as None.

    Raises TypeError for a value that has no place in a log.
    """
    if isinstance(value, float):  # nearly all of a record
        return round(float(value), DECIMALS) + 0.0 if math.isfinite(value) else None
    if isinstance(value, Enum):
        return to_plain(value.value)
    if value is None or isinstance(value, (bool, str, int)):
        return value
    if isinstance(value, (np.ndarray, np.generic)):
        return to_plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain(v) for v in value]
    if isinstance(value, PurePath):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be written into a flight log")


def encode(record: Mapping[str, Any]) -> bytes:
    """Return the record as one line, keys in the record's own order, ended by a newline.

    Top-level keys whose value is None are left out.
    """
    return json_line({k: v for k, v in to_plain(record).items() if v is not None})


def json_line(plain: Mapping[str, Any]) -> bytes:
    """Return JSON's own types as one line of UTF-8 with its newline; no number is rounded."""
    text = json.dumps(plain, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.encode("utf-8", errors="backslashreplace") + b"\n"


def decode_line(line: bytes) -> dict[str, Any]:
    """Return the record of a line. Raises ValueError for anything that is not one JSON object."""
    try:
        record = json.loads(line.decode("utf-8"), parse_constant=_refuse_constant)
    except RecursionError:
        raise ValueError("nested too deep") from None
    if not isinstance(record, dict):
        raise ValueError("not a JSON object")
    return record


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")
