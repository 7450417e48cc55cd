"""Descriptions of a profile's keys: path, unit, default, allowed values and meaning.

The table in docs/profiles.md, commented YAML files and the schema for editors are made from them.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import yaml
from pydantic import BaseModel

from perchctl.profile.base import UNITS as UNITS
from perchctl.profile.base import key_unit
from perchctl.profile.schema import Profile


@dataclass(frozen=True)
class Key:
    """One key of the profile, such as ``camera.latency_s`` (its `path`).

    `meaning` is the schema's description, with backticks around literals. `allowed` is the bounds
    or choices, in words. `default` is the value in the section given to `keys`.
    """

    path: str
    unit: str
    meaning: str
    allowed: str
    default: Any


def keys(section: BaseModel, prefix: str = "") -> Iterator[Key]:
    """Yield every key below a section of a profile, except sections, with its value, in the order
    of the schema."""
    properties = _properties(type(section))
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            yield from keys(value, f"{prefix}{name}.")
        else:
            schema, path = properties[name], f"{prefix}{name}"
            meaning = str(schema.get("description", ""))
            yield Key(path, key_unit(path), meaning, _allowed(schema), value)


def key_bounds(path: str) -> tuple[float, float]:
    """Return the smallest and the largest allowed value of a key, or of each number in its list;
    infinite where the key has no bound."""
    section: BaseModel = Profile()
    *sections, name = path.split(".")
    for each in sections:
        section = getattr(section, each)
    schema = _properties(type(section))[name]
    for kind in schema.get("anyOf", [schema]):
        number = kind.get("prefixItems", [kind])[0]
        if number.get("type") in ("number", "integer"):
            low = number.get("minimum", number.get("exclusiveMinimum", -math.inf))
            high = number.get("maximum", number.get("exclusiveMaximum", math.inf))
            return float(low), float(high)
    return -math.inf, math.inf


@cache
def _properties(section: type[BaseModel]) -> dict[str, Any]:
    """Return the properties of a section's JSON schema, which takes 1 to 40 ms to make."""
    properties: dict[str, Any] = section.model_json_schema()["properties"]
    return properties


def _allowed(schema: dict[str, Any]) -> str:
    kinds = schema.get("anyOf", [schema])
    texts = [_allowed_of(kind) for kind in kinds if kind.get("type") != "null"]
    return ", or ".join([*texts, *(["none"] if len(texts) < len(kinds) else [])])


def _allowed_of(kind: dict[str, Any]) -> str:
    choices = kind.get("enum", [kind["const"]] if "const" in kind else [])
    if choices:
        return ", ".join(f"`{choice}`" for choice in choices)
    match kind.get("type"):
        case "array" if "prefixItems" in kind:
            parts = kind["prefixItems"]
            text = "lowest, highest" if kind.get("ordered") else f"{len(parts)} numbers"
            span = _span(parts[0])
            return f"{text}, each {span}" if span else text
        case "array":
            return f"any number of items, each {_allowed_of(kind['items'])}"
        case "object":
            return "name: number"
        case "boolean":
            return "true, false"
        case "string":
            return "YYYY-MM-DD" if kind.get("format") == "date" else "text"
    return _span(kind)


def _span(number: dict[str, Any]) -> str:
    above, below = number.get("exclusiveMinimum"), number.get("exclusiveMaximum")
    least, most = number.get("minimum"), number.get("maximum")
    if least is None and above is None:
        return ""
    low = f"{least:g}" if least is not None else f"above {above:g}"
    if most is not None:
        return f"{low} to {most:g}"
    if below is not None:
        return f"{low}, below {below:g}"
    return low if least is None else f"at least {low}"


# --- A profile as a commented file ---

_WIDTH = 80


def profile_text(profile: Profile, paths: Collection[str] | None = None) -> str:
    """The keys of a profile as YAML, each below a comment with its meaning, unit and allowed
    values.

    When the text is read back, the keys have the same values. `paths`: dotted paths of the keys to
    include; None: all.
    """
    lines: list[str] = []
    before: list[str] = []
    for key in keys(profile):
        if paths is not None and key.path not in paths:
            continue
        *sections, name = key.path.split(".")
        same = next(
            (n for n, pair in enumerate(zip(sections, before, strict=False)) if pair[0] != pair[1]),
            min(len(sections), len(before)),
        )
        for depth in range(same, len(sections)):
            if depth == 0 and lines:
                lines.append("")
            lines.append(f"{'  ' * depth}{sections[depth]}:")
        before = sections
        margin = "  " * len(sections)
        lines += textwrap.wrap(
            _comment(key),
            _WIDTH,
            initial_indent=f"{margin}# ",
            subsequent_indent=f"{margin}# ",
            break_long_words=False,
            break_on_hyphens=False,
        )
        lines.append(f"{margin}{name}: {yaml_scalar(key.default)}")
    return "\n".join(lines) + "\n"


def _comment(key: Key) -> str:
    choices = key.allowed.replace("`", "")
    limits = ", ".join(part for part in (key.unit, choices) if part not in ("", "text"))
    meaning = key.meaning.replace("`", "")
    return f"{meaning} ({limits})" if limits else meaning


def yaml_scalar(value: Any) -> str:
    """The value as YAML, on one line."""
    plain = list(value) if isinstance(value, tuple) else value
    text: str = yaml.safe_dump([plain], default_flow_style=True, width=10**9, allow_unicode=True)
    return text.strip()[1:-1]


def json_schema() -> dict[str, Any]:
    """The JSON schema for profile files: types, bounds, defaults, meanings and units."""
    schema = Profile.model_json_schema()
    for section in (schema, *schema["$defs"].values()):
        section.pop("title", None)
        # a profile that extends another one contains only some of the keys
        section.pop("required", None)
        for name, field in section["properties"].items():
            field.pop("title", None)
            field.pop("ordered", None)
            unit = key_unit(name)
            if unit and "description" in field:
                field["description"] += f" ({unit})"
    extends = {
        "type": "string",
        "description": "name or path of the profile that supplies all other keys",
    }
    schema["properties"] = {"extends": extends, **schema["properties"]}
    return {"title": "perchctl profile", **schema}
