"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from perchctl.errors import InvalidValue, NotFound


def check_writable(path: Path) -> None:
    """Raises NotFound without the folder, InvalidValue where the path is a folder."""
    if not path.parent.is_dir():
        raise NotFound(f"folder {path.parent} does not exist: make it, or name another with -o")
    if path.is_dir():
        raise InvalidValue(f"{path} is a folder: name a file")


def write_whole(files: Mapping[Path, bytes]) -> None:
    """Every file under a temporary name first, then all renamed; nothing is left behind
    where one cannot be written. Raises NotFound, InvalidValue."""
    for path in files:
        check_writable(path)
    parts = {path: path.with_name(f".{path.name}.{os.getpid()}.part") for path in files}
    try:
        for path, data in files.items():
            parts[path].write_bytes(data)
        for path, part in parts.items():
            part.replace(path)
    except OSError as error:
        raise InvalidValue(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        for part in parts.values():
            part.unlink(missing_ok=True)
