"""How many threads OpenCV works with."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

import cv2

_LOCK = threading.Lock()
_users = 0  # of `one_thread` at this moment
_threads = 0  # that OpenCV had before the first of them


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Context manager: OpenCV works on one thread until the last user leaves, in the whole process,
    since its setting is global.

    For small patches, whose threads take longer to wake than they save, and where sums must have
    one order. A whole picture is searched faster by all threads.
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
