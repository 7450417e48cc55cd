"""Write files atomically, and recognise files by their content.

A file is written under a temporary name next to its destination, synced to disk and renamed, so
that a reader finds either the old file or the new one, never a part of it.

One rule applies to all output of commands: an existing file is only replaced with ``--force``,
which is checked before any long work, and missing folders are created.
"""

from __future__ import annotations

import os
import re
import secrets
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

from perchctl.errors import InvalidValue

FORMAT = "the output file"
RECORDING, ROS_BAG = "a recording", "a ROS bag"
SQLITE = "an SQLite database, as in a ROS bag"
_BEGINNINGS = (
    (b"\x89PNG", "a picture"),
    (b"\xff\xd8\xff", "a picture"),
    (b"%PDF", "a PDF"),
    (b"#ROSBAG V", ROS_BAG),
    (b"SQLite format 3\0", SQLITE),
    (b'{"kind":"header","format":"perchctl-flight-log"', "a flight log"),
    (b'{"part":', "a recording from calibrate mount"),
)
_MCAP = b"\x89MCAP0\r\n"
_MCAP_PROFILE = slice(21, 25)
"""The profile's name in an MCAP file's header, after the magic bytes (8), the record's type (1) and
length (8), and the length of the name (4)."""
_BAG_METADATA = "metadata.yaml"
_KEYS = (  # keys at the beginning of a line, by which a YAML file is recognised
    (r"rosbag2_bagfile_information", ROS_BAG),
    (r"image_width|camera_matrix|distortion_model|cam0", "a camera calibration"),
    (r"vehicles", "a fleet file"),
    (r"extends|vehicle|planner|safety|positioning", "a profile"),
)
_JSON_BEGINNING = r'\s*(\{\s*("|\})|\[\s*["{\[\]\d-])'
_READ_BYTES = 4096
_UNKNOWN = "another kind of file"


def file_kind(path: Path) -> str:
    """Return what kind of file this seems to be, such as ``a picture``; ``another kind of file`` if
    unknown. A folder is only recognised if it is a ROS 2 bag, by its ``metadata.yaml``.

    For messages about a file of the wrong kind; never raises.
    """
    with suppress(OSError, ValueError):
        if path.is_dir():
            is_bag = file_kind(path / _BAG_METADATA) == ROS_BAG
            return ROS_BAG if is_bag else _UNKNOWN
        if not path.is_file():  # reading a pipe would take its data away
            return _UNKNOWN
        with path.open("rb") as stream:
            head = stream.read(_READ_BYTES)
        for beginning, kind in _BEGINNINGS:
            if head.startswith(beginning):
                return kind
        if head.startswith(_MCAP):
            return ROS_BAG if head[_MCAP_PROFILE] in (b"ros1", b"ros2") else RECORDING
        if head[4:8] == b"ftyp":
            return "a video"
        text = head.decode("utf-8", errors="ignore")
        for keys, kind in _KEYS:
            if re.search(rf"^(?:{keys})\s*:", text, re.MULTILINE):
                return kind
        if re.match(_JSON_BEGINNING, text):
            return "a JSON file"
    return _UNKNOWN


def kind_note(path: Path, *expected: str) -> str:
    """Return what kind of file this is, to append to a message: `` (it is a flight log)``; empty if
    the kind is unknown or one of the `expected` kinds. Never raises an exception."""
    kind = file_kind(path)
    return "" if kind in (*expected, _UNKNOWN) else f" (it is {kind})"


def check_output(
    path: Path,
    suffixes: Sequence[str],
    force: bool,
    content: str = FORMAT,
    *,
    makes_folder: bool = False,
) -> None:
    """Raise InvalidValue if the name ends in none of the `suffixes` (in upper or lower case), or if
    the file cannot be written (`check_writable`). `content` is what the message calls such a file,
    for example "a plot"."""
    if path.suffix.lower() not in suffixes:
        raise InvalidValue(
            f"the name of {content} must end in {' or '.join(suffixes)}, found {path}"
        )
    check_writable(path, force, makes_folder=makes_folder)


def check_writable(path: Path, force: bool, *, makes_folder: bool = True) -> None:
    """Check that `path` can be written; to be called before any long work.

    Args:
        force: an existing file may be replaced.
        makes_folder: the folder of the file may be created; False for a path typed by the user, in
            which a missing folder is usually a typing error.

    Raises:
        InvalidValue: the path is a folder, a file that must not be replaced, or a place where
        no file or folder can be made.
    """
    # os.path treats a folder without permissions as empty; Path may raise PermissionError.
    if os.path.isdir(path):
        raise InvalidValue(f"{path} is a folder: name a file in it")
    if os.path.exists(path) and not force:
        raise InvalidValue(
            f"{path} already exists; add --force to replace it, or name another file"
        )
    folder = next(folder for folder in path.absolute().parents if os.path.exists(folder))
    if not os.path.isdir(folder):
        raise InvalidValue(f"{path} cannot be written: {folder} is a file, not a folder")
    if folder != path.absolute().parent and not makes_folder:
        raise InvalidValue(
            f"{path} cannot be written: folder {path.parent} does not exist; create it, or "
            "name another folder"
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InvalidValue(f"{path} cannot be written: no permission to write in {folder}")


def same_file(path: Path, other: Path) -> bool:
    """True if both paths exist and lead to the same file."""
    return path.exists() and other.exists() and path.samefile(other)


def write_error(
    path: Path, error: OSError, more: str = ": free some space, or choose another place"
) -> InvalidValue:
    """Convert an error of the operating system to one with a single sentence that ends with
    `more`."""
    return InvalidValue(f"{path} cannot be written: {error.strerror or error}{more}")


@contextmanager
def atomic_write(path: Path, mode: int | None = None) -> Iterator[Path]:
    """Yield a temporary path for the block to write a file to.

    When the block ends, the file is synced to disk and moved to its destination; after an error, no
    file is left.

    The temporary path has the suffix of `path`, because some libraries choose the format by the
    suffix. The folder is created if necessary. A file that is replaced keeps its permissions; a new
    file gets the permissions `mode`, by default the system's. Raises InvalidValue if the system
    refuses one of these steps.
    """
    part = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    made = [folder for folder in path.parents if not folder.exists()]
    try:
        with _refusals_of(path):
            mode = file_mode(path) if path.exists() else mode
            path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        with _refusals_of(path):
            with part.open("r+b") as stream:
                os.fsync(stream.fileno())
            if mode is not None:
                with suppress(OSError):  # some file systems have no permissions
                    part.chmod(mode)
            os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        with suppress(OSError):  # another file was put into the folder meanwhile
            for folder in made:
                folder.rmdir()
        raise


@contextmanager
def _refusals_of(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise write_error(path, error) from None


def file_mode(path: Path) -> int:
    """A file's permissions. Raises OSError."""
    return stat.S_IMODE(path.stat().st_mode)


def write_files(files: Mapping[Path, bytes], mode: int | None = None) -> None:
    """Write all files or none: no file is renamed to its final name before the last one is written.

    Args:
        mode: permissions of new files, by default the system's; a replaced file keeps its own.

    Raises:
        InvalidValue: a path is a folder, the disk is full, or permissions are missing.
    """
    for path in files:
        check_writable(path, force=True)
    with ExitStack() as stack:
        for path, data in files.items():
            # While the file is incomplete, other users must not read it.
            at_first = 0o666 if mode is None and not path.exists() else 0o600
            part = stack.enter_context(atomic_write(path, mode))
            opener = partial(os.open, mode=at_first)
            with _refusals_of(path), open(part, "xb", opener=opener) as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
