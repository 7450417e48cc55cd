"""Where a recording lies."""

from __future__ import annotations

from pathlib import Path

from perchctl.log.place import path_beside

SUFFIX = ".mcap"
LAYOUT_SUFFIX = ".foxglove.json"


def recording_path(path: Path | str) -> Path:
    """The recording's place, of a log's path or the recording's own."""
    return path_beside(path, SUFFIX)
