"""YAML as perchctl reads it: every key once, and no aliases that unfold beyond all bounds.

PyYAML keeps the last of two equal keys without a word, and a few aliases of aliases stand
for millions of values.
"""

from __future__ import annotations

from typing import Any

import yaml

MOST_VALUES = 20_000
"""Keys and values of a file, each alias counted as what it stands for."""
_MOST_SHOWN = 60


def parse_yaml(text: str) -> Any:
    """Return the value that the text holds, None for an empty one.

    Raises ValueError, with a sentence, for what is not YAML, holds a key twice or unfolds
    to more than `MOST_VALUES`.
    """
    try:
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _count(node, {})
        return loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise ValueError(f"line {line}: not YAML: {clip_text(str(error.problem))}") from None
    except yaml.YAMLError as error:
        raise ValueError(f"not a text file in YAML ({error.__class__.__name__})") from None
    except RecursionError:
        raise ValueError("values are nested too deeply to be read") from None
    except (ValueError, OverflowError) as error:
        raise ValueError(clip_text(str(error), 200)) from None


def split_values(text: str) -> list[str]:
    """Return the texts of values that commas stand between, as in a list: a value may be a list
    itself. Raises ValueError as `parse_yaml` does."""
    row = f"[{text}]"
    parse_yaml(row)
    node = yaml.compose(row, yaml.SafeLoader)
    assert isinstance(node, yaml.SequenceNode)
    return [row[part.start_mark.index : part.end_mark.index].strip() for part in node.value]


def clip_text(text: str, most: int = _MOST_SHOWN) -> str:
    """Return the text, or its beginning if it is longer than anybody reads."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def _count(node: yaml.Node, counts: dict[int, int]) -> int:
    """Return the number of keys and values below a node. Raises ValueError for too many, and for a
    key twice."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if (known := counts.get(id(node))) is not None:
        if known == 0:
            raise ValueError(f"line {_line(node)}: an alias stands within what it stands for")
        return known
    counts[id(node)] = 0
    if isinstance(node, yaml.MappingNode):
        _refuse_twice(node)
        parts = [part for pair in node.value for part in pair]
    else:
        parts = node.value
    total = 1
    for part in parts:
        total += _count(part, counts)
        if total > MOST_VALUES:
            raise ValueError(
                f"line {_line(part)}: more than {MOST_VALUES} values, aliases (*name) unfolded: "
                f"write out the few that are meant"
            )
    counts[id(node)] = total
    return total


def _refuse_twice(node: yaml.MappingNode) -> None:
    first: dict[tuple[str, str], int] = {}
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode):
            continue
        name = (key.tag, key.value)
        if name in first:
            raise ValueError(
                f"line {_line(key)}: key {clip_text(key.value)} is there twice, first in line "
                f"{first[name]}: keep one"
            )
        first[name] = _line(key)


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1
