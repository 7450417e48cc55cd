"""The one way to write a whole file.

A file is written under a temporary name beside its place, brought to the disk, and renamed:
a reader finds the old file or the new one, never a part of one. Logs and sessions, which grow
line by line, are not written this way.

One rule for what a command writes: an existing file is replaced with ``--force`` only, which is
asked before any long work; folders that are missing are made.
"""

from __future__ import annotations

import os
import secrets
import stat
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from perchctl.errors import InvalidValue

FORMAT = "the format that is written"


def check_output(path: Path, suffixes: Sequence[str], force: bool, content: str = FORMAT) -> None:
    """As `check_place`, and the name must end in one of `suffixes` (the case does not matter),
    which the message says is `content`. Raises InvalidValue."""
    if path.suffix.lower() not in suffixes:
        raise InvalidValue(f"{path} must end in {' or '.join(suffixes)}, which is {content}")
    check_place(path, force)


def check_place(path: Path, force: bool) -> None:
    """Whether a file can be put there; to be called before any long work.

    Args:
        force: an existing file may be replaced.

    Raises:
        InvalidValue: the path is a folder, a file that must not be replaced, or where no file
        and no folder can be made.
    """
    # Of os.path, which takes a folder without rights for one that holds nothing.
    if os.path.isdir(path):
        raise InvalidValue(f"{path} is a folder: name a file in it")
    if os.path.exists(path) and not force:
        raise InvalidValue(f"{path} exists already; add --force to replace it, or name another")
    folder = next(folder for folder in path.absolute().parents if os.path.exists(folder))
    if not os.path.isdir(folder):
        raise InvalidValue(f"{path} cannot be written: {folder} is a file, not a folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InvalidValue(f"{path} cannot be written: no right to write in {folder}")


def same_file(one: Path, other: Path) -> bool:
    """Whether both exist and are one and the same."""
    return one.exists() and other.exists() and one.samefile(other)


def cannot_be_written(
    path: Path, error: OSError, more: str = ": free some space, or choose another place"
) -> InvalidValue:
    """The operating system's refusal as one sentence."""
    return InvalidValue(f"{path} cannot be written: {error.strerror or error}{more}")


class PartFile:
    """A file under a temporary name, until it is whole; its folder is made.

    `part` is the path to write to. It has the suffix of `path`, by which some libraries
    choose the format. A file that is replaced keeps its permissions; a new one gets `mode`,
    by default the system's. All methods raise OSError.
    """

    def __init__(self, path: Path, mode: int | None = None) -> None:
        self.path = path
        self._mode = mode_of(path) if path.exists() else mode
        self.part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
        self._made = [folder for folder in path.parents if not folder.exists()]
        path.parent.mkdir(parents=True, exist_ok=True)

    def write(self, data: bytes) -> None:
        """The whole content at once."""
        # Until it is whole nobody else reads what may not be for them.
        mode = 0o666 if self._mode is None else 0o600
        with open(self.part, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as stream:
            stream.write(data)
        self.sync()

    def sync(self) -> None:
        """Bring what was written to the disk."""
        with self.part.open("r+b") as stream:
            os.fsync(stream.fileno())

    def keep(self) -> None:
        """Put the file in its place."""
        if self._mode is not None:
            with suppress(OSError):  # some file systems have none to set
                self.part.chmod(self._mode)
        os.replace(self.part, self.path)
        self._made.clear()

    def drop(self) -> None:
        """Remove the temporary file, if there is one, and the folders that were made for it."""
        self.part.unlink(missing_ok=True)
        with suppress(OSError):  # something else was put into one
            for folder in self._made:
                folder.rmdir()


def mode_of(path: Path) -> int:
    """A file's permissions. Raises OSError."""
    return stat.S_IMODE(path.stat().st_mode)


def write_files(files: Mapping[Path, bytes], mode: int | None = None) -> None:
    """Write all files, or none: the first is renamed when the last is on the disk.

    Args:
        mode: permissions of those that are new, by default the system's; one that is replaced
            keeps its own.

    Raises:
        InvalidValue: a path is a folder; or a full disk, or missing rights.
    """
    for path in files:
        check_place(path, force=True)
    parts: list[PartFile] = []
    path = Path()
    try:
        with ExitStack() as undo:
            for path, data in files.items():
                parts.append(PartFile(path, mode))
                undo.callback(parts[-1].drop)
                parts[-1].write(data)
            for part in parts:
                path = part.path
                part.keep()
            undo.pop_all()
    except OSError as error:
        more = "; nothing was written: free some space, or choose another place"
        raise cannot_be_written(path, error, more) from None
