"""Wrap messages between words for terminals."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import textwrap
from typing import TextIO

_LABEL = re.compile(r"\[[^\]]*\] |\w[\w ]{0,9}: +")
"""The time of an event, or the name of a row, with the spaces after it."""


def wrap_line(line: str, columns: int, indent: int | None = None) -> str:
    """Break a line between words. A word that is longer than a line, such as a path, stays whole,
    so that it can be copied. Continuation lines are indented by `indent` columns, by default to
    align with the text after the line's label."""
    if indent is None:
        label = _LABEL.match(line)
        indent = label.end() if label else 0
    return textwrap.fill(
        line,
        columns,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def wrap_for(stream: TextIO | None, text: str) -> str:
    """Return the text wrapped to the width of the terminal, if the stream is one; otherwise
    unchanged. Indented lines stay whole, because they contain tables or commands to copy."""
    if stream is None or not getattr(stream, "isatty", bool)():
        return text
    columns = 0
    with contextlib.suppress(OSError, AttributeError):  # a terminal in name only
        columns = os.get_terminal_size(stream.fileno()).columns
    columns = columns or shutil.get_terminal_size().columns
    return "\n".join(
        line if line[:1].isspace() else wrap_line(line, columns) for line in text.split("\n")
    )
