"""Change a profile: some keys of a loaded one, or numbers in its file.

The comments and the order of the file are preserved.
"""

from __future__ import annotations

import copy
import io
import itertools
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import YAMLError

from perchctl.errors import InvalidValue, PerchError
from perchctl.files import check_writable, file_mode, write_files
from perchctl.places import data_folder
from perchctl.plain_yaml import clip_text, parse_yaml
from perchctl.profile.load import check_profile, find_profile
from perchctl.profile.schema import Profile

# --- Keys of a loaded profile ---


def apply_settings(profile: Profile, settings: Iterable[str], option: str = "--set") -> Profile:
    """The profile with each ``key=value`` applied, such as ``planner.align.xy_m=0.03``; values are
    in YAML. `option` is the name of the command-line option in messages; empty if there is none.

    Raises:
        InvalidValue: a setting is not ``key=value``, its key is unknown, or its value is not
            allowed.
    """
    values: dict[str, Any] = {}
    for key, text in [_parsed(setting, option) for setting in settings]:
        try:
            values[key] = parse_yaml(text)
        except ValueError as error:
            setting = f"{option} {clip_text(f'{key}={text}')}".lstrip()
            raise InvalidValue(f"{setting}: {error}") from None
    try:
        return profile.with_(values)
    except InvalidValue as error:
        raise InvalidValue(f"{option}: {error}" if option else str(error)) from None


def _parsed(setting: str, option: str) -> tuple[str, str]:
    """Split ``key=value``, the value of `option`, into key and value. Raises InvalidValue."""
    key, equals, text = setting.partition("=")
    if not equals or not key.strip():
        raise InvalidValue(
            f"{option} {clip_text(setting)} must be KEY=VALUE with a key of the profile, as in "
            f"{option} planner.align.xy_m=0.03"
        )
    return key.strip(), text


def profile_value(profile: Profile, key: str) -> Any:
    """Return the value of a key such as ``camera.latency_s`` in JSON types; None if there is no
    such key."""
    value: Any = profile.model_dump(mode="json")
    for name in key.split("."):
        value = value.get(name) if isinstance(value, dict) else None
    return value


# --- Numbers in a profile's file ---

Value = float | int | str | tuple[float, ...]

_DECIMALS = 6


def writable_profile(name: str) -> Path:
    """Return the path of a user's own profile, with symbolic links resolved.

    Raises NotFound if there is no such profile, and InvalidValue if the profile is shipped with
    perchctl or not writable.
    """
    path = find_profile(name).resolve()
    if path.is_relative_to(data_folder("profiles").resolve()):
        raise InvalidValue(
            f"{path} is shipped with perchctl, so it is not changed: copy it (cp {path} "
            f"my_{path.name}), and name the copy (-p my_{path.name})"
        )
    check_writable(path, force=True)
    if not os.access(path, os.W_OK):
        raise InvalidValue(
            f"{path} is read-only: make it writable (chmod u+w {path}), or name a copy (-p)"
        )
    return path


def write_profile_values(path: Path, values: Mapping[str, Value]) -> Path:
    """Write the values into the file under their dotted keys; return the path of the backup next to
    it, which has the same permissions.

    Raises:
        InvalidValue: the values do not fit into the YAML layout, the profile would not load with
            them, or the file cannot be written. After such an error, the profile's file is
            unchanged.
    """
    listed = ", ".join(f"{dotted}: {_flow(value)}" for dotted, value in values.items())
    by_hand = f"write the values by hand: {listed}"
    try:
        old, mode = path.read_bytes().decode(), file_mode(path)
        new = replace_values(old, values)
    except (OSError, ValueError, YAMLError) as error:
        why = " ".join(str(error).split())
        raise InvalidValue(f"{path}: {why}: {by_hand}") from None
    try:
        check_profile(path, new)
    except PerchError as error:
        raise InvalidValue(
            "with these numbers the profile would be invalid, so it was not changed: "
            f"{error}; correct that, then {by_hand}"
        ) from None
    numbers = itertools.chain([""], map(str, itertools.count(2)))
    names = (path.with_name(f"{path.name}.bak{number}") for number in numbers)
    aside = next(name for name in names if not name.exists())
    write_files({aside: old.encode(), path: new.encode()}, mode)
    return aside


def replace_values(text: str, values: Mapping[str, Value]) -> str:
    """The text of a profile with new values for dotted keys such as ``camera.latency_s``.

    Comments, order and quotation marks are preserved. A list of the same length keeps its layout. A
    missing key is added at the end of its section, and a missing section at the end of the file.

    Raises:
        ValueError: something in `text` that should be a section contains no keys.
    """
    yaml = YAML()
    yaml.preserve_quotes, yaml.width = True, 10**6
    yaml.representer.add_representer(type(None), _as_null)
    document = yaml.load(text)
    wanted = copy.deepcopy(_values_of(text))
    for dotted, value in values.items():
        new = yaml.load(_flow(value))
        sections, key = dotted.split(".")[:-1], dotted.rpartition(".")[2]
        place, plain = document, wanted
        for section in sections:
            place = place.setdefault(section, CommentedMap())
            plain = plain.setdefault(section, {})
            if not isinstance(place, dict):
                raise ValueError(f"{section} has no keys and values")
        old = place.get(key)
        if isinstance(old, list) and isinstance(value, tuple) and len(old) == len(value):
            for index, number in enumerate(new):  # one by one, to keep their comments
                old[index] = number
        else:
            place[key] = new
        plain[key] = parse_yaml(_flow(value))
    stream = io.StringIO()
    yaml.dump(document, stream)
    written = stream.getvalue()
    # the written values differ, for example, if another key refers to an anchor
    if _values_of(written) != wanted:
        raise ValueError("the values cannot be written into this file's layout")
    return written


def _as_null(representer: Any, nothing: None) -> Any:
    """Write null explicitly; by default ruamel leaves the value out."""
    return representer.represent_scalar("tag:yaml.org,2002:null", "null")


def _values_of(text: str) -> dict[str, Any]:
    values = parse_yaml(text)
    if not isinstance(values, dict):
        raise ValueError("has no keys and values")
    return values


def _flow(value: Value) -> str:
    """Return a value in YAML: with a decimal point and without an exponent, which would be read as
    text."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_flow, value))}]"
    if not isinstance(value, float):
        return str(value)
    whole, _, part = f"{round(value, _DECIMALS) + 0.0:.{_DECIMALS}f}".partition(".")
    return f"{whole}.{part.rstrip('0') or '0'}"
