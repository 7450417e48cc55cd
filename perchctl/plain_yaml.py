"""Read YAML as plain values. Duplicate keys are an error (PyYAML would silently use the last
one)."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import yaml

_MOST_SHOWN = 60
_DEEPEST_SHOWN = 4
_MOST_DECIMAL_BITS = 14_000
"""Size above which an integer is shown in hexadecimal digits. Larger: Python refuses to write more
than 4300 decimal digits."""


class _Loader(yaml.SafeLoader):
    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        first: dict[tuple[str, str], int] = {}
        for key, _ in node.value:
            line = int(key.start_mark.line) + 1
            if isinstance(key, yaml.ScalarNode) and (key.tag, key.value) in first:
                raise ValueError(
                    f"line {line}: key {clip_text(key.value)} appears twice, first on line "
                    f"{first[key.tag, key.value]}: keep only one"
                )
            if isinstance(key, yaml.ScalarNode):
                first[key.tag, key.value] = line
        return super().construct_mapping(node, deep)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (ValueError, LookupError, AttributeError) as error:
            # PyYAML does not check scalars before it converts them: a date without a month, `!!bool
            # 7`.
            if not isinstance(node, yaml.ScalarNode):
                raise
            kind = node.tag.rpartition(":")[2]
            why = f": {error}" if kind == "timestamp" and isinstance(error, ValueError) else ""
            line = node.start_mark.line + 1
            raise ValueError(
                f"line {line}: {clip_text(node.value)!r} is not a valid {kind}{why}"
            ) from None


def parse_yaml(text: str) -> Any:
    """Return the value in the text; None for an empty text.

    Raises ValueError with a sentence if the text is not YAML or contains a duplicate key.
    """
    with _errors_in_one_sentence():
        return yaml.load(text, _Loader)


def parse_documents(text: str) -> list[Any]:
    """Return the values of all documents in the text, which are separated by ``---``. Empty
    documents are left out. Raises ValueError as `parse_yaml` does."""
    with _errors_in_one_sentence():
        return [value for value in yaml.load_all(text, _Loader) if value is not None]


@contextmanager
def _errors_in_one_sentence() -> Iterator[None]:
    """Turn the library's errors into a ValueError with one sentence."""
    try:
        yield
    except yaml.constructor.ConstructorError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise ValueError(
            f"line {line}: only plain numbers, strings, lists and mappings are supported "
            f"({clip_text(str(error.problem))})"
        ) from None
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise ValueError(f"line {line}: not YAML: {clip_text(str(error.problem))}") from None
    except yaml.YAMLError as error:
        raise ValueError(f"not a YAML text file ({error.__class__.__name__})") from None
    except RecursionError:
        raise ValueError("values are nested too deeply") from None
    except OverflowError as error:
        raise ValueError(str(error)) from None


def split_values(text: str) -> list[str]:
    """Split a comma-separated list into the texts of its values. A value may itself be a list.
    Raises ValueError as `parse_yaml` does."""
    row = f"[{text}]"
    parse_yaml(row)
    node = yaml.compose(row, yaml.SafeLoader)
    assert isinstance(node, yaml.SequenceNode)
    return [row[part.start_mark.index : part.end_mark.index].strip() for part in node.value]


def clip_text(text: str, max_length: int = _MOST_SHOWN) -> str:
    """Return the text, truncated to `max_length` characters and then ending in ``...``."""
    return text if len(text) <= max_length else f"{text[: max_length - 3]}..."


def value_text(value: Any) -> str:
    """Return a value that was read from YAML, in the words of YAML rather than Python, truncated
    for a message."""
    return clip_text(_flow_text(value))


def _flow_text(value: Any, depth: int = 0) -> str:
    """Return the value as YAML on one line, in full only as far as `clip_text` shows it: by its
    aliases, a short file can contain a list that is very long, or that contains itself."""
    match value:
        case None:
            return "nothing"
        case bool():
            return str(value).lower()
        case int() if value.bit_length() > _MOST_DECIMAL_BITS:
            return hex(value)
        case list() | tuple() | dict() if depth == _DEEPEST_SHOWN:
            return "..."
        case list() | tuple():
            return f"[{_joined(_flow_text(each, depth + 1) for each in value)}]"
        case dict():
            pairs = (
                f"{name if isinstance(name, str) else _flow_text(name, depth + 1)}: "
                f"{_flow_text(each, depth + 1)}"
                for name, each in value.items()
            )
            return f"{{{_joined(pairs)}}}"
        case datetime.date():
            return str(value)
    return repr(value)


def _joined(texts: Iterable[str]) -> str:
    """Return the texts with commas between them, as many as a message shows."""
    shown, length = list[str](), 0
    for text in texts:
        if length > _MOST_SHOWN:
            shown.append("...")
            break
        shown.append(text)
        length += len(text) + 2
    return ", ".join(shown)
