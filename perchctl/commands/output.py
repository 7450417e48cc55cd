"""What a command prints: sentences for people on stderr, the result on stdout."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import Any


def say(sentence: str) -> None:
    """One sentence on stderr, as stdout is for the result."""
    print(f"perchctl: {sentence}", file=sys.stderr)


def print_record(record: Mapping[str, Any]) -> None:
    """The one JSON object of `--json` on stdout."""
    print(json.dumps(record))
