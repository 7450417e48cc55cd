"""Where a recording lies."""

from __future__ import annotations

from pathlib import Path

SUFFIX = ".mcap"
LAYOUT_SUFFIX = ".foxglove.json"
_PACKED = ".gz"


def recording_of(path: Path | str) -> Path:
    """The recording's place, of a log's path or the recording's own."""
    path = Path(path)
    return (path.with_suffix("") if path.suffix == _PACKED else path).with_suffix(SUFFIX)
