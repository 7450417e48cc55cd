"""The one way to write a whole file.

A file is written under a temporary name beside its place, brought to the disk, and renamed:
a reader finds the old file or the new one, never a part of one. Logs and sessions, which grow
line by line, are not written this way.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from itertools import count
from pathlib import Path

from perchctl.errors import InvalidValue, NotFound


def check_place(path: Path, *, replace: bool = True, make_folders: bool = False) -> None:
    """Whether a file can be put there; to be called before any long work.

    Args:
        replace: an existing file may be replaced.
        make_folders: folders that are missing will be made.

    Raises:
        NotFound: the folder is missing. InvalidValue: the path is a folder, or a file that
        must not be replaced.
    """
    if path.is_dir():
        raise InvalidValue(f"{path} is a folder: name a file in it")
    if path.exists() and not replace:
        raise InvalidValue(f"{path} exists already; add --force to replace it, or name another")
    if not (make_folders or path.parent.is_dir()):
        raise NotFound(
            f"folder {path.parent} for {path.name} does not exist: make it, or name another"
        )


def same_file(one: Path, other: Path) -> bool:
    """Whether both exist and are one and the same."""
    return one.exists() and other.exists() and one.samefile(other)


def cannot_be_written(path: Path, error: OSError, more: str = "") -> InvalidValue:
    """The operating system's refusal as one sentence."""
    return InvalidValue(f"{path} cannot be written: {error.strerror or error}{more}")


class PartFile:
    """A file under a temporary name, until it is whole.

    `part` is the path to write to. It has the suffix of `path`, by which some libraries
    choose the format. All methods raise OSError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")

    def write(self, data: bytes) -> None:
        """The whole content at once."""
        with self.part.open("xb") as stream:
            stream.write(data)
        self.sync()

    def sync(self) -> None:
        """Bring what was written to the disk."""
        with self.part.open("r+b") as stream:
            os.fsync(stream.fileno())

    def keep(self) -> None:
        """Put the file in its place."""
        os.replace(self.part, self.path)

    def drop(self) -> None:
        """Remove the temporary file, if there is one."""
        self.part.unlink(missing_ok=True)


def write_files(
    files: Mapping[Path, bytes], *, make_folders: bool = False, keep_old: bool = False
) -> dict[Path, Path]:
    """Write all files, or none: the first is renamed when the last is on the disk.

    Args:
        make_folders: make folders that are missing; those of a failure are removed again.
        keep_old: copy each existing file to a new name, as in ``weights.yaml.bak1``.

    Returns:
        The copies, by the path of the file that they were made of.

    Raises:
        NotFound, InvalidValue: as `check_place`; or a full disk, or missing rights.
    """
    for path in files:
        check_place(path, make_folders=make_folders)
    copies: dict[Path, Path] = {}
    parts: list[PartFile] = []
    path = Path()
    try:
        with ExitStack() as undo:
            for path, data in files.items():
                if make_folders:
                    _make_folder(path.parent, undo)
                parts.append(PartFile(path))
                undo.callback(parts[-1].drop)
                parts[-1].write(data)
            for path in files:
                if keep_old and path.exists():
                    copies[path] = _copy(path)
                    undo.callback(copies[path].unlink)
            for part in parts:
                path = part.path
                part.keep()
            undo.pop_all()
    except OSError as error:
        more = "; nothing was changed: free some space, or choose another place"
        raise cannot_be_written(path, error, more) from None
    return copies


def _make_folder(folder: Path, undo: ExitStack) -> None:
    if not folder.exists():
        _make_folder(folder.parent, undo)
        folder.mkdir()
        undo.callback(_remove_folder, folder)


def _remove_folder(folder: Path) -> None:
    with suppress(OSError):  # something else was put into it
        folder.rmdir()


def _copy(path: Path) -> Path:
    """A copy under the next name that is free."""
    for number in count(1):
        copy = path.with_name(f"{path.name}.bak{number}")
        with suppress(FileExistsError), copy.open("xb") as stream:
            stream.write(path.read_bytes())
            return copy
    raise AssertionError("unreachable")
