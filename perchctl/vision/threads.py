"""How many threads OpenCV works with."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import cv2


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Keep OpenCV to one thread meanwhile; of the whole process, since it knows no other way.

    For small patches, whose threads take more time to wake than they save, and where sums must have
    one order. A whole picture is searched faster by all threads.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
