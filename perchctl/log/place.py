"""Where a flight's files lie: the log, and what is beside it by its name."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

from perchctl.errors import InvalidValue

PACKED = ".gz"
_ELSEWHERE = "name another folder with --log-dir, or in the profile (log.directory)"


def path_beside(log: Path | str, suffix: str) -> Path:
    """The file of a log's name with another ending, such as ``.png``; of a packed log, too."""
    path = Path(log)
    whole = path.with_suffix("") if path.suffix == PACKED else path
    return whole.with_name(whole.stem + suffix)


def log_path(directory: Path, profile_name: str, started: datetime) -> Path:
    """``flight_<UTC yyyymmdd_hhmmss>_<profile>.jsonl`` in the directory.

    (A flight in lockstep is named ``flight_seed<seed>.jsonl`` by the campaign.)
    """
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", profile_name).strip("-.") or "profile"
    return directory / f"flight_{started.astimezone(UTC):%Y%m%d_%H%M%S}_{safe[:60]}.jsonl"


def make_log_folder(directory: Path) -> None:
    """Where it is missing. Errors: InvalidValue."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = "it is a file" if directory.is_file() else error.strerror or str(error)
        raise InvalidValue(f"{directory} cannot hold flight logs ({why}): {_ELSEWHERE}") from None


def new_file(path: Path, none_beside: tuple[str, ...] = ()) -> tuple[Path, int]:
    """A file that did not exist before, open, by `path`'s name or the next free one; `none_beside`:
    suffixes of files of the same name that must not be there, either. Raises OSError."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_BINARY", 0)
    for number in count(1):
        free = path if number == 1 else path.with_stem(f"{path.stem}_{number}")
        if any(path_beside(free, suffix).exists() for suffix in none_beside):
            continue
        with suppress(FileExistsError):
            return free, os.open(free, flags, 0o644)
    raise AssertionError("unreachable")


def cannot_start(path: Path, error: OSError) -> str:
    return (
        f"{path}: the flight log cannot be created ({error.strerror or error}): free the place, "
        f"or {_ELSEWHERE}"
    )


# --- Where a recording lies --------------------------------------------------------------------


SUFFIX = ".mcap"
LAYOUT_SUFFIX = ".foxglove.json"


def recording_path(path: Path | str) -> Path:
    """The recording's place, of a log's path or the recording's own."""
    return path_beside(path, SUFFIX)
