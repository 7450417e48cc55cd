"""YAML as perchctl reads it: every key once, and no aliases of aliases.

PyYAML keeps the last of two equal keys without a word, and a few aliases of aliases stand
for millions of values.
"""

from __future__ import annotations

from typing import Any

import yaml

_MOST_SHOWN = 60


class _Loader(yaml.SafeLoader):
    """Refuses, with a ValueError, a key that stands twice, and an alias within what is anchored."""

    anchors_open = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent) and self.anchors_open:
            raise ValueError(
                f"line {line}: the alias *{event.anchor} stands within what another alias stands "
                f"for: write out the values that are meant"
            )
        is_anchored = not isinstance(event, yaml.AliasEvent) and event.anchor is not None
        self.anchors_open += is_anchored
        node = super().compose_node(parent, index)
        self.anchors_open -= is_anchored
        return node

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        first: dict[tuple[str, str], int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            name = (key.tag, str(key.value))
            if name in first:
                raise ValueError(
                    f"line {line}: key {clip_text(name[1])} is there twice, first in line "
                    f"{first[name]}: keep one"
                )
            first[name] = line
        return node


def parse_yaml(text: str) -> Any:
    """Return the value that the text holds, None for an empty one.

    Raises ValueError, with a sentence, for what is not YAML, holds a key twice or aliases of
    aliases.
    """
    try:
        return yaml.load(text, _Loader)
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
