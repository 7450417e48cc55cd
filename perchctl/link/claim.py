"""One program at a time for each vehicle: a lock that this user's programs on this computer share.

A second connection would do harm without a word: cflib's connect resets the log blocks of a
vehicle that flies for another program, and two streams of setpoints would pull it two ways. The
operating system holds the lock and lets it go with the process, however that ends.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
from pathlib import Path

from perchctl.camera import without_password
from perchctl.errors import ConnectionFailed
from perchctl.places import user_runtime_folder

_USUAL = ("2", "2M", "E7E7E7E7E7")  # channel, rate and address of a radio's URI that names none
_LOCKED_BYTE = 1 << 30  # beyond the text, which others read (Windows)
_TRIES = 5


class Claim:
    """A vehicle that this process has for itself, until `release` or its end."""

    def __init__(self, path: Path, fd: int) -> None:
        self._path = path
        self._fd: int | None = fd

    def release(self) -> None:
        """May be called twice."""
        fd, self._fd = self._fd, None
        if fd is not None:
            with contextlib.suppress(OSError):  # Windows removes no open file
                self._path.unlink()
            os.close(fd)


def vehicle_uri(uri: str) -> str:
    """The URI without what does not tell vehicles apart: a radio's dongle, case, options."""
    scheme, _, rest = uri.partition("?")[0].partition("://")
    scheme = scheme.lower()
    if scheme == "radio":
        given = [part for part in rest.split("/")[1:4] if part]
        channel, rate, address = (*given, *_USUAL[len(given) :])
        return f"radio/{int(channel)}/{rate.upper()}/{address.upper().zfill(len(_USUAL[2]))}"
    if scheme != "serial":  # whose place is a file, and its case tells
        rest = rest.lower()
    return f"{scheme}/{re.sub('^localhost(?=:|$)', '127.0.0.1', rest)}"


def claim(uri: str) -> Claim | None:
    """The vehicle at `uri`, for this process alone; None where no such lock can be kept (no
    folder to write to), which is no reason not to fly.

    Raises ConnectionFailed, which names the program that has it.
    """
    folder = user_runtime_folder()
    path = folder / (re.sub(r"[^A-Za-z0-9.]+", "_", vehicle_uri(uri)) + ".lock")
    for _ in range(_TRIES):
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError:
            return None
        if not _lock(fd):
            holder = _text(fd)
            os.close(fd)
            raise ConnectionFailed(_in_use(uri, holder))
        if _is_at(fd, path):
            with contextlib.suppress(OSError):  # a full disk: the lock holds all the same
                os.ftruncate(fd, 0)
                os.write(fd, _myself().encode())
            return Claim(path, fd)
        os.close(fd)  # its last holder has just removed it
    return None


def _in_use(uri: str, holder: str) -> str:
    return (
        f"the vehicle at {uri} is in use by another program ({holder or 'it gives no name'}): two "
        f"would steer it two ways; end that one, or name another vehicle"
    )


def _myself() -> str:
    name, *words = sys.argv or [""]
    name = Path(name).name
    words = ["perchctl" if name in ("", "__main__.py") else name, *map(without_password, words)]
    return f"process {os.getpid()}: {' '.join(words)}"[:200]


def _text(fd: int) -> str:
    with contextlib.suppress(OSError):
        return os.read(fd, 400).decode(errors="replace").replace("\n", " ").strip()
    return ""


def _is_at(fd: int, path: Path) -> bool:
    with contextlib.suppress(OSError):
        return os.path.samestat(os.fstat(fd), path.stat())
    return False


if sys.platform == "win32":

    def _lock(fd: int) -> bool:
        import msvcrt

        os.lseek(fd, _LOCKED_BYTE, os.SEEK_SET)
        try:
            msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        finally:
            os.lseek(fd, 0, os.SEEK_SET)
        return True
else:

    def _lock(fd: int) -> bool:
        import fcntl

        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks
            return True
        return True
