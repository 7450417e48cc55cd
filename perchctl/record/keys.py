"""The names in a log's turns that differ from those in the program.

A turn is written field by field. So that a field or dataclass may be renamed while logs stay
readable, both ways, the log keeps the names that it has had from the start.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache

CLASS_KEYS: dict[str, str] = {}
"""The name of a dataclass in the log's ``turn_fields``, by its name in the program."""
FIELD_KEYS: dict[str, dict[str, str]] = {}
"""The key of a field in the log, by the names of its dataclass and of itself in the program."""


@dataclass(frozen=True)
class LogNames:
    """The names by which a log knows a dataclass: its own, and the key of each field by the field's
    name in the program."""

    owner: str
    keys: dict[str, str]


@cache
def log_names(kind: type) -> LogNames:
    """Return the names by which a log knows a dataclass and its fields."""
    keys = FIELD_KEYS.get(kind.__name__, {})
    names = (each.name for each in dataclasses.fields(kind))
    owner = CLASS_KEYS.get(kind.__name__, kind.__name__)
    return LogNames(owner, {name: keys.get(name, name) for name in names})
