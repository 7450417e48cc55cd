"""What people read about a profile's keys: path, unit, default, what is allowed, what it means.

From here are the table of docs/profiles.md, the comments of a profile that perchctl writes, and
the schema for editors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

BOUNDS = ("ge", "gt", "le", "lt")
UNITS = {
    "acc_g": "g",
    "deg": "deg",
    "dps": "deg/s",
    "g": "g",
    "hz": "Hz",
    "kg": "kg",
    "m": "m",
    "mah": "mAh",
    "m2": "m^2",
    "mb": "MB",
    "mps": "m/s",
    "mps2": "m/s^2",
    "n": "N",
    "ohm": "ohm",
    "per_m": "1/m",
    "per_s": "1/s",
    "px": "px",
    "rad": "rad",
    "radps": "rad/s",
    "radps2": "rad/s^2",
    "s": "s",
    "v": "V",
}
"""A name's last word, and the unit that it stands for."""
UNITS_OF = {
    "k1": "cm^2, deg^2",
    "k2": "cm^2, deg^2",
    "camera_noise_sigma": "grey levels",
}


@dataclass(frozen=True)
class Key:
    """One leaf of the profile's schema."""

    path: str
    field: Any
    default: Any

    @property
    def section(self) -> str:
        """The headings that people read: the first word, and the planner's phases."""
        words = self.path.split(".")
        deep = words[0] == "planner" and len(words) > 2
        return ".".join(words[: 2 if deep else 1]) if len(words) > 1 else ""

    @property
    def unit(self) -> str:
        return key_unit(self.path)

    @property
    def meaning(self) -> str:
        """The schema's own description; backticks around what is typed as it stands."""
        return str(self.field.description or "")


def key_unit(path: str) -> str:
    """By the last of a key's words; empty where it has no unit."""
    name = path.rpartition(".")[2]
    endings = (name.split("_", n)[-1] for n in range(1, name.count("_") + 1))
    return UNITS_OF.get(name) or next((UNITS[e] for e in endings if e in UNITS), "")


def keys(section: BaseModel, prefix: str = "") -> Iterator[Key]:
    """Every leaf below a section of the default profile, in the schema's order."""
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            yield from keys(value, f"{prefix}{name}.")
        else:
            yield Key(prefix + name, field, value)


def allowed(field: Any) -> str:
    """The bounds or choices of a field, in words."""
    kinds = _alternatives(field.annotation)
    texts = [_allowed_of(kind, field.metadata) for kind in kinds if kind is not type(None)]
    return ", or ".join([*texts, *(["none"] if type(None) in kinds else [])])


def _alternatives(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)


def _allowed_of(kind: Any, metadata: Iterable[Any]) -> str:
    """Of one of a field's kinds; `metadata` is of the field, or of the kind alone."""
    if get_origin(kind) is Annotated:
        inner, *notes = get_args(kind)
        each = (m for note in notes for m in getattr(note, "metadata", (note,)))
        return _allowed_of(inner, tuple(each))
    if get_origin(kind) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(kind))
    if bounds := _bounds(metadata):
        return _span(bounds)
    if get_origin(kind) is tuple and Ellipsis in get_args(kind):
        return f"any number, each of {_allowed_of(get_args(kind)[0], ())}"
    if get_origin(kind) is tuple:
        ordered = any(type(m).__name__ == "AfterValidator" for m in metadata)
        text = "lowest, highest" if ordered else f"{len(get_args(kind))} numbers"
        for each in getattr(get_args(kind)[0], "__metadata__", ()):
            text += f", each {_span(_bounds(each.metadata))}"
        return text
    if get_origin(kind) is dict:
        return "name: number"
    return {"bool": "true, false", "str": "text", "date": "YYYY-MM-DD"}.get(kind.__name__, "")


def _bounds(metadata: Iterable[Any]) -> dict[str, float]:
    """``ge``, ``gt``, ``le`` and ``lt``, as far as they are given."""
    found = ((name, getattr(m, name, None)) for m in metadata for name in BOUNDS)
    return {name: value for name, value in found if value is not None}


def _span(bounds: dict[str, float]) -> str:
    low = f"{bounds['ge']:g}" if "ge" in bounds else f"above {bounds['gt']:g}"
    if "le" in bounds:
        return f"{low} to {bounds['le']:g}"
    if "lt" in bounds:
        return f"{low}, below {bounds['lt']:g}"
    return low if "gt" in bounds else f"at least {low}"
