"""A profile as a commented YAML file, and the schema by which an editor completes one."""

from __future__ import annotations

import textwrap
from collections.abc import Collection
from typing import Any

import yaml

from perchctl.profile.keys import Key, allowed, key_unit, keys
from perchctl.profile.schema import Profile

_WIDTH = 80


def profile_text(profile: Profile, paths: Collection[str] | None = None) -> str:
    """Keys of a profile, each under a comment with its meaning, unit and what is allowed.

    Read back, the keys have the same values. `paths` are the dotted paths of the keys that are
    written, by default all.
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
            _comment(key), _WIDTH, initial_indent=f"{margin}# ", subsequent_indent=f"{margin}# ",
            break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
        lines.append(f"{margin}{name}: {scalar_text(key.default)}")
    return "\n".join(lines) + "\n"


def _comment(key: Key) -> str:
    choices = allowed(key.field).replace("`", "")
    limits = ", ".join(part for part in (key.unit, choices) if part not in ("", "text"))
    meaning = key.meaning.replace("`", "")
    return f"{meaning} ({limits})" if limits else meaning


def scalar_text(value: Any) -> str:
    """The value in YAML, on one line."""
    plain = list(value) if isinstance(value, tuple) else value
    text: str = yaml.safe_dump([plain], default_flow_style=True, width=10**9, allow_unicode=True)
    return text.strip()[1:-1]


def editor_schema() -> dict[str, Any]:
    """The JSON schema of a profile's file: types, bounds, defaults, meanings and units."""
    schema = Profile.model_json_schema()
    for section in (schema, *schema["$defs"].values()):
        section.pop("title", None)
        section.pop("required", None)  # a profile that extends another gives some keys only
        for name, field in section["properties"].items():
            field.pop("title", None)
            unit = key_unit(name)
            if unit and "description" in field:
                field["description"] += f" ({unit})"
    extends = {"type": "string", "description": "name or path of the profile that has the rest"}
    schema["properties"] = {"extends": extends, **schema["properties"]}
    return {"title": "perchctl profile", **schema}
