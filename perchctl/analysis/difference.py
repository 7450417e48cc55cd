"""Whether two values are the same to the bit, and in which field they first are not."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from perchctl.log import to_exact


@dataclass(frozen=True)
class Difference:
    """The first of a replay.

    `tick` counts the turns from take-off from 0, as the log's ticks do; of a turn before that
    it is negative. `t_s`: since the log began. `recorded`, `replayed`: as JSON has them.
    """

    tick: int
    t_s: float
    field: str
    recorded: Any
    replayed: Any


def first_differing(name: str, one: Any, other: Any) -> tuple[str, Any, Any] | None:
    """The field's whole name, and both values in their exact form; None where nothing differs."""
    if same(one, other):
        return None
    parts: list[tuple[str, Any, Any]] = []
    if dataclasses.is_dataclass(one) and type(one) is type(other):
        names = [f.name for f in dataclasses.fields(one)]
        parts = [(f"{name}.{n}", getattr(one, n), getattr(other, n)) for n in names]
    elif isinstance(one, dict) and isinstance(other, dict):
        keys = [*one, *(key for key in other if key not in one)]
        parts = [(f"{name}.{_key(k)}", one.get(k), other.get(k)) for k in keys]
    elif _is_row(one) and _is_row(other) and len(one) == len(other):
        pairs = zip(one, other, strict=True)
        parts = [(f"{name}[{k}]", a, b) for k, (a, b) in enumerate(pairs)]
    within = next((d for part in parts if (d := first_differing(*part)) is not None), None)
    return within or (name, _shown(one), _shown(other))


def same(one: Any, other: Any) -> bool:
    """To the bit: 0.0 is not -0.0, and NaN is NaN. Two commands without a field are two."""
    if dataclasses.is_dataclass(one) and type(one) is not type(other):
        return False
    return json.dumps(to_exact(one)) == json.dumps(to_exact(other))


def _is_row(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.ndim > 0
    return isinstance(value, (list, tuple))


def _key(key: Any) -> str:
    return str(getattr(key, "value", key))


def _shown(value: Any) -> Any:
    exact = to_exact(value)
    if dataclasses.is_dataclass(value):  # which of several is the difference
        return {type(value).__name__: exact}
    return exact
