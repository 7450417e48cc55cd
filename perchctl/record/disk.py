"""Files that hold whole records only, and a thread for a disk that may hang."""

from __future__ import annotations

import errno
import os
import shutil
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

Job = Callable[[], None]


class Stream(Protocol):
    """What a recording is written to. All methods but `tell` may raise OSError."""

    def write(self, data: bytes) -> int: ...

    def tell(self) -> int: ...

    def flush(self) -> None: ...

    def free_bytes(self) -> int: ...

    def close(self) -> None: ...


class DiskFile:
    """A file that holds whole records only: a write that fails leaves nothing of itself."""

    def __init__(self, path: Path, fd: int, sync: bool) -> None:
        """`fd`: the open file of that path; `sync`: what is flushed is on the disk, not only with
        the system."""
        self._path = path
        self._fd = fd
        self._sync = sync
        self._good_bytes = 0

    @classmethod
    def new(cls, path: Path, sync: bool = True) -> DiskFile:
        """Create a file. Raises OSError, where one is there already, too."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_BINARY", 0)
        return cls(path, os.open(path, flags, 0o644), sync)

    def write(self, data: bytes) -> int:
        """Append the whole record; return its length. Raises OSError."""
        done, view = 0, memoryview(data)
        try:
            while done < len(data):
                done += os.write(self._fd, view[done:])
        except BaseException:
            if done:
                with suppress(OSError):
                    os.ftruncate(self._fd, self._good_bytes)
            raise
        self._good_bytes += done
        return done

    def tell(self) -> int:
        """Return the length of the file."""
        return self._good_bytes

    def flush(self) -> None:
        """Bring what was written to the disk, where `sync` asks for that."""
        if not self._sync:
            return
        try:
            os.fsync(self._fd)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a pipe, a special file
                raise

    def free_bytes(self) -> int:
        """Return the bytes that are left on its disk."""
        return shutil.disk_usage(self._path).free

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        fd, self._fd = self._fd, -1  # the number may be another file's by the second time
        if fd >= 0:
            os.close(fd)


class BackgroundWriter:
    """Does jobs in their order: at once, or `live` by a thread of its own, out of a bounded queue.

    What a job raises is dropped: it has to remember itself what failed."""

    def __init__(self, most: int, name: str, live: bool) -> None:
        """Begin with room for `most` jobs; `name` is the thread's."""
        self._most = most
        self._jobs: deque[Job] = deque()
        self._changed = threading.Condition()
        self._last = False
        self._thread: threading.Thread | None = None
        if live:
            self._thread = threading.Thread(target=self._run, name=name, daemon=True)
            self._thread.start()

    def put(self, job: Job, share: float = 1.0) -> bool:
        """Hand over a job; False when that share of the queue is full, and the job is not done. A
        share of infinity is never full."""
        if self._thread is None:
            _do(job)
            return True
        with self._changed:
            if len(self._jobs) >= share * self._most or self._last:
                return False
            self._jobs.append(job)
            self._changed.notify()
        return True

    def finish(self, job: Job, timeout_s: float, late: Job) -> int:
        """Hand over a last job and wait for it. Return how many jobs were not done by then; 0 is
        all done.

        `late` is done instead of them should the thread ever get on: it frees what they held."""
        if self._thread is None:
            _do(job)
            return 0
        with self._changed:
            self._jobs.append(job)
            self._last = True
            self._changed.notify()
        self._thread.join(timeout_s)
        with self._changed:
            alive = self._thread.is_alive()
            left = len(self._jobs) + int(alive)
            self._jobs.clear()  # what comes too late is not done at all
            if alive:
                self._jobs.append(late)
        return left

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._jobs:
                    if self._last:
                        return
                    self._changed.wait()
                job = self._jobs.popleft()
            _do(job)


def _do(job: Job) -> None:
    with suppress(Exception):  # the next one is done all the same
        job()
