"""Where a recording lies."""

from __future__ import annotations

from pathlib import Path

from perchctl.log.place import beside

SUFFIX = ".mcap"
LAYOUT_SUFFIX = ".foxglove.json"


def recording_of(path: Path | str) -> Path:
    """The recording's place, of a log's path or the recording's own."""
    return beside(path, SUFFIX)
