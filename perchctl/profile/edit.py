"""Numbers written into a profile's file, and nothing else of it touched: comments, order and
layout stay as they are."""

from __future__ import annotations

import copy
import itertools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from perchctl.errors import InvalidValue, PerchError
from perchctl.files import check_place, mode_of, write_files
from perchctl.profile.load import check_profile, find_profile
from perchctl.profile.old_keys import RENAMED, with_present_keys
from perchctl.profile.places import data_folder
from perchctl.profile.plain_yaml import parse_yaml

Value = float | int | str | tuple[float, ...]

_DECIMALS = 6
_STEP = "  "


def writable_profile(name: str) -> Path:
    """The file of a profile that belongs to the user, behind any links.

    Raises:
        NotFound: no such profile.
        InvalidValue: it is one that is shipped, or may not be written.
    """
    path = find_profile(name).resolve()
    if path.is_relative_to(data_folder("profiles").resolve()):
        raise InvalidValue(
            f"{path} is shipped with perchctl and is not written to: copy it (cp {path} "
            f"my_{path.name}), and name the copy (-p my_{path.name})"
        )
    check_place(path, force=True)
    if not os.access(path, os.W_OK):
        raise InvalidValue(
            f"{path} is read-only and is not written to: allow it (chmod u+w {path}), or name a "
            f"copy (-p)"
        )
    return path


def write_profile_values(path: Path, values: Mapping[str, Value]) -> Path:
    """Put the values into the file, by their dotted keys; returns the file that keeps the old
    text, beside it, for the same eyes only.

    Raises:
        InvalidValue: the layout does not allow it, the profile would not load with them, or the
        file cannot be written; nothing is changed then.
    """
    by_hand = f"write them yourself: {_listed(values)}"
    try:
        old, mode = path.read_bytes().decode(), mode_of(path)
        new = with_values(old, values)
    except (OSError, ValueError) as error:
        raise InvalidValue(f"{path}: {error}: {by_hand}") from None
    try:
        check_profile(path, new)
    except PerchError as error:
        raise InvalidValue(
            f"with these numbers the profile would not load, and it is left as it was: {error}; "
            f"mend what does not fit, then {by_hand}"
        ) from None
    aside = _free_name(path)
    write_files({aside: old.encode(), path: new.encode()}, mode)
    return aside


def with_values(text: str, values: Mapping[str, Value]) -> str:
    """The text of a profile with the values under their dotted keys, as in ``camera.latency_s``.

    A number, or each of a list, is replaced where it stands; a key that is missing is put under
    its section, a section at the end.

    Raises:
        ValueError: the layout does not allow it without a change of something else.
    """
    new = text
    for dotted, value in values.items():
        new = _with_value(new, dotted.split("."), value)
    wanted = copy.deepcopy(_values_of(text))
    for dotted, value in values.items():
        *sections, key = dotted.split(".")
        place = wanted
        for section in sections:
            place = place.setdefault(section, {})
        place[key] = list(value) if isinstance(value, tuple) else value
    try:
        written = _values_of(new)
    except ValueError:
        written = {}
    if _rounded(written) != _rounded(wanted):
        raise ValueError("the numbers do not fit into this file's layout")
    return new


def _with_value(text: str, keys: list[str], value: Value) -> str:
    node = yaml.compose(text, yaml.SafeLoader)
    if not isinstance(node, yaml.MappingNode):
        raise ValueError("holds no keys and values")
    above: yaml.Node | None = None
    for depth, name in enumerate(keys):
        found = _child(node, keys[:depth], name)
        if found is None:
            return _inserted(text, node, above, keys[depth:], value)
        above, inner = found
        if depth == len(keys) - 1:
            return _replaced(text, inner, value)
        if not isinstance(inner, yaml.MappingNode):
            break
        node = inner
    raise ValueError(f"{'.'.join(keys[:-1])} holds no keys and values")


def _child(
    node: yaml.MappingNode, sections: list[str], name: str
) -> tuple[yaml.Node, yaml.Node] | None:
    """Key and value of that name, or of its name in earlier versions."""
    names = {name}
    for old, present in RENAMED.items():
        *place, former = old.split(".")
        if present == name and place == sections:
            names.add(former)
    return next(((k, v) for k, v in node.value if k.value in names), None)


def _replaced(text: str, node: yaml.Node, value: Value) -> str:
    if (
        isinstance(node, yaml.SequenceNode)
        and isinstance(value, tuple)
        and len(node.value) == len(value)
    ):
        for part, number in reversed(list(zip(node.value, value, strict=True))):
            text = _put(text, part, _number(number))
        return text
    return _put(text, node, _flow(value))


def _put(text: str, node: yaml.Node, new: str) -> str:
    return text[: node.start_mark.index] + new + text[node.end_mark.index :]


def _inserted(
    text: str, node: yaml.MappingNode, above: yaml.Node | None, keys: list[str], value: Value
) -> str:
    """Below the line of the section's own key, so that what stands above the first of its keys,
    as a comment does, stays there; in braces at their beginning; at the end of the file."""
    if node.flow_style:
        new = f"{keys[-1]}: {_flow(value)}"
        for key in reversed(keys[:-1]):
            new = f"{key}: {{{new}}}"
        at = text.index("{", node.start_mark.index) + 1
        return text[:at] + new + (", " if node.value else "") + text[at:]
    end = "\r\n" if "\r\n" in text else "\n"
    indent = " " * node.value[0][0].start_mark.column
    lines = [f"{indent}{_STEP * depth}{key}:" for depth, key in enumerate(keys)]
    block = end.join(lines) + f" {_flow(value)}{end}"
    if above is None:
        gap = "" if text.endswith("\n") else end
        return f"{text}{gap}{end}{block}"
    at = text.index("\n", above.end_mark.index) + 1
    return text[:at] + block + text[at:]


def _flow(value: Value) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_number, value))}]"
    return _number(value) if isinstance(value, float) else str(value)


def _number(value: float) -> str:
    """With a point and without an exponent, which YAML would read as text."""
    whole, _, part = f"{round(value, _DECIMALS) + 0.0:.{_DECIMALS}f}".partition(".")
    return f"{whole}.{part.rstrip('0') or '0'}"


def _values_of(text: str) -> dict[str, Any]:
    values = parse_yaml(text)
    if not isinstance(values, dict):
        raise ValueError("holds no keys and values")
    return with_present_keys(values)[0]


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_rounded(inner) for inner in value]
    return round(value, _DECIMALS) if isinstance(value, float) else value


def _listed(values: Mapping[str, Value]) -> str:
    return ", ".join(f"{dotted}: {_flow(value)}" for dotted, value in values.items())


def _free_name(path: Path) -> Path:
    numbers = itertools.chain([""], map(str, itertools.count(2)))
    names = (path.with_name(f"{path.name}.bak{number}") for number in numbers)
    return next(name for name in names if not name.exists())
