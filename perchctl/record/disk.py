"""Files that contain only complete records, and a thread for writing to a disk that may stall."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import SimpleQueue
from typing import TypeVar

Job = Callable[[], object]
T = TypeVar("T")


class DiskFile:
    """A file that contains only complete records: a failed write leaves no partial record."""

    def __init__(self, path: Path, sync: bool = True) -> None:
        """Create the file. With `sync`, flushing writes the data to the disk instead of only
        passing it to the operating system. Raises OSError, FileExistsError if the file exists."""
        self._path = path
        self._sync = sync
        self._good_bytes = 0
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)

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
        """Return the length of the file, bytes."""
        return self._good_bytes

    def flush(self) -> None:
        """Flush to the disk (fsync), if `sync` was set. Raises OSError."""
        if self._sync:
            os.fsync(self._fd)

    def free_bytes(self) -> int:
        """The free space on the file's disk. Raises OSError."""
        return shutil.disk_usage(self._path).free

    def close(self) -> None:
        """Close the file; a second call does nothing. Raises OSError."""
        fd, self._fd = (
            self._fd,
            -1,
        )  # before a second call, the descriptor may have been reused for another file
        if fd >= 0:
            os.close(fd)


def create_file(path: Path, sync: bool, build: Callable[[DiskFile], T]) -> T:
    """Create a file and return the object that `build` makes from it. If `build` raises an
    exception, delete the file. Raises OSError as `DiskFile` does."""
    file = DiskFile(path, sync)
    try:
        return build(file)
    except BaseException:
        file.close()
        path.unlink(missing_ok=True)
        raise


class BackgroundWriter:
    """Runs jobs in order: at once or, if `live`, in a thread that takes them from a bounded queue.

    Exceptions raised by a job are ignored; the job itself must record failures.

    Attributes:
        refused_jobs: number of jobs refused because the queue was full.
    """

    def __init__(self, most: int, name: str, live: bool) -> None:
        """Start with a queue for jobs whose weights (see `put`) add up to at most `most`. `name` is
        the name of the thread."""
        self.refused_jobs = 0
        self._most = most
        self._jobs: SimpleQueue[tuple[Job, int] | None] = SimpleQueue()
        self._counting = threading.Lock()
        self._weight = self._left = 0
        self._thread: threading.Thread | None = None
        if live:
            self._thread = threading.Thread(target=self._run, name=name, daemon=True)
            self._thread.start()

    def put(self, job: Job, weight: int = 1) -> bool:
        """Queue a job of the given `weight`. Returns False if the queue has no room for it."""
        if self._thread is None:
            _do(job)
            return True
        with self._counting:
            if self._weight + weight > self._most:
                self.refused_jobs += 1
                return False
            self._weight += weight
            self._left += 1
        self._jobs.put((job, weight))
        return True

    def finish(self, job: Job, timeout_s: float) -> int:
        """Queue the last job, wait at most `timeout_s`, and return the number of jobs not done."""
        if self._thread is None:
            _do(job)
            return 0
        with self._counting:
            self._left += 1
        self._jobs.put((job, 0))
        self._jobs.put(None)
        self._thread.join(timeout_s)
        return self._left

    def _run(self) -> None:
        while (entry := self._jobs.get()) is not None:
            job, weight = entry
            _do(job)
            with self._counting:
                self._weight -= weight
                self._left -= 1


def _do(job: Job) -> None:
    with suppress(Exception):  # continue with the next job
        job()
