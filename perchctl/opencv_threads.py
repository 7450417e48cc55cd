"""The number of threads that OpenCV uses."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

import cv2

_LOCK = threading.Lock()
_users = 0  # number of current users of `one_thread`
_threads = 0  # number of OpenCV's threads before the first user


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Limit OpenCV to one thread during the block; if several such blocks overlap, until the last
    of them ends. The limit applies to the whole process, because OpenCV's setting is global.

    Use it for small patches, where waking threads costs more than it saves, and where sums need a
    fixed order. Searching a whole image is faster with all threads.
    """
    global _users, _threads
    with _LOCK:
        if _users == 0:
            _threads = cv2.getNumThreads()
            cv2.setNumThreads(1)
        _users += 1
    try:
        yield
    finally:
        with _LOCK:
            _users -= 1
            if _users == 0:
                cv2.setNumThreads(_threads)
